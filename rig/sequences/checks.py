"""Checks: a window of a run, a number measured there, limits, and a verdict. And guards, watched in every cycle.

Every kind of check is a row of `KINDS`: the number that it measures (measures.py says how), its unit, and the class
that has its keys. The number is held against `low` and `high`, all three in `unit`. What no run could answer (0 Hz, an
empty band) is refused when the check is read. On a run a check never raises: what cannot be measured has failed, and
`detail` says why.
"""
from __future__ import annotations

from cmath import phase
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import degrees, inf, isfinite, nan
from typing import Annotated, Any, NamedTuple

import numpy as np

from plant.errors import InputError
from plant.run import Columns
from plant.segments import LONGEST, RATE, Array
from plant.signals import EHA, Signals
from rig.benches.bench import Bench
from rig.benches.profiles import CIA408, State, find_state
from rig.sequences import measures
from rig.sequences.faults import Time
from rig.sequences.measures import MAIN, NO_DRIVES, DriveFrames, NotMeasurable, RunData, find_scale
from rig.sequences.python_parts import Argument, UserFunction, describe_value, require_function_name
from rig.sequences.signals import DERIVED, Controlled, Guarded, Measured, find_controlled, find_tested, find_unit
from rig.sequences.uncertainty import NO_METROLOGY, Metrology, compute_expanded_uncertainty, decide
from rig.tables import Range

LEFT_OPERATIONAL = "controller left OPERATIONAL:"  # words of the event
InSI = Annotated[float, "SI units"]
InUnit = Annotated[float, "the check's unit"]


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
    uncertainty: float = nan  # U (k = 2) of the value; NaN: not known, or not asked for
    cannot_tell: bool = False  # the decision rule leaves it open; then it has not passed either

    @property
    def verdict(self) -> str:
        """PASS, FAIL or CANNOT_TELL."""
        if self.cannot_tell:
            return "CANNOT_TELL"
        return "PASS" if self.passed else "FAIL"

    def collect_data(self) -> dict[str, Any]:
        """All of it by name, for an answer in JSON."""
        return {**self._asdict(), "verdict": self.verdict}


