"""Bayesian regression of a fault's size on every law at once.

    size_i = offset + steps + rise * shape(u_i) + wander(u_i) + error_i          rise >= 0

`shape` runs over all laws, onsets and bends (laws.py). `wander` is what no law foresees: nothing, a Wiener process, or
an integrated one, of several strengths. `error` has the variances of the intervals, which may be too small, or of which
a part is the same in all traces of one unit, by its tolerances. That part goes into the offset, and no size can tell it
from one: it is taken off what is foretold (life.py). Offset and steps are Gaussian and go into the covariance, the rise
is solved in closed form, all else is a sum over a grid: exact but for the grid, and the same every time.
"""
from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import log_ndtr

from fdi.prognosis.growth_laws import Shape, basis, shapes
from fdi.thresholds import OFFSET_PRIOR_SD, STEP_PRIOR_SD

Floats = NDArray[np.float64]

# (common part of the variance, factor on the deviation)
NOISES = ((0.0, 1.0), (0.5, 1.0), (0.9, 1.0), (0.98, 1.0), (0.996, 1.0), (0.0, 2.0))
NOISE_PRIOR = (0.18, 0.18, 0.18, 0.18, 0.18, 0.1)
WANDERS = (("still", 0.0), ("wiener", 0.03), ("wiener", 0.1), ("wiener", 0.3),
           ("integrated", 0.03), ("integrated", 0.1), ("integrated", 0.3))  # kind, deviation at u = 1
WANDER_PRIOR = (0.22, 0.13, 0.13, 0.13, 0.13, 0.13, 0.13)
LOOSE = 10.0  # deviation of a size that says nothing
GRAIN = 1e-4  # no interval is taken for narrower than this deviation


class Scaled(NamedTuple):
    """A series in the regression's own units: u from 0 to 1, size 0 when healthy and 1 at MaxBand; of shape (n,)."""

    u: Floats
    y: Floats
    sigma: Floats
    steps: tuple[int, ...] = ()  # rows at which the size jumped for good
    loose: tuple[int, ...] = ()  # rows out of line, which say nothing
    bounded: tuple[int, ...] = ()  # rows that only say "not more than": the estimate stopped at what is possible at all


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
    """All parts."""

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
        """Log of the probability of the data."""
        return float(np.logaddexp.reduce([part.evidence for part in self.parts], axis=None))

    def laws(self) -> dict[str, float]:
        """Probability of each law."""
        found: dict[str, float] = {}
        for shape, weight in zip(self.shapes, self.weights.sum(axis=0), strict=True):
            found[shape.law] = found.get(shape.law, 0.0) + float(weight)
        return found


def regress(data: Scaled) -> Posterior:
    """The posterior of a series of at least two times."""
    every, _ = shapes()
    g = basis(every, data.u)
    return Posterior(every, tuple(_part(data, g, noise, wander)
                                  for noise in range(len(NOISES)) for wander in range(len(WANDERS))))


def covariance(data: Scaled, noise: int, wander: int) -> Floats:
    """Of the sizes about rise * shape, (n, n)."""
    common, factor = NOISES[noise]
    sigma = factor * np.maximum(data.sigma, GRAIN)
    jumps = _jumps(data)
    own = np.where(np.isin(np.arange(len(sigma)), data.bounded), 1.0, 1.0 - common)
    out: Floats = (np.diag(own * sigma ** 2) + OFFSET_PRIOR_SD ** 2
                   + STEP_PRIOR_SD ** 2 * jumps.T @ jumps + wandering(wander, data.u, data.u))
    out[data.loose, data.loose] += LOOSE ** 2
    return out


def odds(noise: int, wander: int) -> Floats:
    """Log of the prior of each shape under a noise and a wander: a level that wanders is a trend, not `none`."""
    every, prior = shapes()
    constant = np.array([shape.law == "none" for shape in every])
    chance = WANDER_PRIOR[wander] * np.ones(len(every))
    chance[constant] = WANDERS[wander][0] == "still"
    with np.errstate(divide="ignore"):
        out: Floats = np.log(chance * prior * NOISE_PRIOR[noise])
    return out


def _jumps(data: Scaled) -> Floats:
    """A row for each step, (steps, n): 1 from the step on."""
    return np.array([np.arange(len(data.u)) >= row for row in data.steps], dtype=float).reshape(-1, len(data.u))


def wandering(wander: int, a: Floats, b: Floats) -> Floats:
    """Covariance of the wander at times a with that at times b, (len(a), len(b))."""
    kind, strength = WANDERS[wander]
    first = np.minimum(a[:, None], b)
    if kind == "integrated":
        first = 3.0 * (first ** 3 / 3 + np.abs(a[:, None] - b) * first ** 2 / 2)
    out: Floats = strength ** 2 * first
    return out


def _part(data: Scaled, g: Floats, noise: int, wander: int) -> Part:
    kind, strength = WANDERS[wander]
    factor = np.linalg.cholesky(covariance(data, noise, wander))
    white = solve_triangular(factor, np.column_stack([data.y, g, end_with(data, data.u, wander).T]), lower=True,
                             check_finite=False)
    y, g, s = white[:, 0], white[:, 1:-2], white[:, -2:]
    every, _ = shapes()
    usual = np.array([shape.rise for shape in every])
    precision = (g * g).sum(axis=0) + usual ** -2
    rise, deviation = (g.T @ y) / precision, precision ** -0.5
    evidence = odds(noise, wander) - np.log(np.diag(factor)).sum() - 0.5 * y @ y + truncated(rise, deviation, usual)
    own = np.array([[OFFSET_PRIOR_SD ** 2 + len(data.steps) * STEP_PRIOR_SD ** 2, 0.0], [0.0, 0.0]])
    return Part(noise, wander, evidence, rise, deviation, s.T @ y, s.T @ g, own + _end(kind, strength) - s.T @ s)


def truncated(rise: Floats, deviation: Floats, usual: Floats) -> Floats:
    """Log of what a rise >= 0, half-normal beforehand, adds to the evidence, from its mean and deviation uncut."""
    out: Floats = (0.5 * (rise / deviation) ** 2 + np.log(deviation / usual) + np.log(2.0) + log_ndtr(rise / deviation))
    return out


def end_with(data: Scaled, u: Floats, wander: int) -> Floats:
    """Covariance of the level and of the wander's slope at u = 1 with the levels at times u, (2, m)."""
    kind, strength = WANDERS[wander]
    counted = np.sum([u >= data.u[row] for row in data.steps], axis=0) if data.steps else 0.0
    level = OFFSET_PRIOR_SD ** 2 + STEP_PRIOR_SD ** 2 * counted + np.zeros_like(u)
    if kind == "integrated":
        return np.array([level + 3 * strength ** 2 * (u ** 2 / 2 - u ** 3 / 6), 3 * strength ** 2 * u ** 2 / 2])
    return np.array([level + strength ** 2 * u, np.zeros_like(u)])


def _end(kind: str, strength: float) -> Floats:
    """Prior covariance of the wander and its slope at u = 1."""
    if kind == "integrated":
        return strength ** 2 * np.array([[1.0, 1.5], [1.5, 3.0]])
    return strength ** 2 * np.array([[1.0, 0.0], [0.0, 0.0]])
