"""Measures of sampled signals: overshoot, settling time, phase lag and so on, each a single number.

Signals have shape (n,), SI, one sample per cycle, `rate` a second. Position carries some 2 um rms of sensor noise;
where one sample could decide (a peak, the last sample outside a band) a centred moving median of MEDIAN_SPAN goes
first. At 1000 samples a second it keeps steps and ramps as they are, lowers a peak of angular frequency w by
(w * 1 ms)^2 / 2 of its curve (0.7 % at 120 rad/s), and leaves 1.1 um rms of the noise. From 200 samples a second down
there is no room for a median: one sample decides.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant.errors import InputError
from plant.run import Columns
from plant.segments import RATE, Array
from plant.signals import EHA, Signals
from plant.units import UNITS
from rig import tables
from rig.benches.profiles import CIA408, ProfileWords, find_state
from rig.sequences.signals import DERIVED
from rig.sequences.uncertainty import NO_METROLOGY, Metrology

MEDIAN_SPAN = 5e-3  # s
SPEED_SPAN = 20e-3  # s between the two samples of a speed: 2 um rms of position noise become 0.14 mm/s rms


class NotMeasurable(Exception):
    """A measure does not exist for a signal; the message says why."""


def bridge_gaps(signal: Array, name: str, allowed: float) -> Array:
    """The signal with missing samples (NaN) on straight lines; NotMeasurable if more than a fraction `allowed` are."""
    missing = ~np.isfinite(signal)
    count = int(missing.sum())
    if count == len(signal):
        raise NotMeasurable(f"{name} was not measured")
    if count > allowed * len(signal):
        raise NotMeasurable(f"{count} of {len(signal)} samples of {name} are missing")
    if not count:
        return signal
    rows = np.arange(len(signal))
    return np.interp(rows, rows[~missing], signal[~missing])


def filter_median(signal: Array, rate: float) -> Array:
    """Centred moving median of the samples in MEDIAN_SPAN, the ends repeated."""
    half = int(MEDIAN_SPAN * rate / 2 + 1e-9)
    padded = np.pad(signal, half, mode="edge")
    filtered: Array = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1), axis=1)
    return filtered


def compute_speed(position: Array, rate: float) -> Array:
    """Central difference over SPEED_SPAN, one cycle to each side at least, one-sided at the ends, m/s."""
    rows, half = np.arange(len(position)), max(1, round(SPEED_SPAN * rate / 2))
    ahead, behind = np.minimum(rows + half, len(rows) - 1), np.maximum(rows - half, 0)
    if len(rows) < 2:
        raise NotMeasurable("one sample has no speed")
    difference: Array = (position[ahead] - position[behind]) * rate / (ahead - behind)
    return difference


def measure_step_size(com: Array, before: float, smallest: float = 20e-6) -> float:
    """What a step section asks for; NotMeasurable if it has no step at its start or moves on later.

    `smallest`: m; ten times the noise.
    """
    size = float(com[-1] - before)
    if abs(size) < smallest or np.abs(com - com[-1]).max() > 1e-9:
        raise NotMeasurable("the command does not step here and then hold")
    return size


def measure_overshoot(position: Array, com: Array, before: float, rate: float) -> float:
    """How far the highest point is beyond the target, % of the step; 0 if it never gets there."""
    size = measure_step_size(com, before)
    return max(0.0, 100 * float(((filter_median(position, rate) - com[-1]) / size).max()))


def measure_settling_time(position: Array, com: Array, before: float, rate: float, band: float) -> float:
    """Time until the position stays within +-band % of the step around the target, s."""
    size = measure_step_size(com, before)
    outside = np.flatnonzero(np.abs(filter_median(position, rate) - com[-1]) > abs(size) * band / 100)
    if not len(outside):
        return 0.0
    if outside[-1] == len(position) - 1:
        raise NotMeasurable(f"still outside +-{band:g} % at the end of the window")
    return float(outside[-1] + 1) / rate


def measure_rise_time(position: Array, com: Array, before: float, rate: float) -> float:
    """Time from 10 % to 90 % of the step, s, interpolated between samples."""
    size = measure_step_size(com, before)
    done = (filter_median(position, rate) - before) / size

    def find_time(level: float) -> float:
        beyond = np.flatnonzero(done >= level)
        if not len(beyond):
            raise NotMeasurable(f"{100 * level:g} % of the step was never reached")
        k = int(beyond[0])
        return k - (done[k] - level) / (done[k] - done[k - 1]) if k else 0.0

    return float(find_time(0.9) - find_time(0.1)) / rate


def measure_ramp_error(error: Array, com: Array) -> float:
    """Mean lag behind a ramp, m, positive when the ram is behind whichever way it goes (docs/physics.md)."""
    if com[-1] == com[0]:
        raise NotMeasurable("the command does not move here")
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
    if len(com) < rate / frequency:
        raise NotMeasurable(f"the window is shorter than one period of {frequency:g} Hz")
    phase = 2 * np.pi * frequency * np.arange(len(com)) / rate
    basis = np.column_stack((np.sin(phase), np.cos(phase), np.ones(len(com))))
    (sine, cosine, _), *_ = np.linalg.lstsq(basis, np.column_stack((com, signal)), rcond=None)
    asked, given = complex(sine[0], cosine[0]), complex(sine[1], cosine[1])
    if abs(asked) < 1e-9:
        raise NotMeasurable(f"the command has no {frequency:g} Hz here")
    return given / asked


def find_crossing(signal: Array, rate: float, above: float | None, below: float | None) -> float:
    """Time of the first of three samples in a row above or below a level, s from the signal's start."""
    beyond = (signal > (inf if above is None else above)) | (signal < (-inf if below is None else below))
    in_a_row = np.flatnonzero(beyond[:-2] & beyond[1:-1] & beyond[2:])
    if not len(in_a_row):
        raise NotMeasurable("the level was never passed")
    return float(in_a_row[0]) / rate


