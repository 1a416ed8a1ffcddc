"""One fault's trend: where its size stands, how it grows, and the time left to MidBand and MaxBand.

Bayesian regression of the size on every law at once:

    size_i = offset + steps + rise * shape(u_i) + wander(u_i) + error_i          rise >= 0

`shape` runs over all laws, onsets and bends. `wander` is growth that follows no law: none, a Wiener process, or an
integrated one, of several strengths. `error` has the variances of the intervals, which may be too small, or of which a
part is the same in all traces of one unit, by its tolerances. That part cannot be told from the offset: it is added to
the forecast. Offset and steps are Gaussian and go into the covariance, the rise is solved in closed form, and the rest
is a sum over a grid: exact up to the grid, and the same every time.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.special import log_ndtr, ndtr, ndtri

from fdi.diagnosis.faults import Estimate, Fault, Level, classify_size, judge_size
from fdi.thresholds import (
    BREAK_FEWEST_IN_LINE,
    BREAK_MOST,
    BREAK_PRIOR,
    INTERVAL_95_SD,
    INTERVAL_SLOPE_RANGE,
    LAST_OUTLIER_PRIOR,
    NEVER_FACTOR,
    NO_GROWTH_PROBABILITY,
    OFFSET_PRIOR_SD,
    PACE_FREEDOM,
    PACE_SCALE,
    STEP_PRIOR_SD,
    TREND_FEWEST_TRACES,
    TREND_MOST_TRACES,
    TREND_PATHS,
)
from fdi.trace import Flags, Floats

AHEAD = np.concatenate([[0.0], np.logspace(-2.5, np.log10(NEVER_FACTOR), 80)])  # from the last trace, in u


class Paths(NamedTuple):
    """Sizes the fault may have from the last trace on, (paths, times), at times AHEAD; scaled as `Scaled`."""

    sizes: Floats
    rate: Floats  # now, (paths,), per u


def sample_paths(posterior: Posterior, unit_error: Floats, seed: int = 0, paths: int = TREND_PATHS) -> Paths:
    """Paths of equal probability; `unit_error` as `_fit_unit_error` gives it."""
    rng = np.random.default_rng(seed)
    weights = posterior.weights
    part, shape = np.unravel_index(_sample_stratified_rows(weights.ravel(), paths, rng), weights.shape)
    ahead = evaluate_shapes(posterior.shapes, 1.0 + AHEAD).T
    now, before = (evaluate_shapes(posterior.shapes, np.array([u])) for u in (1.0, 0.98))
    slopes = (now - before)[0] / 0.02
    sizes, rate = np.empty((paths, len(AHEAD))), np.empty(paths)
    for i in np.unique(part):
        p, rows = posterior.parts[i], np.flatnonzero(part == i)
        kind, strength = WANDERS[p.wander]
        k = shape[rows]
        rise = _sample_positive_numbers(p.rise[k], p.deviation[k], rng.uniform(size=len(rows)))
        rise[[posterior.shapes[j].law == "none" for j in k]] = 0.0
        root = np.linalg.cholesky(p.spread + np.diag([1e-12, 1e-12]))
        level = p.level[:, None] - p.pull[:, k] * rise + root @ rng.standard_normal((2, len(rows)))
        wander = _sample_wander(kind, strength, level[1], rng)
        sizes[rows] = rise[:, None] * ahead[k] + level[0][:, None] + wander
        rate[rows] = rise * slopes[k] + (level[1] if kind == "integrated" else 0.0)
    common = np.sqrt([NOISES[p.noise][0] for p in posterior.parts])[part] * rng.standard_normal(paths)
    sizes -= common[:, None] * np.polyval(unit_error, sizes)
    pace = np.exp(np.clip(PACE_SCALE * rng.standard_t(PACE_FREEDOM, paths), -2.0, 2.0))
    sizes = np.array([np.interp(AHEAD, AHEAD * slower, row) for slower, row in zip(pace, sizes, strict=True)])
    return Paths(sizes, rate / pace)


def find_first_passage(paths: Paths, limit: float) -> Floats:
    """When each path first reaches the limit, in u from the last trace on: 0 if it has, infinity if it never does."""
    above = paths.sizes >= limit
    first = above.argmax(axis=1)
    rows = np.arange(len(first))
    before = np.maximum(first - 1, 0)
    low, high = paths.sizes[rows, before], paths.sizes[rows, first]
    share = np.where(first > 0, (limit - low) / np.where(high > low, high - low, 1.0), 0.0)
    return np.asarray(np.where(above.any(axis=1), AHEAD[before] + share * (AHEAD[first] - AHEAD[before]), np.inf))


def _sample_stratified_rows(weights: Floats, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Row numbers in proportion to the weights, less random than independent draws."""
    ends = np.cumsum(weights)
    return np.minimum(np.searchsorted(ends / ends[-1], (np.arange(count) + rng.uniform(size=count)) / count),
                      len(weights) - 1)


