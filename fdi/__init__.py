"""Offline analysis of traces: compare, explain, add an effect, identify, diagnose (docs/python.md). No CAN."""

from lazy_loader import attach_stub

import plant  # noqa: F401  selects the kernels of linear algebra before anything imports NumPy

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
