"""Scores of remaining lives: alpha-lambda accuracy, prognostic horizon, coverage of the intervals.

Alpha-lambda and prognostic horizon as in A. Saxena, J. Celaya, B. Saha, S. Saha, K. Goebel, "Metrics for Offline
Evaluation of Prognostic Performance", International Journal of Prognostics and Health Management 1 (2010) 001, with
beta the least probability that has to lie within the bounds. End of life is MaxBand.
"""
from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.prognosis.trend import Trend, fit_trend
from fdi.thresholds import TREND_FEWEST_TRACES
from rig.studies.prognosis.degrading_units import Unit

Floats = NDArray[np.float64]
Predict = Callable[[Unit, int], "Prediction"]

ALPHA, BETA = 0.2, 0.5
LAMBDAS = (0.25, 0.5, 0.75, 0.9)


class Prediction(NamedTuple):
    """Prediction for a unit after some of its traces: equally probable times left to MidBand and MaxBand, days."""

    has_trend: bool
    middle: Floats
    most: Floats


class Score(NamedTuple):
    """Scores of one unit. NaN where there was no prediction or the limit had passed."""

    law: str
    alpha_lambda: tuple[float, ...]  # 1.0 or 0.0, at each of LAMBDAS
    horizon: float  # time before end of life from which a prediction is good, as a share of the fault's life
    relative: tuple[float, ...]  # 1 - abs(error) / true, at each of LAMBDAS
    held_middle: tuple[float, ...]  # whether the 95 % interval contains the truth, at each of LAMBDAS
    held_most: tuple[float, ...]
    width: tuple[float, ...]  # of the interval to MaxBand over the true time left; infinite ones too
    below: tuple[float, ...]  # 1.0 where MaxBand comes before the interval
    latency: float  # from onset to the first reported trend, as a share of the fault's life


def predict_unit(unit: Unit, traces: int) -> Prediction:
    """The prediction of `follow` from the first `traces` traces."""
    trend = fit_trend(unit.fault, list(unit.t[:traces]), unit.sizes[:traces])
    if not trend.remaining:
        return Prediction(False, np.full(2, np.inf), np.full(2, np.inf))
    return Prediction(trend.verdict == "TREND", trend.remaining["maintenance"].draws,
                      trend.remaining["non_nominal"].draws)


def score_unit(unit: Unit, predict: Predict = predict_unit, every: int = 2) -> Score:
    """Follow a unit from trace to trace, as in service, with a prediction after every `every`-th trace.

    End of life is the time at which the fault reaches MaxBand.
    """
    end, middle = unit.time_of_size(unit.fault.most), unit.time_of_size(unit.fault.middle)
    counts = [n for n in range(TREND_FEWEST_TRACES, len(unit.t) + 1, every) if unit.t[n - 1] < end]
    predictions = {n: predict(unit, n) for n in counts}
    with_trend = [n for n in counts if predictions[n].has_trend]
    life = end - unit.onset
    unknown = (np.nan,) * len(LAMBDAS)
    if not with_trend:
        return Score(unit.law, (0.0,) * len(LAMBDAS), 0.0, unknown, unknown, unknown, unknown, unknown, np.nan)

    def time_left(n: int) -> float:
        """The true time to end of life after n traces."""
        return float(end - unit.t[n - 1])

    start = unit.t[with_trend[0] - 1]
    good = [n for n in with_trend if _probability_within(predictions[n].most, time_left(n), ALPHA * end) >= BETA]
    evaluated = [max(n for n in counts if unit.t[n - 1] <= start + x * (end - start) + 1e-9) for x in LAMBDAS]
    drawn = [(n, predictions[n].most, time_left(n)) for n in evaluated]
    return Score(
        unit.law,
        alpha_lambda=tuple(float(_probability_within(most, left, ALPHA * left) >= BETA) for _, most, left in drawn),
        horizon=time_left(good[0]) / life if good else 0.0,
        relative=tuple(1.0 - abs(float(np.median(most)) - left) / left for _, most, left in drawn),
        held_middle=tuple(_is_covered(predictions[n].middle, middle - unit.t[n - 1]) for n in evaluated),
        held_most=tuple(_is_covered(most, left) for _, most, left in drawn),
        width=tuple(_interval_width(most) / left for _, most, left in drawn),
        below=tuple(float(_interval(most)[0] > left) for _, most, left in drawn),
        latency=(start - unit.onset) / life)


def find_false_trends(units: Iterable[Unit]) -> list[Trend]:
    """The trends of healthy units that have one after all their traces."""
    trends = [fit_trend(unit.fault, list(unit.t), unit.sizes) for unit in units]
    return [trend for trend in trends if trend.verdict == "TREND"]


def _probability_within(drawn: Floats, truth: float, bound: float) -> float:
    """The share of the drawn times within the truth +- bound."""
    return float((np.abs(drawn - truth) <= bound).mean())


def _interval(drawn: Floats) -> tuple[float, float]:
    """The 95 % interval of the drawn times."""
    low, high = np.quantile(drawn, [0.025, 0.975], method="nearest")
    return float(low), float(high)


def _interval_width(drawn: Floats) -> float:
    low, high = _interval(drawn)
    return high - low


def _is_covered(drawn: Floats, truth: float) -> float:
    """1.0 if the 95 % interval contains the truth, else 0.0; NaN for a time that has passed."""
    low, high = _interval(drawn)
    return np.nan if truth <= 0.0 else float(low <= truth <= high)
