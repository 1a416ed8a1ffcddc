"""Wear and damage of the servovalve that `rig fdi` measures with the list of faults "wider".

Magnets and coil are those of the torque motor, whose current is the demanded one: a drive with a current loop asks
for more voltage instead, and weak magnets are a smaller torque constant there. Each law is that of its source; what a
signal shows of it looks like a parameter of the reference model, so `rig explain` names that parameter and does not
test these effects unasked.

The first six faults of the list are those of Dalla Vedova, Maggiore and Pace, "Proposal of Prognostic Parametric Method
Applied to an Electrohydraulic Servomechanism Affected by Multiple Failures", after Borello, Dalla Vedova, Jacazio and
Sorli, "A Prognostic Model for Electrohydraulic Servovalves", PHM 2009: friction of spool and jack, radial clearance of
the spool, rounding of its lands' corners, torque of the first stage, contamination of the filter.
"""

from collections import namedtuple
from math import sqrt
from typing import Any

from plant.effects import Line, Quantity, effect

NOWHERE = ("none",)  # plants in which rig explain tests them unasked


@effect("current", {  # Share of the torque that the magnets of the torque motor have lost.
    "share": Quantity("1", "d", low=0, below=1, typical="0.05-0.3"),
}, law="Tact = GM (1 - d) Cor - KSF XS", symptoms="same as a smaller gain of the motor", starts=(0.05, 0.2),
    confused_with=("torque_motor.gain",), searched_in=NOWHERE, plant="eha",
    revealed_by="a torque or flux measurement of the motor alone",
    source="torque of a polarised motor in proportion to its magnets' flux, Merritt 1967")
def magnet_loss(x: float, s: Any, u: Any, p: Any) -> float:
    """Demagnetised magnets: less torque for the same current."""
    return x * (1.0 - p.magnet_loss.share)


# the current that the flux stands for
Flux = namedtuple("Flux", "current", defaults=(0.0,))


@effect("current", {  # Share of the turns that is shorted, and inductance over resistance of the whole coil.
    "share": Quantity("1", "s", low=0, below=1, typical="0.05-0.3"),
    "time_constant": Quantity("s", "L/R", low=0, high=1, typical="1-5 ms"),
}, off={"time_constant": 3e-3}, memory=Flux, fitted=("share",), starts=(0.05, 0.2),
    confused_with=("torque_motor.gain",),
    law="s L/R i' + i = (1 - s) Cor: the turns left drive the flux, the shorted ones slow it down",
    symptoms="less gain, and a lag that grows with it", searched_in=NOWHERE, plant="eha",
    revealed_by="the coil's resistance, R (1 - s)",
    source="transformer with a shorted secondary of s N turns and resistance s R, whose time constant is s L/R")
def coil_short(x: float, m: Flux, s: Any, u: Any, p: Any) -> tuple[float, Flux]:
    """Shorted turns are missing from the coil and are a ring around its core (implicit; without them exactly x).

    Flux N phi = L i of the whole coil; the ring has the voltage -s N phi' and the resistance s R, so its ampere-turns
    are -s (L/R) times the rate of the whole coil's.
    """
    g = p.coil_short
    lag = g.share * g.time_constant
    y = x * (1.0 - g.share)
    y = y + lag / (lag + u.h) * (m.current - y)
    return y, Flux(y)


@effect("nozzle", {  # Share of one nozzle's opening that dirt blocks; the sign tells which nozzle.
    "share": Quantity("1", "b", low=-1, high=1, typical="0.05-0.5"),
}, law="XF = XF (1 - |b|/2) + b/2 XFM", symptoms="a null shift, and less pilot gain", starts=(0.1, -0.1, 0.3, -0.3),
    confused_with=("null_bias",), searched_in=NOWHERE, revealed_by="pressures of both nozzles at null",
    source="bridge of two nozzles with openings XFM - XF and XFM + XF, Merritt 1967; one of them times 1 - b")
