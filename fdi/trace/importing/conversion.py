"""The map of a recording (which column is which signal, in which unit and time base), and the trace made by it."""
from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from fdi.trace import Floats, SensorDynamics, Trace, require_growth
from fdi.trace.importing.formats import OTHER_UNITS, Channel, Measurement
from plant import (
    EHA,
    InputError,
    Place,
    Quantity,
    Signals,
    Unit,
    build_dataclass,
    decode_text,
    fit_unit,
    list_choices,
    list_fitting_units,
    parse_table,
    read_file,
    require,
    require_unit,
    suggest_name,
)


@dataclass(frozen=True)
class SourceTerm:
    """A column of the recording, and how its raw values become SI: sign * (scale * raw + offset), in `unit`."""

    source: str
    unit: str = ""  # default: that of the signal
    sign: Literal[1, -1] = 1
    scale: float = 1.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        require(self.scale != 0.0, "", "scale", "a number other than 0")

    def find_unit(self, si: str, where: object = "", field: str = "") -> Unit:
        """Its unit, of a signal in the unit `si`; as of `plant.units`, and of one that is raw it says what to do."""
        if self.unit in OTHER_UNITS and not fit_unit(self.unit, si):
            fitting = list_fitting_units(si)[0]
            raise InputError(where, field, f"the unit that scale and offset lead to, such as {fitting} ({self.unit} is "
                                           f"raw: value = sign * (scale * raw + offset) in `unit`)")
        return require_unit(self.unit or si, si, where, field)


@dataclass(frozen=True)
class TimeBase:
    """Where the times come from: a column in a unit, the row number at a rate, or a counter that wraps."""

    source: str | None = None
    unit: str = "s"  # or iso: calendar times
    rate: Annotated[float, Quantity("1/s", above=0)] | None = None  # rows, or counts, a second
    bits: Annotated[int, Quantity("1", low=1, high=64)] | None = None  # of a counter

    def __post_init__(self) -> None:
        has_source, has_rate, is_counter = self.source is not None, self.rate is not None, self.bits is not None
        require(not is_counter or (has_source and has_rate), "", "",
                "source and rate (counts a second) for a counter of so many bits")
        require(has_source or has_rate, "", "", "source (a column), or rate (rows a second)")
        require(is_counter or not (has_source and has_rate), "", "bits",
                "the bits of the counter, as source and rate are given")
        if not (has_rate or self.is_calendar):
            require_unit(self.unit, "s", "", "unit")

    @property
    def is_calendar(self) -> bool:
        """Whether the column has dates."""
        return self.unit == "iso" and self.rate is None


@dataclass(frozen=True)
class SensorKeys:
    """The measuring chain of a signal, as a map has it."""

    moving_mean: Annotated[float, Quantity("1", low=1, high=999_999)] = 1.0  # samples of the recording
    centred: bool = False
    lag: Annotated[float, Quantity("s", low=0)] = 0.0
    quantum: Annotated[float, Quantity("1", low=0)] = 0.0  # in the unit of the signal
    dead: bool | tuple[tuple[float, float], ...] = ()  # s, from and to; True: always

    def __post_init__(self) -> None:
        require(self.moving_mean % 1.0 == 0.0, "", "moving_mean", "a whole number of samples")
        spans = () if isinstance(self.dead, bool) else self.dead
        require(all(start < end for start, end in spans), "", "dead",
                "true, or a list of [from, to] in s, from before to")


@dataclass(frozen=True)
class SignalMap(SourceTerm):
    """Where a signal comes from."""

    minus: SourceTerm | None = None  # is subtracted, as the pressure of the other chamber
    time: TimeBase | None = None  # None: that of the recording
    delay: float = 0.0  # s, that the recorded signal is late
    method: Literal["auto", "samples", "interpolate", "hold"] = "auto"
    low_pass: bool | None = None  # before samples are left out; None: if it is needed
    sensor: SensorKeys = SensorKeys()

    def make_dynamics(self, si: str) -> SensorDynamics:
        """The measuring chain, in the unit `si` of the signal."""
        keys = self.sensor
        return SensorDynamics(keys.lag, keys.moving_mean, centred=keys.centred,
                              quantum=keys.quantum * float(self.find_unit(si).factor))


