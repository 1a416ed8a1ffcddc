"""Bayesian regression of a fault's size on every law at once.

    size_i = offset + steps + rise * shape(u_i) + wander(u_i) + error_i          rise >= 0

`shape` runs over all laws, onsets and bends (growth_laws.py). `wander` is growth that follows no law: none, a Wiener
process, or an integrated one, of several strengths. `error` has the variances of the intervals, which may be too small,
or of which a part is the same in all traces of one unit, by its tolerances. That part cannot be told from the offset:
it is added to the forecast (remaining_life.py). Offset and steps are Gaussian and go into the covariance, the rise is
solved in closed form, and the rest is a sum over a grid: exact up to the grid, and the same every time.
"""
from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.special import log_ndtr

from fdi.thresholds import INTERVAL_95_SD, OFFSET_PRIOR_SD, STEP_PRIOR_SD

Floats = NDArray[np.float64]

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
        weights: Floats = np.exp(evidence - np.logaddexp.reduce(evidence, axis=None))
        return weights

    @property
    def evidence(self) -> float:
        """Log probability of the data."""
        return float(np.logaddexp.reduce([part.evidence for part in self.parts], axis=None))

    def compute_law_probabilities(self) -> dict[str, float]:
        """Probability of each law."""
        found: dict[str, float] = {}
        for shape, weight in zip(self.shapes, self.weights.sum(axis=0), strict=True):
            found[shape.law] = found.get(shape.law, 0.0) + float(weight)
        return found


def fit_growth(data: Scaled) -> Posterior:
    """The posterior of a series of at least two times."""
    every, _ = list_shapes()
    g = evaluate_shapes(every, data.u)
    return Posterior(every, tuple(_fit_part(data, g, noise, wander)
                                  for noise in range(len(NOISES)) for wander in range(len(WANDERS))))


def compute_covariance(data: Scaled, noise: int, wander: int, loose: float = 10.0, narrowest: float = 1e-4) -> Floats:
    """Covariance of the sizes about rise * shape, (n, n).

    A size out of line has a standard deviation of `loose`, so it says nothing; no interval is taken for narrower than
    `narrowest`.
    """
    common, factor = NOISES[noise]
    sigma = factor * np.maximum(data.sigma, narrowest)
    n = len(sigma)
    jumps = np.array([np.arange(n) >= row for row in data.steps], dtype=float).reshape(-1, n)  # 1 from the step on
    own = np.where(np.isin(np.arange(n), data.bounded), 1.0, 1.0 - common)
    out: Floats = (np.diag(own * sigma ** 2) + OFFSET_PRIOR_SD ** 2
                   + STEP_PRIOR_SD ** 2 * jumps.T @ jumps + compute_wander_covariance(wander, data.u, data.u))
    out[data.loose, data.loose] += loose ** 2
    return out


def compute_shape_log_priors(noise: int, wander: int) -> Floats:
    """Log prior of each shape under a noise and a wander; a level that wanders is a trend, not `none`."""
    every, prior = list_shapes()
    constant = np.array([shape.law == "none" for shape in every])
    chance = WANDER_PRIOR[wander] * np.ones(len(every))
    chance[constant] = WANDERS[wander][0] == "still"
    with np.errstate(divide="ignore"):
        out: Floats = np.log(chance * prior * NOISE_PRIOR[noise])
    return out


def compute_wander_covariance(wander: int, a: Floats, b: Floats) -> Floats:
    """Covariance of the wander at times a with the wander at times b, (len(a), len(b))."""
    kind, strength = WANDERS[wander]
    first = np.minimum(a[:, None], b)
    if kind == "integrated":
        first = 3.0 * (first ** 3 / 3 + np.abs(a[:, None] - b) * first ** 2 / 2)
    out: Floats = strength ** 2 * first
    return out


def _fit_part(data: Scaled, g: Floats, noise: int, wander: int) -> Part:
    kind, strength = WANDERS[wander]
    factor = np.linalg.cholesky(compute_covariance(data, noise, wander))
    end = compute_end_covariance(data, data.u, wander)
    white = solve_triangular(factor, np.column_stack([data.y, g, end.T]), lower=True, check_finite=False)
    y, g, s = white[:, 0], white[:, 1:-2], white[:, -2:]
    every, _ = list_shapes()
    usual = np.array([shape.rise for shape in every])
    precision = (g * g).sum(axis=0) + usual ** -2
    rise, deviation = (g.T @ y) / precision, precision ** -0.5
    evidence = (compute_shape_log_priors(noise, wander) - np.log(np.diag(factor)).sum() - 0.5 * y @ y
                + compute_rise_evidence(rise, deviation, usual))
    own = np.array([[OFFSET_PRIOR_SD ** 2 + len(data.steps) * STEP_PRIOR_SD ** 2, 0.0], [0.0, 0.0]])
    wandered = np.array([[1.0, 1.5], [1.5, 3.0]]) if kind == "integrated" else np.diag([1.0, 0.0])
    spread = own + strength ** 2 * wandered - s.T @ s
    return Part(noise, wander, evidence, rise, deviation, s.T @ y, s.T @ g, spread)


