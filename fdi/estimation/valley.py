"""Fits in valleys whose floor is known to be level: what may be scaled in the plant without any signal showing it.

Torques, pressures and forces inside the servovalve are not measured. A filter that lets through less and pilot gains
that are larger by as much are the same plant to every sensor; so are stronger springs behind a stronger motor, and so
on (`FLAT`). Along such a direction priors alone decide where a fit ends and how wide its interval is. Differences along
single parameters do not add up to nought there, as each of them shifts a hundred small stops of the spool; so slopes
are taken across the valley only, and along it they are nought by construction, where a trial confirms it.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fdi.estimation import unidentifiable
from fdi.estimation.final_rounds import PATIENCE, WIDTH, _better, _inside
from fdi.estimation.fit import ENOUGH, Fit, misfit, weights
from fdi.estimation.problem import Free, Problem, ends
from fdi.estimation.unidentifiable import LEVEL, LOAD, TRIED

Floats = NDArray[np.float64]

ACROSS = 1e-3  # of the logarithms: the first differences across
NARROWEST, WIDEST = 1e-12, 9.0  # variances of scaled unknowns, within which a direction across is taken
# static friction of the jack is known here by its ratio to the dynamic one, which stays
FLAT = tuple({name: power for name, power in flat.items() if name != "jack.static_friction"}
             for flat in unidentifiable.FLAT)


def flats(problem: Problem, free: Sequence[Free], x: Floats) -> Floats:
    """Directions at `x` (p,) of scaled unknowns that change no signal, as columns (p, k): those of `FLAT` that hold."""
    law = problem.model["filter.law"]
    load = next((f.value(float(v)) for f, v in zip(free, x, strict=True) if f.name == LOAD), 0.0)
    said = [{**flat, "pilot.flow_gain": -law} if "filter.clogging" in flat else
            {**flat, LOAD: load} if "jack.area" in flat else flat for flat in FLAT]
    ways = np.array([[flat.get(f.name, 0.0) / f.scale for f in free] for flat in said])
    trials = np.array([_inside(free, x, TRIED * way) for way in ways])
    full = np.abs(trials).max(axis=1) >= 0.9 * TRIED * np.abs(ways).max(axis=1)
    white = problem.whitened(problem.residuals(free, np.vstack([x, x + trials])))
    moved = ((white[1:] - white[0]) ** 2).sum(axis=(1, 2))
    found: Floats = ways[full & (moved < LEVEL)].T
    return found


def descended(problem: Problem, begun: Fit, rounds: int, flat: Floats) -> Fit:
    """A fit after so many rounds of damped Gauss-Newton steps, fewer if some of them gain nothing.

    `flat` (p, k) are the directions that the data do not see.
    """
    now, idle = begun, 0
    for _ in range(rounds):
        here = sloped(problem, now.free, now.x, now.covariance, flat)
        there = _better(problem, here)
        idle = idle + 1 if here.cost - there.cost < ENOUGH else 0
        now = replace(there, covariance=here.covariance)
        if idle >= PATIENCE:
            break
    return replace(relaxed(now, flat), converged=True)


def across(free: Sequence[Free], flat: Floats) -> NDArray[np.int64]:
    """Places of the unknowns that, with the flat directions (p, k), span all: one of each direction is left out."""
    left_out = {int(np.argmax(np.abs(column) * [f.name in [next(iter(v)) for v in FLAT] for f in free]))
                for column in flat.T}
    return np.array([k for k in range(len(free)) if k not in left_out])


def sloped(problem: Problem, free: Sequence[Free], x: Floats, covariance: Floats, flat: Floats) -> Fit:
    """The model at `x` (p,), its Jacobian by differences across the valley, along principal directions there."""
    places = across(free, flat)
    basis = np.column_stack([np.eye(len(free))[:, places], flat])
    inverse = np.linalg.inv(basis)[:len(places)]  # of the coordinates across by all unknowns
    variances, vectors = np.linalg.eigh(inverse @ covariance @ inverse.T)
    wide = WIDTH * vectors * np.sqrt(np.clip(variances, NARROWEST, WIDEST))
    moves = np.zeros((len(places), len(free)))
    moves[:, places] = wide.T
    moves = np.array([_inside(free, x, way) for way in moves])
    white = problem.whitened(residuals := problem.residuals(free, np.vstack([x, x + moves])))
    steep = np.asarray(np.linalg.pinv(moves[:, places]), np.float64) @ (white[1:] - white[0]).reshape(len(places), -1)
    jacobian = (inverse.T @ steep).reshape(len(free), *white[0].shape)
    prior = np.diag([f.prior**-2 for f in free])
    flat_rows = jacobian.reshape(len(free), -1)
    heavy = (jacobian * weights(white[0])).reshape(len(free), -1)
    held = float(misfit(white[:1])[0])
    return Fit(tuple(free), x, held + float(x @ prior @ x), held, np.linalg.pinv(heavy @ flat_rows.T + prior),
               residuals[0], white[0], jacobian)


def first_widths(free: Sequence[Free]) -> Floats:
    """A covariance, (p, p), that gives differences across the valley their first width."""
    return np.diag([min(ACROSS / f.scale, 0.1) ** 2 if type(f) is not Free else 1e-4 for f in free])


def relaxed(found: Fit, flat: Floats) -> Fit:
    """The fit moved along the flat directions to where the priors want it, within the bounds: no residual changes."""
    prior = np.array([f.prior**-2 for f in found.free])
    low, high = ends(found.free)
    x = found.x
    for _ in range(len(flat.T) + 1):
        pull = flat.T @ (prior * x)
        way = -flat @ np.linalg.solve(flat.T @ (prior[:, None] * flat), pull) if flat.size else np.zeros(len(x))
        room = np.where(way > 0.0, high - x, x - low) / np.maximum(np.abs(way), 1e-300)
        x = np.clip(x + min(1.0, float(room.min())) * way, low, high)
        if room.min() >= 1.0:
            break
        flat = _held(flat, int(np.argmin(room)))
    cost = found.misfit + float(x**2 @ prior)
    return replace(found, x=x, cost=cost) if cost < found.cost else found


def _held(flat: Floats, k: int) -> Floats:
    """The directions within the flat ones along which unknown k does not move."""
    row = flat[k:k + 1]
    _, _, rows = np.linalg.svd(row)
    within: Floats = flat @ rows[1:].T
    return within
