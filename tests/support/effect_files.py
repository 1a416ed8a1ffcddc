"""Effect files as a user would write them, and a catalogue that forgets them after the test."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from unittest.mock import patch

from plant.effects import CATALOGUE

# A short search: what `rig fdi` needs, and two lags. One kernel serves all tests that search these.
SEARCHED = ("null_bias", "constant_load", "coil_lag", "sensor_lag", "filter_clogging", "spool_friction",
            "jack_friction", "viscous_drag", "moving_mass", "internal_leakage")
HEAD = """
from math import pi, sin
from typing import Annotated, NamedTuple
from plant.effects import effect
from plant.quantity import Quantity
"""

COGGING = HEAD + '''
class Cogging(NamedTuple):
    """A force periodic in position."""
    force: Annotated[float, Quantity("N")] = 0.0
    length: Annotated[float, Quantity("m", above=0)] = 1e-3

@effect("load", Cogging, law="FR = FR + F sin(2 pi XJ / L)")
def cogging(x, s, u, p):
    return x + p.cogging.force * sin(2.0 * pi * s.jack_position / p.cogging.length)
'''

SPRING = HEAD + '''
class Spring(NamedTuple):
    stiffness: Annotated[float, Quantity("N/m")] = 0.0

@effect("load", Spring, law="FR = FR + K XJ")
def spring(x, s, u, p):
    return x + p.spring.stiffness * s.jack_position
'''

MEMORY = "from __future__ import annotations\n" + HEAD + '''
class Wear(NamedTuple):
    rate: Annotated[float, Quantity("N/m", low=0)] = 0.0

class Way(NamedTuple):
    travelled: float = 0.0
    last: float = 0.0

@effect("load", Wear, law="FR = FR + k * way travelled", memory=Way)
def wear(x, m, s, u, p):
    way = m.travelled + abs(s.jack_position - m.last)
    return x + p.wear.rate * way, Way(way, s.jack_position)
'''


@contextmanager
def restored_catalogue(*effects: str) -> Iterator[None]:
    """Takes out again what was registered meanwhile; with only these `effects` searched, if any are named.

    The others stay in the catalogue: kernels have the parameters of all, so those of other tests serve here too.
    """
    others = set(CATALOGUE) - set(effects or CATALOGUE)
    with patch.dict(CATALOGUE, {name: replace(CATALOGUE[name], searched_in=("nowhere",)) for name in others}):
        yield