def find_scale(unit: str, si: str) -> float:
    """How many of the SI unit `si` one `unit` is; InputError at the key `unit` if it measures something else."""
    fitting = {name: float(each.factor) for name, each in UNITS.items() if each.si == si} | {si: 1.0}
    if unit not in fitting:
        raise InputError("unit", "unit", tables.list_choices(unit, fitting))
    return fitting[unit]


MAIN = "main"  # the window that is all of the main phase


def map_words(values: NDArray[Any], find: Callable[[int], int]) -> NDArray[np.int64]:
    """What `find` gives for each of some words, most of which are equal."""
    known, places = np.unique(values.astype(int), return_inverse=True)
    found: NDArray[np.int64] = np.array([find(word) for word in known.tolist()], np.int64)[places]
    return found


class DriveFrames(NamedTuple):
    """All drive frames of a run, whatever their cycle number, as columns; only recorded if faults act on the bus."""

    t: Array  # s of main
    current: Array  # A
    status: NDArray[np.int64]  # status word
    words: ProfileWords = CIA408  # what it means

    def select_between(self, t0: float, t1: float) -> DriveFrames:
        """Those with t0 <= t < t1."""
        chosen = (self.t >= t0 - 1e-9) & (self.t < t1 - 1e-9)  # times come from ns
        return DriveFrames(self.t[chosen], self.current[chosen], self.status[chosen], self.words)

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
        if last > rows:
            raise NotMeasurable(f"the run ended at {rows / self.rate:g} s, the window at {last / self.rate:g} s")
        first += round(skip * self.rate)
        if first >= last:
            raise NotMeasurable("the window is empty")
        return slice(first, last)

    def read_signal(self, name: str, span: slice, largest_missing_share: float = 0.01) -> Array:
        """A signal's samples in a span, few missing ones bridged by straight lines; NotMeasurable without it."""
        command, controlled = self.signals.command.name, self.signals.controlled.name
        if name == "error" and name not in self.signals.names:
            return self.read_signal(command, span) - self.read_signal(controlled, span)
        if name == "speed" and name not in self.signals.names:
            return compute_speed(self.read_signal(controlled, span), self.rate)
        if not hasattr(self.trace, name):
            raise NotMeasurable(f"the plant has no signal {name}")
        return bridge_gaps(np.asarray(getattr(self.trace, name), float)[span], name, largest_missing_share)

    def count_missing(self, name: str, span: slice) -> int:
        """How many samples of a signal were bridged."""
        known = self.signals.names
        name = self.signals.controlled.name if name in DERIVED and name not in known else name
        column = getattr(self.trace, name) if name in known else np.zeros(0)  # an event has none
        return int(np.isnan(np.asarray(column, float)[span]).sum())

    def read_step(self, span: slice) -> tuple[Array, Array, float, float]:
        """Position and demand in a span, the demand before it (at the very start: where the ram is), and the rate."""
        position, command = self.read_signal(self.signals.controlled.name, span), self.signals.command.name
        before = float(getattr(self.trace, command)[span.start - 1] if span.start else position[0])
        return position, self.read_signal(command, span), before, self.rate

    def find_events(self, event: str, t0: float, t1: float = float("inf")) -> list[Any]:
        """Events in t0 <= t < t1 whose kind and text have all words of `event`, whatever their case, by time."""
        words = set(event.lower().split())
        found = (e for e in self.events if t0 <= e.t < t1 and words <= set(f"{e.kind} {e.text}".lower().split()))
        return sorted(found, key=lambda e: e.t)
