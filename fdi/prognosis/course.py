"""The level under the traces, by the likeliest law, wander and noise: what a picture draws through the points."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from fdi.prognosis.growth_laws import basis
from fdi.prognosis.regression import Posterior, Scaled, covariance, wandering
from fdi.thresholds import INTERVAL_95_SD, OFFSET_PRIOR_SD, STEP_PRIOR_SD

Floats = NDArray[np.float64]


def fitted(data: Scaled, posterior: Posterior, u: Floats) -> Floats:
    """Low, mean and high of the level at times u from 0 to 1, shape (3, m)."""
    best, shape = np.unravel_index(posterior.weights.argmax(), posterior.weights.shape)
    part = posterior.parts[best]
    g = basis((posterior.shapes[shape],), np.concatenate([data.u, u]))[:, 0]
    here, there = g[:len(data.u)], g[len(data.u):]
    rise = max(float(part.rise[shape]), 0.0)
    solver = cho_factor(covariance(data, part.noise, part.wander))
    cross = _between(data, part.wander, u, data.u)
    mean = rise * there + cross @ cho_solve(solver, data.y - rise * here)
    pull = there - cross @ cho_solve(solver, here)
    left = _between(data, part.wander, u, u).diagonal() - (cross * cho_solve(solver, cross.T).T).sum(axis=1)
    half = INTERVAL_95_SD * np.sqrt(np.maximum(left + (pull * part.deviation[shape]) ** 2, 0.0))
    return np.array([mean - half, mean, mean + half])


def _between(data: Scaled, wander: int, a: Floats, b: Floats) -> Floats:
    """Covariance of the level without the rise at times a with that at times b, (len(a), len(b))."""
    out = OFFSET_PRIOR_SD ** 2 + wandering(wander, a, b)
    for row in data.steps:
        out = out + STEP_PRIOR_SD ** 2 * np.outer(a >= data.u[row], b >= data.u[row])
    return out
