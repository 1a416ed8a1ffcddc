"""A DC motor turns a wheel through a gear: voltage in, angle out. A plant of your own in one file (docs/plants.md).

    L i' = V - R i - Ke N w      J w' = N Kt i - B w - dry(w) - M      theta' = w
"""
from plant.declare import (
    Annotated,
    Any,
    Fault,
    Hold,
    NamedTuple,
    Plant,
    Quantity,
    Signal,
    Sine,
    Step,
    clip,
    effect,
    port,
    solve_sliding,
)


class Motor(NamedTuple):
    """A small brushed motor. Each field: unit, symbol, range, scatter from unit to unit; the default is nominal."""

    resistance: Annotated[float, Quantity("ohm", "R", low=0.01, high=100, tolerance=0.05)] = 2.0
    inductance: Annotated[float, Quantity("H", "L", low=1e-6, high=1)] = 2e-3
    torque_constant: Annotated[float, Quantity("N m/A", "Kt", low=1e-4, high=10, tolerance=0.03)] = 0.05


class Wheel(NamedTuple):
    """The wheel with its gear, seen from the wheel."""

    ratio: Annotated[float, Quantity("1", "N", low=1, high=1e4)] = 50.0
    inertia: Annotated[float, Quantity("kg m2", "J", low=1e-6, high=1e3, tolerance=0.05)] = 0.05
    damping: Annotated[float, Quantity("N m s/rad", "B", low=0, high=1e3, tolerance=0.1)] = 0.2


class Controller(NamedTuple):
    """A proportional law. Every plant has this group, with the period of the cycle."""

    gain: Annotated[float, Quantity("V/rad", low=0, high=1e4)] = 40.0
    limit: Annotated[float, Quantity("V", above=0, high=1e3)] = 24.0
    period: Annotated[float, Quantity("s", low=1e-4, high=0.1)] = 1e-3


class State(NamedTuple):
    """The state at one instant; the defaults are the plant at rest."""

    current: float = 0.0  # A
    speed: float = 0.0  # rad/s
    angle: float = 0.0  # rad


at_voltage = port("V", "voltage at the motor")
at_load = port("N m", "external torque on the wheel, against positive speed")
at_friction = port("N m", "level of the wheel's dry friction")


def step(s: State, m: Any, u: Any, p: Any) -> tuple[State, Any]:
    """The state `u.h` seconds later: the stiff terms (current, friction) implicit, so that it is stable."""
    h, ratio, kt = u.h, p.wheel.ratio, p.motor.torque_constant
    voltage, m = at_voltage(u.drive, m, s, u, p)
    load, m = at_load(u.load, m, s, u, p)
    dry, m = at_friction(0.0, m, s, u, p)
    inductance = p.motor.inductance
    current = (inductance * s.current + h * (voltage - kt * ratio * s.speed)) / (inductance + h * p.motor.resistance)
    impulse = p.wheel.inertia * s.speed + h * (ratio * kt * current - load)
    speed = solve_sliding(s.speed, impulse, h * dry, 1.0 / (p.wheel.inertia + h * p.wheel.damping))
    return State(current, speed, s.angle + 0.5 * h * (s.speed + speed)), m


def measure(s: State, p: Any) -> tuple[float, float]:
    """What the sensors show, without noise, in the order of the output signals."""
    return s.angle, s.current


def control(c: float, demand: float, y: Any, p: Any) -> tuple[float, float]:
    """Voltage of the next cycle; `y` are the readings of `measure`, `c` is what the law remembers (here nothing)."""
    return clip(p.controller.gain * (demand - y[0]), p.controller.limit), c


class DryFriction(NamedTuple):
    """An effect that the nominal plant lacks: at the default of its parameters it changes nothing."""

    torque: Annotated[float, Quantity("N m", low=0, high=100, typical="0.05-2 N m")] = 0.0


@effect("friction", DryFriction, law="dry(torque, w)", symptoms="the wheel stops short of its demand",
        source="Coulomb 1785")
def dry_friction(x: float, s: Any, u: Any, p: Any) -> float:
    """Bearings and gear resist by a constant torque."""
    return x + p.dry_friction.torque


PLANT = Plant(
    title="DC motor with gear and wheel",
    signals=(Signal("demand", "theta_c", "rad", "demanded angle", "command", largest=100.0),
             Signal("voltage", "V", "V", "voltage at the motor", "drive"),
             Signal("angle", "theta", "rad", "angle of the wheel", noise=1e-4),  # the first output is controlled
             Signal("current", "i", "A", "current of the motor", noise=0.01),
             Signal("torque", "M", "N m", "external torque on the wheel", "load")),
    parameters=(Motor, Wheel, Controller),
    state=State, step=step, measure=measure, moves=("angle",), control=control,
    faults=(Fault("winding", "rise of the winding's resistance", "motor.resistance", (2.0, 4.0), 2.3, 3.0,
                  "our choice: 15 % and 50 % above nominal"),),
    profile=(Hold(time=0.1), Step(to=0.5, time=0.9), Sine(amplitude=0.2, frequency=2.0, time=1.0)),
)
