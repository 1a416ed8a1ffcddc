"""Checks: a window of a run, a number measured there, limits, and a verdict. And guards, watched in every cycle.

Every kind of check is a row of `KINDS`: the number that it measures, its unit, and the class that has its keys. The
number is held against `low` and `high`, all three in `unit`. What no run could answer (0 Hz, an empty band) is refused
when the check is read. On a run a check never raises: what cannot be measured has failed, and `detail` says why.
"""

from cmath import phase
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import degrees, hypot, inf, isfinite, nan
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from fdi.trace import SPEED_SPAN, CheckResult, compute_speed, fill_gaps, filter_median
from plant import (
    EHA,
    LONGEST,
    RATE,
    Array,
    Columns,
    Quantity,
    Signals,
    list_fitting_units,
    require,
    require_unit,
    tables,
)
from rig.benches import CIA408, Bench, ProfileWords, State, find_state
from rig.sequences.faults import Time
from rig.sequences.python_parts import OWN, PythonPart, describe_value, require_function_name
from rig.sequences.signals import DERIVED, Controlled, Guarded, Measured, find_controlled, find_tested, find_unit
from rig.sequences.uncertainty import NO_METROLOGY, Metrology, compute_expanded_uncertainty, decide


class NotMeasurable(Exception):
    """A measure does not exist for a signal; the message says why."""


def require_measurable(holds: object, reason: str) -> None:
    """Raises NotMeasurable unless what the measure needs `holds`."""
    if not holds:
        raise NotMeasurable(reason)


def fill_few_gaps(signal: Array, name: str, largest_share: float) -> Array:
    """The signal with missing samples (NaN) on straight lines; NotMeasurable if more than `largest_share` are NaN."""
    missing = ~np.isfinite(signal)
    count = int(missing.sum())
    require_measurable(count < len(signal), f"{name} was not measured")
    require_measurable(count <= largest_share * len(signal), f"{count} of {len(signal)} samples of {name} are missing")
    return fill_gaps(np.where(missing, np.nan, signal))


SMALLEST_STEP = 20e-6  # m where a plant's command is at most 1 m, else in proportion; ten times the noise of the EHA


class StepResponse(NamedTuple):
    """What a step section asks for, and the filtered answer to it, SI."""

    position: Array
    before: float  # the command before the step
    target: float
    rate: float  # samples/s

    @property
    def size(self) -> float:
        """What the section asks for."""
        return self.target - self.before


def measure_overshoot(step: StepResponse) -> float:
    """How far the highest point is beyond the target, % of the step; 0 if it never gets there."""
    return max(0.0, 100 * float(((step.position - step.target) / step.size).max()))


def measure_settling_time(step: StepResponse, band: float) -> float:
    """Time until the position stays within +-band % of the step around the target, s."""
    outside = np.flatnonzero(np.abs(step.position - step.target) > abs(step.size) * band / 100)
    if not len(outside):
        return 0.0
    require_measurable(outside[-1] < len(step.position) - 1, f"still outside +-{band:g} % at the end of the window")
    return float(outside[-1] + 1) / step.rate


def measure_rise_time(step: StepResponse) -> float:
    """Time from 10 % to 90 % of the step, s, interpolated between samples."""
    done = (step.position - step.before) / step.size

    def find_time(level: float) -> float:
        beyond = np.flatnonzero(done >= level)
        require_measurable(len(beyond), f"{100 * level:g} % of the step was never reached")
        k = int(beyond[0])
        return k - (done[k] - level) / (done[k] - done[k - 1]) if k else 0.0

    return float(find_time(0.9) - find_time(0.1)) / step.rate


def measure_ramp_error(error: Array, com: Array) -> float:
    """Mean lag behind a ramp, m, positive when the ram is behind whichever way it goes (docs/physics.md)."""
    require_measurable(com[-1] != com[0], "the command does not move here")
    return float(error.mean() * np.sign(com[-1] - com[0]))


def measure_break_away(error: Array, rate: float) -> float:
    """Position error that builds up before the spool lets go, m: half the band that stick-slip draws on a slow ramp.

    docs/physics.md: FSS KF / (GPF1 ASV GM GAP). The band is taken from the 1st to the 99th percentile of the
    filtered error, so that noise and single outliers do not widen it; a triangle loses 2 % by that. The mean (ramp
    error) drops out.
    """
    low, high = np.percentile(filter_median(error, rate), (1, 99))
    return float(high - low) / 2


