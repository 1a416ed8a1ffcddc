"""Checks as data: what is measured in which window of a run, within which limits, and whether it passed.

Every kind measures one number (measures.py says how) that is held against `low` and `high`, all three in `unit`.
A check never raises: what cannot be measured has failed, and `detail` says why.
"""
from __future__ import annotations

from abc import ABC, abstractmethod
from cmath import phase
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import degrees, nan
from typing import Annotated, ClassVar, Literal, NamedTuple

import numpy as np

from plant.errors import InputError
from plant.segments import RATE, Hertz, Second
from rig.sequences import measures
from rig.sequences.measures import NotMeasurable
from rig.sequences.scene import MAIN, EventLike, Scene, TraceLike
from rig.sequences.units import OF_SIGNAL, scale

Signal = Literal["com", "xj", "error", "speed", "cor", "p12", "xs", "load"]
InUnit = Annotated[float, "the check's unit"]
InSI = Annotated[float, "SI units"]
Percent = Annotated[float, "%"]


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

    def __post_init__(self) -> None:
        if self.low is None and self.high is None:
            raise InputError("check", "", "a low, a high, or both")
        if self.low is not None and self.high is not None and self.low > self.high:
            raise InputError("check", "high", f"a number from low = {self.low:g} up, not {self.high:g}")
        if isinstance(self.window, tuple) and not 0 <= self.window[0] < self.window[1]:
            raise InputError("check", "window", f"[t0, t1] with 0 <= t0 < t1, not {list(self.window)}")
        if self.skip < 0:
            raise InputError("check", "skip", f"0 s or more, not {self.skip:g}")
        scale(self.shown_unit, self.si_unit)

    @property
    def about(self) -> str:
        """The signal, or the event, that is judged."""
        return str(getattr(self, "signal", None) or getattr(self, "event", ""))

    @property
    def si_unit(self) -> str:
        return self.si or OF_SIGNAL[self.about]

    @property
    def shown_unit(self) -> str:
        return self.unit or self.si_unit

    @abstractmethod
    def measure(self, scene: Scene, span: slice) -> float:
        """The number in rows `span`, SI; raises NotMeasurable with the reason."""

    def judge(self, scene: Scene) -> CheckResult:
        """Measure and hold against the limits."""
        value, t0, t1, detail = nan, nan, nan, ""
        try:
            span = scene.span(self.window, self.skip)
            t0, t1 = span.start / RATE, span.stop / RATE
            value = self.measure(scene, span) / scale(self.shown_unit, self.si_unit)
            missing = scene.missing(self.about, span)
            detail = f"{missing} missing samples bridged" if missing else ""
        except NotMeasurable as reason:
            detail = str(reason)
        low, high = (nan if limit is None else limit for limit in (self.low, self.high))
        passed = not (value != value or value < low or value > high)  # NaN limits compare false
        return CheckResult(self.name, self.kind, self.about, value, self.shown_unit, low, high, passed, t0, t1, detail)


@dataclass(frozen=True, kw_only=True)
class _OfPosition(Check):
    """A number of the position against the demand."""

    si = "m"
    signal: Literal["xj"] = "xj"


@dataclass(frozen=True, kw_only=True)
class _OfSignal(Check):
    si = ""
    signal: Signal


@dataclass(frozen=True, kw_only=True)
class Overshoot(_OfPosition):
    """How far a step goes beyond its target, % of the step."""

    kind, si = "overshoot", "%"

    def measure(self, scene: Scene, span: slice) -> float:
        return measures.overshoot(*scene.step(span))


@dataclass(frozen=True, kw_only=True)
class SettlingTime(_OfPosition):
    """Time until a step stays within +-`band` of its target, s."""

    kind, si = "settling_time", "s"
    band: Percent

    def measure(self, scene: Scene, span: slice) -> float:
        return measures.settling_time(*scene.step(span), self.band)


@dataclass(frozen=True, kw_only=True)
class RiseTime(_OfPosition):
    """Time from 10 % to 90 % of a step, s."""

    kind, si = "rise_time", "s"

    def measure(self, scene: Scene, span: slice) -> float:
        return measures.rise_time(*scene.step(span))


@dataclass(frozen=True, kw_only=True)
class SteadyError(_OfPosition):
    """Size of the mean position error, m."""

    kind = "steady_error"

    def measure(self, scene: Scene, span: slice) -> float:
        return abs(float(scene.signal("error", span).mean()))


@dataclass(frozen=True, kw_only=True)
class RampError(_OfPosition):
    """Mean lag behind a ramp, m."""

    kind = "ramp_error"

    def measure(self, scene: Scene, span: slice) -> float:
        return measures.ramp_error(scene.signal("error", span), scene.signal("com", span))


