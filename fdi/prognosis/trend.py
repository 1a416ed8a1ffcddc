"""One fault's trend: where its size stands, how it grows, and the time left to MidBand and MaxBand."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from fdi.diagnosis.faults import Estimate, Fault, Level, classify_size, judge_size
from fdi.prognosis import remaining_life
from fdi.prognosis.regression import (
    NOISES,
    WANDERS,
    Posterior,
    Scaled,
    compute_covariance,
    compute_rise_evidence,
    compute_shape_log_priors,
    estimate_level,
    evaluate_shapes,
    fit_growth,
    list_shapes,
)
from fdi.thresholds import (
    BREAK_FEWEST_IN_LINE,
    BREAK_MOST,
    BREAK_PRIOR,
    INTERVAL_95_SD,
    INTERVAL_SLOPE_RANGE,
    LAST_OUTLIER_PRIOR,
    NO_GROWTH_PROBABILITY,
    STEP_PRIOR_SD,
    TREND_FEWEST_TRACES,
    TREND_MOST_TRACES,
    TREND_PATHS,
)

Floats = NDArray[np.float64]


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
    remaining = {}
    for reached, limit in (("maintenance", fault.middle), ("non_nominal", fault.most)):
        draws = remaining_life.find_first_passage(paths, (limit - fault.healthy) / unit) * span
        remaining[reached] = Remaining(limit, *_summarise_draws(draws), draws)
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


def _make_forecast(fault: Fault, unit: float, paths: remaining_life.Paths, start: float, span: float) -> Curve:
    """The sizes up to when most paths have reached MaxBand, at most twice the time seen so far."""
    until = float(np.quantile(remaining_life.find_first_passage(paths, 1.0), 0.5, method="nearest"))
    ahead = remaining_life.AHEAD
    shown = np.flatnonzero(ahead <= min(max(1.5 * until, 0.3), 2.0))
    low, middle, high = fault.healthy + unit * np.quantile(paths.sizes[:, shown], [0.025, 0.5, 0.975], axis=0)
    return Curve(start + span * ahead[shown], low, middle, high)


class Break(NamedTuple):
    """A break, by the row of the series as it was given."""

    kind: str  # "outlier" | "step" | "repair" | "last": the next trace will tell which of them it is
    row: int
    size: float  # of the jump, in the series' unit


class Cleaned(NamedTuple):
    """The series with its breaks marked."""

    data: Scaled
    first: int  # row of the given series that it starts with
    breaks: tuple[Break, ...]


def find_breaks(data: Scaled) -> Cleaned:
    """Mark breaks one by one: an outlier becomes loose, a step gets a column, rows before a repair are dropped."""
    first, found = 0, []
    for _ in range(BREAK_MOST):
        strongest = _find_strongest_break(data) if len(data.u) - len(data.loose) >= BREAK_FEWEST_IN_LINE else None
        if strongest is None:
            break
        kind, at, size = strongest
        found.append(Break(kind, first + at, size))
        if kind == "step":
            data = data._replace(steps=(*data.steps, at))
        elif kind == "repair":
            data, first = _cut_before(data, at), first + at
        else:
            data = data._replace(loose=(*data.loose, at))
    return Cleaned(data, first, tuple(sorted(found, key=lambda b: b.row)))


def _cut_before(data: Scaled, at: int) -> Scaled:
    """The series from a row on, on its own scale of time."""
    u = data.u[at:] - data.u[at]
    return Scaled(u / (u[-1] or 1.0), data.y[at:], data.sigma[at:], tuple(row - at for row in data.steps if row > at),
                  *(tuple(row - at for row in rows if row >= at) for rows in (data.loose, data.bounded)))


def _find_strongest_break(data: Scaled) -> tuple[str, int, float] | None:
    """Kind, row and size of the break with the most evidence; None if that is not enough."""
    n = len(data.u)
    spikes = np.eye(n)
    jumps = np.tril(np.ones((n, n)))[:, 1:-1]  # from row j on; the first is no jump, at the last one cannot tell
    v = np.column_stack([spikes, jumps])
    gain, size = _compute_gains(data, v)
    gain = gain + np.log(BREAK_PRIOR / np.repeat([n, max(n - 2, 1)], [n, n - 2]))
    gain[n - 1] += np.log(LAST_OUTLIER_PRIOR / BREAK_PRIOR * n)
    gain[[*data.loose, *(n + row - 1 for row in data.steps if row < n - 1)]] = -np.inf  # known already
    if n == 3:  # each of three is out of line with the other two
        gain[:] = np.where(np.abs(size) > STEP_PRIOR_SD, gain, -np.inf)
    best = int(np.argmax(gain))
    if not gain[best] > 0.0:
        return None
    if best < n:
        return ("last" if best == n - 1 else "outlier"), best, float(size[best])
    return ("step" if size[best] > 0 else "repair"), best - n + 1, float(size[best])


def _compute_gains(data: Scaled, v: Floats) -> tuple[Floats, Floats]:
    """Log evidence that each column of v, shape (n, m), adds, and its factor under the best law: shape (m,) both."""
    every, _ = list_shapes()
    g = evaluate_shapes(every, data.u)
    usual = np.array([shape.rise for shape in every])
    plain, with_it, factors = [], [], []
    for i, j in product(range(len(NOISES)), range(len(WANDERS))):
        factor = np.linalg.cholesky(compute_covariance(data, i, j))
        white = solve_triangular(factor, np.column_stack([data.y, g, v]), lower=True, check_finite=False)
        y, rises, columns = white[:, 0], white[:, 1:1 + len(every)], white[:, 1 + len(every):]
        chance = compute_shape_log_priors(i, j) - np.log(np.diag(factor)).sum() - 0.5 * y @ y
        alone, both, size = _compute_evidence(y, rises, columns, usual)
        plain.append(chance + alone)
        with_it.append(chance[:, None] + both)
        factors.append(size)
    base = np.logaddexp.reduce(plain, axis=None)
    stack = np.concatenate(with_it)
    best = stack.argmax(axis=0)
    return np.logaddexp.reduce(stack, axis=0) - base, np.concatenate(factors)[best, np.arange(v.shape[1])]


def _compute_evidence(y: Floats, g: Floats, v: Floats, usual: Floats) -> tuple[Floats, Floats, Floats]:
    """Log evidence that the rise, (k,), and rise and a column's factor, (k, m), add; and that factor, (k, m)."""
    gg, vv, gv = (g * g).sum(axis=0) + usual ** -2, (v * v).sum(axis=0) + STEP_PRIOR_SD ** -2, g.T @ v
    gy, vy = g.T @ y, v.T @ y
    alone = compute_rise_evidence(gy / gg, gg ** -0.5, usual)
    left = gg[:, None] - gv ** 2 / vv  # of the rise, the factor taken out
    rest = gy[:, None] - gv * (vy / vv)
    both = (0.5 * vy ** 2 / vv - 0.5 * np.log(vv * STEP_PRIOR_SD ** 2)
            + compute_rise_evidence(rest / left, left ** -0.5, usual[:, None]))
    rise = np.maximum(rest / left, 0.0)
    return alone, both, (vy - gv * rise) / vv
