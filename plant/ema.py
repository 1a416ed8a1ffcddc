"""An electromechanical actuator: a brushless motor with its drive turns a ball screw, the screw moves a surface.

Motor and screw are seen from the nut, in metres: z = r theta with r = lead/(2 pi ratio).

    L i' = V - R i - Ke theta'          V = L wc (i_ref - i) + R wc int(i_ref - i) + Ke theta', |V| <= Vdc
    J/r^2 z'' = Kt i/r - B/r^2 z' - F   F = k (d - clip(d, b/2) + tau d'), d = z - x; none within the backlash b
    M x'' = F - C x' - dry(FS, FD, x') - load        |x| <= travel, FS = FD (1 + stiction)

The current controller cancels the pole of the winding, so the current follows as a first-order lag of 1/wc (Krishnan,
Permanent Magnet Synchronous and Brushless DC Motor Drives, 2010). Backlash as a dead zone with a spring behind it
(Nordin and Gutman, Automatica 38, 2002); dry friction after Karnopp 1985. Faults and their ranges: Dalla Vedova,
Germana, Berri and Maggiore, Aerospace 6(9), 94, 2019.
"""
from collections import namedtuple
from collections.abc import Mapping
from math import cos, exp, pi

import numpy as np

from plant.declare import (
    Annotated,
    Any,
    Chirp,
    Fault,
    Hold,
    NamedTuple,
    Plant,
    Quantity,
    Ramp,
    Signal,
    Sine,
    Step,
    base_effect,
    clip,
    effect,
    port,
    solve_sliding,
)
from plant.plants import Table, Term
from plant.segments import Array
from plant.signals import Signals


class Motor(NamedTuple):
    """The motor, with the inertia of gear and screw."""

    torque_constant: Annotated[float, Quantity("N m/A", "Kt", low=1e-4, high=100)] = 0.2
    inertia: Annotated[float, Quantity("kg m2", "J", low=1e-12, high=10, tolerance=0.02)] = 2e-4
    damping: Annotated[float, Quantity("N m s/rad", "B", low=0, high=10)] = 1e-4
    resistance: Annotated[float, Quantity("ohm", "R", low=1e-3, high=100)] = 0.5
    inductance: Annotated[float, Quantity("H", "L", low=1e-6, high=1)] = 1e-3


class Drive(NamedTuple):
    """The power stage with its current controller."""

    bandwidth: Annotated[float, Quantity("1/s", "wc", low=10, high=1e5)] = 5e3
    voltage: Annotated[float, Quantity("V", "Vdc", low=1, high=2e3)] = 270.0
    current_limit: Annotated[float, Quantity("A", low=1e-3, high=1e4)] = 25.0


class Screw(NamedTuple):
    """Gear and ball screw, up to the surface."""

    lead: Annotated[float, Quantity("m", low=1e-4, high=10)] = 8e-3
    ratio: Annotated[float, Quantity("1", low=1e-2, high=1e3)] = 5.0
    compliance: Annotated[float, Quantity("m/N", "1/k", low=0, high=1e-4)] = 1e-8
    relaxation: Annotated[float, Quantity("s", "tau", low=0, high=0.1)] = 5e-5
    backlash: Annotated[float, Quantity("m", "b", low=0, high=1e-2)] = 0.0


class Surface(NamedTuple):
    """The moved mass, with the friction of screw, seals and bearings."""

    mass: Annotated[float, Quantity("kg", "M", low=1e-2, high=1e6, tolerance=0.02)] = 200.0
    damping: Annotated[float, Quantity("N s/m", "C", low=0, high=1e7, tolerance=0.05)] = 2e3
    friction: Annotated[float, Quantity("N", "FD", low=0, high=1e6, tolerance=0.05)] = 100.0
    stiction: Annotated[float, Quantity("1", "FS/FD - 1", low=0, high=10)] = 0.5
    travel: Annotated[float, Quantity("m", low=1e-3, high=10)] = 0.06


