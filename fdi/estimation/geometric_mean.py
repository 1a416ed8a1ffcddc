"""The geometric mean of repeated ratios, with its interval."""
from __future__ import annotations

from math import exp, nan, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit


class Mean(NamedTuple):
    """A mean and its interval."""

    value: float
    low: float
    high: float


def estimate_geometric_mean(logs: NDArray[np.float64], risk: float, fewest: int) -> Mean:
    """The geometric mean of independent ratios and its interval by Student's t, NaN of fewer ratios than `fewest`.

    Args:
        logs: natural logarithms of the ratios, (n,); NaN: not measured.
        risk: probability that the interval misses.
        fewest: ratios for an interval, 2 or more.

    >>> [round(x, 3) for x in estimate_geometric_mean(np.log([0.5, 1.0, 2.0]), 0.05, 2)]
    [1.0, 0.179, 5.595]
    """
    known = logs[np.isfinite(logs)]
    if not len(known):
        return Mean(nan, nan, nan)
    mean = float(known.mean())
    if len(known) < fewest:
        return Mean(exp(mean), nan, nan)
    half = float(stdtrit(len(known) - 1, 1.0 - risk / 2) * known.std(ddof=1) / sqrt(len(known)))
    with np.errstate(over="ignore"):  # of ratios that scatter widely nothing is known: up to infinity
        return Mean(exp(mean), float(np.exp(mean - half)), float(np.exp(mean + half)))
