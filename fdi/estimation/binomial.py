"""How sure a count is: shares with their exact intervals."""
from __future__ import annotations

import math
from typing import NamedTuple

CONFIDENCE = 0.95


class Share(NamedTuple):
    """So many of so many, with the exact 95 % interval of the probability behind."""

    good: int
    of: int
    low: float
    high: float

    @property
    def value(self) -> float:
        """Good ones of all; NaN where there was none."""
        return self.good / self.of if self.of else math.nan


def share(good: int, of: int) -> Share:
    """A count with its exact binomial interval (Clopper and Pearson 1934); 0 to 1 where nothing was counted."""
    from scipy.special import betaincinv

    tail = (1.0 - CONFIDENCE) / 2
    low = float(betaincinv(good, of - good + 1, tail)) if good > 0 else 0.0
    high = float(betaincinv(good + 1, of - good, 1.0 - tail)) if good < of else 1.0
    return Share(good, of, low, high)
