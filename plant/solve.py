"""What runs of a plant consist of, as functions for `plant.model.build_kernel`: a cycle, a whole loop, its parts alone.

Timing (physics of a synchronous bus): cycle k reads the sensors at t_k, the controller answers a drive, which acts on
the plant from t_k+1 to t_k+2. Row k of a log holds demand, drive and readings of cycle k.
"""

from typing import Any

from plant.friction import soften
from plant.kernels import (
    add_noise,
    compute_plant_coefficients,
    control_plant,
    correct_plant,
    get_readings,
    invert_plant,
    keep_row,
    load_control,
    measure_plant,
    move_plant,
    pack_state,
    replace_first,
    sense_plant,
    shift_memories,
    start_control,
    step_plant,
    unpack_state,
)
from plant.ports import at_command, at_reading
from plant.state import Input, Memory, Sampled


def take_demand(com: float, m: Memory, sensed: float, t: float, p: Any) -> tuple[float, Memory]:
    """The demand that the loop closes on, and the memories; effects know nothing of the plant but what is `sensed`."""
    return at_command(com, m, Sampled(sensed), Input(0.0, 0.0, 0.0, t, 0.0, p.controller.period), p)


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
    s, m = unpack_state(flat, 0)
    y, m = read_sensors(s, m, noise, t, record[0])
    pack_state((s, m), flat, 0)
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
    s, m = unpack_state(flat, 0)
    pack_state(step_cycle(s, m, drive, load, noise, t, record, steps), flat, 0)


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
    s, m = unpack_state(flat, 0)
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
    pack_state((s, m), flat, 0)


def run_controller(flat: Any, control: Any, com: Any, readings: Any, record: Any, out: Any) -> None:
    """The controller alone over demands and readings; fills out[k] with its drive.

    Args:
        flat: state of the plant at the start; only its memories are used.
        control: what the law remembers at the start, from `CONTROL_AT` on.
        com: (n,) demand.
        readings: (n, outputs).
        record: (1,) parameters of the model.
        out: (n,), written.
    """
    p = record[0]
    m = unpack_state(flat, 0)[1]
    c = load_control(control, 0)
    for k in range(len(com)):
        y = get_readings(readings, k)
        demand, m = take_demand(com[k], m, y[0], k * p.controller.period, p)
        out[k], c = control_plant(c, demand, y, p)


def fill_needed_drive(flat: Any, motion: Any, load: Any, record: Any, out: Any) -> None:
    """Fills out[k] with the drive at row k; of `flat`, a state of the plant, only the memories are used."""
    p = record[0]
    m = unpack_state(flat, 0)[1]
    for k in range(len(motion)):
        u = Input(0.0, load[k], 0.0, k * p.controller.period, 0.0, p.controller.period)
        out[k], m = invert_plant(motion[k, 0], motion[k, 1], motion[k, 2], m, u, p)


# ---------------------------------------------------------------------------------------------------------------------
# Runs that are tied to a measured signal: they start where the sensor shows it, and are pulled there
# ---------------------------------------------------------------------------------------------------------------------

def show_start(s: Any, m: Memory, p: Any) -> Any:
    """The state with what its sensors show before the first step; memories stay as they are."""
    return sense_plant(s, m, Input(0.0, 0.0, 0.0, 0.0, 0.0, 1e-5), p)[0]


def rest_at_reading(s: Any, m: Memory, x: float, p: Any, steps: int) -> tuple[Any, Memory]:
    """The plant at rest where its controlled signal shows `x`: a lag has caught up, an offset or gain is made up for.

    Three times the plant is moved by what the sensor is off, and rests for 40 cycles of `steps` steps.
    """
    u = Input(0.0, 0.0, 0.0, 0.0, 0.0, p.controller.period / steps)
    shown = 0.0
    for _ in range(3):
        s = move_plant(s, x - shown, p)
        for _ in range(40 * steps):
            s, m = sense_plant(s, m, u, p)
        shown = measure_plant(s, p)[0]
    return s, m


def pull_plant(s: Any, m: Memory, share: float, measured: float, slack: float, p: Any) -> tuple[Any, Memory]:
    """The plant moved by this share of the way to the measured signal; as it is where none was measured.

    Positions that a sensor remembers move along. Else the noise of the measurement would push a ram through the play of
    its rod end, and the play would seem 1 um smaller than it is.

    The measured signal of a coarse sensor says no more than that the true one is within `slack` of it, half a step. An
    observer that took the rounding for motion would add it to every speed, the same in each repeat of a run.
    """
    moved = share * soften(measured - measure_plant(s, p)[0], slack) if measured == measured else 0.0
    return correct_plant(s, moved, p), shift_memories(m, moved)
