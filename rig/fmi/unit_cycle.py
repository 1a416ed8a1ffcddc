"""One communication step of an exported unit, as a function for `plant.model.build_kernel`."""
from __future__ import annotations

from typing import Any

from plant.controller import Loop, apply_command_effects, compute_current
from plant.flat import pack_state, unpack_state
from plant.ports import at_position
from plant.solve import read_sensors, step_cycle
from plant.state import Input, Memory, Ports, State

LOOP = 5  # integral part, A, error, m, and cycles of the controller, its answer; cycles of the plant, -1: not started
INPUTS = 5


def advance_unit(flat: Any, loop: Any, inputs: Any, noise: Any, record: Any, steps: int, out: Any) -> None:
    """Advance a unit by one cycle and read its transducers, with the numbers of `plant.solve.run_closed_loop`.

    A unit that has not started stays where it is: only its transducers are read.

    Args:
        flat: state of the plant, changed in place.
        loop: (LOOP,) state of the controller, changed in place.
        inputs: (INPUTS,) demand, drive and load of this cycle; 1 where the controller closes the loop, so that its
            answer to the cycle before drives the plant; and the standard normal number of effects that are noise.
        noise: (NOISES,) standard normal numbers of the cycle that follows, whose readings these are.
        record: (1,) parameters of the model.
        steps: of the solver, a cycle.
        out: (outputs + 1,) readings at the end, and the controller's answer; holds those at the start.
    """
    p = record[0]
    s = unpack_state(flat)
    m_command: Memory = s.memory.command
    if loop[4] < 0.0:
        shown = at_position(s.jack_position, s.memory.position, s, Input(0.0, 0.0, 0.0, 0.0, 0.0, 1e-5), p)[0]
        s = _replace(s, shown, m_command, s.memory.reading)
    else:
        t = loop[4] * p.controller.period
        drive = inputs[1]
        if inputs[3] > 0.0:
            drive = loop[3]
            demand, m_command = apply_command_effects(inputs[0], m_command, out[0], t, p)
            loop[3], c = compute_current(Loop(loop[0], loop[1], loop[2]), demand, out[0], p.controller)
            loop[0], loop[1], loop[2] = c.integral, c.error, c.cycles
        s = step_cycle(s, drive, inputs[2], inputs[4], t, record, steps)
    loop[4] += 1.0
    out[0], out[1], out[2], m_reading = read_sensors(s, s.memory.reading, noise, loop[4] * p.controller.period, p)
    out[3] = loop[3]
    pack_state(_replace(s, s.sensed, m_command, m_reading), flat)


def _replace(s: State, sensed: float, m_command: Memory, m_reading: Memory) -> State:
    """The state with another reading and other memories of the ports around the sampled loop."""
    m = s.memory
    ports = Ports(m_command, m.current, m.supply, m.viscosity, m.nozzle, m.feedback, m.spool_force, m.metering,
                  m.valve, m.load, m.jack_drag, m.position, m_reading)
    return State(s.flapper_position, s.flapper_speed, s.spool_position, s.spool_speed, s.jack_position, s.jack_speed,
                 s.pressure, sensed, ports)
