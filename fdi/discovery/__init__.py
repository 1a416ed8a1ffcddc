"""Which physics is missing: replay, noise, fits, search, verdict."""
from fdi.discovery.explain import Explanation, explain
from fdi.trace.record import record

__all__ = ["Explanation", "explain", "record"]
