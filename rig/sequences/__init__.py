"""Test sequences: the shipped ones as TOML, and what reads them, injects their faults and judges their checks."""

from lazy_loader import attach_stub

__getattr__, __dir__, _ = attach_stub(__name__, __file__)
__all__ = ["Sequence", "load_sequence"]
