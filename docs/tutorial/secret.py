"""An effect outside the catalogue, which makes the data of the tutorial's second example and is used nowhere else."""
from math import pi, sin
from typing import Annotated, NamedTuple

from plant import Quantity
from plant.effects import effect


class Cogging(NamedTuple):
    force: Annotated[float, Quantity("N", low=0)] = 0.0
    pitch: Annotated[float, Quantity("m", low=1e-5)] = 0.002


@effect("load", Cogging, law="FR = FR + force sin(2 pi XJ / pitch)")
def cogging(x, s, u, p):
    return x + p.cogging.force * sin(2 * pi * s.jack_position / p.cogging.pitch)
