"""A foreign recording made a trace by its map, and what was done with each signal."""
from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fdi.trace.importing.import_map import REQUIRED_SIGNALS, ImportMap, SignalMap, SourceTerm, TimeBase
from fdi.trace.importing.measurement import Channel, Measurement, require_channel
from fdi.trace.importing.resampling import Samples, find_hold, measure_period, place_samples
from fdi.trace.importing.time_base import compute_times, require_growth
from fdi.trace.importing.units import convert_to_si
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