class Controller(NamedTuple):
    """The cascade of the example controller: position error to speed to current."""

    position_gain: Annotated[float, Quantity("1/s", "kp", low=0, high=1e4)] = 25.0
    speed_gain: Annotated[float, Quantity("A s/m", "kv", low=0, high=1e7)] = 600.0
    speed_integral: Annotated[float, Quantity("1/s", low=0, high=1e4)] = 20.0
    speed_limit: Annotated[float, Quantity("m/s", low=1e-4, high=100)] = 0.1
    current_limit: Annotated[float, Quantity("A", low=1e-3, high=1e4)] = 20.0
    measured_speed: Annotated[float, Quantity("1", words={"motor": 1.0, "position": 0.0})] = 1.0
    period: Annotated[float, Quantity("s", low=1e-4, high=0.1)] = 1e-3


class Observer(NamedTuple):
    """How replays follow the measured position: the faster, the finer its sensor; M w^2 noise is small beside FD."""

    rate: Annotated[float, Quantity("1/s", "w", low=1, high=300, typical="25: 1 um of noise; 200: 50 nm")] = 25.0


class State(NamedTuple):
    """The state at one instant; all zero is the centred actuator at rest."""

    current: float = 0.0  # A
    integral: float = 0.0  # V, of the current controller
    motor_position: float = 0.0  # m, z
    motor_speed: float = 0.0  # m/s
    position: float = 0.0  # m, x
    speed: float = 0.0  # m/s
    sensed: float = 0.0  # m, x as its transducer shows it


class Friction(NamedTuple):
    """What resists the surface: dry(static, dynamic) + force, N."""

    force: float
    static: float
    dynamic: float


# what follows from the parameters and the step, so that no step divides
Coefficients = namedtuple("Coefficients", (
    "half_step",  # h/(2 L)
    "loop_gain",  # L wc + h R wc/2, V/A
    "follow",  # of the mean current of a step, within the voltage
    "decay",  # the same at the limit of the voltage
    "integration",  # h R wc
    "emf",  # V s/m
    "per_radius",  # 1/r
    "motor_keep",
    "motor_push",  # h over the effective mass of the motor
    "before",  # s, of the relative speed before the step in the stretch that makes the force
    "after",  # s, the same of that after it
    "lever",  # after + tau
    "stiffness",  # of the screw with the motor behind it, N/m
    "slope",  # N s/m, fall of the screw's force with the speed of the surface
    "free",  # 1/kg
    "coupled",  # 1/kg
    "new",  # weight of the new speed in the way of a step
))


def compute_coefficients(p: Any, h: float) -> Coefficients:
    """Coefficients for steps of `h` seconds.

    The spring takes the midpoint rule, which keeps the energy, while it is slow beside the step, and the end of the
    step where it is stiff or rigid (compliance 0); w goes from 0 to 1 between them.
    """
    r = p.screw.lead / (2.0 * pi * p.screw.ratio)
    mass, mt = p.motor.inertia / (r * r), p.surface.mass
    push = h / (mass + h * p.motor.damping / (r * r))
    reduced = mass * mt / (mass + mt)
    w = h * h / (h * h + 8.0 * p.screw.compliance * reduced)
    after = h * (0.25 + 0.75 * w)
    lever = after + p.screw.relaxation
    stiffness = 1.0 / (p.screw.compliance + lever * push)
    gain = p.drive.bandwidth * (p.motor.inductance + 0.5 * h * p.motor.resistance)
    half = 0.5 * h / p.motor.inductance
    surface = mt + h * p.surface.damping
    return Coefficients(half, gain, 1.0 / (1.0 + half * (p.motor.resistance + gain)),
                        1.0 / (1.0 + half * p.motor.resistance), h * p.drive.bandwidth * p.motor.resistance,
                        p.motor.torque_constant / r, 1.0 / r, push * mass / h, push,
                        0.25 * h * (1.0 - w), after, lever, stiffness, stiffness * lever, 1.0 / surface,
                        1.0 / (surface + h * stiffness * lever), 0.5 + 0.5 * w)


at_current = port("A", "demanded current, as the power stage takes it")
at_torque = port("N m", "torque of the motor")
at_load = port("N", "external force on the surface, against extension")
at_friction = port("N", "what resists the surface")
at_position = port("m", "position, as its transducer shows it")


