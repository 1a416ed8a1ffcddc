"""A check: a window of a run, a number measured there, limits, and a verdict. checks.py has the kinds."""
from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from math import isfinite, nan
from typing import Annotated, ClassVar, NamedTuple

from plant.errors import InputError
from plant.segments import LONGEST, RATE, Second
from rig.sequences.measures import MAIN, UNIT_OF_SIGNAL, NotMeasurable, RunData, find_scale

InUnit = Annotated[float, "the check's unit"]
LATEST_TIME = 1e6  # s, later than any run ends


def require_check(holds: bool, key: str, expected: str) -> None:
    """Raise InputError unless `holds`; the caller adds file and line."""
    if not holds:
        raise InputError("check", key, expected)


class CheckResult(NamedTuple):
    """One line of the table. `value`, `low` and `high` are in `unit`; NaN: not measurable, no such limit."""

    name: str
    kind: str
    signal: str
    value: float
    unit: str
    low: float
    high: float
    passed: bool
    t0: float  # s, the window
    t1: float
    detail: str
    requirement: tuple[str, ...] = ()  # ids of the requirements that the check verifies
    after: float = nan  # s of main, from which a time is measured; NaN: the check measures none
    above: float = nan  # level that a signal has to pass, SI
    below: float = nan


class Reference(NamedTuple):
    """What a check measures a reaction against: the instant from which time counts, s of main, and levels, SI."""

    after: float = nan
    above: float = nan
    below: float = nan


@dataclass(frozen=True, kw_only=True)
class Check(ABC):
    """A measured number and its limits. `window`: a section's name, [t0, t1] in s of main, or "main" for all of it."""

    kind: ClassVar[str]
    si: ClassVar[str]  # what the kind measures in; "" is the signal's own unit
    name: str
    window: str | tuple[Second, Second] = MAIN
    skip: Second = 0.0  # left out at the window's beginning
    low: InUnit | None = None
    high: InUnit | None = None
    unit: str = ""
    requirement: str | tuple[str, ...] = ()  # id of the requirement that it verifies, or several

    def __post_init__(self) -> None:
        require_check(self.low is not None or self.high is not None, "", "a low, a high, or both")
        if self.low is not None and self.high is not None:
            require_check(self.low <= self.high, "high", f"a number from low = {self.low:g} up, not {self.high:g}")
        if isinstance(self.window, tuple):
            t0, t1 = self.window
            require_check(0 <= t0 < t1 <= LATEST_TIME, "window",
                          f"[t0, t1] with 0 <= t0 < t1 <= {LATEST_TIME:g}, not {[t0, t1]}")
        require_check(0 <= self.skip <= LONGEST, "skip", f"0 s or more, at most {LONGEST:g}, not {self.skip:g}")
        for word in self.requirements:
            require_check(bool(word.strip()) and word.isprintable(), "requirement",
                          f"the id of a requirement, such as REQ-12, not {word!r}")
        _ = self.scale  # raises InputError for a unit of something else

    @property
    def about(self) -> str:
        """The signal, or the event, that is judged."""
        return str(getattr(self, "signal", None) or getattr(self, "event", ""))

    @property
    def requirements(self) -> tuple[str, ...]:
        """The ids of the requirements that the check verifies."""
        return (self.requirement,) if isinstance(self.requirement, str) else self.requirement

    @property
    def si_unit(self) -> str:
        return self.si or UNIT_OF_SIGNAL[self.about]

    @property
    def shown_unit(self) -> str:
        return self.unit or self.si_unit

    @property
    def scale(self) -> float:
        """How many SI units the unit of the limits is."""
        return find_scale(self.shown_unit, self.si_unit)

    def find_reference(self, run: RunData) -> Reference:
        """What a reaction is measured against; NaN for a check of something else, or if there was no such fault."""
        return Reference()

    @abstractmethod
    def measure(self, run: RunData, span: slice) -> float:
        """Measure the number in rows `span`, SI; raises NotMeasurable with the reason."""

    def judge(self, run: RunData) -> CheckResult:
        """Measure the number and compare it with the limits."""
        value, t0, t1, detail = nan, nan, nan, ""
        try:
            span = run.find_rows(self.window, self.skip)
            t0, t1 = span.start / RATE, span.stop / RATE
            missing = run.count_missing(self.about, span)
            measured = self.measure(run, span) / self.scale
            if not isfinite(measured):
                raise NotMeasurable(f"the measure came to {measured:g}")
            value, detail = measured, f"{missing} missing samples bridged" if missing else ""
        except NotMeasurable as reason:
            detail = str(reason)
        except (ArithmeticError, ValueError) as error:  # one bad check must not cost a run its verdict
            detail = f"the measure failed ({type(error).__name__}: {error})"
        low, high = (nan if limit is None else limit for limit in (self.low, self.high))
        passed = not (value != value or value < low or value > high)  # NaN limits compare false
        return CheckResult(self.name, self.kind, self.about, value, self.shown_unit, low, high, passed, t0, t1, detail,
                           self.requirements, *self.find_reference(run))
