"""The map of a recording: which column is which signal, in which unit, on which time base, behind which sensor."""
from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.trace.sensor_dynamics import SensorDynamics
from fdi.trace.signals import OUTPUTS, SIGNALS
from plant.errors import InputError, show_value, suggest_name
from plant.parameters import parse_toml
from plant.units import UNITS, Unit, find_unit, require_unit

Floats = NDArray[np.float64]

REQUIRED_SIGNALS = ("com", "xj", "cor")
SIGNAL_NAMES = tuple(name for name in SIGNALS if name != "t")


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
        if word not in values and key.default is ...:
            raise InputError(where, f"{prefix}{word}", key.expected)
        if word in values and not (type(values[word]) in key.kinds
                                   and (type(values[word]) is not int or abs(values[word]) <= 1e308)  # a float holds it
                                   and key.is_valid(values[word])):
            raise InputError(where, f"{prefix}{word}", f"{key.expected}, not {show_value(values[word])}")
    found = {word: values.get(word, key.default) for word, key in keys.items()}
    return {word: float(value) if type(value) is int and float in keys[word].kinds else value
            for word, value in found.items()}


def read_map(path: Path) -> ImportMap:
    """Read a map.

    Raises:
        InputError: a file that cannot be read, is no TOML, or has a key or value that a map cannot have.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, "", f"a readable map ({getattr(error, 'strerror', None) or error})") from error
    return parse_map(text, path)


def parse_map(text: str, path: Path) -> ImportMap:
    """The map that a TOML text holds; `path` is its name in messages.

    Raises:
        InputError: as of `read_map`; or a map without a signal that every analysis needs, or with a column that is two
            signals.
    """
    top = _read_table(path, "", parse_toml(text, path), MAP)
    signals = {name: _parse_signal(path, name, table) for name, table in top["signals"].items()}
    for name in REQUIRED_SIGNALS:
        if name not in signals:
            raise InputError(path, f"signals.{name}", "a table with the source of "
                                                      f"{SIGNALS[name].symbol}, {SIGNALS[name].quantity}")
    owner: dict[str, str] = {}
    for name, signal in signals.items():
        other = owner.setdefault(signal.term.source, name)
        if other != name and signal.minus is None and signals[other].minus is None:
            raise InputError(path, f"signals.{name}.source",
                             f"a column of its own; signals.{other} has {signal.term.source!r} already")
    return ImportMap(path, text, signals, _parse_time(path, "time", top["time"]),
                     **_read_table(path, "trace", top["trace"], ROWS), **_read_table(path, "file", top["file"], FILE))


def _parse_time(path: Path, name: str, values: Any) -> TimeBase | None:
    if values is None:
        return None
    table = _read_table(path, name, values, TIME)
    source, rate, bits = table["source"], table["rate"], table["bits"]
    if bits is not None and (source is None or rate is None):
        raise InputError(path, name, "source and rate (counts a second) for a counter of so many bits")
    if source is None and rate is None:
        raise InputError(path, name, "source (a column), or rate (rows a second)")
    if source is not None and rate is not None and bits is None:
        raise InputError(path, f"{name}.bits", "the bits of the counter, as source and rate are given")
    has_unit = rate is None and table["unit"] != "iso"
    return TimeBase(source, _require_unit(table["unit"], "s", path, f"{name}.unit") if has_unit else None, rate, bits)


def _parse_signal(path: Path, signal: str, values: Any) -> SignalMap:
    name = f"signals.{signal}"
    if signal not in SIGNAL_NAMES:
        raise InputError(path, name, f"one of {', '.join(SIGNAL_NAMES)}{suggest_name(signal, SIGNAL_NAMES)}")
    table = _read_table(path, name, values, SIGNAL)
    si, minus = SIGNALS[signal].unit, table["minus"]
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
    if dynamics.filters and signal not in OUTPUTS:
        raise InputError(path, f"{name}.sensor", f"moving_mean and lag for {', '.join(OUTPUTS)} alone; {signal} is "
                                                 "an input of the model and is used as recorded")
    return SignalMap(signal, term, minus, _parse_time(path, f"{name}.time", table["time"]), table["delay"],
                     table["method"], table["low_pass"], dynamics, tuple((float(a), float(b)) for a, b in dead))


def _parse_term(path: Path, name: str, table: Mapping[str, Any], si: str) -> SourceTerm:
    return SourceTerm(**{**table, "unit": _require_unit(table["unit"] or si, si, path, f"{name}.unit")})


# ---------------------------------------------------------------------------------------------------------------------
# Units
# ---------------------------------------------------------------------------------------------------------------------

OTHER_UNITS = ("V", "mV", "counts", "%")  # what a logger may write that needs scale and offset


def _require_unit(name: str, si: str, where: object, field: str) -> Unit:
    """As of `plant.units`; of a unit that is raw it says what to do."""
    if find_unit(name) is None and name in OTHER_UNITS:
        fitting = next(known for known, u in UNITS.items() if u.si == si)
        raise InputError(where, field, f"the unit that scale and offset lead to, such as {fitting} ({name} is raw: "
                                       f"value = sign * (scale * raw + offset) in `unit`)")
    return require_unit(name, si, where, field)


def convert_to_si(values: Floats, unit: Unit) -> Floats:
    """Values in SI units.

    A factor below 1 is a division by a whole number: 12.3456 mm becomes the float nearest to 0.0123456 m.

    >>> convert_to_si(np.array([12.3456]), UNITS["mm"]).tolist()
    [0.0123456]
    """
    if unit.factor < 1 and unit.factor.numerator == 1:
        return values / float(unit.factor.denominator)
    return values * float(unit.factor)


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