def nozzle_block(x: float, s: Any, u: Any, p: Any) -> float:
    """What drives the spool is half the difference of the openings: ((XFM + XF) - (1 - b) (XFM - XF))/2."""
    b = p.nozzle_block.share
    return x * (1.0 - 0.5 * abs(b)) + 0.5 * b * p.flapper.travel


@effect("valve", {  # Radial clearance of the spool, circumference and length of its lands, viscosity of the oil.
    "clearance": Quantity("m", "c", low=0, high=1e-3, typical="3-40 um; new 6 um"),
    "circumference": Quantity("m", "w", low=0, high=1),  # of a spool with the nominal ends
    "length": Quantity("m", "L", above=0, high=1),
    "viscosity": Quantity("Pa s", "mu", above=0, high=10),
    "new": Quantity("m", low=0, high=1e-3),  # clearance that the nominal leakage includes
}, off={"clearance": 6e-6, "circumference": 0.013, "length": 1e-3, "viscosity": 0.015, "new": 6e-6},
    fitted=("clearance",), starts=(1.5e-5, 3e-5), confused_with=("jack.leakage",),
    law="Q = w c^3 P12/(12 mu L), less that of a new spool", symptoms="same as leakage across the piston",
    searched_in=NOWHERE, revealed_by="flow of the valve at null with its control ports blocked",
    source="laminar flow through an annular gap, Merritt 1967; 6 um new and the lands are choices")
def land_clearance(x: Line, s: Any, u: Any, p: Any) -> Line:
    """Four worn lands leak from the supply to both chambers and from these to the return: in sum in proportion to P12.

    With P1 = (PSR + P12)/2 the flow into a chamber is K (PSR - P1) - K P1 = -K P12, implicit in P12.
    """
    g = p.land_clearance
    flow = g.circumference / (12.0 * g.viscosity * g.length) * (
        g.clearance * g.clearance * g.clearance - g.new * g.new * g.new)
    return leak_more(x, flow, p)


def leak_more(x: Line, flow: float, p: Any) -> Line:
    """The line of the metering edges with `flow` m3/s/Pa more past the piston: slope/AJ is pressure per flow."""
    kept = 1.0 / (1.0 + flow * x.slope / p.jack.area)
    return Line(x.offset * kept, x.slope * kept, x.limit, x.drive * kept)


@effect("valve", {  # Radius of the corners of the metering edges.
    "radius": Quantity("m", "r", low=0, high=1e-3, typical="1-50 um; new 1 um"),
    "new": Quantity("m", low=0, high=1e-3),  # radius that the nominal gains include
}, off={"radius": 1e-6, "new": 1e-6}, fitted=("radius",), starts=(5e-6, 2e-5), searched_in=NOWHERE,
    law="edges open by a = sqrt(max(XS, 0)^2 + r^2) and b = sqrt(max(-XS, 0)^2 + r^2): XS = a - b, and they leak "
        "GQ (a + b)/(2 PSR) P12",
    symptoms="soft around null: less flow and less pressure gain", confused_with=("spool_overlap",),
    revealed_by="pressure gain and leakage at null on a valve test bench",
    source="opening of a corner, sqrt(x^2 + c^2), Merritt 1967; r 1 um new is a choice")
def edge_rounding(x: Line, s: Any, u: Any, p: Any) -> Line:
    """Both edges of a chamber are a bridge: Q = GQ ((a - b) - (a + b)/2 P12/PSR), less that of new edges."""
    g, gain = p.edge_rounding, p.valve.pressure_gain
    gain = gain / (1.0 + gain * p.jack.leakage / p.valve.flow_gain)  # of the line, Pa/m
    opening = x.drive / gain
    worn, new = sqrt(opening * opening + g.radius * g.radius), sqrt(opening * opening + g.new * g.new)
    more = gain * ((worn - g.radius) - (new - g.new)) * (1.0 if opening > 0.0 else -1.0)
    flow = 0.5 * p.valve.flow_gain / p.supply.pressure * ((worn + g.radius) - (new + g.new))
    return leak_more(Line(x.offset + more, x.slope, x.limit, x.drive + more), flow, p)
