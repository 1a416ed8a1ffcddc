"""A block of runs side by side: one run a lane of the processor's wide registers.

All that a block knows is in one flat buffer, number f of a lane at f * width + lane: the distances between any two
accesses are constants, so the compiler sees by itself that lanes do not touch each other. With one array a quantity it
would have to check that at run time, and gives up for the number of checks. The loop over the lanes is the innermost,
of constant length, around the very step that a single run takes; whatever it calls must not branch.
"""
from __future__ import annotations

from typing import Any, NamedTuple

from plant.compile import Function, compile_function, make_record_reader, rebind_names
from plant.controller import Loop, compute_current
from plant.flat import make_lane_packers
from plant.model import build_bare_model, build_initial_state, collect_bindings
from plant.plants import find_plant
from plant.ports import at_reading
from plant.replay import (
    compute_pull,
    initialise_sensed_position,
    rest_at_reading,
    set_jack_position,
    set_sample_memories,
)
from plant.solve import apply_command_effects
from plant.state import Input
from plant.step import compute_coefficients, step_plant

WIDTH = 16  # lanes: this stands for a layout's own, which is put in its place
# two of the widest registers, so that one computes while the other waits; for many runs of a short step, four
NARROW, WIDE = 16, 32


class Layout(NamedTuple):
    """How the buffer of a block is laid out for a plant with certain effects."""

    names: dict[str, Function]  # what stands for the functions below and for the ports
    parameters: int  # the number of the first parameter, which follow each other as in `Model.names`
    numbers: int  # of a lane
    width: int  # lanes

class Drive(NamedTuple):
    """Current through the torque motor, A: in this cycle, and the controller's answer for the next."""

    now: float = 0.0
    next: float = 0.0


def _raise_unbound(*arguments: Any) -> Any:
    raise TypeError("no model is bound")


# each of these stands for a model's own, which is put in its place: x_at(buffer, lane), keep_x(x, buffer, lane)
state_at = parameters_at = coefficients_at = loop_at = drive_at = _raise_unbound
keep_state = keep_coefficients = keep_loop = keep_drive = _raise_unbound


def plan_layout(effects: tuple[str, ...], plant: str, width: int = NARROW) -> Layout:
    """The layout for a plant with `effects`, `width` lanes."""
    record = build_bare_model(plant).having(effects).record()
    shapes = {"state": build_initial_state(effects), "loop": Loop(), "drive": Drive(),
              "coefficients": find_plant(plant).coefficients(record[0], 1.0)}
    made, place = collect_bindings(effects, plant), 0
    for name, shape in shapes.items():
        made[f"keep_{name}"], made[f"{name}_at"], place = make_lane_packers(shape, width, place)
    made["parameters_at"] = make_record_reader(record.dtype, place * width, width)
    return Layout(made, place, place + record.view(float).size, width)


def compile_block_kernel(plan: Layout) -> Function:
    """`run` as machine code."""
    return compile_function(rebind_names(run_block, WIDTH=plan.width), plan.names)


def run_block(a: Any, com: Any, load: Any, position: Any, anchor: float, closed: bool, period: float, steps: int,
        rows: Any, out: Any) -> None:
    """A block of runs; fills out[rows[lane], :, k] = XJ as sensed, (Cor in closed loop,) P12, XS at sample k.

    Args:
        a: the block's buffer: state at the start and parameters in place, the rest zero. Used up.
        com: (n,) demand m in closed loop, else the measured current A: com[k - 1] acts from k to k + 1.
        load: (n,) N, external force against extension.
        position: (n,) m, measured; NaN where missing; or (0,).
        anchor: 1/s, how fast the ram is pulled to the measured position.
        closed: with the model's own controller.
        period: of a cycle, s.
        steps: steps a cycle.
        rows: (WIDTH,) where in `out` each lane goes.
        out: (m, 3 or 4, n), written.
    """
    h, columns = period / steps, out.shape[1]
    for lane in range(WIDTH):
        begin_lane(a, lane, position, steps, h)
    for k in range(len(com)):
        t = k * period
        for lane in range(WIDTH):
            row = rows[lane]
            out[row, 0, k], out[row, columns - 2, k], out[row, columns - 1, k] = sample_lane(a, lane, t)
        given = com[k - 1] if k else 0.0
        for lane in range(WIDTH):
            if closed:
                out[rows[lane], 1, k] = control_lane(a, lane, t, com[k], out[rows[lane], 0, k])
            else:
                keep_drive(Drive(given, 0.0), a, lane)
        if len(position):
            for lane in range(WIDTH):
                s = state_at(a, lane)
                pulled = s.jack_position + compute_pull(anchor * period, position[k], s.sensed)
                keep_state(set_jack_position(s, pulled), a, lane)
        for i in range(steps):
            # the loop that everything is for
            for lane in range(WIDTH):
                u = Input(drive_at(a, lane).now, load[k], 0.0, t + i * h, i * h, h)
                keep_state(step_plant(state_at(a, lane), u, parameters_at(a, lane), coefficients_at(a, lane)), a, lane)


def begin_lane(a: Any, lane: int, position: Any, steps: int, h: float) -> None:
    """One lane at rest, where the transducer shows position[0] or at zero; and its coefficients."""
    s, p = state_at(a, lane), parameters_at(a, lane)
    keep_coefficients(compute_coefficients(p, h), a, lane)
    rest = rest_at_reading(s, position[0], p, steps) if len(position) else initialise_sensed_position(s, p)
    keep_state(rest, a, lane)


def sample_lane(a: Any, lane: int, t: float) -> tuple[float, float, float]:
    """What one lane's transducers read at `t`: XJ m, P12 Pa, XS m; as `plant.solve.read_sensors`, but for the noise."""
    s = state_at(a, lane)
    p = parameters_at(a, lane)
    xj, m_reading = at_reading(s.sensed, s.memory.reading, s, Input(0.0, 0.0, 0.0, t, 0.0, p.controller.period), p)
    keep_state(set_sample_memories(s, s.memory.command, m_reading), a, lane)
    return xj, s.pressure, s.spool_position


def control_lane(a: Any, lane: int, t: float, com: float, xj: float) -> float:
    """What the controller of one lane answers to the demand `com` and the position `xj` it sensed; it acts later."""
    s, p, d = state_at(a, lane), parameters_at(a, lane), drive_at(a, lane)
    demand, m_command = apply_command_effects(com, s.memory.command, xj, t, p)
    cor, c = compute_current(loop_at(a, lane), demand, xj, p.controller)
    keep_loop(c, a, lane)
    keep_state(set_sample_memories(s, m_command, s.memory.reading), a, lane)
    keep_drive(Drive(d.next, cor), a, lane)
    return cor