def measure_response(signal: Array, com: Array, rate: float, frequency: float) -> complex:
    """Signal over command as a complex number at `frequency`, Hz: least-squares sine, cosine and mean of both."""
    require_measurable(len(com) >= rate / frequency, f"the window is shorter than one period of {frequency:g} Hz")
    phase = 2 * np.pi * frequency * np.arange(len(com)) / rate
    basis = np.column_stack((np.sin(phase), np.cos(phase), np.ones(len(com))))
    (sine, cosine, _), *_ = np.linalg.lstsq(basis, np.column_stack((com, signal)), rcond=None)
    command_phasor, signal_phasor = complex(sine[0], cosine[0]), complex(sine[1], cosine[1])
    require_measurable(abs(command_phasor) >= 1e-9, f"the command has no {frequency:g} Hz here")
    return signal_phasor / command_phasor


def find_crossing(signal: Array, rate: float, above: float | None, below: float | None) -> float:
    """Time of the first of three samples in a row above or below a level, s from the signal's start."""
    beyond = (signal > (inf if above is None else above)) | (signal < (-inf if below is None else below))
    in_a_row = np.flatnonzero(beyond[:-2] & beyond[1:-1] & beyond[2:])
    require_measurable(len(in_a_row), "the level was never passed")
    return float(in_a_row[0]) / rate


def find_scale(unit: str, si: str) -> float:
    """How many of a signal's own unit, `si`, one `unit` is; InputError at the key `unit` for another quantity."""
    fitting = dict.fromkeys([*list_fitting_units(si), si])
    require(unit in fitting, "unit", "unit", tables.list_choices(unit, fitting))
    return float(require_unit(unit, si, "", "").factor)


MAIN = "main"  # the window that is all of the main phase


def map_words(values: NDArray[Any], find: Callable[[int], int]) -> NDArray[np.int64]:
    """What `find` gives for each of some words, most of which are equal."""
    words, places = np.unique(values.astype(int), return_inverse=True)
    return np.array([find(word) for word in words.tolist()], np.int64)[places]


class DriveFrames(NamedTuple):
    """All drive frames of a run, whatever their cycle number, as columns; only recorded if faults act on the bus."""

    t: Array  # s of main
    current: Array  # A
    status: NDArray[np.int64]  # status word
    words: ProfileWords = CIA408  # what it means

    def select_between(self, t0: float, t1: float) -> Self:
        """Those with t0 <= t < t1."""
        is_within = (self.t >= t0 - 1e-9) & (self.t < t1 - 1e-9)  # times come from ns
        return self._replace(t=np.maximum(self.t[is_within], t0), current=self.current[is_within],
                             status=self.status[is_within])

    @property
    def states(self) -> NDArray[np.int64]:
        """What each status word says."""
        return map_words(self.status, lambda word: find_state(self.words, word))


NO_DRIVES = DriveFrames(np.zeros(0), np.zeros(0), np.zeros(0, np.int64))


