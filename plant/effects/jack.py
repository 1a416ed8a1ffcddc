"""Forces on the ram. Positive external force acts against extension."""
from __future__ import annotations

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
