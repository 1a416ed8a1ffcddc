"""Lists of faults by name or file, and the rules from a size with its interval to one of three levels.

A limit counts as reached when it lies inside the 95 % interval or below it, while the limit before it (the healthy
size, for MidBand) is excluded. A fault is acceptable only if MidBand lies clear of the interval
(`ACCEPTABLE_INTERVAL_FACTOR`): a missed fault costs more than an early look. So a fault exactly at MidBand is found in
98 % of all tests, as long as the interval excludes a healthy unit. An interval that holds both the healthy size and
MidBand cannot be judged.
"""

from collections.abc import Mapping, Sequence
from enum import IntEnum
from functools import cache
from importlib.resources import files
from pathlib import Path
from statistics import NormalDist
from typing import NamedTuple

from fdi.thresholds import ABSENT_FAULT_SHARE, ACCEPTABLE_INTERVAL_FACTOR, INTERVAL_95_SD
from plant import Fault, Plant, find_plant, place_faults, read_faults, require

__all__ = ["CLOGGING", "FAULTS", "FRICTION", "Estimate", "Fault", "Level", "choose_faults", "classify_size",
           "compute_severity", "find_ruling_fault", "judge_size", "list_fault_files", "load_faults"]

SHIPPED = "faults_{}.toml"  # beside this file


class Level(IntEnum):
    """How far a fault has gone (the paper's three classes)."""

    ACCEPTABLE = 0
    MAINTENANCE = 1  # beyond MidBand
    NON_NOMINAL = 2  # beyond MaxBand

    @property
    def word(self) -> str:
        """The level as in the JSON answer."""
        return self.name.lower()


class Estimate(NamedTuple):
    """A number with its 95 % interval, SI units."""

    value: float
    low: float
    high: float


def list_fault_files() -> list[str]:
    """Names of the lists of faults that come with the software."""
    start, end = SHIPPED.split("{}")
    names = [entry.name for entry in files("fdi.diagnosis").iterdir()]
    return sorted(name[len(start):-len(end)] for name in names if name.startswith(start) and name.endswith(end))


def load_faults(source: str | Path = "paper", kind: Plant | None = None) -> tuple[Fault, ...]:
    """The faults of a shipped list by name, or of a file, for a plant (default: the EHA).

    Raises:
        InputError: no such list, or faults that the plant cannot have.
    """
    kind = kind or find_plant("eha")
    if str(source) in list_fault_files():
        return _load_shipped_faults(str(source), kind)
    require(Path(source).is_file(), "--faults", str(source), f"a fault file, or one of {', '.join(list_fault_files())}")
    return read_faults(Path(source), kind)


@cache
def _load_shipped_faults(name: str, kind: Plant) -> tuple[Fault, ...]:
    return read_faults(Path(str(files("fdi.diagnosis") / SHIPPED.format(name))), kind)


def choose_faults(source: str | Path | None, kind: Plant) -> tuple[Fault, ...]:
    """The faults that an option names; without it those that the plant brings, or else the paper's.

    Raises:
        InputError: no such list, or faults that the plant cannot have.
    """
    if source is None and kind.faults:
        return place_faults(kind.faults, kind, kind.file or kind.name)
    require(source is not None or kind == find_plant("eha"), "--faults", "",
            f"a fault file: the plant {kind.name} brings no faults of its own")
    return load_faults(source or "paper", kind)


FAULTS = CLOGGING, FRICTION = load_faults()  # the paper's


def judge_size(fault: Fault, size: Estimate, tested: int = 1) -> Level | None:
    """The level of a fault of that size; None if the interval holds both a healthy unit and MidBand.

    Of many faults `tested` at once the healthy size has to lie outside a wider interval: see `widen_for_many`.

    >>> judge_size(CLOGGING, Estimate(0.02, 0.0, 0.07)).word, judge_size(CLOGGING, Estimate(0.23, 0.18, 0.28)).word
    ('acceptable', 'maintenance')
    """
    value, low, high = measure_departures(fault, size)
    healthy, middle, most = fault.limits
    if value + ACCEPTABLE_INTERVAL_FACTOR * (high - value) < middle:
        return Level.ACCEPTABLE
    more = widen_for_many(tested) - 1.0
    sure = Estimate(size.value, size.low - more * (size.value - size.low), size.high + more * (size.high - size.value))
    if measure_departures(fault, sure).low <= healthy:
        return None
    return Level.NON_NOMINAL if high >= most and low > middle else Level.MAINTENANCE


def widen_for_many(tested: int) -> float:
    """By how much a 95 % interval is widened where so many faults are tested at once, that no more than
    `ABSENT_FAULT_SHARE` of the units without a fault have one outside (Bonferroni). Two are judged as one is, which
    their rates are counted with.

    >>> widen_for_many(2), round(widen_for_many(11), 2)
    (1.0, 1.69)
    """
    return NormalDist().inv_cdf(1.0 - 0.5 * ABSENT_FAULT_SHARE / tested) / INTERVAL_95_SD if tested > 2 else 1.0


def measure_departures(fault: Fault, size: Estimate) -> Estimate:
    """An estimate as departures, larger is worse; the least one is 0 where the interval of both ways is on both sides.
    """
    ends = sorted(fault.measure_departure(x) for x in size[1:])
    is_inside = fault.both_ways and size.low < fault.healthy < size.high
    return Estimate(fault.measure_departure(size.value), 0.0 if is_inside else ends[0], ends[1])


def classify_size(fault: Fault, value: float) -> Level:
    """The class of a size without an interval, as by Table 2 of the paper; a size at a limit is beyond it."""
    size, (_, middle, most) = fault.measure_departure(value), fault.limits
    return Level(int(size >= middle) + int(size >= most))


def compute_severity(fault: Fault, value: float) -> float:
    """How far a fault has gone: 0 healthy, 1 at MidBand, 2 at MaxBand, straight lines between and beyond."""
    size, (healthy, middle, most) = fault.measure_departure(value), fault.limits
    return (size - healthy) / (middle - healthy) if size <= middle else 1.0 + (size - middle) / (most - middle)


def find_ruling_fault(faults: Sequence[Fault], sizes: Mapping[str, Estimate], levels: Mapping[str, Level | None]
                      ) -> str | None:
    """Name of the most severe of the faults that are not acceptable; None if there is none."""
    candidates = [f for f in faults if levels.get(f.name) not in (None, Level.ACCEPTABLE)]
    return max(candidates, key=lambda f: compute_severity(f, sizes[f.name].value)).name if candidates else None