def step_current(s: State, wanted: float, p: Any, k: Any) -> tuple[float, float, float]:
    """Mean current of the step, A, current at its end, and integral of the controller, V (trapezoidal rule)."""
    emf = k.emf * s.motor_speed
    mean = k.follow * (s.current + k.half_step * (k.loop_gain * wanted + s.integral))
    asked = k.loop_gain * (wanted - mean) + s.integral  # beyond the electromotive force, which the drive adds
    low, high = -p.drive.voltage - emf, p.drive.voltage - emf
    held = asked if asked > low else low
    held = held if held < high else high
    is_free = held == asked
    mean = mean if is_free else k.decay * (s.current + k.half_step * held)
    integral = s.integral + k.integration * (wanted - mean) if is_free else s.integral
    return mean, 2.0 * mean - s.current, integral


def step(s: State, m: Any, u: Any, p: Any, k: Any) -> tuple[State, Any]:
    """The state `u.h` seconds later.

    The screw's force is a line over the surface's speed, F = offset - slope v, once the motor is eliminated; without
    contact it is none. The stretch that follows without contact tells which side touches: the force falls as the
    surface's speed rises, and friction with it, so there is one solution.
    """
    h = u.h
    wanted, m = at_current(u.drive, m, s, u, p)
    mean, current, integral = step_current(s, clip(wanted, p.drive.current_limit), p, k)
    torque, m = at_torque(p.motor.torque_constant * mean, m, s, u, p)
    load, m = at_load(u.load, m, s, u, p)
    level = p.surface.friction
    friction, m = at_friction(Friction(0.0, level * (1.0 + p.surface.stiction), level), m, s, u, p)
    v0, w0 = s.speed, s.motor_speed
    impulse = p.surface.mass * v0 - h * (load + friction.force)
    dry = h * (friction.static if v0 == 0.0 else friction.dynamic)
    alone = k.motor_keep * w0 + k.motor_push * k.per_radius * torque  # speed of the motor without the screw
    loose = solve_sliding(v0, impulse, dry, k.free)
    stretch = s.motor_position - s.position + k.before * (w0 - v0)
    half = 0.5 * p.screw.backlash
    reached = stretch + k.after * (alone - loose)
    side = 1.0 if reached > 0.0 else -1.0
    offset = k.stiffness * (stretch - side * half + k.lever * alone)
    v = solve_sliding(v0, impulse + h * offset, dry, k.coupled)
    force = offset - k.slope * v
    touches = half == 0.0 or (side * reached > half and side * force > 0.0)
    v, force = v if touches else loose, force if touches else 0.0
    w = alone - k.motor_push * force
    x = s.position + h * ((1.0 - k.new) * v0 + k.new * v)
    z = s.motor_position + h * ((1.0 - k.new) * w0 + k.new * w)
    v = v if abs(x) <= p.surface.travel else 0.0
    x = clip(x, p.surface.travel)
    sensed, m = at_position(x, m, State(current, integral, z, w, x, v, s.sensed), u, p)
    return State(current, integral, z, w, x, v, sensed), m


def measure(s: State, p: Any) -> tuple[float, float, float]:
    """Position of the surface, m, speed of the motor, rad/s, and its current, A."""
    return s.sensed, s.motor_speed * (2.0 * pi) * p.screw.ratio / p.screw.lead, s.current


def correct(s: State, distance: float, p: Any) -> State:
    """The actuator after a correction of a replay: an observer of position and speed with both poles at its rate w.

    A position drawn alone leaves the speed wrong for as long as friction takes to slow it: errors of force add up to
    waves of seconds, in which friction, mass and load trade places. This residual is force/(mass w^2) within 1/w.
    Every replay is drawn at 20 1/s; here it is drawn at 2 w, and the speed by w/2 of that. The speed of a surface that
    friction holds is known: it is 0, and the noise of the position must not tear it off its stiction.
    """
    moved = distance * p.observer.rate * (2.0 / 20.0)
    gained = 0.5 * p.observer.rate * moved if s.speed != 0.0 else 0.0
    return State(s.current, s.integral, s.motor_position + moved, s.motor_speed + gained, s.position + moved,
                 s.speed + gained, s.sensed)


