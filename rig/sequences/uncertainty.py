"""How uncertain the number of a check is, and what follows for its verdict.

The number is measured again with errors of the sensors drawn from their distributions (Monte Carlo, JCGM 101): maxima,
medians and times of a signal have no useful derivative. Its standard uncertainty is the root mean square of what these
numbers differ by from the number itself, so that what the errors add to a maximum or an RMS counts too. A time that is
read from samples is known to a cycle either way, a reading to half a count. docs/uncertainty.md derives it.
"""

from collections.abc import Callable, Mapping, Sequence
from math import hypot, inf, isnan, nan
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from plant import Array, Columns, Signals
from rig.benches import WIDTHS, Bench, Decision, SensorCalibration

COVERAGE = 2.0  # k: U = k u, about 95 %
DRAWS = 200  # a sensitivity to 1 %, what noise does to 5 %
_LEAST_DRAWS, _MOST_SAMPLES = 50, 4_000_000  # of long windows fewer are drawn
_QUANTILES: Mapping[str, Callable[[Array], Array]] = {  # of the distributions, in half-widths
    "normal": np.vectorize(NormalDist().inv_cdf), "rectangular": lambda p: 2.0 * p - 1.0,
    "triangular": lambda p: np.where(p < 0.5, np.sqrt(2.0 * p) - 1.0, 1.0 - np.sqrt(2.0 * (1.0 - p))),
    "arcsine": lambda p: -np.cos(np.pi * p)}
_LARGEST_SHARE = 1 / 3  # of U in a tolerance under shared risk (as OIML R 111-1, 5.2, of the permissible error)


class Metrology(NamedTuple):
    """What is known of the readings of a bench, by the name of the signal, and how a verdict uses it."""

    decision: Decision = "simple"
    calibration: Mapping[str, SensorCalibration] = {}
    counts: Mapping[str, float] = {}  # what a count of its frame is worth, SI
    problems: Mapping[str, str] = {}  # of the calibrations that do not hold at the date of the run

    @property
    def is_used(self) -> bool:
        """Whether anything asks for uncertainties."""
        return bool(self.calibration) or self.decision != "simple"


NO_METROLOGY = Metrology()


def collect_metrology(bench: Bench, signals: Signals, decision: Decision | None, t_ns: int) -> Metrology:
    """What a bench knows of its readings at a date, ns since 1970.

    `decision`: the rule of the sequence, which comes before that of the bench.
    """
    counts = {s.name: bench.find_count(s.word) for s in signals[1:]}
    problems = {name: problem for name, each in bench.calibration.items() if (problem := each.find_problem(t_ns))}
    return Metrology(decision or bench.decision, bench.calibration, counts, problems)


def compute_expanded_uncertainty(measure: Callable[[Columns], float], value: float, trace: Columns,
                                 names: Sequence[str], metrology: Metrology, step: float = 0.0) -> float:
    """U (k = 2) of a number.

    Args:
        measure: gives the number for columns; NaN where it cannot be measured.
        value: what it gives for the columns as read; NaN if it could not be measured.
        trace: the columns as read, SI.
        names: signals that it depends on.
        metrology: calibrations and counts.
        step: half-width of a rectangular error, such as that of a time in samples, in the unit of the number.

    Returns:
        In the unit of the number. Infinite if more than 5 % of the errors decide whether it can be measured at all.
    """
    random = np.random.default_rng(0)  # the same run has the same U
    wrong = [name for name in names if name in metrology.calibration or metrology.counts.get(name)]
    number = max(_LEAST_DRAWS, min(DRAWS, _MOST_SAMPLES // len(trace.t))) if wrong else 0
    errors = {name: _draw_errors(name, metrology, number, random) for name in wrong}
    again = np.array([measure(trace._replace(**{
        name: _read_again(getattr(trace, name), errors[name][row], random) for name in wrong}))
        for row in range(number)])
    share = float(np.isnan(again).mean()) if number else float(isnan(value))
    if isnan(value):
        return nan if share > 0.95 else inf
    if share > 0.05:
        return inf
    spread = float(np.sqrt(np.nanmean((again - value) ** 2))) if number else 0.0
    spread = 0.0 if spread < 1e-9 * abs(value) else spread  # rounding: the errors drop out
    return COVERAGE * hypot(spread, step / WIDTHS["rectangular"])


def _draw_errors(name: str, metrology: Metrology, number: int, random: np.random.Generator) -> Array:
    """Zero error, SI, span error, and standard deviation of the noise, SI: shape (number, 3).

    Each column takes every part of its distribution once, in random order (Latin hypercube). That of a count is a zero
    error too: a signal at rest is always rounded the same way.
    """
    shares = (np.arange(number) + 0.5) / number
    errors = np.zeros((number, 3))
    errors[:, 0] = metrology.counts.get(name, 0.0) / 2 * random.permutation(_QUANTILES["rectangular"](shares))
    if (calibration := metrology.calibration.get(name)) is not None:
        half_width = calibration.u * WIDTHS[calibration.distribution]
        errors[:, 0] += half_width * random.permutation(_QUANTILES[calibration.distribution](shares))
        errors[:, 1] = calibration.gain * random.permutation(_QUANTILES["normal"](shares))
        errors[:, 2] = calibration.noise
    return errors


def _read_again(column: Array, errors: Array, random: np.random.Generator) -> Array:
    """What a sensor with these errors reads in place of a column."""
    zero, span, noise = errors
    readings: Array = column * (1.0 + span) + zero
    return readings + noise * random.normal(size=len(column)) if noise else readings


def decide(value: float, low: float, high: float, uncertainty: float, decision: Decision) -> bool | None:
    """Whether a value passes its limits; None: the rule cannot tell. NaN limits are none, a NaN value has failed.

    simple: by the value alone. guarded: by the value and U, a guard band of U on either side of each limit (JCGM 106,
    8.3; ILAC-G8). shared: by the value alone if U is at most a third of half the tolerance, of a single limit of its
    size (JCGM 106, 8.2.2). An unknown U (NaN) leaves a value open.
    """
    low, high = -inf if isnan(low) else low, inf if isnan(high) else high
    is_inside = low <= value <= high
    if decision == "simple" or (isnan(value) and isnan(uncertainty)):
        return is_inside
    if isnan(value) or isnan(uncertainty) or uncertainty == inf:
        return None
    if decision == "guarded":
        if low + uncertainty <= value <= high - uncertainty:
            return True
        return False if value > high + uncertainty or value < low - uncertainty else None
    tolerance = (high - low) / 2 if high - low < inf else min(abs(low), abs(high))
    return is_inside if uncertainty <= _LARGEST_SHARE * tolerance else None