@dataclass(frozen=True)
class RunData:
    """The data of a run that checks use: trace, `rate` rows a second, sections, events, and when each fault started
    (s of main, by label).
    """

    trace: Columns
    sections: Mapping[str, slice] = field(default_factory=dict)
    events: Sequence[Any] = ()  # each has `t` (s of main), `kind` and `text`
    starts: Mapping[str, float] = field(default_factory=dict)
    drives: DriveFrames = NO_DRIVES
    rate: float = RATE
    signals: Signals = EHA  # of the plant
    metrology: Metrology = NO_METROLOGY
    speed_span: float = SPEED_SPAN  # s

    def find_start(self, after: str | float) -> float:
        """The start of the cycle nearest to a time, s of main, or in which the fault of a label begins."""
        return round(after * self.rate) / self.rate if isinstance(after, float) else self.starts[after]

    def find_rows(self, window: str | tuple[float, float], skip: float = 0.0) -> slice:
        """Rows of a window without its first `skip` seconds; NotMeasurable if the run ended before the window did."""
        rows = len(self.trace.t)
        if isinstance(window, tuple):
            first, last = round(window[0] * self.rate), round(window[1] * self.rate)
        else:
            section = slice(0, rows) if window == MAIN else self.sections[window]
            first, last = section.start, section.stop
        require_measurable(
            last <= rows, f"the run ended at {rows / self.rate:g} s, the window at {last / self.rate:g} s")
        first += round(skip * self.rate)
        require_measurable(first < last, "the window is empty")
        return slice(first, last)

    def read_signal(self, name: str, span: slice, largest_missing_share: float = 0.01) -> Array:
        """A signal's samples in a span, few missing ones bridged by straight lines; NotMeasurable without it."""
        command, controlled = self.signals.command.name, self.signals.controlled.name
        if name == "error" and name not in self.signals.names:
            return self.read_signal(command, span) - self.read_signal(controlled, span)
        if name == "speed" and name not in self.signals.names:
            require_measurable(span.stop - span.start >= 2, "one sample has no speed")
            return compute_speed(self.read_signal(controlled, span), self.rate, self.speed_span)
        require_measurable(hasattr(self.trace, name), f"the plant has no signal {name}")
        return fill_few_gaps(np.asarray(getattr(self.trace, name), float)[span], name, largest_missing_share)

    def count_missing(self, name: str, span: slice) -> int:
        """How many samples of a signal were bridged."""
        names = self.signals.names
        name = self.signals.controlled.name if name in DERIVED and name not in names else name
        column = getattr(self.trace, name) if name in names else np.zeros(0)  # an event has none
        return int(np.isnan(np.asarray(column, float)[span]).sum())

    def read_step(self, span: slice) -> StepResponse:
        """The step at the start of a span; at the very start of main it begins where the actuator is.

        NotMeasurable if there is none, or if the command moves on later.
        """
        from fdi.trace import measure_scale  # here: nodes, which judge nothing, start without recordings

        position, command = self.read_signal(self.signals.controlled.name, span), self.signals.command
        commands, demand = getattr(self.trace, command.name), self.read_signal(command.name, span)
        before = float(commands[span.start - 1] if span.start else position[0])
        target, scale = float(demand[-1]), measure_scale(command, commands)
        is_held = np.abs(demand - target).max() <= 1e-9 * scale
        require_measurable(abs(target - before) >= SMALLEST_STEP * scale and is_held,
                           "the command does not step here and then hold")
        return StepResponse(filter_median(position, self.rate), before, target, self.rate)

    def find_events(self, event: str, t0: float, t1: float = float("inf")) -> list[Any]:
        """Events in t0 <= t < t1 whose kind and text have all words of `event`, whatever their case, by time."""
        words = set(event.lower().split())
        events = (e for e in self.events if t0 <= e.t < t1 and words <= set(f"{e.kind} {e.text}".lower().split()))
        return sorted(events, key=lambda e: e.t)


LEFT_OPERATIONAL = "controller left OPERATIONAL:"  # words of the event
InSI = Annotated[float, "SI units"]
InUnit = Annotated[float, "the check's unit"]


