"""The map of a recording: which column is which signal, in which unit, on which time base, behind which sensor."""
from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.trace.sensor_dynamics import SensorDynamics
from fdi.trace.signals import OUTPUTS, SIGNALS
from plant.errors import InputError, suggest_name

REQUIRED_SIGNALS = ("com", "xj", "cor")
SIGNAL_NAMES = tuple(name for name in SIGNALS if name != "t")


@dataclass(frozen=True)
class Scaling:
    """How raw values become SI: sign * (scale * raw + offset), in `unit`."""

    unit: Unit
    unit_name: str
    sign: float = 1.0
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class SourceTerm:
    """A column of the recording and its scaling."""

    source: str
    scaling: Scaling


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
    minus: SourceTerm | None = None  # is subtracted, as the pressure of the other chamber
    time: TimeBase | None = None  # None: that of the recording
    delay: float = 0.0  # s, that the recorded signal is late
    method: str = "auto"  # auto, samples, interpolate, hold
    low_pass: bool | None = None  # before samples are left out; None: if it is needed
    sensor: SensorDynamics = field(default_factory=SensorDynamics)
    dead: tuple[tuple[float, float], ...] = ()  # s, when the channel was dead; -inf .. inf: always


@dataclass(frozen=True)
class ImportMap:
    """A whole map."""

    path: Path
    signals: Mapping[str, SignalMap]
    time: TimeBase | None
    period: float | None = None  # s, of the trace's rows
    start: float | None = None  # s of the recording, first and last that is taken
    end: float | None = None
    separator: str | None = None
    decimal: str | None = None
    name_line: int | None = None
    text: str = ""


