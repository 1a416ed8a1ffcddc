"""The two progressive faults, their levels, and what is said about them."""
from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple


class Level(IntEnum):
    """How far a fault has gone (the paper's three classes)."""

    ACCEPTABLE = 0
    MAINTENANCE = 1  # beyond MidBand
    NON_NOMINAL = 2  # beyond MaxBand

    @property
    def word(self) -> str:
        """As in the JSON answer."""
        return self.name.lower()


class Fault(NamedTuple):
    """A progressive fault: its parameter, healthy size, and the sizes that end two classes (Table 2 of the paper)."""

    name: str  # of its effect
    symbol: str  # of its size: kintas, fss
    parameter: str  # "group.field"
    unit: str
    healthy: float
    middle: float  # MidBand
    most: float  # MaxBand


CLOGGING = Fault("filter_clogging", "kintas", "filter.clogging", "1", 0.0, 0.25, 0.35)
FRICTION = Fault("spool_friction", "fss", "spool.static_friction", "N", 5.0, 35.0, 70.0)
FAULTS = CLOGGING, FRICTION


class Estimate(NamedTuple):
    """A number with its 95 % interval, SI units."""

    value: float
    low: float
    high: float


class Event(NamedTuple):
    """A stay outside a band."""

    band: str  # "middle" | "most"
    signal: str  # "position" | "speed"
    section: str  # of the command, as fdi.trace.sections names it
    t_in: float  # s
    t_out: float  # s
    excess: float  # furthest beyond the band, m or m/s
