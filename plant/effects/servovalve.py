"""Effects of the torque motor, the pilot stage and the spool."""
from __future__ import annotations

from math import pi, sin
from typing import Annotated, Any, NamedTuple

from plant.effects import effect
from plant.friction import soften
from plant.quantity import Quantity


class NullBias(NamedTuple):
    """Current offset."""

    current: Annotated[float, Quantity("A", low=-20, high=20, typical="0.2-4 % of Imax")] = 0.0


@effect("current", NullBias, law="i = i + i0", symptoms="constant error i0/GAP with P12 unchanged")
def null_bias(x: float, s: Any, u: Any, p: Any) -> float:
    """The valve's null is not at zero current."""
    return x + p.null_bias.current


class CurrentNoise(NamedTuple):
    """Electrical noise on the current line."""

    white: Annotated[float, Quantity("A rms", low=0, high=20)] = 0.0
    hum: Annotated[float, Quantity("A", low=0, high=20, typical="amplitude")] = 0.0
    frequency: Annotated[float, Quantity("Hz", low=0, high=1e6)] = 400.0


@effect("current", CurrentNoise, law="i = i + white n_k + hum sin(2 pi f t), n_k new every cycle",
        symptoms="the current the coil feels differs from the one sent; a line at f in P12", disturbance=True)
def current_noise(x: float, s: Any, u: Any, p: Any) -> float:
    """Aircraft supply hum and white noise couple into the current line."""
    g = p.current_noise
    return x + g.white * u.noise + g.hum * sin(2.0 * pi * g.frequency * u.t)


class SpoolOverlap(NamedTuple):
    """Half width of the metering edges' dead zone."""

    overlap: Annotated[float, Quantity("m", low=0, high=1, typical="5-60 um")] = 0.0


@effect("metering", SpoolOverlap, law="XS = deadzone(XS, overlap) at the metering edges",
        symptoms="single-valued flat spot at null")
def spool_overlap(x: float, s: Any, u: Any, p: Any) -> float:
    """The lands cover the ports by more than their width: nothing flows around null."""
    return soften(x, p.spool_overlap.overlap)