class _Table:
    """A TOML table whose keys are taken one by one; what is left at the end is refused."""

    def __init__(self, where: object, name: str, values: Any) -> None:
        if not isinstance(values, dict):
            raise InputError(where, name, "a table")
        self.where, self.name, self._left = where, name, dict(values)
        self._known: list[str] = []

    def label(self, key: str) -> str:
        return f"{self.name}.{key}" if self.name else key

    def take(self, key: str, kind: type | tuple[type, ...], expected: str, default: Any = None) -> Any:
        self._known.append(key)
        if key not in self._left:
            return default
        value = self._left.pop(key)
        kinds = kind if isinstance(kind, tuple) else (kind,)
        if not isinstance(value, kind) or (isinstance(value, bool) and bool not in kinds):
            raise InputError(self.where, self.label(key), f"{expected}, not {value!r}")
        return value

    def take_number(self, key: str, default: float | None = None, low: float = -math.inf,
                    expected: str = "a finite number") -> float | None:
        value = self.take(key, (int, float), expected, default)
        if value is not None and not (math.isfinite(value) and value >= low):
            raise InputError(self.where, self.label(key), f"{expected}, not {value!r}")
        return value  # type: ignore[no-any-return]

    def take_positive(self, key: str, expected: str) -> float | None:
        value = self.take_number(key, expected=expected)
        if value is not None and value <= 0.0:
            raise InputError(self.where, self.label(key), f"{expected}, not {value!r}")
        return value

    def close(self) -> None:
        for key in self._left:
            raise InputError(self.where, self.label(key), f"one of {', '.join(self._known)}"
                                                          f"{suggest_name(key, self._known)}")


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
        InputError: as of `read_map`.
    """
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(path, "", f"a TOML file ({error})") from error
    top = _Table(path, "", values)
    file = _Table(path, "file", top.take("file", dict, "a table", {}))
    rows = _Table(path, "trace", top.take("trace", dict, "a table", {}))
    time = top.take("time", dict, "a table")
    signals = top.take("signals", dict, "a table of signals", {})
    out = ImportMap(
        path, {name: _parse_signal(path, name, table) for name, table in signals.items()},
        None if time is None else _parse_time(_Table(path, "time", time)),
        rows.take_positive("period", "a period above 0 s"),
        rows.take_number("start"), rows.take_number("end"),
        _parse_separator(file), _parse_decimal(file), _parse_line(file), text)
    for table in (top, file, rows):
        table.close()
    _check_signals(out)
    return out


def _check_signals(found: ImportMap) -> None:
    """Refuse a map without a signal that every analysis needs, and one column that is two signals."""
    for name in REQUIRED_SIGNALS:
        if name not in found.signals:
            raise InputError(found.path, f"signals.{name}", "a table with the source of "
                                                            f"{SIGNALS[name].symbol}, {SIGNALS[name].quantity}")
    owner: dict[str, str] = {}
    for name, signal in found.signals.items():
        other = owner.setdefault(signal.term.source, name)
        if other != name and signal.minus is None and found.signals[other].minus is None:
            raise InputError(found.path, f"signals.{name}.source",
                             f"a column of its own; signals.{other} has {signal.term.source!r} already")


def _parse_separator(file: _Table) -> str | None:
    value: str | None = file.take("separator", str, "one character, such as ';' or '\\t'")
    if value is not None and len(value) != 1:
        raise InputError(file.where, "file.separator", f"one character, such as ';' or '\\t', not {value!r}")
    return value


def _parse_decimal(file: _Table) -> str | None:
    value: str | None = file.take("decimal", str, "'.' or ','")
    if value not in (None, ".", ","):
        raise InputError(file.where, "file.decimal", f"'.' or ',', not {value!r}")
    return value


def _parse_line(file: _Table) -> int | None:
    value: int | None = file.take("header", int, "the number of the line with the names, from 1")
    if value is not None and value < 1:
        raise InputError(file.where, "file.header", f"the number of the line with the names, from 1, not {value}")
    return value


def _parse_time(table: _Table) -> TimeBase:
    source = table.take("source", str, "the name of a column")
    rate = table.take_positive("rate", "rows or counts a second, above 0")
    bits = table.take("bits", int, "bits of a counter, 1 to 64")
    unit = table.take("unit", str, "a unit of time, or iso")
    table.close()
    if bits is not None and not 1 <= bits <= 64:
        raise InputError(table.where, table.label("bits"), f"bits of a counter, 1 to 64, not {bits}")
    if bits is not None and (source is None or rate is None):
        raise InputError(table.where, table.name, "source and rate (counts a second) for a counter of so many bits")
    if source is None and rate is None:
        raise InputError(table.where, table.name, "source (a column), or rate (rows a second)")
    if source is not None and rate is not None and bits is None:
        raise InputError(table.where, table.label("bits"), "the bits of the counter, as source and rate are given")
    if unit == "iso" or source is None or bits is not None:
        return TimeBase(source, None, rate, bits)
    return TimeBase(source, require_unit("s" if unit is None else unit, "s", table.where, table.label("unit")))


def _parse_signal(path: Path, name: str, values: Any) -> SignalMap:
    if name not in SIGNAL_NAMES:
        raise InputError(path, f"signals.{name}", f"one of {', '.join(SIGNAL_NAMES)}{suggest_name(name, SIGNAL_NAMES)}")
    table = _Table(path, f"signals.{name}", values)
    term = _parse_term(table, SIGNALS[name].unit, None)
    minus = table.take("minus", (str, dict), "a column, or a table with source, unit, scale and offset")
    if isinstance(minus, str):
        minus = {"source": minus}
    other = None
    if minus is not None:
        inner = _Table(path, f"signals.{name}.minus", minus)
        other = _parse_term(inner, SIGNALS[name].unit, term.scaling)
        inner.close()
    time = table.take("time", dict, "a table as [time]")
    method = table.take("method", str, "auto, samples, interpolate or hold", "auto")
    if method not in ("auto", "samples", "interpolate", "hold"):
        raise InputError(path, table.label("method"), f"auto, samples, interpolate or hold, not {method!r}")
    delay = table.take_number("delay", 0.0, expected="seconds that the signal is late")
    low_pass = table.take("low_pass", bool, "true or false")
    sensor, dead = _parse_sensor(table, term.scaling)
    if sensor.filters and name not in OUTPUTS:
        raise InputError(path, table.label("sensor"), f"moving_mean and lag for {', '.join(OUTPUTS)} alone; {name} is "
                                                      "an input of the model and is used as recorded")
    table.close()
    base = None if time is None else _parse_time(_Table(path, f"signals.{name}.time", time))
    return SignalMap(name, term, other, base, float(delay or 0.0), method, low_pass, sensor, dead)


def _parse_term(table: _Table, si: str, base: Scaling | None) -> SourceTerm:
    """Source and scaling; `base` is what is not given."""
    source = table.take("source", str, "the name of a column")
    if source is None:
        raise InputError(table.where, table.label("source"), "the name of a column")
    unit_name = table.take("unit", str, "a unit", base.unit_name if base else si)
    unit = require_unit(unit_name, si, table.where, table.label("unit"))
    sign = table.take_number("sign", base.sign if base else 1.0, expected="1 or -1")
    if sign not in (1, -1):
        raise InputError(table.where, table.label("sign"), f"1 or -1, not {sign!r}")
    scale = table.take_number("scale", base.scale if base else 1.0, expected="a number other than 0")
    if not scale:
        raise InputError(table.where, table.label("scale"), "a number other than 0")
    offset = table.take_number("offset", base.offset if base else 0.0)
    return SourceTerm(source, Scaling(unit, unit_name, float(sign or 1.0), float(scale), float(offset or 0.0)))


def _parse_sensor(table: _Table, scaling: Scaling) -> tuple[SensorDynamics, tuple[tuple[float, float], ...]]:
    """The dynamics with its quantum in SI, and when the channel was dead."""
    inner = _Table(table.where, table.label("sensor"), table.take("sensor", dict, "a table", {}))
    mean = inner.take("moving_mean", int, "samples of the recording, from 1", 1)
    if mean < 1:
        raise InputError(table.where, inner.label("moving_mean"), f"samples of the recording, from 1, not {mean}")
    centred = inner.take("centred", bool, "true or false", False)
    lag = inner.take_number("lag", 0.0, 0.0, "a time constant from 0 s")
    quantum = inner.take_number("quantum", 0.0, 0.0, f"a step from 0 {scaling.unit_name}")
    dead = inner.take("dead", (bool, list), "true, or a list of [from, to] in s", [])
    inner.close()
    if isinstance(dead, bool):
        dead = [[-math.inf, math.inf]] if dead else []
    for span in dead:
        is_span = isinstance(span, list) and len(span) == 2 and all(isinstance(x, int | float) for x in span)
        if not (is_span and span[0] < span[1]):
            raise InputError(table.where, inner.label("dead"), f"[from, to] in s, from before to, not {span!r}")
    sensor = SensorDynamics(moving_mean=float(mean), centred=centred, lag=float(lag or 0.0),
                            quantum=float(quantum or 0.0) * float(scaling.unit.factor))
    return sensor, tuple((float(a), float(b)) for a, b in dead)


Floats = NDArray[np.float64]


class Unit(NamedTuple):
    """A unit: the SI unit of its quantity and how many of those it is."""

    si: str
    factor: Fraction


def _list_units(si: str, **factors: str | int) -> dict[str, Unit]:
    return {name: Unit(si, Fraction(factor)) for name, factor in factors.items()}


UNITS: Mapping[str, Unit] = {
    **_list_units("m", m=1, cm="1/100", mm="1/1000", um="1/1000000", nm="1/1000000000", inch="0.0254", mil="0.0000254"),
    **_list_units("Pa", Pa=1, hPa=100, kPa=1000, MPa=1000000, GPa=1000000000, mbar=100, bar=100000,
                  psi="6894.757293168361"),
    **_list_units("A", A=1, mA="1/1000", uA="1/1000000"),
    **_list_units("N", N=1, kN=1000, MN=1000000, daN=10, lbf="4.4482216152605"),
    **_list_units("s", s=1, ms="1/1000", us="1/1000000", ns="1/1000000000", min=60, h=3600),
}
SPELLINGS = {"µm": "um", "μm": "um", "µs": "us", "μs": "us", "µA": "uA", "μA": "uA", "in": "inch", "sec": "s",
             "seconds": "s", "second": "s", "msec": "ms", "usec": "us", "pa": "Pa", "kpa": "kPa", "mpa": "MPa",
             "Bar": "bar", "BAR": "bar", "MM": "mm", "a": "A", "ma": "mA", "n": "N", "kn": "kN", "S": "s", "MS": "ms",
             "PSI": "psi", "Volt": "V", "v": "V", "micron": "um", "metre": "m", "meter": "m"}
OTHER_UNITS = ("V", "mV", "counts", "%")  # what a logger may write that needs scale and offset


def find_unit(name: str) -> Unit | None:
    """The unit of this name or spelling; None if it is not known."""
    return UNITS.get(SPELLINGS.get(name.strip(), name.strip()))


def require_unit(name: str, si: str, where: object, field: str) -> Unit:
    """The unit `name`, which must measure what `si` measures.

    Raises:
        InputError: an unknown unit, or one of another quantity.
    """
    unit = find_unit(name)
    fitting = [known for known, u in UNITS.items() if u.si == si]
    if unit is None and name in OTHER_UNITS:
        raise InputError(where, field, f"the unit that scale and offset lead to, such as {fitting[0]} ({name} is raw: "
                                       f"value = sign * (scale * raw + offset) in `unit`)")
    if unit is None or unit.si != si:
        raise InputError(where, field, f"one of {', '.join(fitting)}, not {name!r}{suggest_name(name, fitting)}")
    return unit


def convert_to_si(values: Floats, unit: Unit) -> Floats:
    """Values in SI units.

    A factor below 1 is a division by a whole number: 12.3456 mm becomes the float nearest to 0.0123456 m.

    >>> convert_to_si(np.array([12.3456]), UNITS["mm"]).tolist()
    [0.0123456]
    """
    if unit.factor < 1 and unit.factor.numerator == 1:
        return values / float(unit.factor.denominator)
    return values * float(unit.factor)


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
