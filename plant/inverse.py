"""The drive that a given motion needs: the equations of a plant turned round, where it declares them so."""
from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from plant.kernels import invert_plant
from plant.model import Model, build_kernel
from plant.state import Input, Memory

Array = NDArray[np.float64]


def compute_needed_drive(model: Model, motion: Array, load: Array) -> Array:
    """The drive that a motion needs, (n,), in its unit.

    Args:
        model: of a plant with `inverse`.
        motion: (n, 3) controlled signal, its rate and the rate of that, SI.
        load: (n,) external load.
    """
    out = np.empty(len(motion))
    run = build_kernel(fill_needed_drive, model.effects, plant=model.plant)
    run(model.build_start()[1], np.ascontiguousarray(motion), np.ascontiguousarray(load), model.build_record(), out)
    return out


def fill_needed_drive(m: Memory, motion: Any, load: Any, record: Any, out: Any) -> None:
    """Fills out[k] with the drive at row k."""
    p = record[0]
    for k in range(len(motion)):
        u = Input(0.0, load[k], 0.0, k * p.controller.period, 0.0, p.controller.period)
        out[k], m = invert_plant(motion[k, 0], motion[k, 1], motion[k, 2], m, u, p)
