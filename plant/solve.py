"""One sampled cycle and one closed-loop run, as functions for `plant.model.build_kernel`.

Timing (physics of a synchronous bus): cycle k reads the sensors at t_k, the controller answers a drive, which acts on
the plant from t_k+1 to t_k+2. Row k of a log holds demand, drive and readings of cycle k.
"""

from typing import Any

from plant.controller import take_demand
from plant.kernels import (
    add_noise,
    compute_plant_coefficients,
    control_plant,
    keep_row,
    measure_plant,
    pack_state,
    replace_first,
    start_control,
    step_plant,
    unpack_state,
)
from plant.ports import at_reading
from plant.state import Input, Memory


def read_sensors(s: Any, m: Memory, noise: Any, t: float, p: Any) -> tuple[Any, Memory]:
    """The readings at time `t`, a tuple in the order of the outputs, and the memories.

    `noise` is a standard normal number for each, and one for effects that are noise.
    """
    y = add_noise(measure_plant(s, p), noise, p)
    return read_controlled(y, s, m, noise[len(y)], t, p)


def read_controlled(y: Any, s: Any, m: Memory, noise: float, t: float, p: Any) -> tuple[Any, Memory]:
    """The readings `y` as effects at the port "reading" change them, and the memories."""
    x, m = at_reading(y[0], m, s, Input(0.0, 0.0, noise, t, 0.0, p.controller.period), p)
    return replace_first(y, x), m


def read_flat_sensors(flat: Any, noise: Any, t: float, record: Any) -> Any:
    """`read_sensors` on a flat state, which keeps the memories."""
    s, m = unpack_state(flat)
    y, m = read_sensors(s, m, noise, t, record[0])
    pack_state((s, m), flat)
    return y


def step_cycle(s: Any, m: Memory, drive: float, load: float, noise: float, t: float, record: Any,
               steps: int) -> tuple[Any, Memory]:
    """State and memories one cycle after `t`, drive and load held, in `steps` equal steps; `record` of the model."""
    p = record[0]
    h = p.controller.period / steps
    k = compute_plant_coefficients(p, h)
    for i in range(steps):
        s, m = step_plant(s, m, Input(drive, load, noise, t + i * h, i * h, h), p, k)
    return s, m


def advance_flat_state(flat: Any, drive: float, load: float, noise: float, t: float, record: Any, steps: int) -> None:
    """`step_cycle` in place on a flat state: passing tuples to Python and back costs twice as much as the physics."""
    s, m = unpack_state(flat)
    pack_state(step_cycle(s, m, drive, load, noise, t, record, steps), flat)


def run_closed_loop(flat: Any, com: Any, load: Any, noise: Any, record: Any, steps: int, out: Any) -> None:
    """Runs the plant with its controller over the command `com`; fills out[k] with the columns of cycle k.

    Args:
        flat: state at the start; at the end that after the last cycle.
        com: (n,) demand.
        load: (n,) external load.
        noise: (n, outputs + 1) standard normal numbers.
        record: (1,) parameters of the model.
        steps: steps a cycle.
        out: (n, columns), written: readings and drive in the order of `Signals.columns`.
    """
    p = record[0]
    s, m = unpack_state(flat)
    c = start_control()
    drive = 0.0
    for k in range(len(com)):
        t = k * p.controller.period
        y, m = read_sensors(s, m, noise[k], t, p)
        demand, m = take_demand(com[k], m, y[0], t, p)
        answer, c = control_plant(c, demand, y, p)
        keep_row(y, answer, out, k)
        s, m = step_cycle(s, m, drive, load[k], noise[k, len(y)], t, record, steps)
        drive = answer
    pack_state((s, m), flat)
