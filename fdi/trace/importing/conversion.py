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

from fdi.trace.importing.formats import Channel, Measurement
from fdi.trace.importing.import_map import (
    REQUIRED_SIGNALS,
    ImportMap,
    SignalMap,
    SourceTerm,
    compute_times,
    convert_to_si,
    require_growth,
)
from fdi.trace.sensor_dynamics import SensorDynamics
from fdi.trace.signals import SIGNALS
from fdi.trace.trace import Trace
from plant.errors import InputError, suggest_name

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
    channels = _read_channels(measurement, chosen)
    samples = {name: _scale(measurement, chosen, signal, channels) for name, signal in chosen.signals.items()}
    period = chosen.period or _measure_cycle(samples["xj"], cycle)
    rows = _make_rows(chosen, samples, period)
    columns, done, sensors = {}, [], {}
    for name, signal in chosen.signals.items():
        own = samples[name]
        x, how = place_samples(own, rows, period, signal.method, signal.low_pass, CYCLE_PARTS.get(name, ""))
        if np.isnan(x).all():
            raise InputError(chosen.path, f"signals.{name}", "samples within the time of the other signals")
        sensors[name], how = _find_sensor(signal, own, rows, how, period)
        columns[name] = x
        source = f"{signal.term.source} - {signal.minus.source}" if signal.minus else signal.term.source
        done.append(ImportedSignal(name, source, _describe_unit(signal.term), 1.0 / own.period,
                                   float(np.nanmin(x)), float(np.nanmax(x)),
                                   int((np.diff(own.t) > 1.5 * own.period).sum()), int(np.isnan(x).sum()), how))
    origin = {"imported": measurement.path.name, "imported.sha256": hash_file(measurement.path),
              "imported.format": measurement.format, "imported.map": chosen.path.name,
              "imported.map_sha256": hashlib.sha256(chosen.text.encode()).hexdigest(),
              "imported.start": repr(float(rows[0]))}
    trace = replace(Trace.from_columns(columns, period, origin),
                    sensors={name: sensor for name, sensor in sensors.items() if not sensor.is_ideal})
    return Imported(trace, tuple(done), frozenset(channels))


def hash_file(path: Path) -> str:
    """SHA-256 of a file's content."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _read_channels(measurement: Measurement, chosen: ImportMap) -> Mapping[str, Channel]:
    """All channels that the map names, read at once.

    Raises:
        InputError: a name that is no channel of the recording, with the field of the map and the nearest channel.
    """
    bases = {"time": chosen.time}
    wanted = {}  # field of the map: channel
    for name, signal in chosen.signals.items():
        bases[f"signals.{name}.time"] = signal.time
        wanted[f"signals.{name}.source"] = signal.term.source
        if signal.minus:
            wanted[f"signals.{name}.minus.source"] = signal.minus.source
    timed = {field: base for field, base in bases.items() if base and base.source}
    wanted |= {f"{field}.source": str(base.source) for field, base in timed.items()}
    for field, name in wanted.items():
        if name not in measurement.units:
            shown = ", ".join(list(measurement.units)[:12]) + (", .." if len(measurement.units) > 12 else "")
            raise InputError(chosen.path, field, f"a column of {measurement.path.name} ({shown}), not {name!r}"
                                                 f"{suggest_name(name, measurement.units)}")
    return measurement.read(list(dict.fromkeys(wanted.values())),
                            [str(base.source) for base in timed.values() if base.unit is None and base.bits is None])


def _scale(measurement: Measurement, chosen: ImportMap, signal: SignalMap, channels: Mapping[str, Channel]) -> Samples:
    """A signal's samples in SI at their true times, missing ones left out."""
    channel = channels[signal.term.source]
    x = _convert(channel.values, signal.term)
    t = _find_times(measurement, chosen, signal, channel, channels)
    t = t - signal.delay if signal.delay else t
    if signal.minus:
        other = channels[signal.minus.source]
        if len(other.values) != len(x) or (other.t is not None and channel.t is not None
                                              and not np.array_equal(other.t, channel.t)):
            raise InputError(chosen.path, f"signals.{signal.name}.minus", "a channel with the same times")
        x = x - _convert(other.values, signal.minus)
    there = ~np.isnan(x)
    for first, last in signal.dead:
        there &= (t < first) | (t > last)
    if there.sum() < 2:
        reason = "it is marked dead; leave it out of the map" if signal.dead else f"it has {int(there.sum())}"
        raise InputError(measurement.path, signal.term.source, f"at least two values; {reason}")
    return Samples(t, x) if there.all() else Samples(t[there], x[there])


