"""The map of a recording (which column is which signal, in which unit and time base), and the trace made by it."""
from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdi.trace.importing.formats import OTHER_UNITS, Channel, Measurement
from fdi.trace.sensor_dynamics import SensorDynamics
from fdi.trace.trace import Floats, Trace
from plant.errors import InputError, require, show_value, suggest_name
from plant.parameters import parse_toml
from plant.signals import EHA, Signals
from plant.units import Unit, fit_unit, list_fitting_units, require_unit


@dataclass(frozen=True)
class SourceTerm:
    """A column of the recording, and how its raw values become SI: sign * (scale * raw + offset), in `unit`."""

    source: str
    unit: Unit
    sign: float
    scale: float
    offset: float


@dataclass(frozen=True)
class TimeBase:
    """Where the times come from: a column in a unit, the row number at a rate, or a counter that wraps."""

    source: str | None = None
    unit: Unit | None = None  # None with a source: calendar times, or a counter
    rate: float | None = None  # rows, or counts, a second
    bits: int | None = None  # of a counter


@dataclass(frozen=True)
class SignalMap:
    """Where a signal comes from."""

    name: str
    term: SourceTerm
    minus: SourceTerm | None  # is subtracted, as the pressure of the other chamber
    time: TimeBase | None  # None: that of the recording
    delay: float  # s, that the recorded signal is late
    method: str  # auto, samples, interpolate, hold
    low_pass: bool | None  # before samples are left out; None: if it is needed
    sensor: SensorDynamics = field(default_factory=SensorDynamics)
    dead: tuple[tuple[float, float], ...] = ()  # s, when the channel was dead; -inf .. inf: always


@dataclass(frozen=True)
class ImportMap:
    """A whole map."""

    path: Path
    text: str
    declared: Signals  # of the plant that was recorded
    signals: Mapping[str, SignalMap]
    time: TimeBase | None
    period: float | None  # s, of the trace's rows
    start: float | None  # s of the recording, first and last that is taken
    end: float | None
    separator: str | None
    decimal: str | None
    header: int | None  # line of the names


# ---------------------------------------------------------------------------------------------------------------------
# The keys of a map
# ---------------------------------------------------------------------------------------------------------------------

class Key(NamedTuple):
    """A key of a table: the types that its value may have, what is expected in words, and its default (...: none)."""

    kinds: tuple[type, ...]
    expected: str
    default: Any = None
    is_valid: Callable[[Any], bool] = lambda value: True


def _is_positive(x: float) -> bool:
    return 0.0 < x < math.inf


def _is_duration(x: float) -> bool:
    return 0.0 <= x < math.inf


def _is_span(x: Any) -> bool:
    """Whether it is [from, to] with from before to."""
    return (isinstance(x, list) and len(x) == 2
            and all(isinstance(end, float) or (type(end) is int and abs(end) <= 1e308) for end in x) and x[0] < x[1])


NUMBER = (int, float)
METHODS = ("auto", "samples", "interpolate", "hold")
MAP = {"file": Key((dict,), "a table", {}), "trace": Key((dict,), "a table", {}), "time": Key((dict,), "a table"),
       "signals": Key((dict,), "a table of signals", {})}
FILE = {"separator": Key((str,), "one character, such as ';' or '\\t'", None, lambda x: len(x) == 1),
        "decimal": Key((str,), "'.' or ','", None, lambda x: x in (".", ",")),
        "header": Key((int,), "the number of the line with the names, from 1", None, lambda x: x >= 1)}
ROWS = {"period": Key(NUMBER, "a period above 0 s", None, _is_positive),
        "start": Key(NUMBER, "a finite number", None, math.isfinite),
        "end": Key(NUMBER, "a finite number", None, math.isfinite)}
