"""An effect of your own: a force that the magnets of a linear motor put on the ram, periodic over its travel."""
from math import pi, sin
from typing import Annotated, Any, NamedTuple

from plant import Quantity
from plant.effects import effect


class Cogging(NamedTuple):
    """Amplitude and period of the force; the default is the off value."""

    force: Annotated[float, Quantity("N", low=0)] = 0.0
    pitch: Annotated[float, Quantity("m", above=0)] = 2.5e-3


@effect("load", Cogging, law="FR = FR + F sin(2 pi XJ / pitch)")
def cogging(x: float, s: Any, u: Any, p: Any) -> float:
    """Add the force to FR, the load on the ram, positive against extension."""
    return x + p.cogging.force * sin(2.0 * pi * s.jack_position / p.cogging.pitch)
