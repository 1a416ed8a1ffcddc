"""The two progressive faults of the servovalve, and the rules from a size with its interval to one of three levels.

A limit of Table 2 counts as reached when it lies inside the 95 % interval or below it, while the limit before it (the
healthy size, for MidBand) is excluded. A fault is acceptable only if MidBand lies clear of the interval
(`ACCEPTABLE_INTERVAL_FACTOR`): a missed fault costs more than an early look. So a fault exactly at MidBand is found in
98 % of all tests, as long as the interval excludes a healthy unit. An interval that holds both the healthy size and
MidBand cannot be judged.
"""
from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import NamedTuple

from fdi.thresholds import ACCEPTABLE_INTERVAL_FACTOR

DYNAMIC = "spool.dynamic_friction"  # FDS, which goes with FSS
STATIC_OVER_DYNAMIC = 1.5  # FSS over FDS of the nominal spool (plant/models/nominal.toml)


class Level(IntEnum):
    """How far a fault has gone (the paper's three classes)."""

    ACCEPTABLE = 0
    MAINTENANCE = 1  # beyond MidBand
    NON_NOMINAL = 2  # beyond MaxBand

    @property
    def word(self) -> str:
        """The level as in the JSON answer."""
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
    largest: float  # that a fit may find


CLOGGING = Fault("filter_clogging", "kintas", "filter.clogging", "1", 0.0, 0.25, 0.35, 0.95)
FRICTION = Fault("spool_friction", "fss", "spool.static_friction", "N", 5.0, 35.0, 70.0, 1000.0)
FAULTS = CLOGGING, FRICTION


class Estimate(NamedTuple):
    """A number with its 95 % interval, SI units."""

    value: float
    low: float
    high: float


def judge_size(fault: Fault, size: Estimate) -> Level | None:
    """The level of a fault of that size; None if the interval holds both a healthy unit and MidBand.

    >>> judge_size(CLOGGING, Estimate(0.02, 0.0, 0.07)).word, judge_size(CLOGGING, Estimate(0.23, 0.18, 0.28)).word
    ('acceptable', 'maintenance')
    """
    if size.value + ACCEPTABLE_INTERVAL_FACTOR * (size.high - size.value) < fault.middle:
        return Level.ACCEPTABLE
    if size.low <= fault.healthy:
        return None
    if size.high >= fault.most and size.low > fault.middle:
        return Level.NON_NOMINAL
    return Level.MAINTENANCE


def classify_size(fault: Fault, value: float) -> Level:
    """The class of a size without an interval, by Table 2 of the paper; a size at a limit is beyond it."""
    return Level(int(value >= fault.middle) + int(value >= fault.most))


def compute_severity(fault: Fault, value: float) -> float:
    """How far a fault has gone: 0 healthy, 1 at MidBand, 2 at MaxBand, straight lines between and beyond."""
    if value <= fault.middle:
        return (value - fault.healthy) / (fault.middle - fault.healthy)
    return 1.0 + (value - fault.middle) / (fault.most - fault.middle)


def find_ruling_fault(sizes: Mapping[str, Estimate], levels: Mapping[str, Level | None]) -> str | None:
    """Name of the more severe of the faults that are not acceptable; None if there is none."""
    gone = [f for f in FAULTS if levels.get(f.name) not in (None, Level.ACCEPTABLE)]
    return max(gone, key=lambda f: compute_severity(f, sizes[f.name].value)).name if gone else None
