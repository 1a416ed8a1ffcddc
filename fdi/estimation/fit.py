"""Fits of a model's unknowns to measured runs: Levenberg-Marquardt with priors, its trials side by side in lanes."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from fdi.estimation.likelihood import (
    Free,
    Problem,
    compute_misfit,
    compute_weights,
    scale_noise,
    scaled_bounds,
    weigh_priors,
)
from fdi.thresholds import CONVERGED_GAIN, CONVERGED_SHARE
from fdi.trace.trace import Floats

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
        costs = problem.compute_costs(now.free, trials)
        k = int(np.argmin(costs))
        gained = now.cost - float(costs[k])
        if gained < max(CONVERGED_GAIN, CONVERGED_SHARE * now.cost):
            return replace(replay_fit(problem, now, trials[k]) if gained > 0.0 else now, converged=True)
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
    return Fit(free, x, held + float(x**2 @ weigh_priors(free)), held, covariance, residuals[0], white[0], jacobian)


def replay_fit(problem: Problem, fit: Fit, x: Floats) -> Fit:
    """The fit at `x` (p,) with what `problem` leaves there; its Jacobian and covariance stay as they are."""
    residuals = problem.compute_residuals(fit.free, x[None])
    white = problem.whiten_residuals(residuals)
    held = float(compute_misfit(white)[0])
    return replace(fit, x=x, cost=held + float(x**2 @ weigh_priors(fit.free)), misfit=held, residuals=residuals[0],
                   white=white[0])


def form_normal_equations(fit: Fit) -> tuple[Floats, Floats]:
    """Gradient (p,) and Gauss-Newton Hessian (p, p) of half the cost."""
    heavy = fit.jacobian * compute_weights(fit.white)
    prior = weigh_priors(fit.free)
    flat = fit.jacobian.reshape(len(fit.x), -1)
    heavy = heavy.reshape(len(fit.x), -1)
    return heavy @ fit.white.reshape(-1) + prior * fit.x, heavy @ flat.T + np.diag(prior)


def _compute_covariance(free: Sequence[Free], jacobian: Floats, white: Floats) -> Floats:
    flat = (jacobian * np.sqrt(compute_weights(white))).reshape(len(free), -1)
    return np.asarray(np.linalg.pinv(flat @ flat.T + np.diag(weigh_priors(free))), np.float64)


def _choose_widths(free: Sequence[Free], hessian: Floats) -> Floats:
    widest = np.array([f.step for f in free])
    difference_width_sd = 3.0  # of a parameter: differences wide enough for stick-slip, narrow at the end
    wanted = difference_width_sd / np.sqrt(np.maximum(np.diag(hessian), 1e-12))
    return np.clip(wanted, 0.01 * widest, widest)  # times the first width


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


P = TypeVar("P", bound=Problem)


class Population(NamedTuple):
    """Where a search ended: the best trial, (p,), its cost, and the covariance, (p, p), of the last trials."""

    x: Floats
    cost: float
    covariance: Floats


def evolve_population(measure_costs: Callable[[Floats], Floats], x: Floats, covariance: Floats, low: Floats,
                      high: Floats, generations: int, seed: int, size: int = 64, patience: int = 15) -> Population:
    """The best trial found by a population that starts about `x` (p,).

    Args:
        measure_costs: costs (m,) of trials (m, p).
        x: centre of the first trials.
        covariance: of the first trials, (p, p).
        low: bounds (p,) that no trial passes.
        high: the same.
        generations: at most.
        seed: of the trials.
        size: trials of a generation.
        patience: generations without a gain after which the search ends.
    """
    rng, n = np.random.default_rng(seed), len(x)
    kept = size // 2
    weights = np.log(kept + 0.5) - np.log(np.arange(1, kept + 1))
    weights /= weights.sum()
    effective = 1.0 / float((weights**2).sum())
    path_rate = (4.0 + effective / n) / (n + 4.0 + 2.0 * effective / n)
    step_rate = (effective + 2.0) / (n + effective + 5.0)
    rank_one = 2.0 / ((n + 1.3) ** 2 + effective)
    rank_many = min(1.0 - rank_one, 2.0 * (effective - 2.0 + 1.0 / effective) / ((n + 2.0) ** 2 + effective))
    damping = 1.0 + 2.0 * max(0.0, float(np.sqrt((effective - 1.0) / (n + 1.0))) - 1.0) + step_rate
    usual_length = np.sqrt(n) * (1.0 - 1.0 / (4.0 * n) + 1.0 / (21.0 * n * n))
    centre, spread, step = x.copy(), covariance.copy(), 1.0
    path, step_path = np.zeros(n), np.zeros(n)
    best, best_cost, idle = x.copy(), np.inf, 0
    for generation in range(1, generations + 1):
        variances, axes = np.linalg.eigh(0.5 * (spread + spread.T))
        lengths = np.sqrt(np.maximum(variances, 1e-24))
        trials = np.clip(centre + step * (rng.standard_normal((size, n)) * lengths) @ axes.T, low, high)
        costs = measure_costs(trials)
        order = np.argsort(costs)
        gain = best_cost - float(costs[order[0]])
        idle = 0 if gain > max(CONVERGED_GAIN, CONVERGED_SHARE * float(costs[order[0]])) else idle + 1
        if gain > 0.0:
            best, best_cost = trials[order[0]], float(costs[order[0]])
        moves = (trials[order[:kept]] - centre) / step
        move = weights @ moves
        centre = centre + step * move
        along = axes @ ((axes.T @ move) / lengths)
        step_path = (1.0 - step_rate) * step_path + np.sqrt(step_rate * (2.0 - step_rate) * effective) * along
        length = float(np.linalg.norm(step_path))
        begun = np.sqrt(1.0 - (1.0 - step_rate) ** (2 * generation))
        is_short = length / begun < (1.4 + 2.0 / (n + 1.0)) * usual_length
        path = (1.0 - path_rate) * path
        if is_short:
            path += np.sqrt(path_rate * (2.0 - path_rate) * effective) * move
        lost = 0.0 if is_short else path_rate * (2.0 - path_rate)
        spread = ((1.0 - rank_one - rank_many + rank_one * lost) * spread + rank_one * np.outer(path, path)
                  + rank_many * (moves.T * weights) @ moves)
        step *= float(np.exp(min(1.0, step_rate / damping * (length / usual_length - 1.0))))
        if idle >= patience:
            break
    return Population(best, best_cost, step**2 * spread)


def evolve_fit(problem: Problem, fit: Fit, spread: Floats, generations: int, seed: int) -> Fit:
    """The fit at the best trial of a population that begins at it with the covariance `spread` (p, p); its covariance
    is that of the last trials.
    """
    end = evolve_population(partial(problem.compute_costs, fit.free), fit.x, spread, *scaled_bounds(fit.free),
                            generations, seed)
    return replace(fit, x=end.x, cost=end.cost, covariance=end.covariance)


def follow_population(problem: P, begun: Fit, spread: Floats, stages: Sequence[tuple[float, int]], seed: int,
                      descend: Callable[[P, Fit, int, float], Fit]) -> Fit:
    """The fit at which a population ends whose noise counts for less from stage to stage.

    Args:
        problem: the run, with its own noise.
        begun: where the first trials are centred.
        spread: their covariance, (p, p).
        stages: factor on the noise and generations, each.
        seed: of the trials.
        descend: takes a fit of a problem so many rounds further, with its noise so many times as large.
    """
    fit = begun
    for number, (factor, generations) in enumerate(stages):
        found = evolve_fit(scale_noise(problem, factor), fit, spread, generations, 10 * seed + number)
        spread = 4.0 * found.covariance
        slid = descend(problem, found, 2, factor)
        fit = slid if slid.cost < found.cost else found
    return fit
