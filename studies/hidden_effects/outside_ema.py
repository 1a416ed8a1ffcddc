"""Effects that the catalogue of the EMA lacks, for the blind trial: `rig explain` must not call them something else."""
from math import pi, sin
from typing import Annotated, Any, NamedTuple

from plant import Quantity
from plant.effects import effect
from plant.ema import Friction


class RoughStroke(NamedTuple):
    """Share of the dry friction that changes along the stroke."""

    share: Annotated[float, Quantity("1", low=0, high=0.95)] = 0.0


@effect("friction", RoughStroke, starts=(0.5,), law="FD (1 + share sin(2 pi x / 3 mm))")
def rough_stroke(x: Friction, s: Any, u: Any, p: Any) -> Friction:
    """Dirt on the screw."""
    more = p.rough_stroke.share * sin(2.0 * pi / 3e-3 * s.position)
    return Friction(x.force, x.static * (1.0 + more), x.dynamic * (1.0 + more))


class SquareDrag(NamedTuple):
    """Drag that grows with the square of the speed."""

    level: Annotated[float, Quantity("N s2/m2", low=0, high=1e8)] = 0.0


@effect("friction", SquareDrag, starts=(1e5,), law="c |x'| x'")
def square_drag(x: Friction, s: Any, u: Any, p: Any) -> Friction:
    """Flow around the surface."""
    return Friction(x.force + p.square_drag.level * abs(s.speed) * s.speed, x.static, x.dynamic)


class CentringSpring(NamedTuple):
    """Cubic spring that draws the surface to the middle."""

    level: Annotated[float, Quantity("N/m3", low=0, high=1e12)] = 0.0


@effect("load", CentringSpring, starts=(1e9,), law="k x^3")
def centring_spring(x: float, s: Any, u: Any, p: Any) -> Any:
    """Hinge moment."""
    return x + p.centring_spring.level * s.position * s.position * s.position


class Gust(NamedTuple):
    """Amplitude of a force in time."""

    force: Annotated[float, Quantity("N", low=0, high=1e5)] = 0.0


@effect("load", Gust, starts=(50.0,), law="F sin(2 pi 7.3 Hz t)")
def gust(x: float, s: Any, u: Any, p: Any) -> Any:
    """Separated flow behind a spoiler."""
    return x + p.gust.force * sin(2.0 * pi * 7.3 * u.t)


class Saturation(NamedTuple):
    """Loss of torque with its size."""

    loss: Annotated[float, Quantity("1/(N m)", low=0, high=10)] = 0.0


@effect("torque", Saturation, starts=(0.1,), law="T (1 - loss |T|)")
def saturation(x: float, s: Any, u: Any, p: Any) -> Any:
    """Iron of the motor."""
    return x * (1.0 - p.saturation.loss * min(abs(x), 3.0))


class Warming(NamedTuple):
    """Loss of torque with time."""

    rate: Annotated[float, Quantity("1/s", low=0, high=0.05)] = 0.0


@effect("torque", Warming, starts=(0.005,), law="T (1 - rate t)")
def warming(x: float, s: Any, u: Any, p: Any) -> Any:
    """Magnets lose flux as they warm up."""
    return x * (1.0 - p.warming.rate * u.t)


class BentScale(NamedTuple):
    """Error of the transducer with the square of the position."""

    bend: Annotated[float, Quantity("1/m", low=-10, high=10)] = 0.0


@effect("position", BentScale, starts=(0.5, -0.5), law="x (1 + bend x)")
def bent_scale(x: float, s: Any, u: Any, p: Any) -> Any:
    """Transducer that is not linear."""
    return x * (1.0 + p.bent_scale.bend * x)


class DeadBand(NamedTuple):
    """Current below which the power stage does nothing."""

    width: Annotated[float, Quantity("A", low=0, high=10)] = 0.0


@effect("current", DeadBand, starts=(0.1,), law="i - clip(i, width)")
def dead_band(x: float, s: Any, u: Any, p: Any) -> Any:
    """Dead time of the inverter's switches."""
    width = p.dead_band.width
    return x - min(max(x, -width), width)
