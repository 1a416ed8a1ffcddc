"""One sampled cycle and one closed-loop run, as the physics functions that get compiled.

Timing (physics of a synchronous bus): cycle k senses XJ_k at t_k, the firmware answers Cor_k, and Cor_k drives the
torque motor from t_k+1 to t_k+2. Row k of a log holds Com_k, XJ_k, Cor_k and the pressure and spool position at t_k.
"""
from __future__ import annotations

from typing import Any

from plant.controller import Loop, answer
from plant.flat import pack, unpack
from plant.state import Input, State
from plant.step import coefficients, step

NOISES = 4  # standard normal numbers a cycle: position, pressure, spool, and one for effects that are noise


def sense(s: State, noise: Any, p: Any) -> tuple[float, float, float]:
    """What the transducers read at one instant: XJ m, P12 Pa, XS m."""
    g = p.sensors
    return (s.sensed + g.position_noise * noise[0], s.pressure + g.pressure_noise * noise[1],
            s.spool_position + g.spool_noise * noise[2])


def cycle(s: State, current: float, load: float, noise: float, t: float, record: Any, steps: int) -> State:
    """The plant one cycle after `t`, current and load held, in `steps` equal steps; `record` is a model's record."""
    p = record[0]
    h = p.controller.period / steps
    k = coefficients(p, 1.0, h)
    for i in range(steps):
        s = step(s, Input(current, load, noise, t + i * h, i * h, h), p, k)
    return s


def advance(flat: Any, current: float, load: float, noise: float, t: float, record: Any, steps: int) -> None:
    """`cycle` in place on a flat state: tuples would cross into Python and back at twice the price of the physics."""
    pack(cycle(unpack(flat), current, load, noise, t, record, steps), flat)


def closed_loop(s: State, com: Any, load: Any, noise: Any, record: Any, steps: int, out: Any) -> State:
    """The plant with its controller over the command `com`; fills out[k] = XJ, Cor, P12, XS of cycle k.

    Args:
        s: state at the start.
        com: (n,) demand, m.
        load: (n,) external force against extension, N.
        noise: (n, NOISES) standard normal numbers.
        record: (1,) parameters of the model.
        steps: steps a cycle.
        out: (n, 4), written.
    """
    p = record[0]
    c = Loop(0.0, 0.0, 0.0)  # numba does not know the defaults of a named tuple
    current = 0.0
    for k in range(len(com)):
        xj, p12, xs = sense(s, noise[k], p)
        cor, c = answer(c, com[k], xj, p.controller)
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = xj, cor, p12, xs
        s = cycle(s, current, load[k], noise[k, 3], k * p.controller.period, record, steps)
        current = cor
    return s
