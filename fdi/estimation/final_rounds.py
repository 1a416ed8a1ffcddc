"""The last rounds of a fit, with differences along principal directions: they find a valley's floor and its length.

Stick-slip makes residuals rough: a step of a parameter shifts a hundred small events, some more, some less. Parameters
that make up for each other, such as pressure and friction of the spool, are each known to a thousandth when the other
is held; differences that narrow drown in the roughness, the valley along which both move together is not seen, fits end
in it anywhere and their intervals are far too narrow. Differences along the principal directions of the covariance are
as wide as each direction is open, and what they show is the next round's covariance.

The solver's step has its own part in where a valley is lowest. Steps ten times finer are needed for what a fit is led
by, the residuals, and not for their slopes: so the differences may be taken with a coarser problem than the rest.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fdi.estimation.fit import DAMPINGS, Fit, cut_at_bounds, step_within_bounds
from fdi.estimation.likelihood import Free, Problem, compute_misfit, compute_weights
from fdi.estimation.unidentifiable import choose_across, find_tangents, relax_along, relax_fit, remove_slope
from fdi.progress import NO_STAGE, Stage
from fdi.thresholds import CONVERGED_GAIN

Floats = NDArray[np.float64]

PATIENCE = 3  # rounds without a gain, in which the covariance still grows to what it is
DIRECTION_WIDTH_SD = 3.0  # of a difference, standard deviations
WIDEST_VARIANCE, NARROWEST_VARIANCE = 25.0, 1e-14  # variances of scaled unknowns, within which a direction is taken


def finish_fit(problem: Problem, fit: Fit, rounds: int = 8, slopes: Problem | None = None,
               stage: Stage = NO_STAGE) -> Fit:
    """A fit taken to the end, with a covariance that holds at the width of its own intervals.

    `slopes`: the same problem with coarser steps, for the differences; default `problem` itself. `stage` takes a step
    with each round.
    """
    slopes = slopes or problem
    now = relax_fit(problem, fit, find_tangents(slopes, fit.free, fit.x)[0])
    if now is fit:  # its residuals may be those of other steps, another noise or another place
        now = replay_fit(problem, fit)
    _, flat = find_tangents(slopes, now.free, now.x)
    idle = 0
    for _ in range(rounds):
        here = linearise_along(problem, now, slopes, flat)
        there = take_best_step(problem, here)
        idle = idle + 1 if here.cost - there.cost < CONVERGED_GAIN else 0
        now = there
        stage.finish_step()
        if idle >= PATIENCE:
            break
    return replace(relax_fit(problem, now, find_tangents(slopes, now.free, now.x)[0]), converged=True)


def replay_fit(problem: Problem, fit: Fit) -> Fit:
    """The fit with the residuals, the misfit and the cost that `problem` has at its unknowns."""
    residuals = problem.compute_residuals(fit.free, fit.x[None])
    white = problem.whiten_residuals(residuals)
    held = float(compute_misfit(white)[0])
    return replace(fit, cost=_add_prior(fit, held), misfit=held, residuals=residuals[0], white=white[0])


def linearise_along(problem: Problem, now: Fit, slopes: Problem, flat: Floats) -> Fit:
    """A fit with its Jacobian by differences along the principal directions of its covariance, and the next covariance.

    The residuals of `now` are those of `problem` at its unknowns; they are not replayed again. The differences are
    those of `slopes`. Along `flat` (p, k) there is no slope.
    """
    x = now.x
    moves = np.array([cut_at_bounds(now.free, x, d) for d in _find_principal(now.covariance).T])
    if slopes is problem:
        differences = slopes.compute_white_residuals(now.free, x + moves) - now.white
    else:
        near = slopes.compute_white_residuals(now.free, np.vstack([x, x + moves]))
        differences = near[1:] - near[0]
    steep = np.asarray(np.linalg.pinv(moves), np.float64) @ differences.reshape(len(x), -1)
    jacobian = remove_slope(steep.reshape(len(x), *now.white.shape), flat)
    heavy = (jacobian * compute_weights(now.white)).reshape(len(x), -1)
    hessian = heavy @ jacobian.reshape(len(x), -1).T + np.diag([f.prior**-2 for f in now.free])
    known = invert_hessian(hessian)
    return replace(now, cost=_add_prior(now, now.misfit), covariance=known, jacobian=jacobian)


def _add_prior(fit: Fit, misfit: float) -> float:
    """The cost of a fit with this misfit."""
    return misfit + float(fit.x @ np.diag([f.prior**-2 for f in fit.free]) @ fit.x)


def _find_principal(covariance: Floats) -> Floats:
    """Principal directions (p, p), one a column, `DIRECTION_WIDTH_SD` standard deviations long."""
    variances, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    wide: Floats = DIRECTION_WIDTH_SD * vectors * np.sqrt(np.clip(variances, NARROWEST_VARIANCE, WIDEST_VARIANCE))
    return wide


def take_best_step(problem: Problem, fit: Fit) -> Fit:
    """The best of some damped Gauss-Newton steps; the fit itself if none gains."""
    prior = np.diag([f.prior**-2 for f in fit.free])
    flat, heavy = (j.reshape(len(fit.x), -1) for j in (fit.jacobian, fit.jacobian * compute_weights(fit.white)))
    gradient, hessian = heavy @ fit.white.reshape(-1) + prior @ fit.x, heavy @ flat.T + prior
    trials = np.array([step_within_bounds(fit, hessian, gradient, damping) for damping in DAMPINGS])
    residuals = problem.compute_residuals(fit.free, trials)
    white = problem.whiten_residuals(residuals)
    held = compute_misfit(white)
    costs = held + np.einsum("ij,jk,ik->i", trials, prior, trials)
    k = int(np.argmin(costs))
    if costs[k] >= fit.cost:
        return fit
    return replace(fit, x=trials[k], cost=float(costs[k]), misfit=float(held[k]), residuals=residuals[k],
                   white=white[k])


def descend_valley(problem: Problem, begun: Fit, rounds: int, flat: Floats, stage: Stage = NO_STAGE) -> Fit:
    """A fit after so many rounds of damped Gauss-Newton steps, fewer if some of them gain nothing.

    `flat` (p, k) are the directions that the data do not see. `stage` takes a step with each round.
    """
    now, idle = begun, 0
    for _ in range(rounds):
        here = linearise_across(problem, now.free, now.x, now.covariance, flat)
        there = take_best_step(problem, here)
        idle = idle + 1 if here.cost - there.cost < CONVERGED_GAIN else 0
        now = replace(there, covariance=here.covariance)
        stage.finish_step()
        if idle >= PATIENCE:
            break
    return replace(relax_along(now, flat), converged=True)


def linearise_across(problem: Problem, free: Sequence[Free], x: Floats, covariance: Floats, flat: Floats) -> Fit:
    """The model at `x` (p,), its Jacobian by differences across the valley, along principal directions there."""
    places = choose_across(free, flat)
    basis = np.column_stack([np.eye(len(free))[:, places], flat])
    inverse = np.linalg.inv(basis)[:len(places)]  # of the coordinates across by all unknowns
    variances, vectors = np.linalg.eigh(inverse @ covariance @ inverse.T)
    wide = DIRECTION_WIDTH_SD * vectors * np.sqrt(np.clip(variances, 1e-12, 9.0))
    moves = np.zeros((len(places), len(free)))
    moves[:, places] = wide.T
    moves = np.array([cut_at_bounds(free, x, way) for way in moves])
    white = problem.whiten_residuals(residuals := problem.compute_residuals(free, np.vstack([x, x + moves])))
    steep = np.asarray(np.linalg.pinv(moves[:, places]), np.float64) @ (white[1:] - white[0]).reshape(len(places), -1)
    jacobian = (inverse.T @ steep).reshape(len(free), *white[0].shape)
    prior = np.diag([f.prior**-2 for f in free])
    flat_rows = jacobian.reshape(len(free), -1)
    heavy = (jacobian * compute_weights(white[0])).reshape(len(free), -1)
    held = float(compute_misfit(white[:1])[0])
    covariance = invert_hessian(heavy @ flat_rows.T + prior)
    return Fit(tuple(free), x, held + float(x @ prior @ x), held, covariance, residuals[0], white[0], jacobian)


def invert_hessian(hessian: Floats) -> Floats:
    """The covariance (p, p) of a Hessian (p, p), with every unknown first scaled to a diagonal of one.

    Stick-slip makes some slopes enormous. Beside an eigenvalue of 1e15 a pseudo-inverse takes the 1 of a prior for
    zero and the direction that only this prior holds for known: sizes along it got intervals forty times too narrow.
    """
    diagonal = np.diag(hessian)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    covariance: Floats = scale[:, None] * np.linalg.pinv(scale[:, None] * hessian * scale) * scale
    return covariance


def start_fit(free: Sequence[Free], x: Floats) -> Fit:
    """A fit at `x` (p,) before its first round."""
    none = np.empty((0, 0))
    return Fit(tuple(free), x, np.inf, np.inf, guess_covariance(free), none, none, none)


def guess_covariance(free: Sequence[Free], across: float = 1e-3) -> Floats:
    """A covariance, (p, p), that gives differences across the valley their first width."""
    return np.diag([min(across / f.scale, 0.1) ** 2 if type(f) is not Free else 1e-4 for f in free])
