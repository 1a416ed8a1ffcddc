"""Could it be nothing but scatter? The error after a quick refit of what differs from one unit to the next.

Two Gauss-Newton steps from the model, each parameter tied to its value by its own tolerance, judged by a replay and not
by the linear forecast. `rig explain` does the same with every effect beside it.
"""
from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.estimation.replay import has_known_start
from fdi.estimation.unknowns import WITHOUT_NOISE, limit_dynamic_friction, tolerance_sizes
from fdi.thresholds import ANCHOR_RATE, RESIDUAL_IS_SCATTER, SCATTER_LARGE_RESIDUAL, SCATTER_TOLERANCES
from fdi.trace.columns import rms
from fdi.trace.signals import OUTPUTS
from fdi.trace.trace import Trace
from plant.lanes import Lanes
from plant.model import Model

Floats = NDArray[np.float64]

SCATTER_STEPS = 20  # a cycle; only sizes matter here
SCATTER_ROUNDS = 2
STEP = 0.3  # tolerances, of the differences that the Jacobian is made of
ALIKE = 20  # neighbouring samples that say the same thing


class Scatter(NamedTuple):
    """What a refit within the tolerances makes of the error."""

    error: dict[str, float]  # by signal, SI unit
    ratio: dict[str, float]  # over the floor
    moved: dict[str, float]  # parameter "group.field" to its change in tolerances
    enough: bool  # within reach of the floor


def fit_scatter(trace: Trace, model: Model, floor: Mapping[str, float]) -> Scatter:
    """Refit the tolerances to a trace; `floor` of each chosen signal in its SI unit."""
    known = tolerance_sizes(model)
    base = np.array([model[name] for name in known])
    size = np.array(list(known.values()))
    lanes = Lanes(model.replace(WITHOUT_NOISE), list(known), SCATTER_STEPS)
    measured = np.array([trace.measured(name) for name in trace.outputs])
    columns = [OUTPUTS.index(name) for name in trace.outputs]
    scale = np.array([floor[name] for name in trace.outputs])[:, None]
    position = trace.xj if has_known_start(trace) else None

    def residual(x: Floats) -> Floats:
        """Residuals (m, signals * n) in floors, for changes x (m, parameters) in tolerances."""
        values = limit_dynamic_friction(list(known), base + x * size)
        out = lanes.replay(values, trace.cor, trace.load, position, ANCHOR_RATE)
        left: Floats = np.nan_to_num((measured - out.transpose(0, 2, 1)[:, columns]) / scale)
        return left.reshape(len(x), -1)

    x = np.zeros(len(base))
    now = residual(x[None])[0]
    for _ in range(SCATTER_ROUNDS):
        slope = (residual(x + STEP * np.eye(len(base))) - now) / STEP
        weight = 1.0 / np.sqrt(1.0 + (now / SCATTER_LARGE_RESIDUAL) ** 2)
        normal = np.einsum("ik,jk,k->ij", slope, slope, weight, optimize=False) / ALIKE + np.eye(len(base))
        step = np.linalg.solve(normal, -np.einsum("ik,k->i", slope, weight * now) / ALIKE - x)
        tried = np.clip(x + np.array([1.0, 0.5, 0.2])[:, None] * step, -SCATTER_TOLERANCES, SCATTER_TOLERANCES)
        found = residual(tried)
        large = SCATTER_LARGE_RESIDUAL
        costs = 2 * large**2 * (np.sqrt(1 + (found / large) ** 2) - 1).sum(axis=1) / ALIKE
        best = int(np.argmin(costs + (tried**2).sum(axis=1)))
        x, now = tried[best], found[best]
    rows = now.reshape(len(scale), -1)
    ratio = {name: rms(np.where(np.isnan(y), np.nan, r))
             for name, r, y in zip(trace.outputs, rows, measured, strict=True)}
    error = {name: ratio[name] * floor[name] for name in ratio}
    moved = dict(sorted(zip(known, x.tolist(), strict=True), key=lambda item: -abs(item[1])))
    return Scatter(error, ratio, moved, max(ratio.values()) < RESIDUAL_IS_SCATTER)