def _sample_positive_numbers(mean: Floats, deviation: Floats, uniform: Floats) -> Floats:
    """Normal numbers, truncated to positive ones."""
    below = ndtr(-mean / deviation)
    numbers: Floats = mean + deviation * ndtri(np.clip(below + uniform * (1.0 - below), 1e-300, 1.0 - 1e-16))
    return np.maximum(numbers, 0.0)


def _sample_wander(kind: str, strength: float, slope: Floats, rng: np.random.Generator) -> Floats:
    """Distance of the wander from its present value, (paths, times)."""
    n, h = len(slope), np.diff(AHEAD)
    if kind == "still":
        return np.zeros((n, len(AHEAD)))
    noise = rng.standard_normal((n, len(h)))
    if kind == "wiener":
        moves = strength * np.sqrt(h) * noise
    else:
        turns = np.sqrt(3.0 * h) * strength * noise  # steps of the slope; the place moves by half of each, and a bit
        slopes = slope[:, None] + np.cumsum(np.column_stack([np.zeros(n), turns[:, :-1]]), axis=1)
        moves = h * (slopes + turns / 2) + strength * np.sqrt(3.0 * h ** 3 / 12) * rng.standard_normal((n, len(h)))
    return np.column_stack([np.zeros(n), np.cumsum(moves, axis=1)])


# (common part of the variance, factor on the deviation)
NOISES = ((0.0, 1.0), (0.5, 1.0), (0.9, 1.0), (0.98, 1.0), (0.996, 1.0), (0.0, 2.0))
NOISE_PRIOR = (0.18, 0.18, 0.18, 0.18, 0.18, 0.1)
WANDERS = (("still", 0.0), ("wiener", 0.03), ("wiener", 0.1), ("wiener", 0.3),
           ("integrated", 0.03), ("integrated", 0.1), ("integrated", 0.3))  # kind, deviation at u = 1
WANDER_PRIOR = (0.22, 0.13, 0.13, 0.13, 0.13, 0.13, 0.13)


class Scaled(NamedTuple):
    """A series in the regression's own units: u from 0 to 1, size 0 when healthy and 1 at MaxBand; of shape (n,)."""

    u: Floats
    y: Floats
    sigma: Floats
    steps: tuple[int, ...] = ()  # rows at which the size jumped for good
    loose: tuple[int, ...] = ()  # rows out of line, which carry no information
    bounded: tuple[int, ...] = ()  # rows that only give an upper limit: the estimate stopped at the parameter's bound

    @property
    def jumps(self) -> Floats:
        """1 in the rows from each step on, else 0, (steps, n); by row, for two rows may have one time."""
        rows = np.arange(len(self.u))
        return np.array([rows >= row for row in self.steps], dtype=float).reshape(-1, len(rows))


class Part(NamedTuple):
    """The posterior under one noise and one wander; arrays over shapes, shape (k,)."""

    noise: int  # of NOISES
    wander: int  # of WANDERS
    evidence: Floats  # log, prior included
    rise: Floats  # mean before truncation at 0
    deviation: Floats
    level: Floats  # of offset + steps + wander at u = 1, and of the wander's slope: mean (2,) for rise 0
    pull: Floats  # (2, k), what a unit of rise takes off it
    spread: Floats  # (2, 2)


class Posterior(NamedTuple):
    """The posterior under every noise and wander."""

    shapes: tuple[Shape, ...]
    parts: tuple[Part, ...]

    @property
    def weights(self) -> Floats:
        """Probability of each part and shape, (parts, k)."""
        evidence = np.array([part.evidence for part in self.parts])
        return np.asarray(np.exp(evidence - np.logaddexp.reduce(evidence, axis=None)))

    def compute_law_probabilities(self) -> dict[str, float]:
        """Probability of each law."""
        probabilities: dict[str, float] = {}
        for shape, weight in zip(self.shapes, self.weights.sum(axis=0), strict=True):
            probabilities[shape.law] = probabilities.get(shape.law, 0.0) + float(weight)
        return probabilities


