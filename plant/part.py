"""Pieces of a longer recording, one after the other."""
from __future__ import annotations

from typing import NamedTuple


class Part(NamedTuple):
    """Rows first..stop-1 that were `later` rows further on when they were recorded."""

    first: int
    stop: int
    later: int
