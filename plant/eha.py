"""The electrohydraulic actuator: the paper's reference model (Fig. 5), component by component along the signal path.

Stiff terms are implicit: the pressure-flow damping has time constants of 3 us and 22 us, and dry friction is a set.
Positions follow the mean of the old and the new velocity, the flapper the trapezoidal rule with the spool where it
will be in mid step. That leaves 1/170 of the error of the plain implicit scheme at 10 us, for 8 % more time.

Names in capitals in the comments are the paper's symbols; functions named `at_<port>` are bound to the model's effects.
"""

from collections import namedtuple
from math import sqrt

from plant import signals
from plant.compile import bind_later
from plant.declare import Any, Loop, NamedTuple, Plant, clip, control_by_pid, solve_velocity
from plant.parameters import GROUPS, load_nominal_values
from plant.ports import (
    at_current,
    at_feedback,
    at_jack_drag,
    at_load,
    at_metering,
    at_nozzle,
    at_position,
    at_spool_force,
    at_supply,
    at_valve,
    at_viscosity,
)
from plant.state import Drag, Input, Line, Memory


class State(NamedTuple):
    """The plant at one instant; all zero is the centred actuator at rest."""

    flapper_position: float = 0.0  # m, XF, at the nozzles
    flapper_speed: float = 0.0  # m/s
    spool_position: float = 0.0  # m, XS
    spool_speed: float = 0.0  # m/s
    jack_position: float = 0.0  # m, XJ
    jack_speed: float = 0.0  # m/s
    pressure: float = 0.0  # Pa, P12, across the piston
    sensed: float = 0.0  # m, XJ as its transducer shows it, without noise


# computed from the parameters, so that no step divides; constant while these are
Coefficients = namedtuple("Coefficients", (
    "flapper_keep",  # velocity kept over a step
    "flapper_push",  # velocity gained per unit of torque
    "pilot_gain",  # GPF1, Pa/m
    "pilot_slope",  # GPF1 ASV / GQF1, Pa s/m
    "pilot_limit",  # PS1, Pa
    "spool_free",  # 1/kg
    "spool_coupled",  # 1/kg
    "spool_push",  # h ASV
    "valve_stiffness",  # GP AJ / GQ, Pa s/m, the metering edges without leakage
    "valve_loss",  # GP CLK / GQ, their loss of pressure gain by leakage
    "valve_gain",  # Pa/m, the metering edges with leakage
    "valve_slope",  # Pa s/m
    "valve_limit",  # PSR, Pa
    "jack_damping",  # CJ, N s/m
    "jack_free",  # 1/kg
    "jack_coupled",  # 1/kg
))


def compute_flow_share(left: float, law: float) -> float:
    """`left` to the power of `law`, which is 1/2, 1 or 0 (`plant.parameters.FILTER_LAWS`).

    Exact to rounding. The last bit of `**` depends on the CPU.
    """
    share = sqrt(left) if law == 0.5 else left
    return 1.0 if law == 0.0 else share


def compute_coefficients(p: Any, h: float) -> Coefficients:
    """Coefficients at nominal oil for parameters `p` and steps of `h` seconds."""
    v = p.spool
    left = 1.0 - p.filter.clogging  # 1 - Kintas
    gpf1 = p.pilot.pressure_gain * left
    nominal = Coefficients(
        flapper_keep=0.0, flapper_push=0.0, spool_coupled=0.0, valve_gain=0.0, valve_slope=0.0, jack_free=0.0,
        jack_coupled=0.0,  # these seven depend on the oil: scale_coefficients computes them from the others
        pilot_gain=gpf1,
        pilot_slope=gpf1 * v.end_area / (p.pilot.flow_gain * compute_flow_share(left, p.filter.law)),
        pilot_limit=p.supply.pressure * left,
        spool_free=1.0 / (v.mass + h * v.damping),
        spool_push=h * v.end_area,
        valve_stiffness=p.valve.pressure_gain * p.jack.area / p.valve.flow_gain,
        valve_loss=p.valve.pressure_gain * p.jack.leakage / p.valve.flow_gain,
        valve_limit=p.supply.pressure,
        jack_damping=p.jack.damping,
    )
    return scale_coefficients(nominal, 1.0, 1.0, h, p)


