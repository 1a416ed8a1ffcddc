"""The kinds of check, and how a run is judged by them.

Every kind measures one number (measures.py says how) that is held against `low` and `high`, all three in `unit`.
What no run could answer (0 Hz, an empty band) is refused when the check is read. On a run a check never raises: what
cannot be measured has failed, and `detail` says why.
"""
from __future__ import annotations

from cmath import phase
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import degrees
from typing import Annotated, Literal

import numpy as np

from plant.segments import RATE, Hertz, Second, require_frequency
from rig.sequences import measures
from rig.sequences.check import MOST, Check, CheckResult, InUnit, require
from rig.sequences.measures import NotMeasurable
from rig.sequences.scene import EventLike, Scene, TraceLike

__all__ = ["KINDS", "Check", "CheckResult", "ResponseWithin", "evaluate"]

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

    def measure(self, scene: Scene, span: slice) -> float:
        return measures.overshoot(*scene.step(span))


@dataclass(frozen=True, kw_only=True)
class SettlingTime(_OfPosition):
    """Time until a step stays within +-`band` of its target, s."""

    kind, si = "settling_time", "s"
    band: Percent

    def __post_init__(self) -> None:
        super().__post_init__()
        require(0 < self.band <= 100, "band", f"above 0 and at most 100 % of the step, not {self.band:g}")

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

    def __post_init__(self) -> None:
        super().__post_init__()
        require_frequency("frequency", self.frequency)

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
        require(bool(self.event) != (self.signal is not None), "event", "either an event or a signal")
        levelled = self.above is not None or self.below is not None
        require(levelled == (self.signal is not None), "signal", "a signal with a level above or below which it counts")
        if isinstance(self.after, float):
            require(0 <= self.after <= MOST, "after", f"0 to {MOST:g} s of main, or a fault's name, not {self.after:g}")

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

    def __post_init__(self) -> None:
        super().__post_init__()
        require(bool(self.event.split()), "event", "at least one word")

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
