"""Parts of a run that no model can predict: whether the ram stops there depends on a thousandth of its friction.

On soft oil a slow ramp is a chain of slips, and the time of each follows from the one before. A replay at the true
values drifts out of phase within a second, however fine its steps are, and is then wrong by the height of the slips.
"""
from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fdi.estimation.fit import Fit
from fdi.estimation.likelihood import Problem, limit_dynamic_friction
from fdi.estimation.replay import find_large_windows, list_frictions
from fdi.thresholds import FRICTION_UNCERTAINTY, UNDECIDED_SMALLEST

Flags = NDArray[np.bool_]


def find_undecided_rows(problem: Problem, fit: Fit, floor: Mapping[str, float]) -> Flags:
    """Rows of the problem's run, (n,), in windows that a friction level off by `FRICTION_UNCERTAINTY` changes.

    Args:
        problem: with the run and its solver steps.
        fit: the values to replay.
        floor: of each signal, SI; smaller changes do not count.
    """
    frictions = list_frictions(problem.model)
    names = [f.name for f in fit.free]
    names += [name for name in frictions if name not in names]
    values = {**problem.model.values, **fit.values}
    base = np.array([values[name] for name in names])
    moved = [base.copy() for _ in range(2 * len(frictions))]
    for k, name in enumerate(frictions):
        at = names.index(name)
        moved[2 * k][at] *= 1.0 + FRICTION_UNCERTAINTY
        moved[2 * k + 1][at] *= 1.0 - FRICTION_UNCERTAINTY
    runs = problem.predict_outputs(names, limit_dynamic_friction(names, np.array([base, *moved])))
    changes = np.abs(runs[1:] - runs[0])
    undecided = np.zeros(runs.shape[2], bool)
    for i, signal in enumerate(problem.trace.outputs):
        large = find_large_windows(changes[:, i], max(floor[signal], UNDECIDED_SMALLEST[signal]))
        undecided |= large & ~np.isnan(problem.trace.measurements[i])
    return undecided