@dataclass(frozen=True, kw_only=True)
class BreakAway(_OfPosition):
    """Position error before the spool lets go on a slow ramp, m."""

    kind = "break_away"

    def measure(self, scene: Scene, span: slice) -> float:
        return measures.break_away(scene.signal("error", span))


@dataclass(frozen=True, kw_only=True)
class MaxError(_OfPosition):
    """Largest position error in either direction, m."""

    kind = "max_error"

    def measure(self, scene: Scene, span: slice) -> float:
        return float(np.abs(measures.median(scene.signal("error", span))).max())


@dataclass(frozen=True, kw_only=True)
class RmsError(_OfPosition):
    """Root mean square of the position error, m."""

    kind = "rms_error"

    def measure(self, scene: Scene, span: slice) -> float:
        return float(np.sqrt(np.mean(scene.signal("error", span) ** 2)))


@dataclass(frozen=True, kw_only=True)
class NeverExceeds(_OfSignal):
    """Largest size of a signal, every sample counting."""

    kind = "never_exceeds"

    def measure(self, scene: Scene, span: slice) -> float:
        return float(np.abs(scene.signal(self.signal, span)).max())


@dataclass(frozen=True, kw_only=True)
class AmplitudeRatio(_OfPosition):
    """Amplitude of the position over that of the demand at one frequency."""

    kind, si = "amplitude_ratio", "1"
    frequency: Hertz

    def measure(self, scene: Scene, span: slice) -> float:
        return abs(measures.response(scene.signal("xj", span), scene.signal("com", span), self.frequency))


@dataclass(frozen=True, kw_only=True)
class PhaseLag(AmplitudeRatio):
    """By how much the position is behind the demand at one frequency, deg."""

    kind, si = "phase_lag", "deg"

    def measure(self, scene: Scene, span: slice) -> float:
        response = measures.response(scene.signal("xj", span), scene.signal("com", span), self.frequency)
        return -degrees(phase(response))


@dataclass(frozen=True, kw_only=True)
class ResponseWithin(Check):
    """Time from `after` (a fault's name or s of main) to an event, or to a signal passing a level for 3 samples, s."""

    kind, si = "response_within", "s"
    after: str | Second
    event: str = ""
    signal: Signal | None = None
    above: InSI | None = None
    below: InSI | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if bool(self.event) == (self.signal is not None):
            raise InputError("check", "event", "either an event or a signal")
        if (self.above is None and self.below is None) == (self.signal is not None):
            raise InputError("check", "signal", "a signal with a level above or below which it counts")

    def measure(self, scene: Scene, span: slice) -> float:
        after = self.after if isinstance(self.after, float) else scene.starts.get(self.after)
        if after is None:
            raise NotMeasurable(f"there was no fault {self.after!r}")
        if self.signal:
            rest = scene.span((after, span.stop / RATE))
            return measures.crossing(scene.signal(self.signal, rest), self.above, self.below)
        events = scene.matching(self.event, after)
        if not events:
            raise NotMeasurable(f"no event {self.event!r} after {after:g} s")
        return events[0].t - after


@dataclass(frozen=True, kw_only=True)
class EventOccurs(Check):
    """How often an event happens: at least once unless limits say otherwise."""

    kind, si = "event_occurs", "1"
    event: str
    low: InUnit | None = 1.0

    def measure(self, scene: Scene, span: slice) -> float:
        return float(len(scene.matching(self.event, span.start / RATE, span.stop / RATE)))


@dataclass(frozen=True, kw_only=True)
class EventNever(EventOccurs):
    """How often an event happens that should not."""

    kind = "event_never"
    low: InUnit | None = None
    high: InUnit | None = 0.0


KINDS: dict[str, type[Check]] = {kind.kind: kind for kind in (
    Overshoot, SettlingTime, RiseTime, SteadyError, RampError, BreakAway, MaxError, RmsError, NeverExceeds,
    AmplitudeRatio, PhaseLag, ResponseWithin, EventOccurs, EventNever)}


def evaluate(checks: Iterable[Check], trace: TraceLike, sections: Mapping[str, slice],
             events: Sequence[EventLike] = (), starts: Mapping[str, float] | None = None) -> list[CheckResult]:
    """Judge a run.

    Args:
        checks: what to judge, in the order of the table.
        trace: the main phase.
        sections: rows of each section of the command.
        events: what happened, times in s of main.
        starts: when each fault began, s of main, by its label.
    """
    scene = Scene(trace, sections, events, starts or {})
    return [check.judge(scene) for check in checks]
