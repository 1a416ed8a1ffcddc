"""A foreign recording made a trace by its map, and what was done with each signal."""
from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.trace.importing.formats import Channel, Measurement, require_channel
from fdi.trace.importing.import_map import (
    REQUIRED_SIGNALS,
    ImportMap,
    SignalMap,
    SourceTerm,
    TimeBase,
    compute_times,
    convert_to_si,
    require_growth,
)
from fdi.trace.sensor_dynamics import SensorDynamics
from fdi.trace.signals import SIGNALS
from fdi.trace.trace import Trace
from plant.errors import InputError

Floats = NDArray[np.float64]

CYCLE_PARTS = {"cor": "answer", "com": "demand"}  # where in a cycle a held value comes
MOST_ROWS = 100_000_000  # of a trace: a time in the wrong unit would fill the memory


@dataclass(frozen=True)
class ImportedSignal:
    """What became of one signal."""

    name: str
    source: str
    unit: str  # of the source, with sign, scale and offset where there are any
    rate: float  # Hz, of the source
    low: float  # SI
    high: float
    gaps: int  # in the source
    missing: int  # rows of the trace without a value
    how: str


@dataclass(frozen=True)
class Imported:
    """An imported recording."""

    trace: Trace
    signals: tuple[ImportedSignal, ...]
    samples: int  # of the recording's fastest signal
    used: frozenset[str]  # columns of the recording that the map names


def import_measurement(measurement: Measurement, chosen: ImportMap, cycle: float) -> Imported:
    """The trace that a map makes of a recording.

    Args:
        measurement: the recording.
        chosen: its map.
        cycle: s, the model's; the rows' period unless the map has one, or the recording is slower.

    Raises:
        InputError: a column, time or value that cannot be used.
    """
    _require_sources(measurement, chosen)
    channels = _read_channels(measurement, chosen)
    samples = {name: _scale(measurement, chosen, signal, channels) for name, signal in chosen.signals.items()}
    period = _choose_period(chosen, samples, cycle)
    rows = _make_rows(chosen, samples, period)
    columns, done, sensors = {}, [], {}
    for name, signal in chosen.signals.items():
        placed = place_samples(samples[name], rows, period, signal.method, signal.low_pass,
                               CYCLE_PARTS.get(name, ""))
        columns[name] = placed.x
        if np.isnan(placed.x).all():
            raise InputError(chosen.path, f"signals.{name}", "samples within the time of the other signals")
        sensor, how = _find_sensor(signal, samples[name], rows, placed.how, period)
        sensors[name] = sensor
        done.append(ImportedSignal(name, _describe_source(signal), _describe_unit(signal), 1.0 / samples[name].period,
                                   float(np.nanmin(placed.x)), float(np.nanmax(placed.x)), samples[name].gaps,
                                   int(np.isnan(placed.x).sum()), how))
    origin = {**describe_origin(measurement, chosen), "imported.start": repr(float(rows[0]))}
    trace = replace(Trace.from_columns(columns, period, origin),
                    sensors={name: sensor for name, sensor in sensors.items() if not sensor.is_ideal})
    return Imported(trace, tuple(done), max(len(s.t) for s in samples.values()), frozenset(channels))


def describe_origin(measurement: Measurement, chosen: ImportMap) -> dict[str, str]:
    """Where a trace comes from: file, its hash and format, and the map with its hash."""
    return {"imported": measurement.path.name, "imported.sha256": hash_file(measurement.path),
            "imported.format": measurement.format, "imported.map": chosen.path.name,
            "imported.map_sha256": hashlib.sha256(chosen.text.encode()).hexdigest()}


def hash_file(path: Path) -> str:
    """SHA-256 of a file's content."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _list_terms(signal: SignalMap) -> list[SourceTerm]:
    return [signal.term, *([signal.minus] if signal.minus else [])]


def _time_of(measurement: Measurement, chosen: ImportMap, signal: SignalMap) -> TimeBase | None:
    """The time base of a signal; None for the channel's own times."""
    base = signal.time or chosen.time
    if base is None and not measurement.has_times:
        raise InputError(chosen.path, "time", "a table with source (a column) or rate (rows a second)")
    return base


