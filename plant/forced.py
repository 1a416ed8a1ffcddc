"""Two balances of the jack from measured signals, with the laws and effects of a model.

Flow: from the measured spool position and P12, the metering edges give the speed of the ram.
Force: at that speed, the force of the measured P12 must equal inertia, drag, loads and friction.
Neither depends on the spool's friction, the pilot stage or the controller, so a fault there does not show.
"""

from typing import Any

import numpy as np

from plant.eha import Coefficients, State, apply_oil, compute_coefficients, compute_metering_line, sense_ram
from plant.kernels import unpack_state
from plant.model import Model, build_kernel
from plant.ports import at_jack_drag, at_load
from plant.segments import Array
from plant.solve import rest_at_reading
from plant.state import Drag, Input, Memory

STEPS, FINE = 5, 100  # a cycle: what was stiff is given here, only effects that remember want many


def compute_flow_balance(model: Model, spool: Array, pressure: Array, position: float) -> tuple[Array, Array]:
    """Ram position as sensed, (n,) m, and speed, (n,) m/s, that follow from measured XS (n,) m and P12 (n,) Pa.

    It solves the metering edges' law P12(XS, v) for v; without effects AJ v = GQ (XS - P12/GP) - CLK P12. The run
    starts where the transducer shows `position`, m; between samples the inputs are interpolated linearly.
    """
    out = np.empty((len(spool), 2))
    columns = np.ascontiguousarray(np.column_stack([spool, pressure]), float)
    run = build_kernel(run_flow_balance, model.effects)
    run(model.build_flat_state(), columns, float(position), model.build_record(), _choose_steps(model), out)
    return out[:, 0].copy(), out[:, 1].copy()


def compute_force_balance(model: Model, position: Array, speed: Array, pressure: Array,
                  load: Array) -> tuple[Array, Array, Array]:
    """Force that the motion of the ram needs without dry friction, and the static and dynamic friction levels, (n,) N.

    The first is MJ a + CJ v + FR from the measured position (n,) m, the speed (n,) m/s and the load (n,) N. AJ P12
    less the first is the force of dry friction. Some effects also depend on the measured P12, (n,) Pa.
    """
    out = np.empty((len(speed), 3))
    rate = np.gradient(speed, model["controller.period"])
    columns = np.ascontiguousarray(np.column_stack([position, speed, rate, pressure, load]), float)
    run = build_kernel(run_force_balance, model.effects)
    run(model.build_flat_state(), columns, model.build_record(), _choose_steps(model), out)
    return out[:, 0].copy(), out[:, 1].copy(), out[:, 2].copy()


def _choose_steps(model: Model) -> int:
    return FINE if any(model.find_effect(e).memory is not None for e in model.effects) else STEPS


def compute_pressure_excess(v: float, s: State, m: Memory, u: Input, p: Any, constant: Coefficients
                            ) -> tuple[float, Memory]:
    """Pressure of the metering edges at ram speed `v` less the pressure of the state, Pa; and the memories after it."""
    s = State(s.flapper_position, s.flapper_speed, s.spool_position, s.spool_speed, s.jack_position, v, s.pressure,
              s.sensed)
    k, m = apply_oil(constant, s, m, u, p)
    line, m = compute_metering_line(s, m, u, p, k, s.spool_position)
    return line.offset - line.slope * v, m


def solve_ram_speed(s: State, m: Memory, p12: float, u: Input, p: Any, constant: Coefficients) -> tuple[float, Memory]:
    """Ram speed at which the metering edges leave `p12`, Pa; by the secant method, exact for a straight line."""
    v0 = s.jack_speed
    f0, after = compute_pressure_excess(v0, s, m, u, p, constant)
    v1 = v0 + (f0 - p12) / constant.valve_slope
    for _ in range(3):
        f1, after = compute_pressure_excess(v1, s, m, u, p, constant)
        slope = (f1 - f0) / (v1 - v0) if v1 != v0 else 0.0
        v2 = v1 - (f1 - p12) / slope if slope != 0.0 else v1
        v0, f0, v1 = v1, f1, v2
    return v1, after


def run_flow_balance(flat: Any, rows: Any, position: float, record: Any, steps: int, out: Any) -> None:
    """Fills out[k] = XJ as sensed and v at sample k, from measured `rows` (n, 2): spool position m, pressure Pa."""
    p = record[0]
    h = p.controller.period / steps
    constant = compute_coefficients(p, h)
    s, m = unpack_state(flat, 0)
    s, m = rest_at_reading(s, m, position, p, steps)
    for k in range(len(rows)):
        ahead = min(k + 1, len(rows) - 1)
        for i in range(steps):
            part = (i + 0.5) / steps
            xs = rows[k, 0] + part * (rows[ahead, 0] - rows[k, 0])
            p12 = rows[k, 1] + part * (rows[ahead, 1] - rows[k, 1])
            u = Input(0.0, 0.0, 0.0, k * p.controller.period + i * h, i * h, h)
            s = State(0.0, 0.0, xs, 0.0, s.jack_position, s.jack_speed, s.pressure, s.sensed)
            v, m = solve_ram_speed(s, m, p12, u, p, constant)
            if i == 0:
                out[k, 0], out[k, 1] = s.sensed, v
            s, m = sense_ram(State(0.0, 0.0, xs, 0.0, s.jack_position + h * v, v, p12, s.sensed), m, u, p)


def run_force_balance(flat: Any, motion: Any, record: Any, steps: int, out: Any) -> None:
    """Fills out[k] = MJ a + CJ v + FR, static and dynamic friction, N, at sample k of a given motion.

    `motion` (n, 5): position m, speed m/s, acceleration m/s2, P12 Pa, load N.
    """
    p = record[0]
    g = p.jack
    h = p.controller.period / steps
    constant = compute_coefficients(p, h)
    m = unpack_state(flat, 0)[1]
    for k in range(len(motion)):
        x, v, rate, p12, load = motion[k, 0], motion[k, 1], motion[k, 2], motion[k, 3], motion[k, 4]
        for i in range(steps):
            u = Input(0.0, load, 0.0, k * p.controller.period + i * h, i * h, h)
            now = State(0.0, 0.0, 0.0, 0.0, x + i * h * v, v + i * h * rate, p12, x)
            outside, m = at_load(load, m, now, u, p)
            drag, m = at_jack_drag(Drag(0.0, 0.0, g.static_friction, g.dynamic_friction), m, now, u, p)
            if i == 0:
                oil, _ = apply_oil(constant, now, m, u, p)
                out[k, 0] = g.mass * rate + (oil.jack_damping + drag.damping) * v + outside + drag.force
                out[k, 1], out[k, 2] = drag.static, drag.dynamic
