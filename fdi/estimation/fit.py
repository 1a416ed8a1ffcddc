"""Fits of a model's unknowns to measured runs: Levenberg-Marquardt with priors, its trials side by side in lanes."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from fdi.estimation.likelihood import Free, Problem, compute_misfit, compute_weights, scaled_bounds
from fdi.thresholds import CONVERGED_GAIN, CONVERGED_SHARE

Floats = NDArray[np.float64]

DAMPINGS = (0.0, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
FIT_ROUNDS = 12


@dataclass(frozen=True, eq=False)
class Fit:
    """Parameters found: `x` (p,) scaled, `cost` = -2 log likelihood with priors, `covariance` (p, p) of x."""

    free: tuple[Free, ...]
    x: Floats
    cost: float
    misfit: float  # the cost without the priors
    covariance: Floats
    residuals: Floats  # (s, n), SI units
    white: Floats  # (s, n), whitened
    jacobian: Floats  # (p, s, n), whitened, at x or one step before it
    converged: bool = False

    @property
    def values(self) -> dict[str, float]:
        """Parameters in SI units."""
        return {f.name: f.value(float(v)) for f, v in zip(self.free, self.x, strict=True)}

    def spread(self, name: str) -> float:
        """Standard deviation of a parameter, SI units."""
        i = [f.name for f in self.free].index(name)
        return float(np.sqrt(self.covariance[i, i])) * self.free[i].scale


class Value(NamedTuple):
    """A parameter with its 95 % interval, SI."""

    value: float
    low: float
    high: float
    unit: str


def fit_unknowns(problem: Problem, free: Sequence[Free], start: Floats | None = None, rounds: int = FIT_ROUNDS) -> Fit:
    """The most likely parameters near `start` (p,), scaled (default: the centres)."""
    x = np.zeros(len(free)) if start is None else np.array(start, float)
    return continue_fit(problem, linearise(problem, free, x), rounds)


def continue_fit(problem: Problem, now: Fit, rounds: int = FIT_ROUNDS) -> Fit:
    """A fit after so many further rounds, or fewer if it converges."""
    for _ in range(rounds):
        gradient, hessian = form_normal_equations(now)
        trials = np.array([step_within_bounds(now, hessian, gradient, damping) for damping in DAMPINGS])
        white = problem.compute_white_residuals(now.free, trials)
        costs = compute_misfit(white) + (trials**2) @ _prior_weights(now.free)
        k = int(np.argmin(costs))
        gained = now.cost - float(costs[k])
        if gained < max(CONVERGED_GAIN, CONVERGED_SHARE * now.cost):
            final = _move_fit(problem, now, trials[k]) if gained > 0.0 else now
            return replace(final, converged=True)
        now = linearise(problem, now.free, trials[k], _choose_widths(now.free, hessian))
    return now


def linearise(problem: Problem, free: Sequence[Free], x: Floats, step: Floats | None = None) -> Fit:
    """The model at `x` (p,) with its Jacobian by differences of `step`, away from a bound."""
    free = tuple(free)
    step = np.array([f.step for f in free]) if step is None else step
    signs = np.array([-1.0 if f.centre + f.scale * (v + h) > f.high else 1.0
                      for f, v, h in zip(free, x, step, strict=True)])
    moved = np.vstack([x, x + np.diag(signs * step)])
    residuals = problem.compute_residuals(free, moved)
    white = problem.whiten_residuals(residuals)
    jacobian = (white[1:] - white[0]) / (signs * step)[:, None, None]
    held = float(compute_misfit(white[:1])[0])
    covariance = _compute_covariance(free, jacobian, white[0])
    return Fit(free, x, held + float(x**2 @ _prior_weights(free)), held, covariance, residuals[0], white[0], jacobian)


def _move_fit(problem: Problem, fit: Fit, x: Floats) -> Fit:
    """The fit at `x`, close enough to keep its Jacobian."""
    residuals = problem.compute_residuals(fit.free, x[None])
    white = problem.whiten_residuals(residuals)
    held = float(compute_misfit(white)[0])
    return Fit(fit.free, x, held + float(x**2 @ _prior_weights(fit.free)), held, fit.covariance, residuals[0], white[0],
               fit.jacobian)


def _prior_weights(free: Sequence[Free]) -> Floats:
    return np.array([f.prior**-2 for f in free])


def form_normal_equations(fit: Fit) -> tuple[Floats, Floats]:
    """Gradient (p,) and Gauss-Newton Hessian (p, p) of half the cost."""
    heavy = fit.jacobian * compute_weights(fit.white)
    prior = _prior_weights(fit.free)
    flat = fit.jacobian.reshape(len(fit.x), -1)
    heavy = heavy.reshape(len(fit.x), -1)
    return heavy @ fit.white.reshape(-1) + prior * fit.x, heavy @ flat.T + np.diag(prior)


def _compute_covariance(free: Sequence[Free], jacobian: Floats, white: Floats) -> Floats:
    flat = (jacobian * np.sqrt(compute_weights(white))).reshape(len(free), -1)
    inverse: Floats = np.asarray(np.linalg.pinv(flat @ flat.T + np.diag(_prior_weights(free))), np.float64)
    return inverse


def _choose_widths(free: Sequence[Free], hessian: Floats) -> Floats:
    widest = np.array([f.step for f in free])
    difference_width_sd = 3.0  # of a parameter: differences wide enough for stick-slip, narrow at the end
    wanted = difference_width_sd / np.sqrt(np.maximum(np.diag(hessian), 1e-12))
    widths: Floats = np.clip(wanted, 0.01 * widest, widest)  # times the first width
    return widths


def step_within_bounds(fit: Fit, hessian: Floats, gradient: Floats, damping: float) -> Floats:
    """A damped Gauss-Newton step within the bounds: what runs into one stays there, and the rest is solved again."""
    low, high = scaled_bounds(fit.free)
    damped = hessian + np.diag(damping * np.diag(hessian) + 1e-12 * np.trace(hessian) + 1e-12)
    x, open_ = fit.x.copy(), np.ones(len(fit.x), bool)
    for _ in range(len(x)):
        move = x - fit.x
        right = -gradient[open_] - damped[np.ix_(open_, ~open_)] @ move[~open_]
        x[open_] = fit.x[open_] + cho_solve(cho_factor(damped[np.ix_(open_, open_)]), right)
        out = open_ & ((x < low) | (x > high))
        x = np.clip(x, low, high)
        if not out.any():
            break
        open_ &= ~out
        if not open_.any():
            break
    return x


def cut_at_bounds(free: Sequence[Free], x: Floats, move: Floats) -> Floats:
    """The move, or its opposite, cut off at the bounds: whichever is longer then."""
    low, high = scaled_bounds(free)
    ways = [np.clip(x + way, low, high) - x for way in (move, -move)]
    return max(ways, key=lambda way: float(way @ way))
