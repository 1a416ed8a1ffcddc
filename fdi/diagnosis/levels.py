"""From the size of a fault, with its interval, to one of the paper's three levels; and which of two faults rules.

A limit of Table 2 counts as reached when it lies inside the 95 % interval or below it, while the limit before it (the
healthy size, for MidBand) is excluded. MidBand has to be a little further off (`ACCEPTABLE_INTERVAL_FACTOR`) before a
fault is acceptable: one that is missed costs more than one that is looked at early. So a fault exactly at MidBand is
found in 98 % of all tests, as long as the interval excludes a healthy unit. One that holds the healthy size and MidBand
both cannot be judged.
"""
from __future__ import annotations

from collections.abc import Mapping

from fdi.diagnosis.faults import FAULTS, Estimate, Fault, Level
from fdi.thresholds import ACCEPTABLE_INTERVAL_FACTOR


def level(fault: Fault, size: Estimate) -> Level | None:
    """The level of a fault of that size; None if the interval holds a healthy unit and MidBand both.

    >>> from fdi.diagnosis.faults import CLOGGING
    >>> level(CLOGGING, Estimate(0.02, 0.0, 0.07)).word, level(CLOGGING, Estimate(0.23, 0.18, 0.28)).word
    ('acceptable', 'maintenance')
    """
    if size.value + ACCEPTABLE_INTERVAL_FACTOR * (size.high - size.value) < fault.middle:
        return Level.ACCEPTABLE
    if size.low <= fault.healthy:
        return None
    if size.high >= fault.most and size.low > fault.middle:
        return Level.NON_NOMINAL
    return Level.MAINTENANCE


def of_value(fault: Fault, value: float) -> Level:
    """The class of a size by Table 2 of the paper alone; a size at a limit is beyond it."""
    return Level(int(value >= fault.middle) + int(value >= fault.most))


def severity(fault: Fault, value: float) -> float:
    """How far a fault has gone: 0 healthy, 1 at MidBand, 2 at MaxBand, straight lines between and beyond."""
    if value <= fault.middle:
        return (value - fault.healthy) / (fault.middle - fault.healthy)
    return 1.0 + (value - fault.middle) / (fault.most - fault.middle)


def ruling(sizes: Mapping[str, Estimate], levels: Mapping[str, Level | None]) -> str | None:
    """The fault that is further gone, of those that are not acceptable; None if there is none."""
    gone = [f for f in FAULTS if levels.get(f.name) not in (None, Level.ACCEPTABLE)]
    return max(gone, key=lambda f: severity(f, sizes[f.name].value)).name if gone else None
