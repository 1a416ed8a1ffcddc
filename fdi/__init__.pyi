"""The names of the Python interface (docs/python.md), imported at their first use: numba takes long to load."""

from .analysis import (
    add_effect as add_effect,
    compare as compare,
    diagnose as diagnose,
    explain as explain,
    identify as identify,
    read_trace as read_trace,
)
from .trace.trace import Trace as Trace