def compute_needed_current(x: float, v: float, a: float, m: Any, u: Any, p: Any) -> tuple[float, Any]:
    """Motor current, A, for a motion with the rigid screw; the surface at rest is taken to need no friction."""
    s = State(0.0, 0.0, x, v, x, v, x)
    load, m = at_load(u.load, m, s, u, p)
    level = p.surface.friction
    friction, m = at_friction(Friction(0.0, level * (1.0 + p.surface.stiction), level), m, s, u, p)
    side = (1.0 if v > 0.0 else 0.0) - (1.0 if v < 0.0 else 0.0)
    force = p.surface.mass * a + p.surface.damping * v + friction.force + side * friction.dynamic + load
    r = p.screw.lead / (2.0 * pi * p.screw.ratio)
    return (r * force + (p.motor.inertia * a + p.motor.damping * v) / r) / p.motor.torque_constant, m


def sense(s: State, m: Any, u: Any, p: Any) -> tuple[State, Any]:
    """The transducer of the position, at rest."""
    sensed, m = at_position(s.position, m, s, u, p)
    return State(s.current, s.integral, s.motor_position, s.motor_speed, s.position, s.speed, sensed), m


class Loops(NamedTuple):
    """What the controller remembers."""

    integral: float = 0.0  # A
    last: float = 0.0  # m, reading of the position a cycle ago
    before: float = 0.0  # m, and the one before
    cycles: float = 0.0


def control(c: Loops, demand: float, y: Any, p: Any) -> tuple[float, Loops]:
    """Current for the next cycle, A, of a cascade without feed-forward.

    The speed is that of the motor, or the mean of the last two differences of the position. The integral part waits
    while the current is limited.
    """
    g = p.controller
    difference = (y[0] - c.before) * 0.5 / g.period if c.cycles >= 2.0 else 0.0
    motor = y[1] * p.screw.lead / (2.0 * pi * p.screw.ratio)
    speed = motor if g.measured_speed > 0.5 else difference
    error = clip(g.position_gain * (demand - y[0]), g.speed_limit) - speed
    integral = c.integral + g.speed_gain * g.speed_integral * g.period * error
    wanted = g.speed_gain * error + integral
    current = clip(wanted, g.current_limit)
    is_limited = current != wanted and wanted * error > 0.0
    return current, Loops(c.integral if is_limited else integral, y[0], c.last, c.cycles + 1.0)


# ---------------------------------------------------------------------------------------------------------------------
# Effects
# ---------------------------------------------------------------------------------------------------------------------

_FAULTS = "Dalla Vedova, Germana, Berri and Maggiore, Aerospace 6(9), 94, 2019"

base_effect("backlash", Screw, "backlash", law="F = 0 while |z - x| < b/2", starts=(2e-5, 6e-5, 2e-4),
            symptoms="at each reversal the motor turns and the surface waits",
            source="Nordin and Gutman 2002; " + _FAULTS)
base_effect("dry_friction", Surface, "friction", law="dry(FS, FD, x')", starts=(15.0, 50.0, 200.0, 500.0),
            symptoms="the current steps with the sign of the speed", source="Karnopp 1985; " + _FAULTS)
base_effect("stiction", Surface, "stiction", law="FS = FD (1 + stiction)", starts=(0.2, 1.0, 2.0),
            symptoms="stick-slip at low speed: the surface waits and then jumps", source="Karnopp 1985")
base_effect("viscous_friction", Surface, "damping", law="C x'", symptoms="the current grows with speed",
            starts=(500.0, 4e3, 1e4), source="grease of the screw, at low temperature above all")
base_effect("moving_mass", Surface, "mass", law="M x''", symptoms="the current grows with acceleration",
            starts=(100.0, 400.0, 1000.0), source="another surface, or ice on it")
base_effect("screw_compliance", Screw, "compliance", law="F = (z - x)/compliance",
            symptoms="the surface follows the motor later, the more the larger the force; a resonance",
            starts=(2e-8, 5e-8, 2e-7), source="axial stiffness of screw and nut, ISO 3408-4")
base_effect("torque_gain", Motor, "torque_constant", law="T = Kt i, Ke = Kt", starts=(0.18, 0.14, 0.22),
            symptoms="all forces need more current, or less: weak magnets, by their share",
            source="torque and electromotive force in proportion to the magnets' flux, Krishnan 2010")