def _convert(values: Floats, term: SourceTerm) -> Floats:
    x = values if term.scale == 1.0 and term.offset == 0.0 else term.scale * values + term.offset
    x = convert_to_si(x, term.unit)
    return x if term.sign > 0 else 0.0 - x


def _find_times(measurement: Measurement, chosen: ImportMap, signal: SignalMap, channel: Channel,
                channels: Mapping[str, Channel]) -> Floats:
    base = signal.time or chosen.time
    if base is None:
        if channel.t is None:
            raise InputError(chosen.path, "time", "a table with source (a column) or rate (rows a second)")
        require_growth(channel.t, measurement.path, signal.term.source)
        return channel.t
    column = channels[base.source].values if base.source else None
    if column is not None and len(column) != len(channel.values):
        raise InputError(measurement.path, str(base.source), f"{len(channel.values)} times, one for each value of "
                                                             f"{signal.term.source}, not {len(column)}")
    return compute_times(base, len(channel.values), column, measurement.path, base.source or "rate")


def _measure_cycle(own: Samples, cycle: float) -> float:
    """The model's cycle, or the period of XJ if that is longer; as the recording's own clock has it if that drifts."""
    nominal = cycle if own.period < 1.25 * cycle else round(own.period, 6)
    rows = float(np.rint(np.diff(own.t) / own.period).sum())
    mean = float(own.t[-1] - own.t[0]) / rows
    ratio = max(1, round(nominal / mean)) if mean < nominal else 1
    if abs(mean * ratio / nominal - 1.0) * rows / ratio < SLIP:
        return nominal
    return round(mean * ratio, 9)


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


def _describe_unit(s: SourceTerm) -> str:
    sign = "-" if s.sign < 0 else ""
    scale = f"{s.scale:g} " if s.scale != 1.0 else ""
    offset = f" {s.offset:+g} {s.unit.name}" if s.offset else ""
    return f"{sign}{scale}{s.unit.name}{offset}"


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


def find_hold(samples: Samples, ratio: int) -> int | None:
    """Which of so many samples brings a new value, 0 for the first; None if more than one does."""
    rows = np.rint((samples.t - samples.t[0]) / samples.period).astype(int)
    new = rows[1:][np.diff(samples.x) != 0.0]
    if len(new) < 10:
        return None
    counts = np.bincount(new % ratio, minlength=ratio)
    return int(counts.argmax()) if counts.max() > HELD_SHARE * len(new) else None


