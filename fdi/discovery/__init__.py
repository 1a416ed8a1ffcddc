"""Which physics is missing: replay, noise, fits, search, verdict."""
from fdi.discovery.explain import Explanation, explain

__all__ = ["Explanation", "explain"]
