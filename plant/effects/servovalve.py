"""Effects of the pilot stage, of the spool, and of the oil between its metering edges and the piston."""

from collections import namedtuple
from math import exp, log, sqrt
from typing import Any

from plant.effects import Line, Quantity, clip, effect, soften

_LANDS = "lap of the spool's lands, Merritt 1967"


@effect("nozzle", {  # By what fraction the pilot's gain is higher for a positive XF, and lower for a negative one.
    "asymmetry": Quantity("1", low=-1, high=1, typical="0.05-0.3"),
}, law="pilot gain x (1 + a sign(XF))", symptoms="gain differs by direction", starts=(0.05, -0.05, 0.25, -0.25),
    source="unequal nozzles: wear or dirt in one of them")
def nozzle_asymmetry(x: float, s: Any, u: Any, p: Any) -> float:
    """The two nozzles are not alike."""
    return x + p.nozzle_asymmetry.asymmetry * abs(x)


@effect("feedback", {  # Total play between the feedback spring's ball and its slot in the spool.
    "width": Quantity("m", low=0, high=1, typical="5-50 um"),
}, law="KSF deadzone(XS, width/2)", symptoms="limit cycle at null even with no friction", starts=(5e-6, 2e-5, 5e-5),
    source="ball wear of mechanical-feedback servovalves")
def feedback_gap(x: float, s: Any, u: Any, p: Any) -> float:
    """The worn ball of the feedback wire feels the spool only beyond the gap."""
    return soften(x, 0.5 * p.feedback_gap.width)


@effect("spool_force", {  # Steady flow force per spool displacement and pressure drop: 2 Cd Cv w cos(69 deg).
    "coefficient": Quantity("m", low=0, high=10, typical="0.3-3 mm"),
}, law="F = -K XS (PSR - |P12|)", symptoms="looks like less GM; depends on pressure", starts=(3e-4, 1e-3, 3e-3),
    confused_with=("torque_motor.gain",), source="steady flow force, Merritt 1967")
def flow_force(x: float, s: Any, u: Any, p: Any) -> float:
    """The jet through the metering edges closes the spool (with the spool where it will be in mid step)."""
    ahead = s.spool_position + 0.5 * u.h * s.spool_speed
    return x - p.flow_force.coefficient * ahead * (p.supply.pressure - abs(s.pressure))


@effect("metering", {  # Half width of the metering edges' dead zone.
    "overlap": Quantity("m", low=0, high=1, typical="5-60 um"),
}, law="XS = deadzone(XS, overlap) at the metering edges", symptoms="single-valued flat spot at null",
    starts=(5e-6, 2e-5, 6e-5), excludes=("spool_underlap",), source=_LANDS)
def spool_overlap(x: float, s: Any, u: Any, p: Any) -> float:
    """The lands cover the ports by more than their width: nothing flows around null."""
    return soften(x, p.spool_overlap.overlap)


@effect("metering", {  # Half width of the range around null in which two edges are open.
    "underlap": Quantity("m", low=0, high=1, typical="2-30 um"),
}, law="XS = XS + clip(XS, underlap) at the metering edges: twice the gain within", symptoms="opposite sign of overlap",
    starts=(2e-6, 1e-5, 3e-5), excludes=("spool_overlap",), source=_LANDS)
def spool_underlap(x: float, s: Any, u: Any, p: Any) -> float:
    """The lands leave the ports open at null: both edges of a port meter there."""
    return x + clip(x, p.spool_underlap.underlap)


# the edges' part of the line in the step before
Metered = namedtuple("Metered", "offset drive", defaults=(0.0, 0.0))


# Compressibility 1/B of the oil in the jack, and the volume under pressure.
COMPRESSIBILITY = {
    "coefficient": Quantity("1/Pa", low=0, high=1e-6, typical="0.7e-9-2e-9 1/Pa, 1/B"),
    "volume": Quantity("m3", "V", low=0, high=10),
}


@effect("valve", COMPRESSIBILITY, off={"volume": 1.5e-4}, law="V/(4 B) P12' = GQ XS - GQ/GP P12 - AJ XJ' - CLK P12",
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


ATMOSPHERE = 1.013e5  # Pa


@effect("valve", {  # Volume of the air in the oil, how fast it shrinks with pressure, and what preloads it.
    "volume": Quantity("m3", low=0, high=0.1, typical="0.1-10 cm3, at atmospheric pressure"),
    "exponent": Quantity("1", low=0, high=3, typical="2: isothermal; 1: modulus follows pressure"),
    "preload": Quantity("Pa", low=0, high=1e9, typical="0 to half of PSR"),
}, off={"exponent": 2.0}, fitted=("volume",), starts=(1e-6, 4e-6, 2e-5), excludes=("compressibility",),
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


@effect("valve", {  # How much of the square-root law the metering edges follow; 1: all of it.
    "share": Quantity("1", low=0, high=2, typical="1"),
}, law="P12 = GP (XS w - QJ/GQ), w = 1 - share (1 - sqrt(1 - sign(XS) P12/PSR))",
    symptoms="cross term XS*P12, seen when fast and loaded", starts=(0.4, 1.0), source="orifice equation, Merritt 1967")
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