class SkippedCheck(NamedTuple):
    """A check that does not apply to a bench, and why."""

    name: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class Check:
    """A measured number and its limits. `window`: a section's name, [t0, t1] in s of main, or "main" for all of it."""

    kind: str = field(metadata={"key": False})
    name: str
    window: str | tuple[Time, Time] = MAIN
    skip: Annotated[float, Range("s", low=0.0, high=LONGEST)] = 0.0  # left out at the window's beginning
    low: InUnit | None = None
    high: InUnit | None = None
    unit: str = ""
    requirement: str | tuple[str, ...] = ()  # id of the requirement that it verifies, or several
    signals: Signals = field(default_factory=find_tested, metadata={"key": False}, repr=False)  # of the plant

    def __post_init__(self) -> None:
        require_check(self.low is not None or self.high is not None, "", "a low, a high, or both")
        if self.low is not None and self.high is not None:
            require_check(self.low <= self.high, "high", f"a number from low = {self.low:g} up, not {self.high:g}")
        if isinstance(self.window, tuple):
            require_check(self.window[0] < self.window[1], "window", f"[t0, t1] with t0 < t1, not {[*self.window]}")
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
    def shown_unit(self) -> str:
        """The unit of the limits; by default that of the kind, or of the signal."""
        return self.unit or self._si

    @property
    def scale(self) -> float:
        """How many SI units the unit of the limits is."""
        return find_scale(self.shown_unit, self._si)

    @property
    def _si(self) -> str:
        """The SI unit of the number: that of the kind, where an error is one of the controlled signal, or the signal's.
        """
        unit = KINDS[self.kind].unit or find_unit(self.signals, self.about)
        return self.signals.controlled.unit if unit == "m" and KINDS[self.kind].unit else unit

    def judge(self, run: RunData) -> CheckResult:
        """Measure the number and compare it with the limits."""
        value, t0, t1, detail, uncertainty = nan, nan, nan, "", nan
        try:
            span = run.find_rows(self.window, self.skip)
            t0, t1 = span.start / run.rate, span.stop / run.rate
            missing = run.count_missing(self.about, span)
            value, detail = self._measure(run, span), f"{missing} missing samples bridged" if missing else ""
        except NotMeasurable as reason:
            detail = str(reason)
        except (ArithmeticError, ValueError) as error:  # one bad check must not cost a run its verdict
            detail = f"the measure failed ({type(error).__name__}: {error})"
        if run.metrology.is_used and t1 == t1:
            uncertainty, problem = self._compute_uncertainty(run, span, value)
            detail = "; ".join(filter(None, (detail, problem)))
        low, high = (nan if limit is None else limit for limit in (self.low, self.high))
        passed = decide(value, low, high, uncertainty, run.metrology.decision)
        return CheckResult(self.name, self.kind, self.about, value, self.shown_unit, low, high, passed is True, t0, t1,
                           detail, self.requirements, *self._find_reference(run), uncertainty, passed is None)

    def _measure(self, run: RunData, span: slice) -> float:
        """The number, in the unit of the limits. Raises NotMeasurable."""
        measured = KINDS[self.kind].measure(self, run, span) / self.scale
        if not isfinite(measured):
            raise NotMeasurable(f"the measure came to {measured:g}")
        return measured

    def _compute_uncertainty(self, run: RunData, span: slice, value: float) -> tuple[float, str]:
        """U of the number, NaN if it is not known, and what is wrong with the calibrations that it depends on."""
        def measure(trace: Columns) -> float:
            try:
                return self._measure(replace(run, trace=trace), span)
            except (NotMeasurable, ArithmeticError, ValueError):
                return nan

        signals, known = run.signals, run.metrology.calibration
        names = self._list_readings(signals)
        missing = [s.name for s in signals if s.name in names and s.role in ("output", "load") and s.name not in known]
        if missing and not (self.kind == "python" and known):  # which columns a function reads is not known
            return nan, f"no calibration of {', '.join(missing)}"
        step = 1 / run.rate / self.scale if KINDS[self.kind].is_rounded else 0.0
        found = compute_expanded_uncertainty(measure, value, run.trace, names, run.metrology, step)
        problems = [run.metrology.problems[name] for name in names if name in run.metrology.problems]
        problems += ["errors of the sensor decide whether it can be measured"] if found == inf else []
        return found, "; ".join(problems)

    def _list_readings(self, signals: Signals) -> tuple[str, ...]:
        """The signals that the number depends on; the demand is exact."""
        name = getattr(self, "signal", None)
        if self.kind == "python":
            return tuple(s.name for s in signals[1:] if s.role != "command")
        if name in DERIVED and name not in signals.names:
            name = signals.controlled.name
        return (name,) if name in signals.names and name != signals.command.name else ()

    def _find_reference(self, run: RunData) -> tuple[float, float, float]:
        """What a reaction is measured against: the time from which it counts, s of main, and levels; NaN for none."""
        after = len(run.trace.t) / run.rate if self.kind == "recovers" else getattr(self, "after", nan)
        after = after if isinstance(after, float) else run.starts.get(after, nan)
        above, below = (getattr(self, key, None) for key in ("above", "below"))
        return after, nan if above is None else above, nan if below is None else below


def find_skipped(check: Check, bench: Bench) -> SkippedCheck | None:
    """A check of a sequence that a bench cannot answer, with the reason; None for one that it can."""
    words = check.about.lower().split() if isinstance(getattr(check, "event", None), str) else []
    if not bench.nodes and "controller" in words and any(word.startswith("0x") for word in words):
        return SkippedCheck(check.name, "plain CAN has no EMCY")
    if check.kind == "recovers" and bench.profile == "none":
        return SkippedCheck(check.name, "the bench has no status word")
    return None


def require_check(holds: bool, key: str, expected: str) -> None:
    """Raise InputError unless `holds`; the caller adds file and line."""
    if not holds:
        raise InputError("check", key, expected)


@dataclass(frozen=True, kw_only=True)
class OfPosition(Check):
    """A number of the position against the demand."""

    signal: Controlled = field(default_factory=find_controlled)


