"""A stabiliser trim jack: a motor, commanded in torque, turns a screw through a gear, and that the stabiliser."""
from plant.declare import (
    Annotated,
    Any,
    Hold,
    NamedTuple,
    Plant,
    Quantity,
    Ramp,
    Signal,
    Sine,
    Step,
    clip,
    effect,
    port,
    solve_sliding,
)


class Rotor(NamedTuple):
    """The motor."""

    inertia: Annotated[float, Quantity("kg m2", "J", low=1e-7, high=1, tolerance=0.05)] = 1e-4
    drag: Annotated[float, Quantity("N m s/rad", "B", low=0, high=1, tolerance=0.1)] = 2e-4
    torque_constant: Annotated[float, Quantity("N m/A", "Kt", low=1e-3, high=10, tolerance=0.03)] = 0.1


class Gearing(NamedTuple):
    """Gear and screw, with the seal at the rotor."""

    ratio: Annotated[float, Quantity("1", "N", low=1, high=1e4)] = 100.0
    seal: Annotated[float, Quantity("N m", "Ts", low=0, high=1, tolerance=0.1)] = 5e-3


class Housing(NamedTuple):
    """What the current heats."""

    heating: Annotated[float, Quantity("K/J", low=0, high=10)] = 0.05
    cooling: Annotated[float, Quantity("1/s", low=0, high=10)] = 0.02
    resistance: Annotated[float, Quantity("ohm", "R", low=0, high=100)] = 0.5


class Controller(NamedTuple):
    """A law of error and its slope."""

    stiffness: Annotated[float, Quantity("N m/rad", low=0, high=1e4)] = 6.25
    damping: Annotated[float, Quantity("N m s/rad", low=0, high=1e4)] = 0.43
    torque_limit: Annotated[float, Quantity("N m", above=0, high=100)] = 0.8
    period: Annotated[float, Quantity("s", low=1e-4, high=0.1)] = 1e-3


class State(NamedTuple):
    """At rest by default."""

    torque: float = 0.0  # N m, of the motor
    rate: float = 0.0  # rad/s, of the rotor
    turned: float = 0.0  # rad, of the rotor
    warmth: float = 0.0  # K above the surroundings


at_torque = port("N m", "torque of the motor")
at_hinge = port("N m", "hinge moment on the stabiliser, against positive rate")
at_seal = port("N m", "level of the dry friction, at the rotor")


def step(s: State, m: Any, u: Any, p: Any) -> tuple[State, Any]:
    """The torque acts at once; friction is implicit."""
    h = u.h
    torque, m = at_torque(u.drive, m, s, u, p)
    hinge, m = at_hinge(u.load, m, s, u, p)
    seal, m = at_seal(p.gearing.seal, m, s, u, p)
    impulse = p.rotor.inertia * s.rate + h * (torque - hinge / p.gearing.ratio)
    rate = solve_sliding(s.rate, impulse, h * seal, 1.0 / (p.rotor.inertia + h * p.rotor.drag))
    amps = torque / p.rotor.torque_constant
    warmth = s.warmth + h * (p.housing.heating * p.housing.resistance * amps * amps - p.housing.cooling * s.warmth)
    return State(torque, rate, s.turned + 0.5 * h * (s.rate + rate), warmth), m


def measure(s: State, p: Any) -> tuple[float, float, float, float, float]:
    """Angle, rate, current, angle of the rotor, warmth."""
    return s.turned / p.gearing.ratio, s.rate, s.torque / p.rotor.torque_constant, s.turned, s.warmth


class Memory(NamedTuple):
    """What the law remembers."""

    error: float = 0.0
    cycles: float = 0.0


def control(c: Memory, demand: float, y: Any, p: Any) -> tuple[float, Memory]:
    """Torque of the next cycle."""
    g = p.controller
    error = demand - y[0]
    slope = (error - c.error) / g.period if c.cycles > 0.0 else 0.0
    return clip(g.stiffness * error + g.damping * slope, g.torque_limit), Memory(error, c.cycles + 1.0)


class TightSeal(NamedTuple):
    """Torque beyond the nominal one."""

    torque: Annotated[float, Quantity("N m", low=0, high=10, typical="5-50 mN m")] = 0.0


@effect("seal", TightSeal, law="Ts + torque", symptoms="the jack stops short of its demand", source="Coulomb 1785")
def tight_seal(x: float, s: Any, u: Any, p: Any) -> float:
    """A swollen seal holds the rotor."""
    return x + p.tight_seal.torque


class WeakMagnet(NamedTuple):
    """Share that is lost."""

    share: Annotated[float, Quantity("1", low=0, high=0.9)] = 0.0


@effect("torque", WeakMagnet, law="T (1 - share)", symptoms="less torque than commanded", source="heat")
def weak_magnet(x: float, s: Any, u: Any, p: Any) -> float:
    """Heat has taken a part of the magnetisation."""
    return x * (1.0 - p.weak_magnet.share)


PLANT = Plant(
    title="stabiliser trim jack",
    signals=(Signal("trim_cmd", "tc", "rad", "demanded trim", "command", largest=2),
             Signal("torque_ref", "Tr", "N m", "commanded torque", "drive", limit="controller.torque_limit"),
             Signal("trim_angle", "ta", "rad", "angle of the stabiliser", noise=2e-5),
             Signal("shaft_rate", "wr", "rad/s", "rate of the rotor", noise=0.05),
             Signal("phase_amps", "ia", "A", "current of the motor", noise=0.05),
             Signal("rotor_angle", "ra", "rad", "angle of the rotor", noise=2e-4),  # a replay shows the other's noise
             Signal("case_rise", "dT", "K", "temperature above the surroundings", noise=0.05),
             Signal("hinge", "Mh", "N m", "hinge moment", "load", largest=1e4)),
    parameters=(Rotor, Gearing, Housing, Controller), state=State, step=step, measure=measure, moves=("turned",),
    control=control, control_memory=Memory,
    profile=(Hold(time=0.2), Step(to=0.02, time=0.6), Ramp(to=-0.03, time=1.0),
             Sine(amplitude=0.02, frequency=1.0, time=1.0), Ramp(to=0.0, time=0.7), Hold(time=0.4)),
)