@effect("friction", {  # By what fraction the friction is higher in extension, and lower in retraction.
    "asymmetry": Quantity("1", low=-1, high=1, typical="0.1-0.5"),
}, law="(FD + C |x'|) (1 + d sign(x'))", starts=(0.1, -0.1, 0.4, -0.4),
    symptoms="more current one way than the other, the more the faster", confused_with=("constant_load",),
    source="a worn screw: Janot, Gautier and Brunot, EMPS, 2019")
def friction_asymmetry(x: Friction, s: Any, u: Any, p: Any) -> Friction:
    """The flanks of nut and screw are not worn alike: dry and viscous friction depend on the direction."""
    level = x.static if s.speed == 0.0 else x.dynamic
    more = p.friction_asymmetry.asymmetry * (level + p.surface.damping * abs(s.speed))
    return Friction(x.force + more, x.static, x.dynamic)


@effect("friction", {  # Rise of friction towards standstill, a fraction of FS, and the speed over which it is lost.
    "rise": Quantity("1", low=0, high=10, typical="0.2-1"),
    "speed": Quantity("m/s", above=0, high=10, typical="1-50 mm/s"),
}, off={"speed": 0.01}, law="FD + rise FS exp(-(x'/speed)^2); at rest no less than that",
    symptoms="more current at creep speed; stick-slip", starts=((0.3, 0.01), (1.0, 0.003), (1.0, 0.03)),
    source="Stribeck 1902; Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30, 1994")
def stribeck(x: Friction, s: Any, u: Any, p: Any) -> Friction:
    """Boundary lubrication: the film in screw and seals carries more the faster they move."""
    g, v = p.stribeck, s.speed / p.stribeck.speed
    rise = g.rise * x.static
    top = x.dynamic + rise
    raised = g.rise > 0.0 and top > x.static
    return Friction(x.force, top if raised else x.static, x.dynamic + rise * exp(-v * v))


def compute_angle(s: Any, p: Any) -> Any:
    """Angle of the motor, rad."""
    return s.motor_position * (2.0 * pi * p.screw.ratio) / p.screw.lead


@effect("torque", {  # Amplitude and phase of a torque without current, and its periods per turn (slots and poles).
    "torque": Quantity("N m", low=0, high=100, typical="0.5-5 % of the rated torque"),
    "phase": Quantity("rad", low=-10, high=10),
    "periods": Quantity("1", low=1, high=1000, typical="12-72"),
}, off={"periods": 12.0}, fitted=("torque", "phase"), law="T - torque cos(periods theta + phase)",
    starts=((0.02, 0.0), (0.02, 2.0), (0.02, -2.0), (0.1, 0.0), (0.1, 2.0), (0.1, -2.0)),
    symptoms="a wave of current along the stroke, at rest as well", source="Hanselman, Brushless Motors, 2012")
def cogging(x: float, s: Any, u: Any, p: Any) -> Any:
    """The magnets prefer some angles."""
    g = p.cogging
    return x - g.torque * cos(g.periods * compute_angle(s, p) + g.phase)


@effect("torque", {  # Static eccentricity of the rotor over the air gap, and where the gap is narrowest.
    "share": Quantity("1", low=0, high=0.9, typical="0.05-0.4"),
    "phase": Quantity("rad", low=-10, high=10),
}, law="T (1 + share cos(theta + phase))",
    starts=((0.1, 0.0), (0.1, 2.0), (0.1, -2.0), (0.3, 0.0), (0.3, 2.0), (0.3, -2.0)),
    symptoms="the torque of a current varies once a turn of the motor", source=_FAULTS)
def eccentricity(x: float, s: Any, u: Any, p: Any) -> Any:
    """Worn bearings let the rotor sit off the middle: the flux that links a phase depends on the angle."""
    g = p.eccentricity
    return x * (1.0 + g.share * cos(compute_angle(s, p) + g.phase))


