"""The controller as the reference firmware has it: effects on the demand, then a PID law on the sensed error, limited.

By default the law is proportional only. `compute_answers` runs the controller alone over recorded columns.
"""
from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant.effects import combine_laws
from plant.friction import clip
from plant.model import Model, build_kernel
from plant.ports import at_command
from plant.state import Input, Memory, State

Array = NDArray[np.float64]


class Loop(NamedTuple):
    """What the law remembers from cycle to cycle."""

    integral: float = 0.0  # A, the integral part of the current
    error: float = 0.0  # m, of the cycle before
    cycles: float = 0.0  # cycles since it was enabled


def compute_current(c: Loop, demand: float, position: float, p: Any) -> tuple[float, Loop]:
    """Current for the next cycle, A, and the memory, from demand and sensed position, m.

    `p` has the fields of `plant.parameters.Controller`. The integral part waits while the output is at its limit and
    the error would drive it further (anti-windup). The derivative is the backward difference of the error, none in the
    first cycle.
    """
    error = demand - position
    rate = (error - c.error) / p.period if c.cycles > 0.0 else 0.0
    integral = c.integral + p.integral_gain * error * p.period
    wanted = p.proportional_gain * error + integral + p.derivative_gain * rate
    current = clip(wanted, p.current_limit)
    winding = current != wanted and wanted * error > 0.0
    return current, Loop(c.integral if winding else integral, error, c.cycles + 1.0)


def apply_command_effects(com: float, m: Memory, xj: float, t: float, p: Any) -> tuple[float, Memory]:
    """The demand that the loop closes on, m, and the memory of the effects; the firmware knows no state but `xj`, m."""
    nothing: Memory = 0.0
    s = State(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, xj, nothing)
    return at_command(com, m, s, Input(0.0, 0.0, 0.0, t, 0.0, p.controller.period), p)


def run_controller(m: Memory, com: Any, xj: Any, record: Any, out: Any) -> None:
    """The controller alone over demands and sensed positions; fills out[k] = Cor, A.

    Args:
        m: memory of the port `command` at the start.
        com: (n,) demand, m.
        xj: (n,) sensed position, m.
        record: (1,) parameters of the model.
        out: (n,), written.
    """
    p = record[0]
    c = Loop(0.0, 0.0, 0.0)
    for k in range(len(com)):
        demand, m = apply_command_effects(com[k], m, xj[k], k * p.controller.period, p)
        out[k], c = compute_current(c, demand, xj[k], p.controller)


def compute_answers(model: Model, com: Array, xj: Array) -> Array:
    """Cor, (n,) A, that the model's controller answers to demands `com` and sensed positions `xj`, (n,) m each."""
    out = np.empty(len(com))
    memory = combine_laws("command", model.effects)[1]
    build_kernel(run_controller, model.effects)(memory, com, xj, model.build_record(), out)
    return out