def fit_growth(data: Scaled) -> Posterior:
    """The posterior of a series of at least two times."""
    shapes, _ = list_shapes()
    g = evaluate_shapes(shapes, data.u)
    return Posterior(shapes, tuple(_fit_part(data, g, noise, wander)
                                   for noise in range(len(NOISES)) for wander in range(len(WANDERS))))


def compute_covariance(data: Scaled, noise: int, wander: int, loose: float = 10.0, narrowest: float = 1e-4) -> Floats:
    """Covariance of the sizes about rise * shape, (n, n).

    A size out of line has a standard deviation of `loose`, so it says nothing; no interval is taken for narrower than
    `narrowest`.
    """
    common, factor = NOISES[noise]
    sigma = factor * np.maximum(data.sigma, narrowest)
    own_share = np.where(np.isin(np.arange(len(sigma)), data.bounded), 1.0, 1.0 - common)
    out = np.diag(own_share * sigma ** 2) + _compute_cross_covariance(wander, data.u, data.jumps, data.u, data.jumps)
    out[data.loose, data.loose] += loose ** 2
    return out


def compute_shape_log_priors(noise: int, wander: int) -> Floats:
    """Log prior of each shape under a noise and a wander; a level that wanders is a trend, not `none`."""
    shapes, prior = list_shapes()
    constant = np.array([shape.law == "none" for shape in shapes])
    chance = WANDER_PRIOR[wander] * np.ones(len(shapes))
    chance[constant] = WANDERS[wander][0] == "still"
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(chance * prior * NOISE_PRIOR[noise]))


def compute_wander_covariance(wander: int, a: Floats, b: Floats) -> Floats:
    """Covariance of the wander at times a with the wander at times b, (len(a), len(b))."""
    kind, strength = WANDERS[wander]
    first = np.minimum(a[:, None], b)
    if kind == "integrated":
        first = 3.0 * (first ** 3 / 3 + np.abs(a[:, None] - b) * first ** 2 / 2)
    return strength ** 2 * first


def _fit_part(data: Scaled, g: Floats, noise: int, wander: int) -> Part:
    kind, strength = WANDERS[wander]
    factor = np.linalg.cholesky(compute_covariance(data, noise, wander))
    end = _compute_end_covariance(data, wander)
    white = solve_triangular(factor, np.column_stack([data.y, g, end.T]), lower=True, check_finite=False)
    y, g, s = white[:, 0], white[:, 1:-2], white[:, -2:]
    shapes, _ = list_shapes()
    usual = np.array([shape.rise for shape in shapes])
    precision = (g * g).sum(axis=0) + usual ** -2
    rise, deviation = (g.T @ y) / precision, precision ** -0.5
    evidence = (compute_shape_log_priors(noise, wander) - np.log(np.diag(factor)).sum() - 0.5 * y @ y
                + compute_rise_evidence(rise, deviation, usual))
    offset_spread = np.array([[OFFSET_PRIOR_SD ** 2 + len(data.steps) * STEP_PRIOR_SD ** 2, 0.0], [0.0, 0.0]])
    wander_spread = np.array([[1.0, 1.5], [1.5, 3.0]]) if kind == "integrated" else np.diag([1.0, 0.0])
    spread = offset_spread + strength ** 2 * wander_spread - s.T @ s
    return Part(noise, wander, evidence, rise, deviation, s.T @ y, s.T @ g, spread)


def compute_rise_evidence(rise: Floats, deviation: Floats, usual: Floats) -> Floats:
    """Log evidence that a rise >= 0 with a half-normal prior adds, from its mean and deviation before truncation."""
    return np.asarray(0.5 * (rise / deviation) ** 2 + np.log(deviation / usual) + np.log(2.0)
                      + log_ndtr(rise / deviation))


def _compute_end_covariance(data: Scaled, wander: int) -> Floats:
    """Covariance of the level and of the wander's slope at u = 1, after every step, with the rows' levels, (2, n)."""
    kind, strength = WANDERS[wander]
    u = data.u
    level = OFFSET_PRIOR_SD ** 2 + STEP_PRIOR_SD ** 2 * data.jumps.sum(axis=0)
    return np.array([level + 3 * strength ** 2 * (u ** 2 / 2 - u ** 3 / 6), 3 * strength ** 2 * u ** 2 / 2]
                    if kind == "integrated" else [level + strength ** 2 * u, np.zeros_like(u)])