def compute_rise_evidence(rise: Floats, deviation: Floats, usual: Floats) -> Floats:
    """Log evidence that a rise >= 0 with a half-normal prior adds, from its mean and deviation before truncation."""
    out: Floats = (0.5 * (rise / deviation) ** 2 + np.log(deviation / usual) + np.log(2.0) + log_ndtr(rise / deviation))
    return out


def compute_end_covariance(data: Scaled, u: Floats, wander: int) -> Floats:
    """Covariance of the level and of the wander's slope at u = 1 with the levels at times u, (2, m)."""
    kind, strength = WANDERS[wander]
    counted = np.sum([u >= data.u[row] for row in data.steps], axis=0) if data.steps else 0.0
    level = OFFSET_PRIOR_SD ** 2 + STEP_PRIOR_SD ** 2 * counted + np.zeros_like(u)
    if kind == "integrated":
        return np.array([level + 3 * strength ** 2 * (u ** 2 / 2 - u ** 3 / 6), 3 * strength ** 2 * u ** 2 / 2])
    return np.array([level + strength ** 2 * u, np.zeros_like(u)])


def estimate_level(data: Scaled, posterior: Posterior, u: Floats) -> Floats:
    """Low, mean and high of the level under the traces at times u from 0 to 1, shape (3, m), by the likeliest law."""
    best, shape = np.unravel_index(posterior.weights.argmax(), posterior.weights.shape)
    part = posterior.parts[best]
    g = evaluate_shapes((posterior.shapes[shape],), np.concatenate([data.u, u]))[:, 0]
    here, there = g[:len(data.u)], g[len(data.u):]
    rise = max(float(part.rise[shape]), 0.0)
    solver = cho_factor(compute_covariance(data, part.noise, part.wander))
    cross = _compute_cross_covariance(data, part.wander, u, data.u)
    mean = rise * there + cross @ cho_solve(solver, data.y - rise * here)
    pull = there - cross @ cho_solve(solver, here)
    own = _compute_cross_covariance(data, part.wander, u, u).diagonal()
    left = own - (cross * cho_solve(solver, cross.T).T).sum(axis=1)
    half = INTERVAL_95_SD * np.sqrt(np.maximum(left + (pull * part.deviation[shape]) ** 2, 0.0))
    return np.array([mean - half, mean, mean + half])


def _compute_cross_covariance(data: Scaled, wander: int, a: Floats, b: Floats) -> Floats:
    """Covariance of the level without the rise at times a with that at times b, (len(a), len(b))."""
    out = OFFSET_PRIOR_SD ** 2 + compute_wander_covariance(wander, a, b)
    for row in data.steps:
        out = out + STEP_PRIOR_SD ** 2 * np.outer(a >= data.u[row], b >= data.u[row])
    return out


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
    every = tuple(shape._replace(rise=rise) for rise in rises for shape in flat)
    return every, np.tile(weights, len(rises)) / len(LAWS) / len(rises)


def evaluate_shapes(every: tuple[Shape, ...], u: Floats, largest: float = 1e6) -> Floats:
    """The shapes at times u, shape (m,): a matrix (m, k); steep ones stop at `largest`."""
    return np.column_stack([_evaluate_shape(shape, u, largest) for shape in every])


def _evaluate_shape(shape: Shape, u: Floats, largest: float) -> Floats:
    since = np.maximum(u - shape.onset, 0.0) / (1.0 - shape.onset)
    if shape.law == "none":
        return np.zeros_like(u)
    if shape.law == "exponential":
        top = np.log(largest) + shape.bend
        grown = np.expm1(np.minimum(shape.bend * since, top)) / np.expm1(shape.bend)
    elif shape.law == "runaway":
        left = np.maximum(shape.bend - since, 1e-9)
        grown = (1.0 / left - 1.0 / shape.bend) / (1.0 / (shape.bend - 1.0) - 1.0 / shape.bend)
    else:
        grown = since ** shape.bend
    return np.asarray(np.minimum(grown, largest))
