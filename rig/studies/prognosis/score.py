"""How good remaining lives are: alpha-lambda accuracy, prognostic horizon, and whether the intervals hold the truth.

Alpha-lambda and prognostic horizon as in A. Saxena, J. Celaya, B. Saha, S. Saha, K. Goebel, "Metrics for Offline
Evaluation of Prognostic Performance", International Journal of Prognostics and Health Management 1 (2010) 001, with
beta the least probability that has to lie within the bounds. End of life is MaxBand.
"""
from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.prognosis.trend import Trend, follow
from fdi.thresholds import TREND_FEWEST_TRACES
from rig.studies.prognosis.degrading_units import Unit

Floats = NDArray[np.float64]
Predict = Callable[[Unit, int], "Prediction"]

ALPHA, BETA = 0.2, 0.5
LAMBDAS = (0.25, 0.5, 0.75, 0.9)
EVERY = 2  # a prediction after every other trace


class Prediction(NamedTuple):
    """Of a unit after some of its traces: equally probable times left to MidBand and MaxBand, days."""

    told: bool  # there is a trend
    middle: Floats
    most: Floats


class Score(NamedTuple):
    """Of one unit. NaN where there was no prediction or the limit had passed."""

    law: str
    alpha_lambda: tuple[float, ...]  # 1.0 or 0.0, at each of LAMBDAS
    horizon: float  # time before end of life from which a prediction is good, as a share of the fault's life
    relative: tuple[float, ...]  # 1 - abs(error) / true, at each of LAMBDAS
    held_middle: tuple[float, ...]  # whether the 95 % interval holds the truth, at each of LAMBDAS
    held_most: tuple[float, ...]
    width: tuple[float, ...]  # of the interval to MaxBand over the true time left; infinite ones too
    below: tuple[float, ...]  # 1.0 where MaxBand comes before the interval
    latency: float  # from onset to the first trend told, as a share of the fault's life


def predict(u: Unit, traces: int) -> Prediction:
    """By `follow`, from the first so many traces."""
    found = follow(u.fault, list(u.t[:traces]), u.sizes[:traces])
    if not found.remaining:
        return Prediction(False, np.full(2, np.inf), np.full(2, np.inf))
    return Prediction(found.verdict == "TREND", found.remaining["maintenance"].drawn,
                      found.remaining["non_nominal"].drawn)


def score(u: Unit, by: Predict = predict) -> Score:
    """A unit followed from trace to trace, as it would be in service."""
    end, middle = u.reached(u.fault.most), u.reached(u.fault.middle)
    counts = [n for n in range(TREND_FEWEST_TRACES, len(u.t) + 1, EVERY) if u.t[n - 1] < end]
    every = {n: by(u, n) for n in counts}
    told = [n for n in counts if every[n].told]
    life = end - u.onset
    nothing = (np.nan,) * len(LAMBDAS)
    if not told:
        return Score(u.law, (0.0,) * len(LAMBDAS), 0.0, nothing, nothing, nothing, nothing, nothing, np.nan)
    start = u.t[told[0] - 1]
    at = [max(n for n in counts if u.t[n - 1] <= start + x * (end - start) + 1e-9) for x in LAMBDAS]
    good = [n for n in counts if every[n].told
            and _mass(every[n].most, end - u.t[n - 1], ALPHA * end) >= BETA]
    return Score(
        u.law,
        tuple(float(_mass(every[n].most, end - u.t[n - 1], ALPHA * (end - u.t[n - 1])) >= BETA) for n in at),
        (end - u.t[good[0] - 1]) / life if good else 0.0,
        tuple(1.0 - abs(float(np.median(every[n].most)) - (end - u.t[n - 1])) / (end - u.t[n - 1]) for n in at),
        tuple(_held(every[n].middle, middle - u.t[n - 1]) for n in at),
        tuple(_held(every[n].most, end - u.t[n - 1]) for n in at),
        tuple(_width(every[n].most) / (end - u.t[n - 1]) for n in at),
        tuple(float(_ends(every[n].most)[0] > end - u.t[n - 1]) for n in at),
        (start - u.onset) / life)


def _mass(drawn: Floats, truth: float, bound: float) -> float:
    """Probability within the truth +- bound."""
    return float((np.abs(drawn - truth) <= bound).mean())


def _ends(drawn: Floats) -> tuple[float, float]:
    low, high = np.quantile(drawn, [0.025, 0.975], method="nearest")
    return float(low), float(high)


def _held(drawn: Floats, truth: float) -> float:
    low, high = _ends(drawn)
    return np.nan if truth <= 0.0 else float(low <= truth <= high)


def _width(drawn: Floats) -> float:
    low, high = _ends(drawn)
    return high - low


def told_without_reason(units: Iterable[Unit]) -> list[Trend]:
    """Trends told of healthy units, one entry a unit that had one after all its traces."""
    found = [follow(u.fault, list(u.t), u.sizes) for u in units]
    return [trend for trend in found if trend.verdict == "TREND"]
