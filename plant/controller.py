"""Parts of the loop alone, over recorded columns: effects on the demand and the law of the plant's controller; and the
equations of a plant turned round, where it declares them so."""

from typing import Any

import numpy as np

from plant.kernels import control_plant, get_readings, invert_plant, start_control, unpack_state
from plant.model import Model, build_kernel
from plant.pid import Loop, compute_current
from plant.ports import at_command
from plant.segments import Array
from plant.state import Input, Memory, Sampled

__all__ = ["Loop", "compute_answers", "compute_current", "take_demand"]


def take_demand(com: float, m: Memory, sensed: float, t: float, p: Any) -> tuple[float, Memory]:
    """The demand that the loop closes on, and the memories; effects know nothing of the plant but what is `sensed`."""
    return at_command(com, m, Sampled(sensed), Input(0.0, 0.0, 0.0, t, 0.0, p.controller.period), p)


def run_controller(flat: Any, com: Any, readings: Any, record: Any, out: Any) -> None:
    """The controller alone over demands and readings; fills out[k] with its drive.

    Args:
        flat: state of the plant at the start; only its memories are used.
        com: (n,) demand.
        readings: (n, outputs).
        record: (1,) parameters of the model.
        out: (n,), written.
    """
    p = record[0]
    m = unpack_state(flat)[1]
    c = start_control()
    for k in range(len(com)):
        y = get_readings(readings, k)
        demand, m = take_demand(com[k], m, y[0], k * p.controller.period, p)
        out[k], c = control_plant(c, demand, y, p)


def compute_answers(model: Model, com: Array, readings: Array) -> Array:
    """The drive, (n,), that the model's controller answers to demands `com`, (n,).

    `readings` are those of all outputs, (n, outputs), or of the controlled one alone, (n,): others are NaN then.
    """
    out = np.empty(len(com))
    if readings.ndim == 1:
        others = np.full((len(com), len(model.kind.signals.outputs) - 1), np.nan)
        readings = np.column_stack([readings, others])
    run = build_kernel(run_controller, model.effects, plant=model.plant)
    run(model.build_flat_state(), com, np.ascontiguousarray(readings), model.build_record(), out)
    return out


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