@dataclass(frozen=True, kw_only=True)
class Settling(OfPosition):
    """With the band around the target of a step."""

    band: Annotated[float, Range("%", above=0.0, high=100.0)]


@dataclass(frozen=True, kw_only=True)
class AtFrequency(OfPosition):
    """At one frequency."""

    frequency: Annotated[float, Range("Hz", above=0.0)]  # and below half the rate of the run


@dataclass(frozen=True, kw_only=True)
class OfSignal(Check):
    """A number of any signal."""

    signal: Measured


@dataclass(frozen=True, kw_only=True)
class Response(Check):
    """With the instant from which time counts (a fault's name or s of main), and an event or a level of a signal."""

    after: str | Time
    event: str = ""
    signal: Measured | None = None
    above: InSI | None = None
    below: InSI | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require_check(bool(self.event) != (self.signal is not None), "event", "either an event or a signal")
        levelled = self.above is not None or self.below is not None
        require_check(levelled == (self.signal is not None), "signal",
                      "a signal with a level above or below which it counts")


@dataclass(frozen=True, kw_only=True)
class ShutOff(Check):
    """With the instant from which time counts. `status`: four lower bits of the status word of CiA 408, or of another
    profile the state that they mean; default: any state without current.
    """

    after: str | Time
    status: Annotated[int, Range("1", low=0, high=0xF)] | None = None


@dataclass(frozen=True, kw_only=True)
class OfEvent(Check):
    """With the words of an event: at least once unless limits say otherwise."""

    event: str
    low: InUnit | None = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_check(bool(self.event.split()), "event", "at least one word")


@dataclass(frozen=True, kw_only=True)
class NoEvent(OfEvent):
    """With the words of an event that should not happen."""

    low: InUnit | None = None
    high: InUnit | None = 0.0


@dataclass(frozen=True, kw_only=True)
class PythonCheck(Check):
    """With the function that measures the number."""

    python: str
    arguments: Mapping[str, Argument] = field(default_factory=dict)
    function: UserFunction | None = field(default=None, repr=False, compare=False, metadata={"key": False})

    def __post_init__(self) -> None:
        super().__post_init__()
        require_function_name(self.python)
        require_check(self.unit.isprintable() and len(self.unit) <= 20, "unit", "a unit of at most 20 characters")

    @property
    def scale(self) -> float:
        return 1.0


class Window:
    """What a user's check gets: the cycles of its window as columns by the names of the plant's signals, SI units.

    NaN where a sample is missing. `t` counts from the start of main.
    """

    def __init__(self, signals: Signals, columns: Mapping[str, Array]) -> None:
        self._signals = signals
        vars(self).update(columns)

    @property
    def error(self) -> Array:
        """Demand minus controlled signal, SI."""
        error: Array = vars(self)[self._signals.command.name] - vars(self)[self._signals.controlled.name]
        return error


def _measure_python(check: PythonCheck, run: RunData, span: slice) -> float:
    assert check.function is not None
    columns = {name: np.array(getattr(run.trace, name)[span], dtype=np.float64) for name in run.signals.names}
    columns["t"] = np.arange(span.start, span.stop) / run.rate
    value = check.function.call(Window(run.signals, columns), **check.arguments)
    if value is None:
        raise NotMeasurable(f"{check.python} returned no value")
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise NotMeasurable(f"{check.python} returned {describe_value(value)}, not a number") from None
    if not isfinite(number):
        raise NotMeasurable(f"{check.python} returned {number:g}")
    return number


def _measure_response(check: Response, run: RunData, span: slice) -> float:
    after = run.find_start(check.after)
    if check.signal:
        rest = run.find_rows((after, span.stop / run.rate))
        return measures.find_crossing(run.read_signal(check.signal, rest), run.rate, check.above, check.below)
    events = run.find_events(check.event, after)
    if not events:
        raise NotMeasurable(f"no event {check.event!r} after {after:g} s")
    return float(events[0].t) - after