def _require_sources(measurement: Measurement, chosen: ImportMap) -> None:
    if chosen.time and chosen.time.source:
        require_channel(measurement, chosen.time.source, chosen.path, "time.source")
    for name, signal in chosen.signals.items():
        require_channel(measurement, signal.term.source, chosen.path, f"signals.{name}.source")
        if signal.minus:
            require_channel(measurement, signal.minus.source, chosen.path, f"signals.{name}.minus.source")
        if signal.time and signal.time.source:
            require_channel(measurement, signal.time.source, chosen.path, f"signals.{name}.time.source")


def _read_channels(measurement: Measurement, chosen: ImportMap) -> Mapping[str, Channel]:
    """All channels that the map names, read at once."""
    bases = [base for base in (chosen.time, *(s.time for s in chosen.signals.values())) if base and base.source]
    names = [term.source for signal in chosen.signals.values() for term in _list_terms(signal)]
    dates = [str(base.source) for base in bases if base.unit is None and base.bits is None]
    return measurement.read(list(dict.fromkeys([*names, *(str(base.source) for base in bases)])), dates)


def _scale(measurement: Measurement, chosen: ImportMap, signal: SignalMap, channels: Mapping[str, Channel]) -> Samples:
    """A signal's samples in SI at their true times, missing ones left out."""
    channel = channels[signal.term.source]
    x = _convert(channel.values, signal.term)
    t = _find_times(measurement, chosen, signal, channel, channels)
    if signal.minus:
        other = channels[signal.minus.source]
        if len(other.values) != len(x) or (other.t is not None and channel.t is not None
                                              and not np.array_equal(other.t, channel.t)):
            raise InputError(chosen.path, f"signals.{signal.name}.minus", "a channel with the same times")
        x = x - _convert(other.values, signal.minus)
    t = t - signal.delay if signal.delay else t
    there = ~np.isnan(x)
    for first, last in signal.dead:
        there &= ~((t >= first) & (t <= last))
    if there.sum() < 2:
        reason = "it is marked dead; leave it out of the map" if signal.dead else f"it has {int(there.sum())}"
        raise InputError(measurement.path, signal.term.source, f"at least two values; {reason}")
    if there.all():
        return Samples(t, x)
    return Samples(t[there], x[there])


def _convert(values: Floats, term: SourceTerm) -> Floats:
    s = term.scaling
    x = values if s.scale == 1.0 and s.offset == 0.0 else s.scale * values + s.offset
    x = convert_to_si(x, s.unit)
    return x if s.sign > 0 else 0.0 - x


def _find_times(measurement: Measurement, chosen: ImportMap, signal: SignalMap, channel: Channel,
                channels: Mapping[str, Channel]) -> Floats:
    base = _time_of(measurement, chosen, signal)
    if base is None:
        assert channel.t is not None  # has_times
        require_growth(channel.t, measurement.path, signal.term.source)
        return channel.t
    column = channels[base.source].values if base.source else None
    if column is not None and len(column) != len(channel.values):
        raise InputError(measurement.path, str(base.source), f"{len(channel.values)} times, one for each value of "
                                                             f"{signal.term.source}, not {len(column)}")
    return compute_times(base, len(channel.values), column, measurement.path, base.source or "rate")


def _choose_period(chosen: ImportMap, samples: Mapping[str, Samples], cycle: float) -> float:
    """The map's, else the model's cycle, or the period of XJ if that is longer."""
    if chosen.period is not None:
        return chosen.period
    own = samples["xj"]
    nominal = cycle if own.period < 1.25 * cycle else round(own.period, 6)
    return measure_period(own, nominal)


