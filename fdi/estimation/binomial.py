"""Shares: counted successes with the exact interval of their probability."""

import math
from typing import NamedTuple


class Share(NamedTuple):
    """`good` of `of`, with the exact 95 % interval of the underlying probability."""

    good: int
    of: int
    low: float
    high: float

    @property
    def value(self) -> float:
        """The share itself; NaN if nothing was counted."""
        return self.good / self.of if self.of else math.nan


def measure_share(good: int, of: int) -> Share:
    """The share of `good` among `of`, with its exact 95 % interval."""
    return Share(good, of, *clopper_pearson_interval(good, of))


def clopper_pearson_interval(good: int, of: int, confidence: float = 0.95) -> tuple[float, float]:
    """The exact interval of a binomial probability after `good` successes in `of` trials; 0 to 1 without trials.

    C. J. Clopper, E. S. Pearson, "The use of confidence or fiducial limits illustrated in the case of the binomial",
    Biometrika 26 (1934) 404-413; both limits are quantiles of a beta distribution.
    """
    from scipy.special import betaincinv

    tail = (1.0 - confidence) / 2
    low = float(betaincinv(good, of - good + 1, tail)) if good > 0 else 0.0
    high = float(betaincinv(good + 1, of - good, 1.0 - tail)) if good < of else 1.0
    return low, high
