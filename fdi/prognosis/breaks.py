"""Breaks in a series of sizes: traces out of line, sizes that jump for good, repairs.

Each is a column that may be added to the regression with a factor of its own. The evidence with it, summed over all
laws, wanders and noises, is compared with that without it; the strongest one is accepted if it outweighs its prior.
"""
from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import log_ndtr

from fdi.prognosis.growth_laws import evaluate_shapes, list_shapes
from fdi.prognosis.regression import NOISES, WANDERS, Scaled, compute_covariance, compute_shape_log_priors
from fdi.thresholds import BREAK_FEWEST_IN_LINE, BREAK_MOST, BREAK_PRIOR, LAST_OUTLIER_PRIOR, STEP_PRIOR_SD

Floats = NDArray[np.float64]


class Break(NamedTuple):
    """A break, by the row of the series as it was given."""

    kind: str  # "outlier" | "step" | "repair" | "last": the next trace will tell which of them it is
    row: int
    size: float  # of the jump, in the series' unit


class Cleaned(NamedTuple):
    """The series with its breaks marked."""

    data: Scaled
    first: int  # row of the given series that it starts with
    breaks: tuple[Break, ...]


def find_breaks(data: Scaled) -> Cleaned:
    """Mark breaks one by one: an outlier becomes loose, a step gets a column, rows before a repair are dropped."""
    first, found = 0, []
    for _ in range(BREAK_MOST):
        strongest = _find_strongest_break(data) if len(data.u) - len(data.loose) >= BREAK_FEWEST_IN_LINE else None
        if strongest is None:
            break
        kind, at, size = strongest
        found.append(Break(kind, first + at, size))
        if kind == "step":
            data = data._replace(steps=(*data.steps, at))
        elif kind == "repair":
            data, first = _cut_before(data, at), first + at
        else:
            data = data._replace(loose=(*data.loose, at))
    return Cleaned(data, first, tuple(sorted(found, key=lambda b: b.row)))


def _cut_before(data: Scaled, at: int) -> Scaled:
    """The series from a row on, on its own scale of time."""
    u = data.u[at:] - data.u[at]
    return Scaled(u / (u[-1] or 1.0), data.y[at:], data.sigma[at:], tuple(row - at for row in data.steps if row > at),
                  *(tuple(row - at for row in rows if row >= at) for rows in (data.loose, data.bounded)))


def _find_strongest_break(data: Scaled) -> tuple[str, int, float] | None:
    """Kind, row and size of the break with the most evidence; None if that is not enough."""
    n = len(data.u)
    spikes = np.eye(n)
    jumps = np.tril(np.ones((n, n)))[:, 1:-1]  # from row j on; the first is no jump, at the last one cannot tell
    v = np.column_stack([spikes, jumps])
    gain, size = _compute_gains(data, v)
    gain = gain + np.log(BREAK_PRIOR / np.repeat([n, max(n - 2, 1)], [n, n - 2]))
    gain[n - 1] += np.log(LAST_OUTLIER_PRIOR / BREAK_PRIOR * n)
    gain[[*data.loose, *(n + row - 1 for row in data.steps if row < n - 1)]] = -np.inf  # known already
    if n == 3:  # each of three is out of line with the other two
        gain[:] = np.where(np.abs(size) > STEP_PRIOR_SD, gain, -np.inf)
    best = int(np.argmax(gain))
    if not gain[best] > 0.0:
        return None
    if best < n:
        return ("last" if best == n - 1 else "outlier"), best, float(size[best])
    return ("step" if size[best] > 0 else "repair"), best - n + 1, float(size[best])


def _compute_gains(data: Scaled, v: Floats) -> tuple[Floats, Floats]:
    """Log evidence that each column of v, shape (n, m), adds, and its factor under the best law: shape (m,) both."""
    every, _ = list_shapes()
    g = evaluate_shapes(every, data.u)
    usual = np.array([shape.rise for shape in every])
    plain, with_it, factors = [], [], []
    for i in range(len(NOISES)):
        for j in range(len(WANDERS)):
            factor = np.linalg.cholesky(compute_covariance(data, i, j))
            white = solve_triangular(factor, np.column_stack([data.y, g, v]), lower=True, check_finite=False)
            chance = compute_shape_log_priors(i, j) - np.log(np.diag(factor)).sum() - 0.5 * white[:, 0] @ white[:, 0]
            y, rises, columns = white[:, 0], white[:, 1:1 + len(every)], white[:, 1 + len(every):]
            alone, both, size = _compute_evidence(y, rises, columns, usual)
            plain.append(chance + alone)
            with_it.append(chance[:, None] + both)
            factors.append(size)
    base = np.logaddexp.reduce(plain, axis=None)
    stack = np.concatenate(with_it)
    best = stack.argmax(axis=0)
    return np.logaddexp.reduce(stack, axis=0) - base, np.concatenate(factors)[best, np.arange(v.shape[1])]


def _compute_evidence(y: Floats, g: Floats, v: Floats, usual: Floats) -> tuple[Floats, Floats, Floats]:
    """Log evidence that the rise, (k,), and rise and a column's factor, (k, m), add; and that factor, (k, m)."""
    gg, vv, gv = (g * g).sum(axis=0) + usual ** -2, (v * v).sum(axis=0) + STEP_PRIOR_SD ** -2, g.T @ v
    gy, vy = g.T @ y, v.T @ y
    alone = 0.5 * gy ** 2 / gg - 0.5 * np.log(gg * usual ** 2) + log_ndtr(gy / np.sqrt(gg))
    left = gg[:, None] - gv ** 2 / vv  # of the rise, the factor taken out
    rest = gy[:, None] - gv * (vy / vv)
    both = (0.5 * vy ** 2 / vv - 0.5 * np.log(vv * STEP_PRIOR_SD ** 2) + 0.5 * rest ** 2 / left
            - 0.5 * np.log(left * usual[:, None] ** 2) + log_ndtr(rest / np.sqrt(left)))
    rise = np.maximum(rest / left, 0.0)
    return alone, both, (vy - gv * rise) / vv