TIME = {"source": Key((str,), "the name of a column"),
        "rate": Key(NUMBER, "rows or counts a second, above 0", None, _is_positive),
        "bits": Key((int,), "bits of a counter, 1 to 64", None, lambda x: 1 <= x <= 64),
        "unit": Key((str,), "a unit of time, or iso", "s")}
TERM = {"source": Key((str,), "the name of a column", ...),
        "unit": Key((str,), "a unit"),
        "sign": Key(NUMBER, "1 or -1", 1.0, lambda x: x in (1, -1)),
        "scale": Key(NUMBER, "a number other than 0", 1.0, lambda x: math.isfinite(x) and x != 0),
        "offset": Key(NUMBER, "a finite number", 0.0, math.isfinite)}
SIGNAL = {**TERM,
          "minus": Key((str, dict), "a column, or a table with source, unit, scale and offset"),
          "time": Key((dict,), "a table as [time]"),
          "method": Key((str,), "auto, samples, interpolate or hold", "auto", lambda x: x in METHODS),
          "delay": Key(NUMBER, "seconds that the signal is late", 0.0, math.isfinite),
          "low_pass": Key((bool,), "true or false"),
          "sensor": Key((dict,), "a table", {})}
SENSOR = {"moving_mean": Key(NUMBER, "samples of the recording, from 1", 1.0, lambda x: x in range(1, 1_000_000)),
          "centred": Key((bool,), "true or false", False),
          "lag": Key(NUMBER, "a time constant from 0 s", 0.0, _is_duration),
          "quantum": Key(NUMBER, "a step from 0, in the unit of the signal", 0.0, _is_duration),
          "dead": Key((bool, list), "true, or a list of [from, to] in s, from before to", [],
                      lambda x: isinstance(x, bool) or all(map(_is_span, x)))}


def _read_table(where: object, name: str, values: Any, keys: Mapping[str, Key]) -> dict[str, Any]:
    """The values of a table, defaults included.

    Raises:
        InputError: an unknown key, or a value that it cannot have.
    """
    if not isinstance(values, dict):
        raise InputError(where, name, "a table")
    prefix = f"{name}." if name else ""
    for word in values:
        if word not in keys:
            raise InputError(where, f"{prefix}{word}", f"one of {', '.join(keys)}{suggest_name(word, keys)}")
    for word, key in keys.items():
        require(word in values or key.default is not ..., where, f"{prefix}{word}", key.expected)
        if word in values and not (type(values[word]) in key.kinds
                                   and (type(values[word]) is not int or abs(values[word]) <= 1e308)  # a float holds it
                                   and key.is_valid(values[word])):
            raise InputError(where, f"{prefix}{word}", f"{key.expected}, not {show_value(values[word])}")
    found = {word: values.get(word, key.default) for word, key in keys.items()}
    return {word: float(value) if type(value) is int and float in keys[word].kinds else value
            for word, value in found.items()}