@bind_later
def apply_steady_oil(k: Coefficients, s: State, m: Memory, u: Input, p: Any) -> tuple[Coefficients, Memory]:
    """Coefficients at nominal oil, unchanged, and the memories of effects."""
    return k, m


def apply_changing_oil(k: Coefficients, s: State, m: Memory, u: Input, p: Any) -> tuple[Coefficients, Memory]:
    """Coefficients at the present supply pressure and viscosity (`k`, to the last bit, at nominal ones); memories."""
    ratio, m = at_supply(1.0, m, s, u, p)
    thick, m = at_viscosity(1.0, m, s, u, p)
    ratio, thick = max(ratio, LEAST_RATIO), max(thick, LEAST_RATIO)
    return scale_coefficients(k, ratio, thick, u.h, p), m


LEAST_RATIO = 1e-3  # of supply pressure and viscosity: neither quite vanishes
apply_oil = apply_steady_oil


def scale_coefficients(k: Coefficients, ratio: float, thick: float, h: float, p: Any) -> Coefficients:
    """`k` for a supply of `ratio` and a viscosity of `thick` times the nominal."""
    f, root = p.flapper, sqrt(ratio)
    damping, drag = f.damping * thick, k.jack_damping * thick
    stiff = 1.0 / (f.inertia + 0.5 * h * damping + 0.25 * h * h * f.stiffness)
    slope1 = k.pilot_slope * root  # GPF/GQF
    back = 1.0 / (root * thick)
    leak = 1.0 / (1.0 + k.valve_loss * back)  # QJ = AJ XJ' + CLK P12, solved for P12
    slope2 = k.valve_stiffness * (back * thick) * leak
    jack = p.jack.mass + h * drag
    return Coefficients(
        flapper_keep=(f.inertia - 0.5 * h * damping - 0.25 * h * h * f.stiffness) * stiff,
        flapper_push=h * stiff,
        pilot_gain=k.pilot_gain * ratio,
        pilot_slope=slope1,
        pilot_limit=k.pilot_limit * ratio,
        spool_free=k.spool_free,
        spool_coupled=1.0 / (p.spool.mass + h * p.spool.damping + h * p.spool.end_area * slope1),
        spool_push=k.spool_push,
        valve_stiffness=k.valve_stiffness,
        valve_loss=k.valve_loss,
        valve_gain=p.valve.pressure_gain * leak,
        valve_slope=slope2,
        valve_limit=k.valve_limit * ratio,
        jack_damping=drag,
        jack_free=1.0 / jack,
        jack_coupled=1.0 / (jack + h * p.jack.area * slope2),
    )


def move_between_stops(x0: float, v0: float, v: float, h: float, limit: float) -> tuple[float, float]:
    """Position and velocity after a step at the mean velocity, between inelastic stops at +-`limit`."""
    x = (x0 + 0.5 * h * v0) + 0.5 * h * v
    return clip(x, limit), v if abs(x) <= limit else 0.0


def step_flapper(s: State, m: Memory, u: Input, p: Any, k: Coefficients) -> tuple[float, float, Memory]:
    """Torque motor and flapper (trapezoidal rule): XF, XF', memories."""
    current, m = at_current(u.drive, m, s, u, p)
    ahead = s.spool_position + 0.5 * u.h * s.spool_speed
    spring, m = at_feedback(ahead, m, s, u, p)
    own = p.torque_motor.gain * current - p.flapper.stiffness * s.flapper_position
    torque = own - p.feedback_spring.stiffness * spring  # Tact - KF XF; the spool's part last, it is known last
    v = k.flapper_keep * s.flapper_speed + k.flapper_push * torque
    x, v = move_between_stops(s.flapper_position, s.flapper_speed, v, u.h, p.flapper.travel)
    return x, v, m


def step_spool(s: State, m: Memory, u: Input, p: Any, k: Coefficients, xf: float) -> tuple[float, float, Memory]:
    """Pilot pressure and spool: XS, XS', memories."""
    xf, m = at_nozzle(xf, m, s, u, p)
    force, m = at_spool_force(0.0, m, s, u, p)
    v0, g = s.spool_speed, p.spool
    dry = u.h * g.static_friction if v0 == 0.0 else u.h * g.dynamic_friction
    impulse = g.mass * v0 + u.h * force
    v = solve_velocity(v0, impulse, k.spool_push, k.pilot_gain * xf, k.pilot_slope, k.pilot_limit, dry, k.spool_free,
                       k.spool_coupled)
    x, v = move_between_stops(s.spool_position, v0, v, u.h, g.travel)
    return x, v, m


