"""The kinds of check, and how a run is judged by them.

Every kind measures one number (measures.py says how) that is held against `low` and `high`, all three in `unit`.
What no run could answer (0 Hz, an empty band) is refused when the check is read. On a run a check never raises: what
cannot be measured has failed, and `detail` says why.
"""
from __future__ import annotations

from cmath import phase
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import degrees, inf, nan
from typing import Annotated, Literal

import numpy as np

from plant.errors import InputError
from plant.segments import RATE, Hertz, Second, require_frequency
from rig.network.codec import Status
from rig.sequences import measures
from rig.sequences.check import LATEST_TIME, Check, CheckResult, InUnit, Reference, require_check
from rig.sequences.measures import (
    NO_DRIVES,
    UNIT_OF_SIGNAL,
    DriveFrames,
    EventLike,
    NotMeasurable,
    RunData,
    TraceLike,
    find_scale,
)

__all__ = ["KINDS", "Check", "CheckResult", "ResponseWithin", "ShutOff", "evaluate_checks"]

LEFT_OPERATIONAL = "node 2 left OPERATIONAL:"  # words of the event
Signal = Literal["com", "xj", "error", "speed", "cor", "p12", "xs", "load"]
InSI = Annotated[float, "SI units"]
Percent = Annotated[float, "%"]


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

    def measure(self, run: RunData, span: slice) -> float:
        return measures.measure_overshoot(*run.read_step(span))


@dataclass(frozen=True, kw_only=True)
class SettlingTime(_OfPosition):
    """Time until a step stays within +-`band` of its target, s."""

    kind, si = "settling_time", "s"
    band: Percent

    def __post_init__(self) -> None:
        super().__post_init__()
        require_check(0 < self.band <= 100, "band", f"above 0 and at most 100 % of the step, not {self.band:g}")

    def measure(self, run: RunData, span: slice) -> float:
        return measures.measure_settling_time(*run.read_step(span), self.band)


@dataclass(frozen=True, kw_only=True)
class RiseTime(_OfPosition):
    """Time from 10 % to 90 % of a step, s."""

    kind, si = "rise_time", "s"

    def measure(self, run: RunData, span: slice) -> float:
        return measures.measure_rise_time(*run.read_step(span))


@dataclass(frozen=True, kw_only=True)
class SteadyError(_OfPosition):
    """Size of the mean position error, m."""

    kind = "steady_error"

    def measure(self, run: RunData, span: slice) -> float:
        return abs(float(run.read_signal("error", span).mean()))


@dataclass(frozen=True, kw_only=True)
class RampError(_OfPosition):
    """Mean lag behind a ramp, m."""

    kind = "ramp_error"

    def measure(self, run: RunData, span: slice) -> float:
        return measures.measure_ramp_error(run.read_signal("error", span), run.read_signal("com", span))


@dataclass(frozen=True, kw_only=True)
class BreakAway(_OfPosition):
    """Position error before the spool lets go on a slow ramp, m."""

    kind = "break_away"

    def measure(self, run: RunData, span: slice) -> float:
        return measures.measure_break_away(run.read_signal("error", span))


@dataclass(frozen=True, kw_only=True)
class MaxError(_OfPosition):
    """Largest position error in either direction, m."""

    kind = "max_error"

    def measure(self, run: RunData, span: slice) -> float:
        return float(np.abs(measures.filter_median(run.read_signal("error", span))).max())


@dataclass(frozen=True, kw_only=True)
class RmsError(_OfPosition):
    """Root mean square of the position error, m."""

    kind = "rms_error"

    def measure(self, run: RunData, span: slice) -> float:
        return float(np.sqrt(np.mean(run.read_signal("error", span) ** 2)))


@dataclass(frozen=True, kw_only=True)
class NeverExceeds(_OfSignal):
    """Largest size of a signal, every sample counting."""

    kind = "never_exceeds"

    def measure(self, run: RunData, span: slice) -> float:
        return float(np.abs(run.read_signal(self.signal, span)).max())