def read_map(path: Path, declared: Signals = EHA) -> ImportMap:
    """Read a map of a recording of a plant with the `declared` signals.

    Raises:
        InputError: a file that cannot be read, is no TOML, or has a key or value that a map cannot have.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, "", f"a readable map ({getattr(error, 'strerror', None) or error})") from error
    return parse_map(text, path, declared)


def parse_map(text: str, path: Path, declared: Signals = EHA) -> ImportMap:
    """The map that a TOML text holds; `path` is its name in messages, `declared` are the signals that it may name.

    Raises:
        InputError: as of `read_map`; or a map without a signal that every analysis needs, or with a column that is two
            signals.
    """
    top = _read_table(path, "", parse_toml(text, path), MAP)
    signals = {name: _parse_signal(path, name, table, declared) for name, table in top["signals"].items()}
    for name in declared.required:
        if name not in signals and not (declared.is_open_loop and name == declared.command.name):
            needed = declared.find(name)
            raise InputError(path, f"signals.{name}", f"a table with the source of {needed.symbol}, {needed.quantity}")
    owner: dict[str, str] = {}
    for name, signal in signals.items():
        other = owner.setdefault(signal.term.source, name)
        require(other == name or signal.minus is not None or signals[other].minus is not None, path,
                f"signals.{name}.source", f"a column of its own; signals.{other} has {signal.term.source!r} already")
    # in an open loop the drive is the command
    signals.setdefault(declared.command.name, replace(signals[declared.drive.name], name=declared.command.name))
    return ImportMap(path, text, declared, signals, _parse_time(path, "time", top["time"]),
                     **_read_table(path, "trace", top["trace"], ROWS), **_read_table(path, "file", top["file"], FILE))


def _parse_time(path: Path, name: str, values: Any) -> TimeBase | None:
    if values is None:
        return None
    table = _read_table(path, name, values, TIME)
    source, rate, bits = table["source"], table["rate"], table["bits"]
    require(bits is None or (source is not None and rate is not None), path, name,
            "source and rate (counts a second) for a counter of so many bits")
    require(source is not None or rate is not None, path, name, "source (a column), or rate (rows a second)")
    require(source is None or rate is None or bits is not None, path, f"{name}.bits",
            "the bits of the counter, as source and rate are given")
    has_unit = rate is None and table["unit"] != "iso"
    return TimeBase(source, _require_unit(table["unit"], "s", path, f"{name}.unit") if has_unit else None, rate, bits)


def _parse_signal(path: Path, signal: str, values: Any, declared: Signals) -> SignalMap:
    name = f"signals.{signal}"
    if signal not in declared.names:
        raise InputError(path, name, f"one of {', '.join(declared.names)}{suggest_name(signal, declared.names)}")
    table = _read_table(path, name, values, SIGNAL)
    si, minus = declared.find(signal).unit, table["minus"]
    term = _parse_term(path, name, {word: table[word] for word in TERM}, si)
    if isinstance(minus, str):
        minus = {"source": minus}
    if minus is not None:
        usual = {word: TERM[word]._replace(default=table[word]) for word in TERM if word != "source"}
        minus = _parse_term(path, f"{name}.minus", _read_table(path, f"{name}.minus", minus, TERM | usual), si)
    sensor = _read_table(path, f"{name}.sensor", table["sensor"], SENSOR)
    dead = sensor.pop("dead")
    if isinstance(dead, bool):
        dead = [(-math.inf, math.inf)] if dead else []
    dynamics = SensorDynamics(**{**sensor, "quantum": sensor["quantum"] * float(term.unit.factor)})
    if dynamics.filters and declared.find(signal).role != "output":
        outputs = ", ".join(s.name for s in declared.outputs)
        raise InputError(path, f"{name}.sensor", f"moving_mean and lag for {outputs} alone; {signal} is an input of "
                                                 "the model and is used as recorded")
    return SignalMap(signal, term, minus, _parse_time(path, f"{name}.time", table["time"]), table["delay"],
                     table["method"], table["low_pass"], dynamics, tuple((float(a), float(b)) for a, b in dead))


def _parse_term(path: Path, name: str, table: Mapping[str, Any], si: str) -> SourceTerm:
    return SourceTerm(**{**table, "unit": _require_unit(table["unit"] or si, si, path, f"{name}.unit")})


# ---------------------------------------------------------------------------------------------------------------------
# Units
# ---------------------------------------------------------------------------------------------------------------------

def _require_unit(name: str, si: str, where: object, field: str) -> Unit:
    """As of `plant.units`; of a unit that is raw it says what to do."""
    if name in OTHER_UNITS and not fit_unit(name, si):
        fitting = list_fitting_units(si)[0]
        raise InputError(where, field, f"the unit that scale and offset lead to, such as {fitting} ({name} is raw: "
                                       f"value = sign * (scale * raw + offset) in `unit`)")
    return require_unit(name, si, where, field)


def convert_to_si(values: Floats, unit: Unit) -> Floats:
    """Values in SI units.

    A factor below 1 is a division by a whole number: 12.3456 mm becomes the float nearest to 0.0123456 m.

    >>> convert_to_si(np.array([12.3456]), require_unit("mm", "m", "", "")).tolist()
    [0.0123456]
    """
    is_part = unit.factor < 1 and unit.factor.numerator == 1
    return values / float(unit.factor.denominator) if is_part else values * float(unit.factor)


# ---------------------------------------------------------------------------------------------------------------------
# Times
# ---------------------------------------------------------------------------------------------------------------------

def compute_times(base: TimeBase, samples: int, column: Floats | None, where: object, field: str) -> Floats:
    """Times (s) of so many samples; `column` holds the values of the base's source.

    Raises:
        InputError: times that are missing, stand still or go backwards, and counts that are no whole numbers.
    """
    if column is None:
        assert base.rate is not None  # a base without source has a rate
        return np.arange(samples) / base.rate
    missing = np.isnan(column)
    if missing.any():
        raise InputError(where, field, f"a time in every row; row {int(missing.argmax()) + 1} has none")
    if base.bits is not None and base.rate is not None:
        return unwrap_counter(column, base.bits, where, field) / base.rate
    t = column - column[0] if base.unit is None else convert_to_si(column, base.unit)
    require_growth(t, where, field)
    return t


def unwrap_counter(counts: Floats, bits: int, where: object, field: str) -> Floats:
    """Counts since the first sample, of a counter that starts again at 2**bits.

    >>> unwrap_counter(np.array([254.0, 255.0, 0.0, 3.0]), 8, "x", "n").tolist()
    [0.0, 1.0, 2.0, 5.0]

    Raises:
        InputError: counts that are no whole numbers below 2**bits, or that repeat.
    """
    size = 2.0**bits
    bad = (counts != np.floor(counts)) | (counts < 0) | (counts >= size)
    if bad.any():
        row = int(bad.argmax())
        raise InputError(where, field, f"whole numbers from 0 to {size - 1:.0f} ({bits} bits); "
                                       f"row {row + 1} has {counts[row]:g}")
    steps = np.diff(counts) % size
    if (steps == 0).any():
        row = int((steps == 0).argmax()) + 2
        raise InputError(where, field, f"a counter that goes on in every row; row {row} repeats {counts[row - 1]:g}")
    return np.concatenate([[0.0], np.cumsum(steps)])


def require_growth(t: Floats, where: object, field: str) -> None:
    """Refuse times that do not grow.

    Raises:
        InputError: it names the row and both times.
    """
    grows = np.diff(t) > 0.0
    if not grows.all():
        row = int(np.argmin(grows)) + 1
        raise InputError(where, field, f"times that grow; row {row + 1} has {t[row]:.9g} s after {t[row - 1]:.9g} s "
                                       "(a counter that wraps needs bits and rate)")


CYCLE_PARTS = {"drive": "answer", "command": "demand"}  # by role, where in a cycle a held value comes
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
    period = chosen.period or _measure_cycle(samples[chosen.declared.controlled.name], cycle)
    rows = _make_rows(chosen, samples, period)
    columns, done, sensors, signals = {}, [], {}, chosen.declared
    for name, signal in chosen.signals.items():
        own, part = samples[name], CYCLE_PARTS.get(signals.find(name).role, "")
        x, how = place_samples(own, rows, period, signal.method, signal.low_pass, part)
        require(not np.isnan(x).all(), chosen.path, f"signals.{name}", "samples within the time of the other signals")
        sensors[name], how = _find_sensor(signal, own, rows, how, period, signals.find(name).unit)
        columns[name] = x
        source = f"{signal.term.source} - {signal.minus.source}" if signal.minus else signal.term.source
        done.append(ImportedSignal(name, source, _describe_unit(signal.term), 1.0 / own.period,
                                   float(np.nanmin(x)), float(np.nanmax(x)),
                                   int((np.diff(own.t) > 1.5 * own.period).sum()), int(np.isnan(x).sum()), how))
    origin = {"imported": measurement.path.name, "imported.sha256": hash_file(measurement.path),
              "imported.format": measurement.format, "imported.map": chosen.path.name,
              "imported.map_sha256": hashlib.sha256(chosen.text.encode()).hexdigest(),
              "imported.start": repr(float(rows[0]))}
    trace = replace(Trace.from_columns(columns, period, origin, signals),
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
    timed = {place: base for place, base in bases.items() if base and base.source}
    wanted |= {f"{place}.source": str(base.source) for place, base in timed.items()}
    for place, name in wanted.items():
        if name not in measurement.units:
            shown = ", ".join(list(measurement.units)[:12]) + (", .." if len(measurement.units) > 12 else "")
            raise InputError(chosen.path, place, f"a column of {measurement.path.name} ({shown}), not {name!r}"
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
    """The model's cycle, or the controlled signal's period if longer; by the recording's clock if that drifts."""
    nominal = cycle if own.period < 1.25 * cycle else round(own.period, 6)
    rows = float(np.rint(np.diff(own.t) / own.period).sum())
    mean = float(own.t[-1] - own.t[0]) / rows
    ratio = max(1, round(nominal / mean)) if mean < nominal else 1
    return nominal if abs(mean * ratio / nominal - 1.0) * rows / ratio < SLIP else round(mean * ratio, 9)