def estimate_level(data: Scaled, posterior: Posterior, u: Floats) -> Floats:
    """Low, mean and high of the level under the traces at times u from 0 to 1, shape (3, m), by the likeliest law."""
    best, shape = np.unravel_index(posterior.weights.argmax(), posterior.weights.shape)
    part = posterior.parts[best]
    g = evaluate_shapes((posterior.shapes[shape],), np.concatenate([data.u, u]))[:, 0]
    growth_at_data, growth_at_u = g[:len(data.u)], g[len(data.u):]
    rise = max(float(part.rise[shape]), 0.0)
    solver = cho_factor(compute_covariance(data, part.noise, part.wander))
    jumps = np.array([u >= data.u[row] for row in data.steps], dtype=float).reshape(-1, len(u))  # as Scaled.jumps
    cross = _compute_cross_covariance(part.wander, u, jumps, data.u, data.jumps)
    mean = rise * growth_at_u + cross @ cho_solve(solver, data.y - rise * growth_at_data)
    pull = growth_at_u - cross @ cho_solve(solver, growth_at_data)
    prior_variance = _compute_cross_covariance(part.wander, u, jumps, u, jumps).diagonal()
    variance = prior_variance - (cross * cho_solve(solver, cross.T).T).sum(axis=1)
    half = INTERVAL_95_SD * np.sqrt(np.maximum(variance + (pull * part.deviation[shape]) ** 2, 0.0))
    return np.array([mean - half, mean, mean + half])


def _compute_cross_covariance(wander: int, a: Floats, jumps_a: Floats, b: Floats, jumps_b: Floats) -> Floats:
    """Covariance of the level without the rise at times a with that at times b, (len(a), len(b)).

    `jumps_a` and `jumps_b` say which of the times are after each step, as `Scaled.jumps`.
    """
    return OFFSET_PRIOR_SD ** 2 + compute_wander_covariance(wander, a, b) + STEP_PRIOR_SD ** 2 * jumps_a.T @ jumps_b


LAWS = ("none", "linear", "exponential", "power", "runaway")


class Shape(NamedTuple):
    """One law with its onset, its e-foldings, exponent or end, and the prior width of its rise."""

    law: str
    onset: float = 0.0
    bend: float = 1.0
    rise: float = 1.0  # deviation of the half-normal prior, in units of (MaxBand - healthy)


@cache
def list_shapes() -> tuple[tuple[Shape, ...], Floats]:
    """Every shape and its prior, shape (k,): equal for the laws, half of it for growth before the first trace."""
    within = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)  # onsets since the first trace
    before = (-2.0, -0.5)  # a power law shows how long ago it began; the other two do not
    foldings = (0.5, 1.0, 2.0, 3.5, 5.5)  # e-foldings from the first trace to the last
    exponents = (0.5, 0.7, 1.5, 2.0, 3.0)
    ends = (1.1, 1.25, 1.5, 2.0, 3.0)  # when a runaway becomes infinite; 1 is the last trace
    rises = (0.15, 1.0)  # the smaller one is for growth that has only begun
    table = {"none": [Shape("none")], "linear": [Shape("linear", onset) for onset in within],
             "exponential": [Shape("exponential", onset, fold) for onset in within for fold in foldings],
             "power": [Shape("power", onset, p) for onset in (*before, *within) for p in exponents],
             "runaway": [Shape("runaway", onset, end) for onset in within for end in ends]}
    flat = tuple(shape for law in LAWS for shape in table[law])
    weights: list[float] = []
    for law in LAWS:
        early = sum(shape.onset <= 0.0 for shape in table[law])
        late = len(table[law]) - early
        share = 0.5 if late else 1.0
        weights += [share / early if shape.onset <= 0.0 else 0.5 / late for shape in table[law]]
    shapes = tuple(shape._replace(rise=rise) for rise in rises for shape in flat)
    return shapes, np.tile(weights, len(rises)) / len(LAWS) / len(rises)


def evaluate_shapes(shapes: tuple[Shape, ...], u: Floats, largest: float = 1e6) -> Floats:
    """The shapes at times u, shape (m,): a matrix (m, k); steep ones stop at `largest`."""
    return np.column_stack([_evaluate_shape(shape, u, largest) for shape in shapes])