@dataclass(frozen=True)
class TextKeys:
    """How a text table is written; what is not given is found in it."""

    separator: str | None = None
    decimal: Literal[".", ","] | None = None
    header: Annotated[int, Quantity("1", low=1)] | None = None  # line of the names

    def __post_init__(self) -> None:
        require(len(self.separator or ";") == 1, "", "separator", "one character, such as ';' or '\\t'")


@dataclass(frozen=True)
class RowKeys:
    """The rows of the trace."""

    period: Annotated[float, Quantity("s", above=0)] | None = None
    start: float | None = None  # s of the recording, first and last that is taken
    end: float | None = None


@dataclass(frozen=True)
class ImportMap:
    """A whole map: its tables, and where they are from."""

    path: Path = field(metadata={"key": False})
    text: str = field(metadata={"key": False})
    declared: Signals = field(metadata={"key": False})  # of the plant that was recorded
    file: TextKeys = TextKeys()
    trace: RowKeys = RowKeys()
    time: TimeBase | None = None
    signals: Any = field(default_factory=dict)  # `SignalMap` by name


def read_map(path: Path, declared: Signals = EHA) -> ImportMap:
    """Read a map of a recording of a plant with the `declared` signals.

    Raises:
        InputError: a file that cannot be read, is no TOML, or has a key or value that a map cannot have.
    """
    return parse_map(decode_text(read_file(path), path).removeprefix("\ufeff"), path, declared)


def parse_map(text: str, path: Path, declared: Signals = EHA) -> ImportMap:
    """The map that a TOML text holds; `path` is its name in messages, `declared` are the signals that it may name.

    Raises:
        InputError: as of `read_map`; or a map without a signal that every analysis needs, or with a column that is two
            signals.
    """
    table, place = parse_table(text, str(path))
    import_map = build_dataclass(ImportMap, table, place, path=path, text=text, declared=declared)
    place.at("signals").require(isinstance(import_map.signals, dict), "a table of signals")
    signals = {name: _parse_signal(name, signal_table, place.at("signals", name), declared)
               for name, signal_table in import_map.signals.items()}
    for name in declared.required:
        required_signal = declared.find(name)
        place.at("signals", name).require(
            name in signals or (declared.is_open_loop and required_signal == declared.command),
            f"a table with the source of {required_signal.symbol}, {required_signal.quantity}")
    owner: dict[str, str] = {}
    for name, signal in signals.items():
        other = owner.setdefault(signal.source, name)
        place.at("signals", name, "source").require(
            other == name or signal.minus is not None or signals[other].minus is not None,
            f"a column of its own; signals.{other} has {signal.source!r} already")
    # in an open loop the drive is the command
    signals.setdefault(declared.command.name, signals[declared.drive.name])
    return replace(import_map, signals=signals)


def _parse_signal(name: str, table: Any, place: Place, declared: Signals) -> SignalMap:
    place.require(name in declared.names, list_choices(name, declared.names))
    plant_signal, minus = declared.find(name), table.get("minus") if isinstance(table, dict) else None
    if minus is not None:  # what it does not say is as of the other chamber
        defaults = {key: table[key] for key in ("unit", "sign", "scale", "offset") if key in table}
        keys = {"source": minus} if isinstance(minus, str) else minus
        table = {**table, "minus": defaults | keys if isinstance(keys, dict) else keys}
    signal = build_dataclass(SignalMap, table, place)
    for term, at in ((signal, place), (signal.minus, place.at("minus"))):
        if term is not None:
            with at.locate(has_field=True):
                term.find_unit(plant_signal.unit, "", "unit")
    outputs = ", ".join(s.name for s in declared.outputs)
    place.at("sensor").require(plant_signal.role == "output" or not signal.make_dynamics(plant_signal.unit).filters,
                               f"moving_mean and lag for {outputs} alone; {name} is an input of the model and is used "
                               "as recorded")
    return signal


