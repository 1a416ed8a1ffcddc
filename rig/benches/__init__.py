"""Benches: which device is under test, how it talks, and what its numbers mean; the shipped ones as files."""

from lazy_loader import attach_stub

__getattr__, __dir__, _ = attach_stub(__name__, __file__)