def _evaluate_shape(shape: Shape, u: Floats, largest: float) -> Floats:
    since = np.maximum(u - shape.onset, 0.0) / (1.0 - shape.onset)
    match shape.law:
        case "none":
            growth = np.zeros_like(u)
        case "exponential":
            top = np.log(largest) + shape.bend
            growth = np.expm1(np.minimum(shape.bend * since, top)) / np.expm1(shape.bend)
        case "runaway":
            distance = np.maximum(shape.bend - since, 1e-9)
            growth = (1.0 / distance - 1.0 / shape.bend) / (1.0 / (shape.bend - 1.0) - 1.0 / shape.bend)
        case _:
            growth = since ** shape.bend
    return np.asarray(np.minimum(growth, largest))


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
    used: Flags  # rows that the trend is made of
    breaks: tuple[Break, ...]  # sizes in the fault's unit
    laws: Mapping[str, float]  # probability of each, that nothing grows included; {} if too few
    now: Estimate
    rate: Estimate | None  # per unit of time, now
    remaining: Mapping[str, Remaining]  # by the level that begins there; {} if too few
    past: Curve | None
    future: Curve | None
    no_growth: float = 1.0  # probability that the size does not grow now
    declared: Fault | None = None  # of a fault that falls, which the trend follows by its distance from a healthy unit

    @property
    def stated(self) -> tuple[Fault, Estimate]:
        """The fault and its size now, as its file states sizes."""
        if self.declared is None:
            return self.fault, self.now
        value, *ends = map(self.declared.place_size, self.now)
        return self.declared, Estimate(value, min(ends), max(ends))

    @property
    def level(self) -> Level:
        """Level of the size now, by the rule of `rig fdi`; where its interval is too wide for that, by the value."""
        level = judge_size(self.fault, self.now)
        return classify_size(self.fault, self.now.value) if level is None else level


def fit_trend(fault: Fault, times: Sequence[float], estimates: Sequence[Estimate]) -> Trend:
    """The trend of a fault from its sizes at `times` (in order, any unit), at least one."""
    t = np.array(times[-TREND_MOST_TRACES:], dtype=float)
    sizes = tuple(estimates[-TREND_MOST_TRACES:])
    data, unit = _scale_series(fault, t, sizes)
    series = find_breaks(data) if t[-1] > t[0] else Cleaned(data, 0, ())
    breaks = tuple(b._replace(size=b.size * unit) for b in series.breaks)
    is_used = np.arange(len(t)) >= series.first
    is_used[[series.first + row for row in series.data.loose]] = False
    if is_used.sum() < TREND_FEWEST_TRACES or np.ptp(t[is_used]) == 0.0:
        return Trend(fault, "TOO_FEW", t, sizes, is_used, breaks, {}, sizes[-1], None, {}, None, None)
    span = float(t[-1] - t[series.first])
    posterior = fit_growth(series.data)
    paths, laws = (_sample_paths(series, posterior, _fit_unit_error(data, is_used)),
                   posterior.compute_law_probabilities())
    remaining = {level_name: Remaining(limit, *_summarise_draws(draws), draws)
                 for level_name, limit in (("maintenance", fault.acceptable), ("non_nominal", fault.maintenance))
                 for draws in [find_first_passage(paths, (limit - fault.healthy) / unit) * span]}
    middle = np.linspace(0.0, 1.0, 60)
    level = fault.healthy + unit * estimate_level(series.data, posterior, middle)
    past = Curve(t[series.first] + span * middle, *level)
    now = np.maximum(fault.healthy + unit * paths.sizes[:, 0], fault.range[0])
    no_growth = float((paths.rate <= 0.0).mean())  # a wander that falls now is none either
    return Trend(fault, "TREND" if no_growth < NO_GROWTH_PROBABILITY else "NO_TREND", t, sizes, is_used, breaks,
                 laws, _summarise_draws(now), _summarise_draws(paths.rate * unit / span), remaining, past,
                 _make_forecast(fault, unit, paths, float(t[-1]), span), no_growth)


def _scale_series(fault: Fault, t: Floats, sizes: Sequence[Estimate]) -> tuple[Scaled, float]:
    """The series in the regression's units, and the size that is 1 there."""
    unit = fault.maintenance - fault.healthy
    value, low, high = np.array(sizes).T
    sigma = np.maximum(high - value, value - low) / INTERVAL_95_SD / unit  # one side may end at the parameter's bound
    span = float(t[-1] - t[0]) or 1.0
    bounded = tuple(np.flatnonzero(value <= low).tolist())
    return Scaled((t - t[0]) / span, (value - fault.healthy) / unit, sigma, bounded=bounded), unit