def _make_rows(chosen: ImportMap, samples: Mapping[str, Samples], period: float) -> Floats:
    """Times of the rows: from the first sample that XJ, Com and Cor share to the last, on XJ's samples."""
    needed = [samples[name] for name in REQUIRED_SIGNALS]
    first = max(-math.inf if chosen.start is None else chosen.start, *(s.t[0] for s in needed))
    last = min(math.inf if chosen.end is None else chosen.end, *(s.t[-1] for s in needed))
    origin = _find_origin(samples, period)
    start = origin + period * math.ceil((first - origin) / period - 0.5)
    count = math.floor((last - start) / period + 0.5) + 1
    if count < 2:
        raise InputError(chosen.path, "signals", "com, xj and cor recorded at the same time")
    if count > MOST_ROWS:
        raise InputError(chosen.path, "time", f"at most {MOST_ROWS} rows of {period:g} s, not {count}; is the unit of "
                                              "the time right?")
    out: Floats = start + period * np.arange(count)
    return out


def _find_origin(samples: Mapping[str, Samples], period: float) -> float:
    """The time of a row: the first sample of XJ, or where a held XJ or Cor brings its first new value."""
    xj = samples["xj"]
    for held in (xj, samples["cor"]):
        ratio = round(period / held.period)
        phase = find_hold(held, ratio) if ratio > 1 else None
        if phase is not None:
            return float(held.t[0] + phase * held.period)
    return float(xj.t[0])


def _find_sensor(signal: SignalMap, samples: Samples, rows: Floats, how: str, period: float
                 ) -> tuple[SensorDynamics, str]:
    """The dynamics as the trace keeps them, and the whole list of what was done."""
    sensor = replace(signal.sensor, sample_period=0.0)
    if sensor.moving_mean > 1.0:
        sensor = replace(sensor, sample_period=round(samples.period, 9))
    parts = [how]
    if signal.delay:
        parts.append(f"moved {1e3 * signal.delay:g} ms earlier")
        if how.startswith(("as recorded", "every")) and "held" not in how:
            rest = float(samples.t[0] - rows[0] + 0.5 * samples.period) % samples.period - 0.5 * samples.period
            if abs(rest) > 0.01 * period:
                sensor = replace(sensor, delay=-rest)
    if signal.dead:
        parts.append("dead spans left out")
    if not sensor.is_ideal:
        parts.append(f"the model gets {sensor.describe(period, SIGNALS[signal.name].unit)}")
    return sensor, "; ".join(parts)


def _describe_source(signal: SignalMap) -> str:
    return " - ".join(term.source for term in _list_terms(signal))


def _describe_unit(signal: SignalMap) -> str:
    s = signal.term.scaling
    sign = "-" if s.sign < 0 else ""
    scale = f"{s.scale:g} " if s.scale != 1.0 else ""
    offset = f" {s.offset:+g} {s.unit_name}" if s.offset else ""
    return f"{sign}{scale}{s.unit_name}{offset}"


SLIP = 0.4  # of a row: two clocks that drift apart by less over the recording are the same
FOLDED_SHARE = 0.05  # of a signal's standard deviation; more above the rows' Nyquist frequency is filtered out first
HELD_SHARE = 0.95  # of the changes that lie in one phase: a signal that is held between them


class Samples(NamedTuple):
    """A channel, samples that are missing left out."""

    t: Floats  # s, growing
    x: Floats

    @property
    def period(self) -> float:
        """The usual time between two samples, s."""
        return float(np.percentile(np.diff(self.t), 50, method="lower"))

    @property
    def gaps(self) -> int:
        """Places where samples are missing."""
        return int((np.diff(self.t) > 1.5 * self.period).sum())


class Placed(NamedTuple):
    """A channel on the rows of a trace, NaN where there is none, and how it came there."""

    x: Floats
    how: str