# ---------------------------------------------------------------------------------------------------------------------
# Units
# ---------------------------------------------------------------------------------------------------------------------

def convert_to_si(values: Floats, unit: Unit) -> Floats:
    """Values in SI units.

    A factor 1/n is a division by a whole number: 12.3456 mm becomes the float nearest to 0.0123456 m.

    >>> convert_to_si(np.array([12.3456]), require_unit("mm", "m", "", "")).tolist()
    [0.0123456]
    """
    return values / float(unit.factor.denominator) if unit.factor.numerator == 1 else values * float(unit.factor)


# ---------------------------------------------------------------------------------------------------------------------
# Times
# ---------------------------------------------------------------------------------------------------------------------

COUNTER = " (a counter that wraps needs bits and rate)"


def compute_times(base: TimeBase, samples: int, column: Floats | None, where: object, field: str) -> Floats:
    """Times (s) of so many samples; `column` holds the values of the base's source.

    Raises:
        InputError: times that are missing, stand still or go backwards, and counts that are no whole numbers.
    """
    if column is None:
        assert base.rate is not None  # a base without source has a rate
        return np.arange(samples) / base.rate
    is_missing = np.isnan(column)
    if is_missing.any():
        raise InputError(where, field, f"a time in every row; row {int(is_missing.argmax()) + 1} has none")
    if base.bits is not None and base.rate is not None:
        return unwrap_counter(column, base.bits, where, field) / base.rate
    t = column - column[0] if base.is_calendar else convert_to_si(column, require_unit(base.unit, "s", where, field))
    require_growth(t, where, field, COUNTER)
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


def import_measurement(measurement: Measurement, import_map: ImportMap, cycle: float) -> Imported:
    """The trace that a map makes of a recording.

    Args:
        measurement: the recording.
        import_map: its map.
        cycle: s, the model's; the rows' period unless the map has one, or the recording is slower.

    Raises:
        InputError: a column, time or value that cannot be used.
    """
    channels = _read_channels(measurement, import_map)
    samples = {name: _scale(measurement, import_map, name, channels) for name in import_map.signals}
    period = import_map.trace.period or _measure_cycle(samples[import_map.declared.controlled.name], cycle)
    rows = _make_rows(import_map, samples, period)
    columns, imported_signals, sensors, signals = {}, [], {}, import_map.declared
    for name, signal in import_map.signals.items():
        series, part = samples[name], CYCLE_PARTS.get(signals.find(name).role, "")
        x, how = place_samples(series, rows, period, signal.method, signal.low_pass, part)
        require(not np.isnan(x).all(), import_map.path, f"signals.{name}",
                "samples within the time of the other signals")
        sensors[name], how = _find_sensor(signal, series, rows, how, period, signals.find(name).unit)
        columns[name] = x
        source = f"{signal.source} - {signal.minus.source}" if signal.minus else signal.source
        imported_signals.append(ImportedSignal(
            name, source, _describe_unit(signal, signals.find(name).unit), 1.0 / series.period, float(np.nanmin(x)),
            float(np.nanmax(x)), int((np.diff(series.t) > 1.5 * series.period).sum()), int(np.isnan(x).sum()), how))
    origin = {"imported": measurement.path.name, "imported.sha256": hash_file(measurement.path),
              "imported.format": measurement.format, "imported.map": import_map.path.name,
              "imported.map_sha256": hashlib.sha256(import_map.text.encode()).hexdigest(),
              "imported.start": repr(float(rows[0]))}
    trace = replace(Trace.from_columns(columns, period, origin, signals),
                    sensors={name: sensor for name, sensor in sensors.items() if not sensor.is_ideal})
    return Imported(trace, tuple(imported_signals), frozenset(channels))