def _measure_shut_off(check: ShutOff, run: RunData, span: slice) -> float:
    """Any drive frame counts, also one of another cycle. A controller that leaves OPERATIONAL sends none any more."""
    after = run.find_start(check.after)
    drives = run.drives.select_between(after, span.stop / run.rate)
    words = drives.words
    is_off = (drives.current == 0.0) & (drives.status & words.powered == 0)
    if check.status is not None and words is CIA408:
        is_off &= drives.status & words.mask == check.status
    elif check.status is not None and words.mask:
        is_off &= drives.states == find_state(CIA408, check.status)
    on = np.flatnonzero(~is_off)
    off = drives.t[int(on[-1]) + 1 if len(on) else 0:]
    left = [event.t for event in run.find_events(LEFT_OPERATIONAL, after, span.stop / run.rate)
            if not len(on) or event.t >= drives.t[on[-1]]]
    times = [*off[:1].tolist(), *left[:1]]
    if not times:
        raise NotMeasurable("the controller did not say zero current, nor did it leave OPERATIONAL")
    return float(min(times)) - after


def _measure_recovery(check: Check, run: RunData, span: slice) -> float:
    start = len(run.trace.t) / run.rate
    drives = run.drives.select_between(start, np.inf)
    idle = np.flatnonzero(drives.states != State.ACTIVE)
    first = int(idle[-1]) + 1 if len(idle) else 0
    if first >= len(drives.t):
        raise NotMeasurable("the controller was not ACTIVE at the end of clean-up")
    return float(drives.t[first]) - start


def _read_response(check: AtFrequency, run: RunData, span: slice) -> complex:
    position, demand = (run.read_signal(s.name, span) for s in (run.signals.controlled, run.signals.command))
    return measures.measure_response(position, demand, run.rate, check.frequency)


def _count_events(check: OfEvent, run: RunData, span: slice) -> float:
    return float(len(run.find_events(check.event, span.start / run.rate, span.stop / run.rate)))


class Kind(NamedTuple):
    """A kind of check."""

    text: str  # what it measures
    unit: str  # SI; "" for that of the check's signal
    measure: Callable[[Any, RunData, slice], float]  # in the rows of a window, SI; raises NotMeasurable with the reason
    keys: type[Check] = OfPosition
    is_rounded: bool = False  # to whole cycles


KINDS: dict[str, Kind] = {
    "overshoot": Kind("How far a step goes beyond its target, % of the step.", "%",
                      lambda check, run, span: measures.measure_overshoot(*run.read_step(span))),
    "settling_time": Kind("Time until a step stays within +-`band` of its target, s.", "s", lambda check, run, span:
                          measures.measure_settling_time(*run.read_step(span), check.band), Settling, is_rounded=True),
    "rise_time": Kind("Time from 10 % to 90 % of a step, s.", "s",
                      lambda check, run, span: measures.measure_rise_time(*run.read_step(span))),
    "steady_error": Kind("Size of the mean position error, m.", "m",
                         lambda check, run, span: abs(float(run.read_signal("error", span).mean()))),
    "ramp_error": Kind("Mean lag behind a ramp, m.", "m", lambda check, run, span: measures.measure_ramp_error(
        run.read_signal("error", span), run.read_signal(run.signals.command.name, span))),
    "break_away": Kind("Position error before the spool lets go on a slow ramp, m.", "m",
                       lambda check, run, span: measures.measure_break_away(run.read_signal("error", span), run.rate)),
    "max_error": Kind("Largest position error in either direction, m.", "m", lambda check, run, span: float(
        np.abs(measures.filter_median(run.read_signal("error", span), run.rate)).max())),
    "rms_error": Kind("Root mean square of the position error, m.", "m",
                      lambda check, run, span: float(np.sqrt(np.mean(run.read_signal("error", span) ** 2)))),
    "never_exceeds": Kind("Largest size of a signal, every sample counting.", "", lambda check, run, span: float(
        np.abs(run.read_signal(check.signal, span)).max()), OfSignal),
    "amplitude_ratio": Kind("Amplitude of the position over that of the demand at one frequency.", "1",
                            lambda *given: abs(_read_response(*given)), AtFrequency),
    "phase_lag": Kind("By how much the position is behind the demand at one frequency, deg.", "deg",
                      lambda *given: -degrees(phase(_read_response(*given))), AtFrequency),
    "response_within": Kind("Time from `after` (a fault's name or s of main) to an event, or to a signal passing a "
                            "level for 3 samples, s.", "s", _measure_response, Response, is_rounded=True),
    "shut_off": Kind("Time from `after` to the drive frame from which on the controller says zero current and no "
                     "closed loop, s.", "s", _measure_shut_off, ShutOff, is_rounded=True),
    "recovers": Kind("Time from the start of clean-up until the status word says ACTIVE, and does so to the end, s.",
                     "s", _measure_recovery, Check, is_rounded=True),
    "event_occurs": Kind("How often an event happens: at least once unless limits say otherwise.", "1", _count_events,
                         OfEvent),
    "event_never": Kind("How often an event happens that should not.", "1", _count_events, NoEvent),
    "python": Kind("A number that a function of yours measures: f(window, **arguments), in the check's unit, which may "
                   "be any text.", "1", _measure_python, PythonCheck),
}
KEYS: dict[str, type[Check]] = {name: kind.keys for name, kind in KINDS.items()}


