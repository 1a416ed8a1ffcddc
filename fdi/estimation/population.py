"""A search by a population of trials whose spread follows the valley, for a misfit that is too rough for slopes.

Stick-slip makes the misfit rough: each stop of ram or spool that is made or missed is a ridge, and a local minimum is
left only if several frictions move at once. Evolution with an adapted covariance (CMA-ES: N. Hansen, "The CMA Evolution
Strategy: A Tutorial", arXiv:1604.00772) needs no slopes, only the order of the trials, which run side by side in lanes.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from fdi.estimation.fit import Fit
from fdi.estimation.likelihood import Problem, compute_misfit, scale_noise, scaled_bounds
from fdi.thresholds import CONVERGED_GAIN, CONVERGED_SHARE

Floats = NDArray[np.float64]
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
    prior = np.array([f.prior**-2 for f in fit.free])
    low, high = scaled_bounds(fit.free)

    def measure_costs(trials: Floats) -> Floats:
        costs: Floats = compute_misfit(problem.compute_white_residuals(fit.free, trials)) + trials**2 @ prior
        return costs

    end = evolve_population(measure_costs, fit.x, spread, low, high, generations, seed)
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
