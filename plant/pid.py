"""The law of the reference firmware: PID on the sensed error, limited. By default it is proportional only."""

from typing import Any, NamedTuple

from plant.friction import clip


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
    unlimited_current = p.proportional_gain * error + integral + p.derivative_gain * rate
    current = clip(unlimited_current, p.current_limit)
    winding = current != unlimited_current and unlimited_current * error > 0.0
    return current, Loop(c.integral if winding else integral, error, c.cycles + 1.0)


def control_by_pid(c: Loop, demand: float, y: Any, p: Any) -> tuple[float, Loop]:
    """Drive for the next cycle and the memory, by the PID law on the first of the readings `y`."""
    return compute_current(c, demand, y[0], p.controller)