def evaluate_checks(checks: Iterable[Check], trace: Columns, sections: Mapping[str, slice], events: Sequence[Any] = (),
                    starts: Mapping[str, float] | None = None, drives: DriveFrames = NO_DRIVES,
                    rate: float = RATE, signals: Signals = EHA, metrology: Metrology = NO_METROLOGY,
                    ) -> list[CheckResult]:
    """Judge a run.

    Args:
        checks: what to judge, in the order of the table.
        trace: the main phase.
        sections: rows of each section of the command.
        events: what happened; each has `t` (s of main), `kind` and `text`.
        starts: when each fault began, s of main, by its label.
        drives: all drive frames, for the checks of a reaction.
        rate: rows of the trace a second.
        signals: of the plant.
        metrology: calibrations of the sensors, and the decision rule.
    """
    run = RunData(trace, sections, events, starts or {}, drives, rate, signals, metrology)
    return [check.judge(run) for check in checks]


@dataclass(frozen=True, kw_only=True)
class Guard:
    """`signal` must not be outside low..high (in `unit`, default SI) for `cycles` cycles in a row."""

    name: str
    signal: Guarded
    low: float | None = None
    high: float | None = None
    unit: str = ""
    cycles: Annotated[int, Range("1", low=1)] = 3  # one noisy sample is no excursion
    signals: Signals = field(default_factory=find_tested, metadata={"key": False}, repr=False)  # of the plant

    def __post_init__(self) -> None:
        low, high = self.compute_limits()
        if low >= high or (low, high) == (-inf, inf):
            raise InputError("guard", "", "a low, a high, or both with low below high")

    def compute_limits(self) -> tuple[float, float]:
        """Low and high in SI; infinite where there is none."""
        si = find_unit(self.signals, self.signal)
        size = find_scale(self.unit or si, si)
        return (-inf if self.low is None else self.low * size), (inf if self.high is None else self.high * size)


class GuardWatch:
    """Monitors the guards of a run, cycle by cycle."""

    def __init__(self, guards: Iterable[Guard]) -> None:
        self._watched = [(guard, *guard.compute_limits()) for guard in guards]
        self._outside = [0] * len(self._watched)

    def __bool__(self) -> bool:
        return bool(self._watched)

    def list_limits(self) -> dict[str, tuple[float, float]]:
        """The limits of each signal, SI, within which no guard of it is passed."""
        limits: dict[str, tuple[float, float]] = {}
        for guard, low, high in self._watched:
            lowest, highest = limits.get(guard.signal, (-inf, inf))
            limits[guard.signal] = max(low, lowest), min(high, highest)
        return limits

    def find_passed(self, values: Mapping[str, float]) -> Guard | None:
        """The first guard whose limit this cycle's `values` (SI, by signal) exceed for its number of cycles.

        A missing value (absent or NaN) is not outside, and does not count as back inside either.
        """
        passed = None
        for i, (guard, low, high) in enumerate(self._watched):
            value = values.get(guard.signal, nan)
            if value == value:
                self._outside[i] = 0 if low <= value <= high else self._outside[i] + 1
                if passed is None and self._outside[i] >= guard.cycles:
                    passed = guard
        return passed