def _make_rows(chosen: ImportMap, samples: Mapping[str, Samples], period: float) -> Floats:
    """Times of the rows: from the first sample that all required signals share to the last, on the controlled one's."""
    needed = [samples[name] for name in chosen.declared.required]
    first = max(-math.inf if chosen.start is None else chosen.start, *(s.t[0] for s in needed))
    last = min(math.inf if chosen.end is None else chosen.end, *(s.t[-1] for s in needed))
    origin = _find_origin(samples[chosen.declared.controlled.name], samples[chosen.declared.drive.name], period)
    start = origin + period * math.ceil((first - origin) / period - 0.5)
    count = math.floor((last - start) / period + 0.5) + 1
    require(count >= 2, chosen.path, "signals", f"{', '.join(chosen.declared.required)} recorded at the same time")
    require(count <= MOST_ROWS, chosen.path, "time",
            f"at most {MOST_ROWS} rows of {period:g} s, not {count}; is the unit of the time right?")
    out: Floats = start + period * np.arange(count)
    return out


def _find_origin(controlled: Samples, drive: Samples, period: float) -> float:
    """The time of a row: the first sample of the controlled signal, or where one of both, held, brings a new value."""
    for held in (controlled, drive):
        ratio = round(period / held.period)
        phase = find_hold(held, ratio) if ratio > 1 else None
        if phase is not None:
            return float(held.t[0] + phase * held.period)
    return float(controlled.t[0])


def _find_sensor(signal: SignalMap, samples: Samples, rows: Floats, how: str, period: float, unit: str
                 ) -> tuple[SensorDynamics, str]:
    """The dynamics as the trace keeps them, and the whole list of what was done."""
    sensor = replace(signal.sensor, sample_period=0.0)
    if sensor.moving_mean > 1.0:
        sensor = replace(sensor, sample_period=round(samples.period, 9))
    if signal.delay and how.startswith(("as recorded", "every")) and "held" not in how:
        rest = float(samples.t[0] - rows[0] + 0.5 * samples.period) % samples.period - 0.5 * samples.period
        if abs(rest) > 0.01 * period:
            sensor = replace(sensor, delay=-rest)
    return sensor, "; ".join(filter(None, (
        how, f"moved {1e3 * signal.delay:g} ms earlier" if signal.delay else "",
        "dead spans left out" if signal.dead else "",
        "" if sensor.is_ideal else f"the model gets {sensor.describe(period, unit)}")))


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
