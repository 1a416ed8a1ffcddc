"""Dry friction of the ram beyond one static and one dynamic level."""

from math import exp, sqrt
from typing import Annotated, Any, NamedTuple

from plant.effects import effect
from plant.quantity import Quantity
from plant.state import Drag


class Stribeck(NamedTuple):
    """Rise of the friction towards standstill, as a fraction of FSJ, and the speed over which it is lost."""

    rise: Annotated[float, Quantity("1", low=0, high=10, typical="0.2-1")] = 0.0
    speed: Annotated[float, Quantity("m/s", above=0, high=10, typical="1-50 mm/s")] = 0.01


@effect("jack_drag", Stribeck, law="FDJ + rise FSJ exp(-(XJ'/speed)^2); at rest no less than that",
        symptoms="saw-tooth P12 while the spool moves", starts=((0.2, 0.01), (1.0, 0.003), (1.0, 0.03)),
        source="Stribeck 1902; Armstrong-Helouvry, Dupont and Canudas de Wit 1994")
def stribeck(x: Drag, s: Any, u: Any, p: Any) -> Drag:
    """Boundary lubrication: the film under the seal carries more the faster it moves."""
    g, v = p.stribeck, s.jack_speed / p.stribeck.speed
    rise = g.rise * x.static
    top = x.dynamic + rise  # a ram at rest is not held by less than one that creeps
    raised = g.rise > 0.0 and top > x.static
    return Drag(x.force, x.damping, top if raised else x.static, x.dynamic + rise * exp(-v * v))


class FrictionAsymmetry(NamedTuple):
    """By what fraction the friction is higher in extension, and lower in retraction."""

    asymmetry: Annotated[float, Quantity("1", low=-1, high=1, typical="0.1-0.5")] = 0.0


@effect("jack_drag", FrictionAsymmetry, law="F (1 + d sign(XJ'))", symptoms="same as a constant load while sliding",
        starts=(0.1, -0.1, 0.5, -0.5), confused_with=("constant_load", "null_bias"),
        source="a rod seal that grips more one way")
def friction_asymmetry(x: Drag, s: Any, u: Any, p: Any) -> Drag:
    """Levels F(1 + d) and F(1 - d) are a symmetric level F and a force d F."""
    level = x.static if s.jack_speed == 0.0 else x.dynamic
    return Drag(x.force + p.friction_asymmetry.asymmetry * level, x.damping, x.static, x.dynamic)


class Presliding(NamedTuple):
    """Deflection of the bristles at the static level, z = FSJ/s0, and the speed over which that level is lost."""

    deflection: Annotated[float, Quantity("m", low=0, high=1e-2, typical="5-100 um")] = 0.0
    speed: Annotated[float, Quantity("m/s", low=0, high=10, typical="1-50 mm/s; 0: at once")] = 0.0


class Bristle(NamedTuple):
    """Deflection of the bristles, and what of it and of the way a step leaves."""

    deflection: float = 0.0
    kept: float = 0.0


@effect("jack_drag", Presliding, memory=Bristle, starts=((5e-6, 1e-3), (2e-5, 1e-3), (1e-4, 1e-3), (2e-5, 1e-2)),
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
