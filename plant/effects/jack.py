"""Forces on the ram. Positive external force acts against extension."""

from math import pi
from typing import Annotated, Any, NamedTuple

from plant.effects import effect
from plant.quantity import Quantity


class ConstantLoad(NamedTuple):
    """A steady external force."""

    force: Annotated[float, Quantity("N", low=-1e6, high=1e6, typical="0.2-5 kN")] = 0.0


@effect("load", ConstantLoad, law="FR = FR + F", symptoms="mean P12", starts=(400.0, -400.0, 3000.0, -3000.0),
        confused_with=("friction_asymmetry", "null_bias"), source="a steady air load or weight")
def constant_load(x: float, s: Any, u: Any, p: Any) -> float:
    """A weight or a steady air load."""
    return x + p.constant_load.force


class AeroStiffness(NamedTuple):
    """Hinge moment of the surface per unit of ram position."""

    stiffness: Annotated[float, Quantity("N/m", low=0, high=1e9, typical="1e5-1e6 N/m")] = 0.0


@effect("load", AeroStiffness, law="FR = FR + K XJ", symptoms="P12 proportional to position, at rest too",
        starts=(1e5, 3e5, 1e6), source="hinge moment of a surface against its deflection")
def aero_stiffness(x: float, s: Any, u: Any, p: Any) -> float:
    """The air stream pushes the surface back to neutral."""
    return x + p.aero_stiffness.stiffness * (s.jack_position + 0.5 * u.h * s.jack_speed)


class StructuralResonance(NamedTuple):
    """A mass that the ram moves through a spring with damping; its frequency and damping ratio with the ram held."""

    mass: Annotated[float, Quantity("kg", low=0, high=1e4, typical="10-200 kg")] = 0.0
    frequency: Annotated[float, Quantity("Hz", low=1, high=1e3, typical="20-200 Hz")] = 60.0
    damping_ratio: Annotated[float, Quantity("1", low=0, high=10, typical="0.01-0.1")] = 0.03


class Swing(NamedTuple):
    """How far the mass is ahead of the ram if that keeps its speed, the mass's speed, and the ram's before the step."""

    ahead: float = 0.0
    speed: float = 0.0
    ram_speed: float = 0.0


@effect("load", StructuralResonance, law="FR = FR + M z', z' = w^2 (XJ - z0) + 2 D w (XJ' - z), z = z0', w = 2 pi f",
        symptoms="P12 rings after each move; the ram stands still at f and moves most above it", memory=Swing,
        starts=((20.0, 30.0, 0.03), (20.0, 80.0, 0.03), (60.0, 60.0, 0.03), (100.0, 150.0, 0.03)),
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