def measure_period(samples: Samples, nominal: float) -> float:
    """The period of samples, s: `nominal` if the two do not drift apart over the recording, else to 9 digits."""
    steps = np.rint(np.diff(samples.t) / samples.period)
    rows = float(steps.sum())
    mean = float(samples.t[-1] - samples.t[0]) / rows
    ratio = max(1, round(nominal / mean)) if mean < nominal else 1
    if abs(mean * ratio / nominal - 1.0) * rows / ratio < SLIP:
        return nominal
    return round(mean * ratio, 9)


def find_hold(samples: Samples, ratio: int) -> int | None:
    """Which of so many samples brings a new value, 0 for the first; None if more than one does."""
    rows = np.rint((samples.t - samples.t[0]) / samples.period).astype(int)
    new = rows[1:][np.diff(samples.x) != 0.0]
    if len(new) < 10:
        return None
    counts = np.bincount(new % ratio, minlength=ratio)
    return int(counts.argmax()) if counts.max() > HELD_SHARE * len(new) else None


def place_samples(samples: Samples, rows: Floats, period: float, method: str, low_pass: bool | None,
                  cycle_part: str) -> Placed:
    """The channel at the times `rows` (n,), s, one a `period`.

    Args:
        samples: the channel.
        rows: times of the rows, s.
        period: s.
        method: auto, samples (never between two), interpolate or hold.
        low_pass: whether to filter before samples are left out; None: if more than FOLDED_SHARE would fold.
        cycle_part: where in its cycle a value that is held comes: "answer" after the row's time, "demand" before it,
            "" at it.
    """
    ratio = period / samples.period
    whole = round(ratio)
    slip = abs(ratio / whole - 1.0) * len(rows) if whole >= 1 else math.inf
    is_whole = whole >= 1 and slip < 0.5 * max(whole, 1) + 0.01 * len(rows)
    if method in ("auto", "samples") and whole == 1 and is_whole:
        placed = _place_each(samples, rows, period)
        if placed is not None:
            return placed
    if method in ("auto", "samples") and whole > 1 and is_whole:
        return _pick(samples, rows, period, whole, low_pass, cycle_part)
    if method == "samples":
        return _place_nearest(samples, rows, 0.5 * period)
    if method == "hold" or (method == "auto" and cycle_part and _is_stepwise(samples)):
        return _hold(samples, rows)
    filtered, note = samples, ""
    if ratio > 1.5 and low_pass is not False:
        filtered, note = _filter(samples, ratio), "low-pass filtered, "
    note += f"straight lines between samples {_format_ms(samples.period)} apart"
    return Placed(_interpolate(filtered, rows), note)


def _format_ms(seconds: float) -> str:
    return f"{1e3 * seconds:.4g} ms"


def _place_each(samples: Samples, rows: Floats, period: float) -> Placed | None:
    """Each sample on the row next to it, whatever its place in the cycle; None if two would share a row."""
    turns = np.exp(2j * np.pi * (samples.t - rows[0]) / period)
    phase = float(np.angle(turns.mean())) / (2 * np.pi) * period
    place = np.rint((samples.t - rows[0] - phase) / period).astype(int)
    if (np.diff(place) < 1).any():
        return None
    inside = (place >= 0) & (place < len(rows))
    out = np.full(len(rows), math.nan)
    out[place[inside]] = samples.x[inside]
    where = f", {1e3 * phase:+.2f} ms from the row" if abs(phase) > 0.05 * period else ""
    return Placed(out, f"as recorded{where}")


