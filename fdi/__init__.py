"""Offline analysis of traces: compare, explain, add an effect, identify, diagnose (docs/python.md). No CAN."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import plant  # noqa: F401  selects the kernels of linear algebra before anything imports NumPy

if TYPE_CHECKING:
    from fdi.analysis import add_effect, compare, diagnose, explain, identify, read_trace
    from fdi.trace.trace import Trace

__all__ = ["Trace", "add_effect", "compare", "diagnose", "explain", "identify", "read_trace"]

# Imported at first use: the plant behind the analysis loads numba, which takes longer than `rig --help` may.
_MODULE_OF = {"Trace": "fdi.trace.trace"} | {name: "fdi.analysis" for name in __all__ if name != "Trace"}


def __getattr__(name: str) -> Any:
    """Import a public name at its first use (PEP 562)."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULE_OF[name]), name)
    return value
