"""The forecast of a posterior: paths of the size into the future, and when each first reaches a limit."""
from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from fdi.prognosis.regression import NOISES, WANDERS, Posterior, evaluate_shapes
from fdi.thresholds import NEVER_FACTOR, PACE_FREEDOM, PACE_SCALE, TREND_PATHS

Floats = NDArray[np.float64]

AHEAD = np.concatenate([[0.0], np.logspace(-2.5, np.log10(NEVER_FACTOR), 80)])  # from the last trace, in u


class Paths(NamedTuple):
    """Sizes the fault may have from the last trace on, (paths, times), at times AHEAD; scaled as regression.Scaled."""

    sizes: Floats
    rate: Floats  # now, (paths,), per u


class UnitError(NamedTuple):
    """Standard deviation of a size by the unit's tolerances, common to all its traces: base + share * size."""

    base: float = 0.0
    share: float = 0.0


def sample_paths(posterior: Posterior, own: UnitError, seed: int = 0, paths: int = TREND_PATHS) -> Paths:
    """Paths of equal probability."""
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
    sizes -= common[:, None] * (own.base + own.share * sizes)
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
    when: Floats = AHEAD[before] + share * (AHEAD[first] - AHEAD[before])
    return np.where(above.any(axis=1), when, np.inf)


def _sample_stratified_rows(weights: Floats, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Row numbers in proportion to the weights, less random than independent draws."""
    ends = np.cumsum(weights)
    return np.minimum(np.searchsorted(ends / ends[-1], (np.arange(count) + rng.uniform(size=count)) / count),
                      len(weights) - 1)


def _sample_positive_numbers(mean: Floats, deviation: Floats, uniform: Floats) -> Floats:
    """Normal numbers, truncated to positive ones."""
    below = ndtr(-mean / deviation)
    drawn: Floats = mean + deviation * ndtri(np.clip(below + uniform * (1.0 - below), 1e-300, 1.0 - 1e-16))
    return np.maximum(drawn, 0.0)


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