class SkippedCheck(NamedTuple):
    """A check that does not apply to a bench, and why."""

    name: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class Check:
    """A measured number and its limits. `window`: a section's name, [t0, t1] in s of main, or "main" for all of it."""

    kind: str = field(metadata=OWN)
    name: str
    window: str | tuple[Time, Time] = MAIN
    skip: Annotated[float, Quantity("s", low=0.0, high=LONGEST)] = 0.0  # left out at the window's beginning
    low: InUnit | None = None
    high: InUnit | None = None
    unit: str = ""
    requirement: str | tuple[str, ...] = ()  # id of the requirement that it verifies, or several
    signals: Signals = field(default_factory=find_tested, metadata=OWN, repr=False)  # of the plant

    def __post_init__(self) -> None:
        require(self.low is not None or self.high is not None, "check", "", "a low, a high, or both")
        if self.low is not None and self.high is not None:
            require(self.low <= self.high, "check", "high", f"a number from low = {self.low:g} up, not {self.high:g}")
        if isinstance(self.window, tuple):
            require(self.window[0] < self.window[1], "check", "window", f"[t0, t1] with t0 < t1, not {[*self.window]}")
        for word in self.requirements:
            require(bool(word.strip()) and word.isprintable(), "check", "requirement",
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
        is_passed = decide(value, low, high, uncertainty, run.metrology.decision)
        after, above, below = self._find_reference(run)
        return CheckResult(name=self.name, kind=self.kind, signal=self.about, value=value, unit=self.shown_unit,
                           low=low, high=high, passed=is_passed is True, t0=t0, t1=t1, detail=detail, after=after,
                           above=above, below=below, requirement=", ".join(self.requirements), uncertainty=uncertainty,
                           cannot_tell=is_passed is None)

    def _measure(self, run: RunData, span: slice) -> float:
        """The number, in the unit of the limits. Raises NotMeasurable."""
        number = KINDS[self.kind].measure(self, run, span) / self.scale
        require_measurable(isfinite(number), f"the measure came to {number:g}")
        return number

    def _compute_uncertainty(self, run: RunData, span: slice, value: float) -> tuple[float, str]:
        """U of the number, NaN if it is not known, and what is wrong with the calibrations that it depends on."""
        def measure(trace: Columns, speed_span: float = SPEED_SPAN) -> float:
            try:
                return self._measure(replace(run, trace=trace, speed_span=speed_span), span)
            except (NotMeasurable, ArithmeticError, ValueError):
                return nan

        signals, calibration = run.signals, run.metrology.calibration
        names = self._list_readings(signals)
        missing = [s.name for s in signals
                   if s.name in names and s.role in ("output", "load") and s.name not in calibration]
        if missing and not (self.kind == "python" and calibration):  # which columns a function reads is not known
            return nan, f"no calibration of {', '.join(missing)}"
        step = 1 / run.rate / self.scale if KINDS[self.kind].is_rounded else 0.0
        # what the span takes from a peak grows with its square: half of it takes a quarter
        blur = 4 / 3 * abs(value - measure(run.trace, SPEED_SPAN / 2)) if self.about == "speed" else 0.0
        uncertainty = compute_expanded_uncertainty(measure, value, run.trace, names, run.metrology, hypot(step, blur))
        open_ = ["errors of the sensor decide whether it can be measured"] if uncertainty == inf else []
        return uncertainty, "; ".join([*(run.metrology.problems[name] for name in names
                                         if name in run.metrology.problems), *open_])

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


@dataclass(frozen=True, kw_only=True)
class OfPosition(Check):
    """A number of the position against the demand."""

    signal: Controlled = field(default_factory=find_controlled)


@dataclass(frozen=True, kw_only=True)
class Settling(OfPosition):
    """With the band around the target of a step."""

    band: Annotated[float, Quantity("%", above=0.0, high=100.0)]


@dataclass(frozen=True, kw_only=True)
class AtFrequency(OfPosition):
    """At one frequency."""

    frequency: Annotated[float, Quantity("Hz", above=0.0)]  # and below half the rate of the run


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
        require(bool(self.event) != (self.signal is not None), "check", "event", "either an event or a signal")
        levels = (self.above is not None) + (self.below is not None)
        require(levels == (self.signal is not None), "check", "signal",
                "a signal with a level above or below which it counts, one of them")


@dataclass(frozen=True, kw_only=True)
class ShutOff(Check):
    """With the instant from which time counts. `status`: four lower bits of the status word of CiA 408, or of another
    profile the state that they mean; default: any state without current.
    """

    after: str | Time
    status: Annotated[int, Quantity("1", low=0, high=0xF)] | None = None


@dataclass(frozen=True, kw_only=True)
class OfEvent(Check):
    """With the words of an event: at least once unless limits say otherwise."""

    event: str
    low: InUnit | None = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require(bool(self.event.split()), "check", "event", "at least one word")


@dataclass(frozen=True, kw_only=True)
class NoEvent(OfEvent):
    """With the words of an event that should not happen."""

    low: InUnit | None = None
    high: InUnit | None = 0.0


@dataclass(frozen=True, kw_only=True)
class PythonCheck(PythonPart, Check):
    """With the function that measures the number."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_function_name(self.python)
        require(self.unit.isprintable() and len(self.unit) <= 20, "check", "unit", "a unit of at most 20 characters")

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
        return np.asarray(vars(self)[self._signals.command.name] - vars(self)[self._signals.controlled.name])


def _measure_python(check: PythonCheck, run: RunData, span: slice) -> float:
    columns = {**{name: np.array(getattr(run.trace, name)[span], dtype=np.float64) for name in run.signals.names},
               "t": np.arange(span.start, span.stop) / run.rate}
    value = check.call(Window(run.signals, columns))
    require_measurable(value is not None, f"{check.python} returned no value")
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise NotMeasurable(f"{check.python} returned {describe_value(value)}, not a number") from None
    require_measurable(isfinite(number), f"{check.python} returned {number:g}")
    return number


def _measure_response(check: Response, run: RunData, span: slice) -> float:
    after = run.find_start(check.after)
    if check.signal:
        rest = run.find_rows((after, span.stop / run.rate))
        return find_crossing(run.read_signal(check.signal, rest), run.rate, check.above, check.below)
    events = run.find_events(check.event, after)
    require_measurable(events, f"no event {check.event!r} after {after:g} s")
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
    exit_times = [event.t for event in run.find_events(LEFT_OPERATIONAL, after, span.stop / run.rate)
                  if not len(on) or event.t >= drives.t[on[-1]]]
    times = [*off[:1].tolist(), *exit_times[:1]]
    require_measurable(times, "the controller did not say zero current, nor did it leave OPERATIONAL")
    return float(min(times)) - after


def _measure_recovery(check: Check, run: RunData, span: slice) -> float:
    start = len(run.trace.t) / run.rate
    drives = run.drives.select_between(start, np.inf)
    idle = np.flatnonzero(drives.states != State.ACTIVE)
    first = int(idle[-1]) + 1 if len(idle) else 0
    require_measurable(first < len(drives.t), "the controller was not ACTIVE at the end of clean-up")
    return float(drives.t[first]) - start


def _read_response(check: AtFrequency, run: RunData, span: slice) -> complex:
    position, demand = (run.read_signal(s.name, span) for s in (run.signals.controlled, run.signals.command))
    return measure_response(position, demand, run.rate, check.frequency)


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
    "overshoot": Kind("How far a step goes beyond its target, % of the step; median over 5 ms.", "%",
                      lambda check, run, span: measure_overshoot(run.read_step(span))),
    "settling_time": Kind("Time until a step stays within +-`band` of its target, s; median over 5 ms.", "s",
                          lambda check, run, span: measure_settling_time(run.read_step(span), check.band), Settling,
                          is_rounded=True),
    "rise_time": Kind("Time from 10 % to 90 % of a step, s; median over 5 ms.", "s",
                      lambda check, run, span: measure_rise_time(run.read_step(span))),
    "steady_error": Kind("Size of the mean position error, m.", "m",
                         lambda check, run, span: abs(float(run.read_signal("error", span).mean()))),
    "ramp_error": Kind("Mean lag behind a ramp, m.", "m", lambda check, run, span: measure_ramp_error(
        run.read_signal("error", span), run.read_signal(run.signals.command.name, span))),
    "break_away": Kind("Position error before the spool lets go on a slow ramp: half of its span from the 1st to the "
                       "99th percentile, m; median over 5 ms.", "m",
                       lambda check, run, span: measure_break_away(run.read_signal("error", span), run.rate)),
    "max_error": Kind("Largest position error in either direction, m; median over 5 ms.", "m",
                      lambda check, run, span: float(np.abs(filter_median(run.read_signal("error", span), run.rate)
                                                            ).max())),
    "rms_error": Kind("Root mean square of the position error, m.", "m",
                      lambda check, run, span: float(np.sqrt(np.mean(run.read_signal("error", span) ** 2)))),
    "never_exceeds": Kind("Largest size of a signal, every sample counting.", "", lambda check, run, span: float(
        np.abs(run.read_signal(check.signal, span)).max()), OfSignal),
    "amplitude_ratio": Kind("Amplitude of the position over that of the demand at one frequency.", "1",
                            lambda *given: abs(_read_response(*given)), AtFrequency),
    "phase_lag": Kind("By how much the position is behind the demand at one frequency, deg from -90 up to 270.", "deg",
                      lambda *given: (90.0 - degrees(phase(_read_response(*given)))) % 360.0 - 90.0, AtFrequency),
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
    cycles: Annotated[int, Quantity("1", low=1)] = 3  # one noisy sample is no excursion
    signals: Signals = field(default_factory=find_tested, metadata=OWN, repr=False)  # of the plant

    def __post_init__(self) -> None:
        low, high = self.compute_limits()
        require(low < high and (low, high) != (-inf, inf), "guard", "", "a low, a high, or both with low below high")

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
        first_guard = None
        for i, (guard, low, high) in enumerate(self._watched):
            value = values.get(guard.signal, nan)
            if value == value:
                self._outside[i] = 0 if low <= value <= high else self._outside[i] + 1
                if first_guard is None and self._outside[i] >= guard.cycles:
                    first_guard = guard
        return first_guard