@effect("torque", {  # Share of the turns of one phase of three that are shorted, and pole pairs of the motor.
    "share": Quantity("1", low=0, high=1, typical="0.05-0.5"),
    "pole_pairs": Quantity("1", low=1, high=100),
}, off={"pole_pairs": 4.0}, fitted=("share",), starts=(0.1, 0.4), source=_FAULTS,
    law="T (1 - share/3 (1 - cos(2 p theta))) - share/3 Kt^2/R theta'",
    symptoms="less torque, which pulsates at twice the electrical frequency, and a drag that grows with speed")
def winding_short(x: float, s: Any, u: Any, p: Any) -> Any:
    """Turn-to-turn short: the turns carry no torque; the current that their voltage drives through them brakes."""
    third = p.winding_short.share * (1.0 / 3.0)
    turned = 2.0 * pi * p.screw.ratio / p.screw.lead
    drag = p.motor.torque_constant * p.motor.torque_constant / p.motor.resistance * s.motor_speed * turned
    return x - third * (x * (1.0 - cos(2.0 * p.winding_short.pole_pairs * s.motor_position * turned)) + drag)


def derive_emps_columns(sources: Mapping[str, Array]) -> dict[str, Array]:
    """The demand of EMPS (plant/models/emps.toml) in the rows of a trace, whose drive acts a cycle later.

    A row of its files holds the control signal that acts from there on. The force pulses of the second file are in it.
    """
    return {"current_demand": np.append(sources["vir"][1:], sources["vir"][-1])}


EMPS_COLUMNS = {"t": (Term("t"),), "demand": (Term("qg"),), "position": (Term("qm"),)}

PLANT = Plant(
    name="ema",
    title="electromechanical actuator",
    signals=Signals(
        Signal("demand", "x_d", "m", "position demand", "command", largest=1.0),
        Signal("position", "x", "m", "position of the surface", noise=1e-6),
        Signal("current_demand", "i_d", "A", "demanded motor current", "drive", limit="controller.current_limit"),
        Signal("motor_speed", "w", "rad/s", "speed of the motor", noise=0.05),
        Signal("current", "i", "A", "motor current", noise=0.02),
        Signal("load", "load", "N", "external force on the surface", "load", largest=1e6)),
    parameters={"motor": Motor, "drive": Drive, "screw": Screw, "surface": Surface, "controller": Controller,
                "observer": Observer},
    state=State, step=step, coefficients=compute_coefficients, measure=measure, moves=("motor_position", "position"),
    correct=correct,
    inverse=compute_needed_current, sense=sense,
    control=control, control_memory=Loops,
    lacks=("sensor_gain", "torque_motor_hysteresis", "coil_lag", "flow_delay", "valve_switching", "asymmetric_gain"),
    faults=(
        Fault("dry_friction", "dry friction of screw and bearings", "surface.friction", (100.0, 400.0), 150.0,
              250.0, "limits are ours: 1.5 and 2.5 times nominal; law and range (to 3 times): " + _FAULTS),
        Fault("backlash", "backlash of the screw", "screw.backlash", (0.0, 4e-4), 5e-5, 1.5e-4,
              "limits are ours, by the lost motion of a primary flight control; law: " + _FAULTS),
        Fault("winding_short", "shorted turns of a phase", "winding_short.share", (0.0, 0.5), 0.05, 0.2,
              "limits are ours: a short grows within hours beyond a fifth; law and range (to a half): " + _FAULTS),
        Fault("eccentricity", "eccentricity of the rotor", "eccentricity.share", (0.0, 0.5), 0.1, 0.25,
              "limits are ours: contact of rotor and stator at 1; law and range (to 0.42): " + _FAULTS)),
    tables=(Table(EMPS_COLUMNS, derive=derive_emps_columns, derived_from=("vir",)),),
    profile=(Hold(time=0.5), Step(to=5e-3, time=1.0), Step(to=0.0, time=1.0), Ramp(to=1e-3, time=2.0), Hold(time=0.5),
             Ramp(to=0.0, time=2.0), Hold(time=0.5), Ramp(to=0.03, time=1.0), Hold(time=0.3), Ramp(to=0.0, time=1.0),
             Sine(amplitude=3e-3, frequency=1.0, time=2.0),
             Chirp(amplitude=1e-3, f0=1.0, f1=20.0, fade=20.0, time=2.0), Hold(time=0.5)),
)
