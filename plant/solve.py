"""One sampled cycle and one closed-loop run, as functions for `plant.model.build_kernel`.

Timing (physics of a synchronous bus): cycle k senses XJ_k at t_k, the firmware answers Cor_k, and Cor_k drives the
torque motor from t_k+1 to t_k+2. Row k of a log holds Com_k, XJ_k, Cor_k and the pressure and spool position at t_k.
"""
from __future__ import annotations

from typing import Any

from plant.controller import Loop, apply_command_effects, compute_current
from plant.flat import pack_state, unpack_state
from plant.ports import at_reading
from plant.state import Input, Memory, Ports, State
from plant.step import compute_coefficients, step_plant

NOISES = 4  # standard normal numbers a cycle: position, pressure, spool, and one for effects that are noise


def read_sensors(s: State, m: Memory, noise: Any, t: float, p: Any) -> tuple[float, float, float, Memory]:
    """The readings of the transducers at time `t`: XJ m, P12 Pa, XS m; and the memory of the port `reading`."""
    g = p.sensors
    u = Input(0.0, 0.0, noise[3], t, 0.0, p.controller.period)
    xj, m = at_reading(s.sensed + g.position_noise * noise[0], m, s, u, p)
    return xj, s.pressure + g.pressure_noise * noise[1], s.spool_position + g.spool_noise * noise[2], m


def read_flat_sensors(flat: Any, noise: Any, t: float, record: Any) -> tuple[float, float, float]:
    """`read_sensors` on a flat state, which keeps the memory."""
    s = unpack_state(flat)
    xj, p12, xs, m_reading = read_sensors(s, s.memory.reading, noise, t, record[0])
    m = s.memory
    ports = Ports(m.command, m.current, m.supply, m.viscosity, m.nozzle, m.feedback, m.spool_force, m.metering,
                  m.valve, m.load, m.jack_drag, m.position, m_reading)
    pack_state(State(s.flapper_position, s.flapper_speed, s.spool_position, s.spool_speed, s.jack_position,
                     s.jack_speed, s.pressure, s.sensed, ports), flat)
    return xj, p12, xs


def step_cycle(s: State, current: float, load: float, noise: float, t: float, record: Any, steps: int) -> State:
    """The state one cycle after `t`, current, A, and load, N, held, in `steps` equal steps; `record` of the model."""
    p = record[0]
    h = p.controller.period / steps
    k = compute_coefficients(p, h)
    for i in range(steps):
        s = step_plant(s, Input(current, load, noise, t + i * h, i * h, h), p, k)
    return s


def advance_flat_state(flat: Any, current: float, load: float, noise: float, t: float, record: Any, steps: int) -> None:
    """`step_cycle` in place on a flat state: passing tuples to Python and back costs twice as much as the physics."""
    pack_state(step_cycle(unpack_state(flat), current, load, noise, t, record, steps), flat)


def run_closed_loop(s: State, com: Any, load: Any, noise: Any, record: Any, steps: int, out: Any) -> State:
    """Runs the plant with its controller over the command `com`; fills out[k] = XJ, Cor, P12, XS of cycle k.

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
    current, m_reading, m_command = 0.0, s.memory.reading, s.memory.command
    for k in range(len(com)):
        t = k * p.controller.period
        xj, p12, xs, m_reading = read_sensors(s, m_reading, noise[k], t, p)
        demand, m_command = apply_command_effects(com[k], m_command, xj, t, p)
        cor, c = compute_current(c, demand, xj, p.controller)
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = xj, cor, p12, xs
        s = step_cycle(s, current, load[k], noise[k, 3], t, record, steps)
        current = cor
    return s
