"""Effects between the metering edges and the piston: what pressure they leave across it at which speed."""

from math import exp, log, sqrt
from typing import Annotated, Any, NamedTuple

from plant.effects import effect
from plant.quantity import Quantity
from plant.state import Line


class Compressibility(NamedTuple):
    """Compressibility 1/B of the oil in the jack, and the volume under pressure."""

    coefficient: Annotated[float, Quantity("1/Pa", low=0, high=1e-6, typical="0.7e-9-2e-9 1/Pa, 1/B")] = 0.0
    volume: Annotated[float, Quantity("m3", "V", low=0, high=10)] = 1.5e-4


class Metered(NamedTuple):
    """The edges' part of the line in the step before."""

    offset: float = 0.0
    drive: float = 0.0


@effect("valve", Compressibility, law="V/(4 B) P12' = GQ XS - GQ/GP P12 - AJ XJ' - CLK P12",
        symptoms="resonance in P12", memory=Metered, fitted=("coefficient",), starts=(3e-10, 1e-9, 2e-9),
        source="valve-controlled piston, Merritt 1967")
def compressibility(x: Line, m: Metered, s: Any, u: Any, p: Any) -> tuple[Line, Metered]:
    """The oil in the chambers is a spring between valve and ram.

    The pressure is implicit in itself and takes speed and opening of the start of the step: a leapfrog, which damps
    nothing. Where the step is too long for that (h w near 2, w the resonance) it takes the more of both at its end.
    """
    stored = 0.25 * p.compressibility.volume * p.compressibility.coefficient  # m3/Pa
    step = u.h * p.jack.area
    new = step * step / (step * step + 8.0 * stored * p.jack.mass)  # (h w)^2 / ((h w)^2 + 8); 1 where the oil is rigid
    old = 1.0 - new
    share = step / (step + stored * x.slope)
    taken = new * x.offset + old * m.offset - x.slope * old * s.jack_speed
    line = Line((1.0 - share) * s.pressure + share * taken, x.slope * new * share, x.limit,
                (new * x.drive + old * m.drive) * share)
    return line, Metered(x.offset, x.drive)


class UndissolvedAir(NamedTuple):
    """Volume of the air in the oil at atmospheric pressure, how fast it shrinks with pressure, and what preloads it."""

    volume: Annotated[float, Quantity("m3", low=0, high=0.1, typical="0.1-10 cm3, at atmospheric pressure")] = 0.0
    exponent: Annotated[float, Quantity("1", low=0, high=3, typical="2: isothermal; 1: modulus follows pressure")] = 2.0
    preload: Annotated[float, Quantity("Pa", low=0, high=1e9, typical="0 to half of PSR")] = 0.0


ATMOSPHERE = 1.013e5  # Pa


@effect("valve", UndissolvedAir, fitted=("volume",), starts=(1e-6, 4e-6, 2e-5), excludes=("compressibility",),
        law="V/p0 (p0/p)^exponent P12' = Q - AJ XJ' - CLK P12, p = |P12| + preload + p0",
        symptoms="soft at low pressure: the ram lags where the pressure rises from nothing", searched_in=("ehs",),
        source="Boyle's law for free air in oil, Merritt 1967; dissolving air lowers the exponent")
def undissolved_air(x: Line, s: Any, u: Any, p: Any) -> Line:
    """Free air in the oil gives way, most of all where the pressure is low.

    The air is that of the chamber under pressure. Isothermal, its volume goes with 1/p and its compliance -dV/dp with
    1/p^2; the compliance is that of the pressure at the start of the step, the pressure is implicit in itself.
    """
    g = p.undissolved_air
    share = ATMOSPHERE / (abs(s.pressure) + g.preload + ATMOSPHERE)
    stored = g.volume / ATMOSPHERE * exp(g.exponent * log(share))  # m3/Pa
    step = u.h * p.jack.area
    new = step / (step + stored * x.slope)
    return Line((1.0 - new) * s.pressure + new * x.offset, x.slope * new, x.limit, x.drive * new)


class OrificeRoot(NamedTuple):
    """How much of the square-root law the metering edges follow; 1: all of it."""

    share: Annotated[float, Quantity("1", low=0, high=2, typical="1")] = 0.0


@effect("valve", OrificeRoot, law="P12 = GP (XS w - QJ/GQ), w = 1 - share (1 - sqrt(1 - sign(XS) P12/PSR))",
        symptoms="cross term XS*P12, seen when fast and loaded", starts=(0.4, 1.0),
        source="orifice equation, Merritt 1967")
def orifice_root(x: Line, s: Any, u: Any, p: Any) -> Line:
    """The flow through an edge goes with the root of the pressure left across it: at full load none is left.

    In w = sqrt(1 - sign(XS) P12/PSR) the law is a quadratic equation, solved exactly for the ram's speed at the start
    of the step; from there the pressure follows the tangent.
    """
    part = p.orifice_root.share * x.drive
    size = abs(part)
    on = size > 1e-3  # Pa; below, the law is the linear one and its squares may vanish
    sign = 1.0 if part > 0.0 else -1.0
    left = x.limit - sign * (x.offset - part - x.slope * s.jack_speed)
    left = left if left > 0.0 else 0.0
    root = sqrt(size * size + 4.0 * x.limit * left)
    both = 1.0 / ((root * (root + size)) if on else 1.0)  # one division for 1/root and 1/(root + size)
    w = 2.0 * left * root * both
    slope = x.slope * (1.0 - size * (root + size) * both)
    offset = sign * x.limit * (1.0 - w * w) + slope * s.jack_speed
    return Line(offset if on else x.offset, slope if on else x.slope, x.limit, x.drive)