def hash_file(path: Path) -> str:
    """SHA-256 of a file's content."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _read_channels(measurement: Measurement, import_map: ImportMap) -> Mapping[str, Channel]:
    """All channels that the map names, read at once.

    Raises:
        InputError: a name that is no channel of the recording, with the field of the map and the nearest channel.
    """
    bases = {"time": import_map.time}
    sources = {}  # field of the map: channel
    for name, signal in import_map.signals.items():
        bases[f"signals.{name}.time"] = signal.time
        sources[f"signals.{name}.source"] = signal.source
        if signal.minus:
            sources[f"signals.{name}.minus.source"] = signal.minus.source
    column_bases = {place: base for place, base in bases.items() if base and base.source}
    sources |= {f"{place}.source": str(base.source) for place, base in column_bases.items()}
    for place, name in sources.items():
        if name not in measurement.units:
            examples = ", ".join(list(measurement.units)[:12]) + (", .." if len(measurement.units) > 12 else "")
            raise InputError(import_map.path, place, f"a column of {measurement.path.name} ({examples}), not {name!r}"
                                                     f"{suggest_name(name, measurement.units)}")
    return measurement.read(list(dict.fromkeys(sources.values())),
                            [str(base.source) for base in column_bases.values() if base.is_calendar])


def _scale(measurement: Measurement, import_map: ImportMap, name: str, channels: Mapping[str, Channel]) -> Samples:
    """A signal's samples in SI at their true times, missing ones left out."""
    signal, si = import_map.signals[name], import_map.declared.find(name).unit
    channel = channels[signal.source]
    x = _convert(channel.values, signal, si)
    t = _find_times(measurement, import_map, signal, channel, channels) - signal.delay
    if signal.minus:
        other = channels[signal.minus.source]
        if len(other.values) != len(x) or (other.t is not None and channel.t is not None
                                              and not np.array_equal(other.t, channel.t)):
            raise InputError(import_map.path, f"signals.{name}.minus", "a channel with the same times")
        x = x - _convert(other.values, signal.minus, si)
    dead = signal.sensor.dead
    has_value = ~np.isnan(x) & (dead is not True)
    for first, last in () if isinstance(dead, bool) else dead:
        has_value &= (t < first) | (t > last)
    reason = "it is marked dead; leave it out of the map" if dead else f"it has {int(has_value.sum())}"
    require(has_value.sum() >= 2, measurement.path, signal.source, f"at least two values; {reason}")
    return Samples(t, x) if has_value.all() else Samples(t[has_value], x[has_value])


def _convert(values: Floats, term: SourceTerm, si: str) -> Floats:
    x = values if term.scale == 1.0 and term.offset == 0.0 else term.scale * values + term.offset
    x = convert_to_si(x, term.find_unit(si))
    return x if term.sign > 0 else 0.0 - x


def _find_times(measurement: Measurement, import_map: ImportMap, signal: SignalMap, channel: Channel,
                channels: Mapping[str, Channel]) -> Floats:
    base = signal.time or import_map.time
    if base is None:
        if channel.t is None:
            raise InputError(import_map.path, "time", "a table with source (a column) or rate (rows a second)")
        require_growth(channel.t, measurement.path, signal.source, COUNTER)
        return channel.t
    column = channels[base.source].values if base.source else None
    if column is not None and len(column) != len(channel.values):
        raise InputError(measurement.path, str(base.source), f"{len(channel.values)} times, one for each value of "
                                                             f"{signal.source}, not {len(column)}")
    return compute_times(base, len(channel.values), column, measurement.path, base.source or "rate")


