"""Forces on the ram and what resists it: loads, dry friction, a press. Positive force acts against extension."""

from collections import namedtuple
from math import exp, pi, sqrt
from typing import Any

from plant.effects import Drag, Held, Quantity, effect


@effect("load", {  # A steady external force.
    "force": Quantity("N", low=-1e6, high=1e6, typical="0.2-5 kN"),
}, law="FR = FR + F", symptoms="mean of what makes the force: P12 of a jack, current of a motor",
    starts=(400.0, -400.0, 3000.0, -3000.0), confused_with=("friction_asymmetry", "null_bias"),
    source="a steady air load or weight")
def constant_load(x: float, s: Any, u: Any, p: Any) -> float:
    """A weight or a steady air load."""
    return x + p.constant_load.force


@effect("load", {  # Part of the load that acts both ways.
    "share": Quantity("1", low=-2, high=2, typical="1"),
}, law="FR = FR + share load", symptoms="P12 follows the load in both directions", plant="ehs",
    starts=((1.0,), (0.5,), (-1.0,)), revealed_by="a run against a known load", source="a weight, or a second cylinder")
def external_load(x: float, s: Any, u: Any, p: Any) -> float:
    """The load of the recording is a force on the ram; that of a press acts otherwise, see `one_way_load`."""
    return x + p.external_load.share * u.load


@effect("load", {  # Hinge moment of the surface per unit of ram position.
    "stiffness": Quantity("N/m", low=0, high=1e9, typical="1e5-1e6 N/m"),
}, law="FR = FR + K XJ", symptoms="P12 proportional to position, at rest too", starts=(1e5, 3e5, 1e6),
    source="hinge moment of a surface against its deflection")
def aero_stiffness(x: float, s: Any, u: Any, p: Any) -> float:
    """The air stream pushes the surface back to neutral."""
    return x + p.aero_stiffness.stiffness * (s.jack_position + 0.5 * u.h * s.jack_speed)


# how far the mass is ahead of the ram if that keeps its speed, the mass's speed, the ram's before the step
Swing = namedtuple("Swing", "ahead speed ram_speed", defaults=(0.0, 0.0, 0.0))


@effect("load", {  # A mass that the ram moves through a spring with damping; the last two are with the ram held.
    "mass": Quantity("kg", low=0, high=1e4, typical="10-200 kg"),
    "frequency": Quantity("Hz", low=1, high=1e3, typical="20-200 Hz"),
    "damping_ratio": Quantity("1", low=0, high=10, typical="0.01-0.1"),
}, off={"frequency": 60.0, "damping_ratio": 0.03},
    law="FR = FR + M z', z' = w^2 (XJ - z0) + 2 D w (XJ' - z), z = z0', w = 2 pi f",
    symptoms="P12 rings after each move; the ram stands still at f and moves most above it", memory=Swing,
    starts=tuple((20.0, 20.0 * 1.25**k, 0.03) for k in range(11)),  # a fit finds a frequency that is an eighth off
    source="two masses on a spring: Den Hartog, Mechanical Vibrations, 1956")
def structural_resonance(x: float, m: Swing, s: Any, u: Any, p: Any) -> tuple[float, Swing]:
    """The surface, or its structure, swings on the ram.

    One step of the trapezoidal rule for the mass, against a ram that keeps its speed; where that changed, the next step
    corrects the way.
    """
    g = p.structural_resonance
    w = 2.0 * pi * g.frequency
    ahead = m.ahead - 0.5 * u.h * (s.jack_speed - m.ram_speed)
    slope = 0.5 * u.h * w * w + 2.0 * g.damping_ratio * w  # 1/s: of the acceleration against the mean speed
    acceleration = (slope * (s.jack_speed - m.speed) - w * w * ahead) / (1.0 + 0.5 * u.h * slope)
    speed = m.speed + u.h * acceleration
    return x + g.mass * acceleration, Swing(ahead + u.h * (0.5 * (m.speed + speed) - s.jack_speed), speed, s.jack_speed)


@effect("jack_drag", {  # Rise of friction towards standstill, a fraction of FSJ, and the speed over which it is lost.
    "rise": Quantity("1", low=0, high=10, typical="0.2-1"),
    "speed": Quantity("m/s", above=0, high=10, typical="1-50 mm/s"),
}, off={"speed": 0.01}, law="FDJ + rise FSJ exp(-(XJ'/speed)^2); at rest no less than that",
    symptoms="saw-tooth P12 while the spool moves", starts=((0.2, 0.01), (1.0, 0.003), (1.0, 0.03)),
    source="Stribeck 1902; Armstrong-Helouvry, Dupont and Canudas de Wit 1994")
def stribeck(x: Drag, s: Any, u: Any, p: Any) -> Drag:
    """Boundary lubrication: the film under the seal carries more the faster it moves."""
    g, v = p.stribeck, s.jack_speed / p.stribeck.speed
    rise = g.rise * x.static
    top = x.dynamic + rise  # a ram at rest is not held by less than one that creeps
    raised = g.rise > 0.0 and top > x.static
    return Drag(x.force, x.damping, top if raised else x.static, x.dynamic + rise * exp(-v * v))


