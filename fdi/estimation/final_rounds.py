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

from fdi.estimation.fit import DAMPINGS, ENOUGH, Fit, _stepped, misfit, weights
from fdi.estimation.problem import Free, Problem, ends
from fdi.estimation.unidentifiable import relaxed, tangents, without_slope

Floats = NDArray[np.float64]

ROUNDS = 8
PATIENCE = 3  # rounds without a gain, in which the covariance still grows to what it is
WIDTH = 3.0  # of a difference, standard deviations
WIDEST, NARROWEST = 25.0, 1e-14  # variances of scaled unknowns, within which a direction is taken


def settled(problem: Problem, fit: Fit, rounds: int = ROUNDS, slopes: Problem | None = None) -> Fit:
    """A fit taken to the end, with a covariance that holds at the width of its own intervals.

    `slopes`: the same problem with coarser steps, for the differences; default `problem` itself.
    """
    now, idle = relaxed(problem, fit), 0
    _, flat = tangents(slopes or problem, now.free, now.x)
    for _ in range(rounds):
        here = along(problem, now.free, now.x, now.covariance, slopes or problem, flat)
        there = _better(problem, here)
        idle = idle + 1 if here.cost - there.cost < ENOUGH else 0
        now = there
        if idle >= PATIENCE:
            break
    return replace(relaxed(problem, now), converged=True)


def along(problem: Problem, free: Sequence[Free], x: Floats, covariance: Floats, slopes: Problem, flat: Floats) -> Fit:
    """The model at `x` (p,), its Jacobian by differences along the principal directions of a `covariance` (p, p).

    Along `flat` (p, k) there is no slope.
    """
    directions = _principal(covariance)
    moves = np.array([_inside(free, x, d) for d in directions.T])
    near = slopes.whitened(slopes.residuals(free, np.vstack([x, x + moves])))
    residuals = problem.residuals(free, x[None])
    white = problem.whitened(residuals)
    steep = np.asarray(np.linalg.pinv(moves), np.float64) @ (near[1:] - near[0]).reshape(len(x), -1)
    jacobian = without_slope(steep.reshape(len(x), *white[0].shape), flat)
    prior = np.diag([f.prior**-2 for f in free])
    heavy = (jacobian * weights(white[0])).reshape(len(x), -1)
    held = float(misfit(white)[0])
    hessian = heavy @ jacobian.reshape(len(x), -1).T + prior
    known = np.asarray(np.linalg.pinv(hessian), np.float64)
    return Fit(tuple(free), x, held + float(x @ prior @ x), held, known, residuals[0], white[0], jacobian)


def _principal(covariance: Floats) -> Floats:
    """Principal directions (p, p), one a column, `WIDTH` standard deviations long."""
    variances, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    wide: Floats = WIDTH * vectors * np.sqrt(np.clip(variances, NARROWEST, WIDEST))
    return wide


def _inside(free: Sequence[Free], x: Floats, move: Floats) -> Floats:
    """The move, or its opposite, cut off at the bounds: whichever is longer then."""
    low, high = ends(free)
    ways = [np.clip(x + way, low, high) - x for way in (move, -move)]
    return max(ways, key=lambda way: float(way @ way))


def _better(problem: Problem, fit: Fit) -> Fit:
    """The best of some damped Gauss-Newton steps; the fit itself if none gains."""
    prior = np.diag([f.prior**-2 for f in fit.free])
    flat, heavy = (j.reshape(len(fit.x), -1) for j in (fit.jacobian, fit.jacobian * weights(fit.white)))
    gradient, hessian = heavy @ fit.white.reshape(-1) + prior @ fit.x, heavy @ flat.T + prior
    trials = np.array([_stepped(fit, hessian, gradient, damping) for damping in DAMPINGS])
    residuals = problem.residuals(fit.free, trials)
    white = problem.whitened(residuals)
    held = misfit(white)
    costs = held + np.einsum("ij,jk,ik->i", trials, prior, trials)
    k = int(np.argmin(costs))
    if costs[k] >= fit.cost:
        return fit
    return replace(fit, x=trials[k], cost=float(costs[k]), misfit=float(held[k]), residuals=residuals[k],
                   white=white[k])
