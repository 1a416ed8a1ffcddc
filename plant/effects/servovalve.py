"""Effects of the pilot stage and the spool."""

from typing import Annotated, Any, NamedTuple

from plant.effects import effect
from plant.friction import clip, soften
from plant.quantity import Quantity

_LANDS = "lap of the spool's lands, Merritt 1967"


class NozzleAsymmetry(NamedTuple):
    """By what fraction the pilot's gain is higher for a positive flapper displacement, and lower for a negative."""

    asymmetry: Annotated[float, Quantity("1", low=-1, high=1, typical="0.05-0.3")] = 0.0


@effect("nozzle", NozzleAsymmetry, law="pilot gain x (1 + a sign(XF))", symptoms="gain differs by direction",
        starts=(0.05, -0.05, 0.25, -0.25), source="unequal nozzles: wear or dirt in one of them")
def nozzle_asymmetry(x: float, s: Any, u: Any, p: Any) -> float:
    """The two nozzles are not alike."""
    return x + p.nozzle_asymmetry.asymmetry * abs(x)


class FeedbackGap(NamedTuple):
    """Total play between the feedback spring's ball and its slot in the spool."""

    gap: Annotated[float, Quantity("m", low=0, high=1, typical="5-50 um")] = 0.0


@effect("feedback", FeedbackGap, law="KSF deadzone(XS, gap/2)", symptoms="limit cycle at null even with no friction",
        starts=(5e-6, 2e-5, 5e-5), source="ball wear of mechanical-feedback servovalves")
def feedback_gap(x: float, s: Any, u: Any, p: Any) -> float:
    """The worn ball of the feedback wire feels the spool only beyond the gap."""
    return soften(x, 0.5 * p.feedback_gap.gap)


class FlowForce(NamedTuple):
    """Steady flow force per spool displacement and pressure drop: 2 Cd Cv w cos(69 deg) of the ports."""

    coefficient: Annotated[float, Quantity("m", low=0, high=10, typical="0.3-3 mm")] = 0.0


@effect("spool_force", FlowForce, law="F = -K XS (PSR - |P12|)", symptoms="looks like less GM; depends on pressure",
        starts=(3e-4, 1e-3, 3e-3), confused_with=("torque_motor.gain",), source="steady flow force, Merritt 1967")
def flow_force(x: float, s: Any, u: Any, p: Any) -> float:
    """The jet through the metering edges closes the spool (with the spool where it will be in mid step)."""
    ahead = s.spool_position + 0.5 * u.h * s.spool_speed
    return x - p.flow_force.coefficient * ahead * (p.supply.pressure - abs(s.pressure))


class SpoolOverlap(NamedTuple):
    """Half width of the metering edges' dead zone."""

    overlap: Annotated[float, Quantity("m", low=0, high=1, typical="5-60 um")] = 0.0


@effect("metering", SpoolOverlap, law="XS = deadzone(XS, overlap) at the metering edges",
        symptoms="single-valued flat spot at null", starts=(5e-6, 2e-5, 6e-5), excludes=("spool_underlap",),
        source=_LANDS)
def spool_overlap(x: float, s: Any, u: Any, p: Any) -> float:
    """The lands cover the ports by more than their width: nothing flows around null."""
    return soften(x, p.spool_overlap.overlap)


class SpoolUnderlap(NamedTuple):
    """Half width of the range around null in which two edges are open."""

    underlap: Annotated[float, Quantity("m", low=0, high=1, typical="2-30 um")] = 0.0


@effect("metering", SpoolUnderlap, law="XS = XS + clip(XS, underlap) at the metering edges: twice the gain within",
        symptoms="opposite sign of overlap", starts=(2e-6, 1e-5, 3e-5), excludes=("spool_overlap",), source=_LANDS)
def spool_underlap(x: float, s: Any, u: Any, p: Any) -> float:
    """The lands leave the ports open at null: both edges of a port meter there."""
    return x + clip(x, p.spool_underlap.underlap)