@dataclass(frozen=True, kw_only=True)
class AmplitudeRatio(_OfPosition):
    """Amplitude of the position over that of the demand at one frequency."""

    kind, si = "amplitude_ratio", "1"
    frequency: Hertz

    def __post_init__(self) -> None:
        super().__post_init__()
        require_frequency("frequency", self.frequency)

    def measure(self, run: RunData, span: slice) -> float:
        return abs(measures.measure_response(run.read_signal("xj", span), run.read_signal("com", span), self.frequency))


@dataclass(frozen=True, kw_only=True)
class PhaseLag(AmplitudeRatio):
    """By how much the position is behind the demand at one frequency, deg."""

    kind, si = "phase_lag", "deg"

    def measure(self, run: RunData, span: slice) -> float:
        response = measures.measure_response(run.read_signal("xj", span), run.read_signal("com", span), self.frequency)
        return -degrees(phase(response))


def _require_time(after: str | float) -> None:
    if isinstance(after, float):
        require_check(0 <= after <= LATEST_TIME, "after",
                      f"0 to {LATEST_TIME:g} s of main, or a fault's name, not {after:g}")


def _find_start(run: RunData, after: str | float) -> float:
    """When a reaction is due to begin, s of main; NaN without the fault that it names."""
    try:
        return run.find_start(after)
    except NotMeasurable:
        return nan


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
        require_check(bool(self.event) != (self.signal is not None), "event", "either an event or a signal")
        levelled = self.above is not None or self.below is not None
        require_check(levelled == (self.signal is not None), "signal",
                      "a signal with a level above or below which it counts")
        _require_time(self.after)

    def find_reference(self, run: RunData) -> Reference:
        above, below = (nan if level is None else level for level in (self.above, self.below))
        return Reference(_find_start(run, self.after), above, below)

    def measure(self, run: RunData, span: slice) -> float:
        after = run.find_start(self.after)
        if self.signal:
            rest = run.find_rows((after, span.stop / RATE))
            return measures.find_crossing(run.read_signal(self.signal, rest), self.above, self.below)
        events = run.find_events(self.event, after)
        if not events:
            raise NotMeasurable(f"no event {self.event!r} after {after:g} s")
        return events[0].t - after


@dataclass(frozen=True, kw_only=True)
class ShutOff(Check):
    """Time from `after` to the drive frame from which on the controller says zero current and no closed loop, s.

    Any drive frame counts, also one of another cycle. A controller that leaves OPERATIONAL sends none any more, which
    counts as well. `status`: the four lower bits of the status word that it must say then; by default any without MODE.
    """

    kind, si = "shut_off", "s"
    after: str | Second
    status: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_time(self.after)
        require_check(self.status is None or 0 <= self.status <= 0xF, "status",
                      f"the four lower bits of a status word, 0 to 15, not {self.status}")

    def find_reference(self, run: RunData) -> Reference:
        return Reference(_find_start(run, self.after))

    def measure(self, run: RunData, span: slice) -> float:
        after = run.find_start(self.after)
        drives = run.drives.select_between(after, span.stop / RATE)
        is_off = (drives.current == 0.0) & (drives.status & int(Status.MODE) == 0)
        if self.status is not None:
            is_off &= drives.status & 0xF == self.status
        on = np.flatnonzero(~is_off)
        off = drives.t[int(on[-1]) + 1 if len(on) else 0:]
        left = [event.t for event in run.find_events(LEFT_OPERATIONAL, after, span.stop / RATE)
                if not len(on) or event.t >= drives.t[on[-1]]]
        times = [*off[:1].tolist(), *left[:1]]
        if not times:
            raise NotMeasurable("the controller did not say zero current, nor did it leave OPERATIONAL")
        return float(min(times)) - after


