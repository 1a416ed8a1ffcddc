"""One fault's trend: where its size stands, how it grows, and the time left to MidBand and MaxBand."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.faults import Estimate, Fault, Level, classify_size, judge_size
from fdi.prognosis import remaining_life
from fdi.prognosis.breaks import Break, Cleaned, find_breaks
from fdi.prognosis.regression import Posterior, Scaled, estimate_level, fit_growth
from fdi.thresholds import (
    INTERVAL_95_SD,
    INTERVAL_SLOPE_RANGE,
    NO_GROWTH_PROBABILITY,
    TREND_FEWEST_TRACES,
    TREND_MOST_TRACES,
    TREND_PATHS,
)

Floats = NDArray[np.float64]

LIMITS = {"maintenance": "middle", "non_nominal": "most"}  # level that begins there: field of Fault


class Remaining(NamedTuple):
    """Time from the last trace to a limit, in the axis' unit; infinity: not within 50 times the time seen so far."""

    limit: float  # size
    value: float  # median
    low: float
    high: float
    draws: Floats  # equally probable times

    def compute_probability_within(self, t: float) -> float:
        """Probability that the limit is reached within t."""
        return float((self.draws <= t).mean())


class Curve(NamedTuple):
    """A size over time: middle and the ends of its 95 % interval, shape (m,) each; t on the axis of the traces."""

    t: Floats
    low: Floats
    middle: Floats
    high: Floats


@dataclass(frozen=True, eq=False)
class Trend:
    """The trend of one fault. Times are on the axis of the traces, sizes in the fault's unit."""

    fault: Fault
    verdict: str  # "TREND" | "NO_TREND" | "TOO_FEW"
    t: Floats
    sizes: tuple[Estimate, ...]
    used: NDArray[np.bool_]  # rows that the trend is made of
    breaks: tuple[Break, ...]  # sizes in the fault's unit
    laws: Mapping[str, float]  # probability of each, that nothing grows included; {} if too few
    now: Estimate
    rate: Estimate | None  # per unit of time, now
    remaining: Mapping[str, Remaining]  # by the level that begins there; {} if too few
    past: Curve | None
    future: Curve | None

    @property
    def level(self) -> Level:
        """Level of the size now, by the rule of `rig fdi`; where its interval is too wide for that, by the value."""
        found = judge_size(self.fault, self.now)
        return classify_size(self.fault, self.now.value) if found is None else found


def fit_trend(fault: Fault, times: Sequence[float], estimates: Sequence[Estimate]) -> Trend:
    """The trend of a fault from its sizes at `times` (in order, any unit), at least one."""
    t = np.array(times[-TREND_MOST_TRACES:], dtype=float)
    sizes = tuple(estimates[-TREND_MOST_TRACES:])
    data, unit = _scale_series(fault, t, sizes)
    found = find_breaks(data) if t[-1] > t[0] else Cleaned(data, 0, ())
    breaks = tuple(b._replace(size=b.size * unit) for b in found.breaks)
    used = np.arange(len(t)) >= found.first
    used[[found.first + row for row in found.data.loose]] = False
    if used.sum() < TREND_FEWEST_TRACES or np.ptp(t[used]) == 0.0:
        return Trend(fault, "TOO_FEW", t, sizes, used, breaks, {}, sizes[-1], None, {}, None, None)
    span = float(t[-1] - t[found.first])
    posterior = fit_growth(found.data)
    paths, laws = _sample_paths(found, posterior, _fit_unit_error(data, used)), posterior.compute_law_probabilities()
    remaining = {level: _summarise_remaining(getattr(fault, field), fault, unit, paths, span)
                 for level, field in LIMITS.items()}
    middle = np.linspace(0.0, 1.0, 60)
    level = fault.healthy + unit * estimate_level(found.data, posterior, middle)
    past = Curve(t[found.first] + span * middle, *level)
    now = np.maximum(fault.healthy + unit * paths.sizes[:, 0], 0.0)  # neither fault can be less
    return Trend(fault, "TREND" if laws["none"] < NO_GROWTH_PROBABILITY else "NO_TREND", t, sizes, used, breaks, laws,
                 _summarise_draws(now), _summarise_draws(paths.rate * unit / span), remaining, past,
                 _make_forecast(fault, unit, paths, float(t[-1]), span))


def _scale_series(fault: Fault, t: Floats, sizes: Sequence[Estimate]) -> tuple[Scaled, float]:
    """The series in the regression's units, and the size that is 1 there."""
    unit = fault.most - fault.healthy
    value, low, high = np.array(sizes).T
    sigma = np.maximum(high - value, value - low) / INTERVAL_95_SD / unit  # one side may end at the parameter's bound
    span = float(t[-1] - t[0]) or 1.0
    bounded = tuple(int(row) for row in np.flatnonzero(value <= low))
    return Scaled((t - t[0]) / span, (value - fault.healthy) / unit, sigma, bounded=bounded), unit


def _fit_unit_error(data: Scaled, used: NDArray[np.bool_]) -> remaining_life.UnitError:
    """A line through the intervals' deviations over the sizes; their mean where these hardly differ."""
    y, sigma = data.y[used], data.sigma[used]
    if np.ptp(y) < INTERVAL_SLOPE_RANGE:
        return remaining_life.UnitError(float(sigma[-1]))
    share, base = np.polyfit(y, sigma, 1)
    return remaining_life.UnitError(float(base), float(share))


def _sample_paths(found: Cleaned, posterior: Posterior, own: remaining_life.UnitError) -> remaining_life.Paths:
    """Paths from the last trace on.

    A last size that stands out above may be out of line, a step, or the law that turns up: a third of the paths each.
    """
    last = found.breaks[-1] if found.breaks else None
    if last is None or last.kind != "last" or last.size < 0.0:
        return remaining_life.sample_paths(posterior, own)
    at = len(found.data.u) - 1
    tight = found.data._replace(loose=tuple(row for row in found.data.loose if row != at))
    third = TREND_PATHS // 3
    jumped = fit_growth(tight._replace(steps=(*tight.steps, at)))
    posteriors = posterior, jumped, fit_growth(tight)
    three = [remaining_life.sample_paths(p, own, i, third) for i, p in enumerate(posteriors)]
    return remaining_life.Paths(np.concatenate([p.sizes for p in three]), np.concatenate([p.rate for p in three]))


def _summarise_draws(draws: Floats) -> Estimate:
    low, value, high = np.quantile(draws, [0.025, 0.5, 0.975], method="nearest")
    return Estimate(float(value), float(low), float(high))


def _summarise_remaining(limit: float, fault: Fault, unit: float, paths: remaining_life.Paths, span: float
                         ) -> Remaining:
    draws = remaining_life.find_first_passage(paths, (limit - fault.healthy) / unit) * span
    value, low, high = _summarise_draws(draws)
    return Remaining(limit, value, low, high, draws)


def _make_forecast(fault: Fault, unit: float, paths: remaining_life.Paths, start: float, span: float) -> Curve:
    """The sizes up to when most paths have reached MaxBand, at most twice the time seen so far."""
    until = float(np.quantile(remaining_life.find_first_passage(paths, 1.0), 0.5, method="nearest"))
    ahead = remaining_life.AHEAD
    shown = np.flatnonzero(ahead <= min(max(1.5 * until, 0.3), 2.0))
    low, middle, high = fault.healthy + unit * np.quantile(paths.sizes[:, shown], [0.025, 0.5, 0.975], axis=0)
    return Curve(start + span * ahead[shown], low, middle, high)
