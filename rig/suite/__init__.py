"""A suite: many runs, one report with traceability of requirements, JUnit XML for build servers."""
