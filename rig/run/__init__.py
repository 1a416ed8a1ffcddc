"""One run of a test sequence: job, session, loop, runner, timing rights and the outcome."""

from lazy_loader import attach_stub

__getattr__, __dir__, _ = attach_stub(__name__, __file__)
