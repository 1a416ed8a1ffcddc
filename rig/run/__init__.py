"""One run of a test sequence: job, session, loop, runner, timing rights and the outcome."""