@effect("jack_drag", {  # By what fraction the friction is higher in extension, and lower in retraction.
    "asymmetry": Quantity("1", low=-1, high=1, typical="0.1-0.5"),
}, law="F (1 + d sign(XJ'))", symptoms="same as a constant load while sliding", starts=(0.1, -0.1, 0.5, -0.5),
    confused_with=("constant_load", "null_bias"), source="a rod seal that grips more one way")
def friction_asymmetry(x: Drag, s: Any, u: Any, p: Any) -> Drag:
    """Levels F(1 + d) and F(1 - d) are a symmetric level F and a force d F."""
    level = x.static if s.jack_speed == 0.0 else x.dynamic
    return Drag(x.force + p.friction_asymmetry.asymmetry * level, x.damping, x.static, x.dynamic)


# deflection of the bristles, and what of it and of the way a step leaves
Bristle = namedtuple("Bristle", "deflection kept", defaults=(0.0, 0.0))


@effect("jack_drag", {  # Deflection of bristles at the static level, z = FSJ/s0; speed over which that level is lost.
    "deflection": Quantity("m", low=0, high=1e-2, typical="5-100 um"),
    "speed": Quantity("m/s", low=0, high=10, typical="1-50 mm/s; 0: at once"),
}, memory=Bristle, starts=((5e-6, 1e-3), (2e-5, 1e-3), (1e-4, 1e-3), (2e-5, 1e-2)),
    law="LuGre: z' = XJ' - s0 |XJ'| z/g, F = s0 z + s1 z', g = FDJ + (FSJ - FDJ) exp(-(XJ'/speed)^2), "
        "s0 = FSJ/deflection, s1 = 0.02 sqrt(s0 MJ)",
    symptoms="P12-position spring loop at each reversal, no true stop",
    source="LuGre: Canudas de Wit, Olsson, Astrom and Lischinsky 1995")
def presliding(x: Drag, m: Bristle, s: Any, u: Any, p: Any) -> tuple[Drag, Bristle]:
    """Bristles bend before they slip, in place of stick-slip.

    Implicit in the deflection and in the speed at the end of the step, so stable however stiff; this step's deflection
    is known when its speed is, in the next. The exponential of the level is ((1 - q)/(1 + q))^16, q = (v/speed)^2/32,
    within 5e-4 of it, and a fifth of its time where the whole catalogue is computed.
    """
    z = m.kept * (m.deflection + u.h * s.jack_speed)
    full = p.presliding.deflection
    on = full > 0.0
    s0 = x.static / (full if on else 1.0)
    s1 = 0.02 * sqrt(s0 * p.jack.mass)
    widest = max(32.0 * p.presliding.speed * p.presliding.speed, 1e-30)
    square = min(s.jack_speed * s.jack_speed, widest)
    share = (widest - square) / (widest + square)
    for _ in range(4):
        share = share * share
    level = x.dynamic + (x.static - x.dynamic) * share
    whole = level + u.h * s0 * abs(s.jack_speed)
    kept = level / (whole if whole > 0.0 else 1.0)
    rate = s1 / u.h
    force = z * (s0 * kept - rate * (1.0 - kept))
    damping = (s0 * u.h + s1) * kept
    return (Drag(x.force + (force if on else 0.0), x.damping + (damping if on else 0.0), 0.0 if on else x.static,
                 0.0 if on else x.dynamic), Bristle(z if on else 0.0, kept if on else 0.0))


@effect("jack_drag", {  # Part of the load that resists as a press does, way until it touches, and until all is there.
    "share": Quantity("1", low=0, high=2, typical="1"),
    "slack": Quantity("m", low=0, high=1, typical="0-5 mm"),
    "travel": Quantity("m", low=1e-6, high=1, typical="0.1-10 mm"),
}, off={"travel": 5e-3}, law="FR, against extension only, after a slack and over a travel; it never drives",
    symptoms="no P12 from the load but in extension", memory=Held, plant="ehs",
    starts=((0.5, 0.0, 5e-3), (1.0, 0.0, 1e-3), (1.0, 1e-3, 4e-3)), source="a press cylinder and its relief valve")
def one_way_load(x: Drag, m: Held, s: Any, u: Any, p: Any) -> tuple[Drag, Held]:
    """A press yields at its load. As friction that acts one way: half of it a level, half of it a force.

    It remembers where it was left behind.
    """
    g = p.one_way_load
    whole = s.jack_position - (g.slack + g.travel)
    x0 = m.held if m.held > whole else whole
    x0 = x0 if x0 < s.jack_position else s.jack_position
    pressed = s.jack_position - x0 - g.slack
    half = 0.5 * g.share * u.load * ((pressed if pressed > 0.0 else 0.0) / g.travel)
    return Drag(x.force + half, x.damping, x.static + half, x.dynamic + half), Held(x0)
