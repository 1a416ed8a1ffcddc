"""A block of runs side by side: one run a lane of the processor's wide registers.

All that a block knows is in one flat buffer, number f of a lane at f * WIDTH + lane: the distances between any two
accesses are constants, so the compiler sees by itself that lanes do not touch each other. With one array a quantity it
would have to check that at run time, and gives up for the number of checks. The loop over the lanes is the innermost,
of constant length, around the very step that a single run takes; whatever it calls must not branch.
"""
from __future__ import annotations

from collections import namedtuple
from typing import Any, NamedTuple

from plant.compile import Function
from plant.controller import Loop, answer
from plant.flat import lane_packers
from plant.model import bindings, initial, known_groups
from plant.replay import SILENCE, moved, pull, rested, sampled, shown
from plant.solve import demanded, sense
from plant.state import Input
from plant.step import Coefficients, coefficients, step

WIDTH = 16  # lanes: two of the widest registers, so that one computes while the other waits for its results


class Drive(NamedTuple):
    """Current through the torque motor, A: in this cycle, and in the next."""

    now: float = 0.0
    next: float = 0.0


def _bound(*arguments: Any) -> Any:
    raise TypeError("no model is bound")


# each of these stands for a model's own, which is put in its place: x_at(buffer, lane), keep_x(x, buffer, lane)
state_at = parameters_at = coefficients_at = loop_at = drive_at = _bound
keep_state = keep_coefficients = keep_loop = keep_drive = _bound


def layout(effects: tuple[str, ...]) -> tuple[dict[str, Function], int, int]:
    """For a model with `effects`: what stands for the functions above and the ports; the first number of its
    parameters, and how many numbers a lane has."""
    groups = known_groups(effects)
    parameters = namedtuple("parameters", groups)(*(g(*[0.0] * len(g._fields)) for g in groups.values()))
    shapes = {"state": initial(effects), "parameters": parameters, "loop": Loop(), "drive": Drive(),
              "coefficients": Coefficients(*[0.0] * len(Coefficients._fields))}
    made, first, place = bindings(effects), {}, 0
    for name, shape in shapes.items():
        first[name] = place
        made[f"keep_{name}"], made[f"{name}_at"], place = lane_packers(shape, WIDTH, place)
    return made, first["parameters"], place


def run(a: Any, com: Any, load: Any, position: Any, anchor: float, closed: bool, period: float, steps: int,
        out: Any) -> None:
    """A block of runs; fills out[lane, :, k] = XJ as sensed, (Cor in closed loop,) P12, XS at sample k.

    Args:
        a: the block's buffer: state at the start and parameters in place, the rest zero. Used up.
        com: (n,) demand m in closed loop, else the measured current A: com[k - 1] acts from k to k + 1.
        load: (n,) N, external force against extension.
        position: (n,) m, measured; NaN where missing; or (0,).
        anchor: 1/s, how fast the ram is pulled to the measured position.
        closed: with the model's own controller.
        period: of a cycle, s.
        steps: steps a cycle.
        out: (WIDTH, 3 or 4, n), written.
    """
    h = period / steps
    for lane in range(WIDTH):
        p = parameters_at(a, lane)
        keep_coefficients(coefficients(p, h), a, lane)
        s = state_at(a, lane)
        keep_state(rested(s, position[0], p, steps) if len(position) else shown(s, p), a, lane)
    for k in range(len(com)):
        t = k * period
        for lane in range(WIDTH):
            sample(a, lane, t, com[k], closed, out, k)
        if len(position):
            for lane in range(WIDTH):
                s = state_at(a, lane)
                keep_state(moved(s, s.jack_position + pull(anchor * period, position[k], s.sensed)), a, lane)
        for i in range(steps):
            # the loop that everything is for
            for lane in range(WIDTH):
                u = Input(drive_at(a, lane).now, load[k], 0.0, t + i * h, i * h, h)
                keep_state(step(state_at(a, lane), u, parameters_at(a, lane), coefficients_at(a, lane)), a, lane)


def sample(a: Any, lane: int, t: float, com: float, closed: bool, out: Any, k: int) -> None:
    """One lane's transducers read and its next current known, as `plant.solve` and `plant.replay` do for one run."""
    s, p = state_at(a, lane), parameters_at(a, lane)
    xj, p12, xs, m_reading = sense(s, s.memory.reading, SILENCE, t, p)
    n = out.shape[1]
    out[lane, 0, k], out[lane, n - 2, k], out[lane, n - 1, k] = xj, p12, xs
    cor, m_command = com, s.memory.command
    if closed:
        demand, m_command = demanded(com, m_command, xj, t, p)
        cor, c = answer(loop_at(a, lane), demand, xj, p.controller)
        keep_loop(c, a, lane)
        out[lane, 1, k] = cor
    keep_state(sampled(s, m_command, m_reading), a, lane)
    keep_drive(Drive(drive_at(a, lane).next, cor), a, lane)