@dataclass(frozen=True, kw_only=True)
class Recovers(Check):
    """Time from the start of clean-up until the status word says ACTIVE, and does so to the end, s."""

    kind, si = "recovers", "s"

    def find_reference(self, run: RunData) -> Reference:
        return Reference(len(run.trace.t) / RATE)

    def measure(self, run: RunData, span: slice) -> float:
        start = len(run.trace.t) / RATE
        drives = run.drives.select_between(start, np.inf)
        idle = np.flatnonzero(drives.status & int(Status.ACTIVE) != int(Status.ACTIVE))
        first = int(idle[-1]) + 1 if len(idle) else 0
        if first >= len(drives.t):
            raise NotMeasurable("the controller was not ACTIVE at the end of clean-up")
        return float(drives.t[first]) - start


@dataclass(frozen=True, kw_only=True)
class EventOccurs(Check):
    """How often an event happens: at least once unless limits say otherwise."""

    kind, si = "event_occurs", "1"
    event: str
    low: InUnit | None = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_check(bool(self.event.split()), "event", "at least one word")

    def measure(self, run: RunData, span: slice) -> float:
        return float(len(run.find_events(self.event, span.start / RATE, span.stop / RATE)))


@dataclass(frozen=True, kw_only=True)
class EventNever(EventOccurs):
    """How often an event happens that should not."""

    kind = "event_never"
    low: InUnit | None = None
    high: InUnit | None = 0.0


KINDS: dict[str, type[Check]] = {kind.kind: kind for kind in (
    Overshoot, SettlingTime, RiseTime, SteadyError, RampError, BreakAway, MaxError, RmsError, NeverExceeds,
    AmplitudeRatio, PhaseLag, ResponseWithin, ShutOff, Recovers, EventOccurs, EventNever)}


def evaluate_checks(checks: Iterable[Check], trace: TraceLike, sections: Mapping[str, slice],
             events: Sequence[EventLike] = (), starts: Mapping[str, float] | None = None,
             drives: DriveFrames = NO_DRIVES) -> list[CheckResult]:
    """Judge a run.

    Args:
        checks: what to judge, in the order of the table.
        trace: the main phase.
        sections: rows of each section of the command.
        events: what happened, times in s of main.
        starts: when each fault began, s of main, by its label.
        drives: all drive frames, for the checks of a reaction.
    """
    run = RunData(trace, sections, events, starts or {}, drives)
    return [check.judge(run) for check in checks]


@dataclass(frozen=True, kw_only=True)
class Guard:
    """`signal` must not be outside low..high (in `unit`, default SI) for `cycles` cycles in a row."""

    name: str
    signal: Literal["com", "xj", "error", "cor", "p12", "xs", "load"]
    low: float | None = None
    high: float | None = None
    unit: str = ""
    cycles: int = 3  # one noisy sample is no excursion

    def __post_init__(self) -> None:
        low, high = self.compute_limits()
        if low >= high or (low, high) == (-inf, inf):
            raise InputError("guard", "", "a low, a high, or both with low below high")
        if self.cycles < 1:
            raise InputError("guard", "cycles", f"1 or more cycles, not {self.cycles}")

    def compute_limits(self) -> tuple[float, float]:
        """Low and high in SI; infinite where there is none."""
        si = UNIT_OF_SIGNAL[self.signal]
        size = find_scale(self.unit or si, si)
        return (-inf if self.low is None else self.low * size), (inf if self.high is None else self.high * size)


class GuardWatch:
    """Monitors the guards of a run, cycle by cycle."""

    def __init__(self, guards: Iterable[Guard]) -> None:
        self._watched = [(guard, *guard.compute_limits()) for guard in guards]
        self._outside = [0] * len(self._watched)

    def __bool__(self) -> bool:
        return bool(self._watched)

    def find_passed(self, values: Mapping[str, float]) -> Guard | None:
        """The first guard whose limit this cycle's `values` (SI, by signal) exceed for its number of cycles.

        A missing value (absent or NaN) is not outside, and does not count as back inside either.
        """
        passed = None
        for i, (guard, low, high) in enumerate(self._watched):
            value = values.get(guard.signal)
            if value is None or value != value:
                continue
            self._outside[i] = 0 if low <= value <= high else self._outside[i] + 1
            if passed is None and self._outside[i] >= guard.cycles:
                passed = guard
        return passed