def _fit_unit_error(data: Scaled, is_used: Flags) -> Floats:
    """Standard deviation of a size by the unit's tolerances, common to all its traces: a polynomial of the size.

    A line through the intervals' deviations over the sizes; the last deviation where the sizes hardly differ.
    """
    y, sigma = data.y[is_used], data.sigma[is_used]
    return sigma[-1:] if np.ptp(y) < INTERVAL_SLOPE_RANGE else np.polyfit(y, sigma, 1)


def _sample_paths(series: Cleaned, posterior: Posterior, unit_error: Floats) -> Paths:
    """Paths from the last trace on.

    A last size that stands out above may be out of line, a step, or the law that turns up: a third of the paths each.
    """
    last = series.breaks[-1] if series.breaks else None
    if last is None or last.kind != "last" or last.size < 0.0:
        return sample_paths(posterior, unit_error)
    at = len(series.data.u) - 1
    tight = series.data._replace(loose=tuple(row for row in series.data.loose if row != at))
    third = TREND_PATHS // 3
    posteriors = posterior, fit_growth(tight._replace(steps=(*tight.steps, at))), fit_growth(tight)
    three = [sample_paths(p, unit_error, i, third) for i, p in enumerate(posteriors)]
    return Paths(np.concatenate([p.sizes for p in three]), np.concatenate([p.rate for p in three]))


def _summarise_draws(draws: Floats) -> Estimate:
    low, value, high = np.quantile(draws, [0.025, 0.5, 0.975], method="nearest")
    return Estimate(float(value), float(low), float(high))


def _make_forecast(fault: Fault, unit: float, paths: Paths, start: float, span: float) -> Curve:
    """The sizes up to when most paths have reached MaxBand, at most twice the time seen so far."""
    until = float(np.quantile(find_first_passage(paths, 1.0), 0.5, method="nearest"))
    columns = np.flatnonzero(min(max(1.5 * until, 0.3), 2.0) >= AHEAD)
    low, middle, high = fault.healthy + unit * np.quantile(paths.sizes[:, columns], [0.025, 0.5, 0.975], axis=0)
    return Curve(start + span * AHEAD[columns], low, middle, high)


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
    first, breaks = 0, []
    for _ in range(BREAK_MOST):
        strongest = _find_strongest_break(data) if len(data.u) - len(data.loose) >= BREAK_FEWEST_IN_LINE else None
        if strongest is None:
            break
        kind, at, size = strongest
        breaks.append(Break(kind, first + at, size))
        match kind:
            case "step":
                data = data._replace(steps=(*data.steps, at))
            case "repair":
                data, first = _cut_before(data, at), first + at
            case _:
                data = data._replace(loose=(*data.loose, at))
    return Cleaned(data, first, tuple(sorted(breaks, key=lambda b: b.row)))


def _cut_before(data: Scaled, at: int) -> Scaled:
    """The series from a row on, on its own scale of time."""
    u = data.u[at:] - data.u[at]
    return Scaled(u / (u[-1] or 1.0), data.y[at:], data.sigma[at:], tuple(row - at for row in data.steps if row > at),
                  *(tuple(row - at for row in rows if row >= at) for rows in (data.loose, data.bounded)))


def _find_strongest_break(data: Scaled) -> tuple[str, int, float] | None:
    """Kind, row and size of the break with the most evidence; None if that is not enough."""
    n = len(data.u)
    # spikes; and jumps from row j on, of which the first is none, and at the last one cannot tell
    gain, size = _compute_gains(data, np.column_stack([np.eye(n), np.tril(np.ones((n, n)))[:, 1:-1]]))
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
    shapes, _ = list_shapes()
    g = evaluate_shapes(shapes, data.u)
    usual = np.array([shape.rise for shape in shapes])
    plain, with_it, factors = [], [], []
    for i, j in product(range(len(NOISES)), range(len(WANDERS))):
        factor = np.linalg.cholesky(compute_covariance(data, i, j))
        white = solve_triangular(factor, np.column_stack([data.y, g, v]), lower=True, check_finite=False)
        y, rises, columns = white[:, 0], white[:, 1:1 + len(shapes)], white[:, 1 + len(shapes):]
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
    precision = gg[:, None] - gv ** 2 / vv  # of the rise, the factor taken out
    rest = gy[:, None] - gv * (vy / vv)
    both = (0.5 * vy ** 2 / vv - 0.5 * np.log(vv * STEP_PRIOR_SD ** 2)
            + compute_rise_evidence(rest / precision, precision ** -0.5, usual[:, None]))
    return alone, both, (vy - gv * np.maximum(rest / precision, 0.0)) / vv