def _pick(samples: Samples, rows: Floats, period: float, ratio: int, low_pass: bool | None, cycle_part: str) -> Placed:
    """Every so many samples; those of a held signal where its new value is."""
    held = find_hold(samples, ratio)
    how = f"every {_format_ordinal(ratio)} sample"
    if held is not None:
        own = (samples.t[0] + held * samples.period - rows[0]) % period
        own = 0.0 if own > period - 0.25 * samples.period else own
        shift = 0.0
        if cycle_part == "answer":
            shift = own
        elif cycle_part == "demand" and own:
            shift = own - period
        return Placed(_place_nearest(samples, rows + shift, 0.6 * samples.period).x,
                      f"{how}; the signal is held for {ratio}")
    if low_pass is None:
        low_pass = not cycle_part and _measure_folded_share(samples, ratio) > FOLDED_SHARE
    if low_pass:
        samples, how = _filter(samples, ratio), f"low-pass filtered, {how}"
    return Placed(_place_nearest(samples, rows, 0.6 * samples.period).x, how)


def _format_ordinal(n: int) -> str:
    return f"{n}{ {1: 'st', 2: 'nd', 3: 'rd'}.get(n if n < 20 else n % 10, 'th')}"


def _place_nearest(samples: Samples, rows: Floats, reach: float) -> Placed:
    """The sample nearest to each row, if it is within `reach`, s."""
    after = np.clip(np.searchsorted(samples.t, rows), 1, len(samples.t) - 1)
    nearest = np.where(rows - samples.t[after - 1] <= samples.t[after] - rows, after - 1, after)
    apart = np.abs(samples.t[nearest] - rows)
    return Placed(np.where(apart <= reach, samples.x[nearest], math.nan), "nearest sample")


def _is_stepwise(samples: Samples) -> bool:
    """Whether most samples repeat the one before."""
    return len(samples.x) > 10 and float(np.mean(np.diff(samples.x) == 0.0)) > 0.5


def _hold(samples: Samples, rows: Floats) -> Placed:
    before = np.searchsorted(samples.t, rows + 1e-9, side="right") - 1
    x = samples.x[np.clip(before, 0, None)]
    late = rows - samples.t[np.clip(before, 0, None)] > 1.5 * samples.period
    return Placed(np.where((before < 0) | late, math.nan, x), f"last sample, {_format_ms(samples.period)} apart")


def _interpolate(samples: Samples, rows: Floats) -> Floats:
    """Straight lines between samples; NaN in gaps and outside."""
    after = np.searchsorted(samples.t, rows)
    left, right = np.clip(after - 1, 0, len(samples.t) - 1), np.clip(after, 0, len(samples.t) - 1)
    lost = (samples.t[right] - samples.t[left] > 1.5 * samples.period)
    exact = samples.t[right] == rows
    lost |= (rows < samples.t[0] - 1e-9) | (rows > samples.t[-1] + 1e-9)
    return np.where(lost & ~exact, math.nan, np.interp(rows, samples.t, samples.x))


def _design_low_pass(ratio: float) -> Floats:
    """Symmetric low-pass of unit gain: -6 dB at 0.8 of the rows' Nyquist frequency, Hamming window."""
    half = round(8 * ratio)
    k = np.arange(-half, half + 1)
    taps = np.sinc(0.8 * k / ratio) * np.hamming(2 * half + 1)
    out: Floats = taps / taps.sum()
    return out


def _filter(samples: Samples, ratio: float) -> Samples:
    """The channel without what lies above the rows' Nyquist frequency, not shifted in time; each piece for itself."""
    taps = _design_low_pass(ratio)
    half = len(taps) // 2
    edges = [0, *(np.flatnonzero(np.diff(samples.t) > 1.5 * samples.period) + 1).tolist(), len(samples.t)]
    pieces = []
    for first, stop in pairwise(edges):
        pieces.append(np.convolve(np.pad(samples.x[first:stop], half, "edge"), taps, "valid"))
    return Samples(samples.t, np.concatenate(pieces))


def _measure_folded_share(samples: Samples, ratio: int) -> float:
    """RMS of what lies above the rows' Nyquist frequency, over the signal's standard deviation."""
    part = Samples(samples.t[:200_000], samples.x[:200_000])
    spread = float(part.x.std())
    return float(np.std(part.x - _filter(part, ratio).x)) / spread if spread > 0.0 else 0.0