def compute_metering_line(s: State, m: Memory, u: Input, p: Any, k: Coefficients, xs: float) -> tuple[Line, Memory]:
    """Metering edges with leakage: P12 as a function of the ram's speed; memories."""
    opening, m = at_metering(xs, m, s, u, p)
    drive = k.valve_gain * opening
    line, m = at_valve(Line(drive, k.valve_slope, k.valve_limit, drive), m, s, u, p)
    return line, m


@bind_later
def keep_compliance(k: Coefficients, drag: Drag, line: Line, p: Any, h: float) -> tuple[float, float]:
    """Speed of the ram per impulse, 1/kg, at the limit of the pressure and on its slope, if no effect changes it."""
    return k.jack_free, k.jack_coupled


def update_compliance(k: Coefficients, drag: Drag, line: Line, p: Any, h: float) -> tuple[float, float]:
    """The same with effects that may change drag or slope, for two divisions; `k` to the last bit if they do not."""
    mass = p.jack.mass + h * (k.jack_damping + drag.damping)
    free = k.jack_free if drag.damping == 0.0 else 1.0 / mass
    same = drag.damping == 0.0 and line.slope == k.valve_slope
    return free, k.jack_coupled if same else 1.0 / (mass + h * p.jack.area * line.slope)


compute_compliance = keep_compliance


def step_jack(s: Any, m: Memory, u: Input, p: Any, k: Any, line: Line,
              given: float) -> tuple[float, float, float, Memory]:
    """The ram against a `given` load, N: XJ, XJ', P12, memories."""
    g, h, v0 = p.jack, u.h, s.jack_speed
    load, m = at_load(given, m, s, u, p)
    drag, m = at_jack_drag(Drag(0.0, 0.0, g.static_friction, g.dynamic_friction), m, s, u, p)
    push = h * g.area
    free, coupled = compute_compliance(k, drag, line, p, h)
    dry = h * drag.static if v0 == 0.0 else h * drag.dynamic
    impulse = g.mass * v0 - h * (load + drag.force)
    v = solve_velocity(v0, impulse, push, line.offset, line.slope, line.limit, dry, free, coupled)
    x, v = move_between_stops(s.jack_position, v0, v, h, g.travel)
    return x, v, clip(line.offset - line.slope * v, line.limit), m


def step_actuator(s: State, m: Memory, u: Input, p: Any, k: Coefficients) -> tuple[State, Memory]:
    """The state `u.h` seconds later."""
    k, m = apply_oil(k, s, m, u, p)
    xf, vf, m = step_flapper(s, m, u, p, k)
    xs, vs, m = step_spool(s, m, u, p, k, xf)
    line, m = compute_metering_line(s, m, u, p, k, xs)
    xj, vj, p12, m = step_jack(s, m, u, p, k, line, u.load)
    return sense_ram(State(xf, vf, xs, vs, xj, vj, p12, s.sensed), m, u, p)  # it feels the end of the step


def sense_ram(s: State, m: Memory, u: Input, p: Any) -> tuple[State, Memory]:
    """The state with what the ram's transducer shows of it."""
    sensed, m = at_position(s.jack_position, m, s, u, p)
    return State(s.flapper_position, s.flapper_speed, s.spool_position, s.spool_speed, s.jack_position, s.jack_speed,
                 s.pressure, sensed), m


def measure(s: State, p: Any) -> tuple[float, float, float]:
    """What the transducers show: XJ m, P12 Pa, XS m."""
    return s.sensed, s.pressure, s.spool_position


PLANT = Plant(
    title="electrohydraulic actuator with a servovalve",
    signals=signals.EHA,
    parameters=GROUPS,
    state=State,
    step=step_actuator,
    measure=measure,
    moves=("jack_position",),
    control=control_by_pid,
    control_memory=Loop,
    coefficients=compute_coefficients,
    sense=sense_ram,
    variants={"apply_oil": (apply_changing_oil, frozenset({"supply", "viscosity"})),
              "compute_compliance": (update_compliance, frozenset({"valve", "jack_drag"}))},
    values=load_nominal_values(),
    balances=True,
    shared_starts=True,
)