def _measure_cycle(samples: Samples, cycle: float) -> float:
    """The model's cycle, or the controlled signal's period if longer; by the recording's clock if that drifts.

    Samples that are no whole part of the cycle show the clock where the signal is held: by the times of its new values.
    """
    nominal = cycle if samples.period < 1.25 * cycle else round(samples.period, 6)
    rows = float(np.rint(np.diff(samples.t) / samples.period).sum())
    mean = float(samples.t[-1] - samples.t[0]) / rows
    ratio = max(1, round(nominal / mean)) if mean < nominal else 1
    drift = abs(mean * ratio / nominal - 1.0)
    if mean < nominal and drift > LARGEST_DRIFT:
        new = samples.t[1:][np.diff(samples.x) != 0.0]
        new = new[:: 1 + len(new) // 20_000]
        own = max(nominal * (1.0 + CLOCKS), key=lambda period: abs(np.exp(2j * np.pi / period * new).sum()))
        is_held = find_update(samples, nominal) is None and find_update(samples, own) is not None
        return round(float(own), 9) if is_held else nominal
    return nominal if drift * rows < SLIP else round(mean * ratio, 9)


def _make_rows(import_map: ImportMap, samples: Mapping[str, Samples], period: float) -> Floats:
    """Times of the rows: from the first sample that all required signals share to the last, on the controlled one's.

    Where that or the drive is held for a row, a row begins when its new value comes.
    """
    series = [samples[name] for name in import_map.declared.required]
    first = max(-math.inf if import_map.trace.start is None else import_map.trace.start, *(s.t[0] for s in series))
    last = min(math.inf if import_map.trace.end is None else import_map.trace.end, *(s.t[-1] for s in series))
    names = import_map.declared.controlled.name, import_map.declared.drive.name
    origin = next((update for name in names if (update := find_update(samples[name], period)) is not None),
                  float(samples[names[0]].t[0]))
    start = origin + period * math.ceil((first - origin) / period - 0.5)
    count = math.floor((last - start) / period + 0.5) + 1
    require(count >= 2, import_map.path, "signals",
            f"{', '.join(import_map.declared.required)} recorded at the same time")
    require(count <= MOST_ROWS, import_map.path, "time",
            f"at most {MOST_ROWS} rows of {period:g} s, not {count}; is the unit of the time right?")
    return np.asarray(start + period * np.arange(count))


def _find_sensor(signal: SignalMap, samples: Samples, rows: Floats, how: str, period: float, unit: str
                 ) -> tuple[SensorDynamics, str]:
    """The dynamics as the trace keeps them, and the whole list of what was done."""
    sensor = signal.make_dynamics(unit)
    if sensor.moving_mean > 1.0:
        sensor = replace(sensor, sample_period=round(samples.period, 9))
    if signal.delay and how.startswith(("as recorded", "every")) and "held" not in how:
        rest = float(samples.t[0] - rows[0] + 0.5 * samples.period) % samples.period - 0.5 * samples.period
        if abs(rest) > 0.01 * period:
            sensor = replace(sensor, delay=-rest)
    return sensor, "; ".join(filter(None, (
        how, f"moved {1e3 * signal.delay:g} ms earlier" if signal.delay else "",
        "dead spans left out" if signal.sensor.dead else "",
        "" if sensor.is_ideal else f"the model gets {sensor.describe(period, unit)}")))


def _describe_unit(s: SourceTerm, si: str) -> str:
    unit, sign = s.find_unit(si).name, "-" if s.sign < 0 else ""
    scale = f"{s.scale:g} " if s.scale != 1.0 else ""
    offset = f" {s.offset:+g} {unit}" if s.offset else ""
    return f"{sign}{scale}{unit}{offset}"


SLIP = 0.4  # of a sample: two clocks that drift apart by less over the recording are the same
FOLDED_SHARE = 0.05  # of a signal's standard deviation; more above the rows' Nyquist frequency is filtered out first
LARGEST_DRIFT = 0.01  # of a clock against another; samples that are further from a part of a row are no part of it
CLOCKS = 1e-6 * np.arange(-200, 201)  # by which a quartz clock may be off
HELD_SHARE = 0.75  # of the changes that one phase would miss by chance and does not: a signal that is held between them


class Samples(NamedTuple):
    """A channel, samples that are missing left out."""

    t: Floats  # s, growing
    x: Floats

    @property
    def period(self) -> float:
        """The usual time between two samples, s."""
        return float(np.percentile(np.diff(self.t), 50, method="lower"))


def find_update(samples: Samples, period: float, known: float | None = None) -> float | None:
    """A time at which a signal that is held for a `period`, s, brings a new value; None if it is not held.

    The value is new somewhere between two samples, which need not be a whole part of the period apart. `known` is such
    a time of another signal; it is taken where it explains the changes, however few.
    """
    is_new = (np.diff(samples.x) != 0.0) & (np.diff(samples.t) < period)
    last = samples.t[1:][is_new]
    phases, starts = np.sort(last % period), np.sort(last % period - np.diff(samples.t)[is_new])
    trials = phases if known is None else np.append(phases, (known - 1e-9) % period)  # times are rounded
    counts = (np.searchsorted(starts, trials) + np.searchsorted(starts + period, trials)
              - np.searchsorted(phases, trials))
    free = 1.0 - samples.period / period  # share of the changes that a phase misses by chance
    least = max(1.0, (1.0 - (1.0 - HELD_SHARE) * free) * len(last))
    if free < 0.05 or counts.max(initial=0) < least:
        return None
    if known is not None and counts[-1] >= least:
        return known
    return float(trials[counts.argmax()]) if free * len(last) >= 10.0 else None


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
    update = find_update(samples, period, float(rows[0])) if method in ("auto", "samples") else None
    if update is not None:
        offset = (update - rows[0]) % period
        middle = offset + (0.5 if cycle_part == "answer" or not offset else -0.5) * period
        return _place_nearest(samples, rows + middle, 0.5 * period), "one sample a row; the signal is held for a row"
    ratio = period / samples.period
    whole = round(ratio)
    is_whole = whole >= 1 and abs(ratio / whole - 1.0) * len(rows) < 0.5 * whole + 0.01 * len(rows)
    if method in ("auto", "samples") and whole == 1 and is_whole:
        placement = _place_each(samples, rows, period)
        if placement is not None:
            return placement
    if method in ("auto", "samples") and whole > 1 and is_whole:
        return _pick(samples, rows, whole, low_pass, bool(cycle_part))
    if method == "samples":
        return _place_nearest(samples, rows, 0.5 * period), "nearest sample"
    spacing = f"{1e3 * samples.period:.4g} ms apart"
    is_stepwise = len(samples.x) > 10 and float(np.mean(np.diff(samples.x) == 0.0)) > 0.5  # most repeat the one before
    if method == "hold" or (method == "auto" and cycle_part and is_stepwise):
        return _hold(samples, rows), f"last sample, {spacing}"
    if ratio > 1.5 and low_pass is not False:
        return (_interpolate(_filter(samples, ratio), rows),
                f"low-pass filtered, straight lines between samples {spacing}")
    return _interpolate(samples, rows), f"straight lines between samples {spacing}"


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


def _pick(samples: Samples, rows: Floats, ratio: int, low_pass: bool | None, is_input: bool) -> tuple[Floats, str]:
    """Every so many samples."""
    how = f"every {_format_ordinal(ratio)} sample"
    if low_pass is None:
        low_pass = not is_input and _measure_folded_share(samples, ratio) > FOLDED_SHARE
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
    place = np.clip(before, 0, None)
    is_late = rows - samples.t[place] > 1.5 * samples.period
    return np.where((before < 0) | is_late, math.nan, samples.x[place])


def _interpolate(samples: Samples, rows: Floats) -> Floats:
    """Straight lines between samples; NaN in gaps and outside."""
    after = np.searchsorted(samples.t, rows)
    left, right = np.clip(after - 1, 0, len(samples.t) - 1), np.clip(after, 0, len(samples.t) - 1)
    is_gap = (samples.t[right] - samples.t[left] > 1.5 * samples.period)
    is_exact = samples.t[right] == rows
    is_gap |= (rows < samples.t[0] - 1e-9) | (rows > samples.t[-1] + 1e-9)
    return np.where(is_gap & ~is_exact, math.nan, np.interp(rows, samples.t, samples.x))


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