def place_samples(samples: Samples, rows: Floats, period: float, method: str, low_pass: bool | None,
                  cycle_part: str) -> tuple[Floats, str]:
    """The channel at the times `rows` (n,), s, one a `period`, NaN where there is none; and how it came there.

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
    is_whole = whole >= 1 and abs(ratio / whole - 1.0) * len(rows) < 0.5 * whole + 0.01 * len(rows)
    if method in ("auto", "samples") and whole == 1 and is_whole:
        placed = _place_each(samples, rows, period)
        if placed is not None:
            return placed
    if method in ("auto", "samples") and whole > 1 and is_whole:
        return _pick(samples, rows, period, whole, low_pass, cycle_part)
    if method == "samples":
        return _place_nearest(samples, rows, 0.5 * period), "nearest sample"
    apart = f"{1e3 * samples.period:.4g} ms apart"
    is_stepwise = len(samples.x) > 10 and float(np.mean(np.diff(samples.x) == 0.0)) > 0.5  # most repeat the one before
    if method == "hold" or (method == "auto" and cycle_part and is_stepwise):
        return _hold(samples, rows), f"last sample, {apart}"
    if ratio > 1.5 and low_pass is not False:
        return _interpolate(_filter(samples, ratio), rows), f"low-pass filtered, straight lines between samples {apart}"
    return _interpolate(samples, rows), f"straight lines between samples {apart}"


def _place_each(samples: Samples, rows: Floats, period: float) -> tuple[Floats, str] | None:
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
    return out, f"as recorded{where}"


def _pick(samples: Samples, rows: Floats, period: float, ratio: int, low_pass: bool | None, cycle_part: str
          ) -> tuple[Floats, str]:
    """Every so many samples; those of a held signal where its new value is."""
    held = find_hold(samples, ratio)
    how = f"every {_format_ordinal(ratio)} sample"
    if held is not None:
        own = (samples.t[0] + held * samples.period - rows[0]) % period
        own = 0.0 if own > period - 0.25 * samples.period else own
        shift = {"answer": own, "demand": own - period if own else 0.0}.get(cycle_part, 0.0)
        return _place_nearest(samples, rows + shift, 0.6 * samples.period), f"{how}; the signal is held for {ratio}"
    if low_pass is None:
        low_pass = not cycle_part and _measure_folded_share(samples, ratio) > FOLDED_SHARE
    if low_pass:
        samples, how = _filter(samples, ratio), f"low-pass filtered, {how}"
    return _place_nearest(samples, rows, 0.6 * samples.period), how


def _format_ordinal(n: int) -> str:
    return f"{n}{ {1: 'st', 2: 'nd', 3: 'rd'}.get(n if n < 20 else n % 10, 'th')}"


def _place_nearest(samples: Samples, rows: Floats, reach: float) -> Floats:
    """The sample nearest to each row, if it is within `reach`, s."""
    after = np.clip(np.searchsorted(samples.t, rows), 1, len(samples.t) - 1)
    nearest = np.where(rows - samples.t[after - 1] <= samples.t[after] - rows, after - 1, after)
    return np.where(np.abs(samples.t[nearest] - rows) <= reach, samples.x[nearest], math.nan)


def _hold(samples: Samples, rows: Floats) -> Floats:
    before = np.searchsorted(samples.t, rows + 1e-9, side="right") - 1
    held = np.clip(before, 0, None)
    late = rows - samples.t[held] > 1.5 * samples.period
    return np.where((before < 0) | late, math.nan, samples.x[held])


def _interpolate(samples: Samples, rows: Floats) -> Floats:
    """Straight lines between samples; NaN in gaps and outside."""
    after = np.searchsorted(samples.t, rows)
    left, right = np.clip(after - 1, 0, len(samples.t) - 1), np.clip(after, 0, len(samples.t) - 1)
    lost = (samples.t[right] - samples.t[left] > 1.5 * samples.period)
    exact = samples.t[right] == rows
    lost |= (rows < samples.t[0] - 1e-9) | (rows > samples.t[-1] + 1e-9)
    return np.where(lost & ~exact, math.nan, np.interp(rows, samples.t, samples.x))


def _filter(samples: Samples, ratio: float) -> Samples:
    """The channel without what lies above the rows' Nyquist frequency, not shifted in time; each piece for itself.

    The filter is symmetric, of unit gain, with -6 dB at 0.8 of that frequency and a Hamming window.
    """
    half = round(8 * ratio)
    taps = np.sinc(0.8 * np.arange(-half, half + 1) / ratio) * np.hamming(2 * half + 1)
    taps /= taps.sum()
    edges = [0, *(np.flatnonzero(np.diff(samples.t) > 1.5 * samples.period) + 1).tolist(), len(samples.t)]
    pieces = [np.convolve(np.pad(samples.x[first:stop], half, "edge"), taps, "valid")
              for first, stop in pairwise(edges)]
    return Samples(samples.t, np.concatenate(pieces))


def _measure_folded_share(samples: Samples, ratio: int) -> float:
    """RMS of what lies above the rows' Nyquist frequency, over the signal's standard deviation."""
    part = Samples(samples.t[:200_000], samples.x[:200_000])
    spread = float(part.x.std())
    return float(np.std(part.x - _filter(part, ratio).x)) / spread if spread > 0.0 else 0.0
