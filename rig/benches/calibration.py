"""Calibration of the sensors of a bench, table [calibration] of a bench file: how wrong a reading may be.

A reading is true value x (1 + span error) + zero error + noise. Zero and span error stay the same during a run, noise
is new in every sample. `u` is the standard uncertainty of the zero error, `gain` that of the span error.
docs/uncertainty.md has the keys.
"""

import datetime
from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt
from typing import Annotated, Any, Literal, NamedTuple

from plant import Place, Quantity, Signals, build_dataclass, list_choices, parse_quantity

Decision = Literal["simple", "guarded", "shared"]  # rule by which a value with an uncertainty passes a limit
DECISIONS = ("simple", "guarded", "shared")
# half-width over standard uncertainty (JCGM 100, 4.3.7 to 4.3.9; JCGM 101, 6.4)
WIDTHS = {"normal": 1.0, "rectangular": sqrt(3.0), "triangular": sqrt(6.0), "arcsine": sqrt(2.0)}


@dataclass(frozen=True, kw_only=True)
class SensorKeys:
    """The keys of a signal. `u`: standard uncertainty, or a distribution and its half-width: "rectangular 5 um"."""

    identifier: str
    date: str
    expiry: str
    u: str
    gain: Annotated[float, Quantity("1", low=0.0, below=1.0)] = 0.0  # relative standard uncertainty of the reading
    noise: str | None = None  # standard deviation of one sample


class SensorCalibration(NamedTuple):
    """The calibration of the sensor of one signal; u and noise in `unit`, SI."""

    signal: str
    unit: str
    identifier: str
    date: datetime.date
    expiry: datetime.date
    u: float
    distribution: str = "normal"
    gain: float = 0.0
    noise: float = 0.0

    def find_problem(self, t_ns: int) -> str:
        """Why the calibration does not hold at a time, ns since 1970; "" if it does. It holds on its last day."""
        day = datetime.datetime.fromtimestamp(t_ns / 1e9, datetime.UTC).date()
        if day > self.expiry:
            return f"calibration of {self.signal} expired on {self.expiry}"
        return f"calibration of {self.signal} begins on {self.date}" if day < self.date else ""

    def to_json(self, t_ns: int) -> dict[str, Any]:
        """The entry of the JSON answer of a run at that time."""
        return {**self._asdict(), "date": str(self.date), "expiry": str(self.expiry),
                "problem": self.find_problem(t_ns)}

    def describe(self) -> str:
        """All of it in a line."""
        span = f", span {100 * self.gain:g} %" if self.gain else ""
        noise = f", noise {self.noise:g} {self.unit}" if self.noise else ""
        return (f"{self.identifier}, {self.date} to {self.expiry}, u = {self.u:g} {self.unit} ({self.distribution})"
                f"{span}{noise}")


def read_calibration(tables: Mapping[str, Mapping[str, Any]], place: Place,
                     signals: Signals) -> tuple[Decision, dict[str, SensorCalibration]]:
    """The decision rule and the calibrations by the name of their signal.

    Args:
        tables: keys of each signal, by its name or its word in bench files; the decision at the key "" of "decision".
        place: of the table [calibration].
        signals: of the plant.

    Raises:
        InputError: a signal that no sensor measures, a text that is no date, a u without its unit.
    """
    signals_by_word = {word: s for s in signals if s.role in ("output", "load") for word in (s.alias, s.name) if word}
    decision: Decision = "simple"
    calibrations: dict[str, SensorCalibration] = {}
    for word, table in tables.items():
        entry_place = place.at(word)
        if word == "decision":
            entry_place.require(table.get("") in DECISIONS, list_choices(table.get(""), DECISIONS))
            decision = table[""]
            continue
        entry_place.require(word in signals_by_word,
                            f"decision or a measured signal: {list_choices(word, signals_by_word)}")
        signal = signals_by_word[word]
        entry_place.require(signal.name not in calibrations,
                            f"each signal once; {signal.name} and {signal.alias} are the same")
        keys = build_dataclass(SensorKeys, {key: str(value) if isinstance(value, datetime.date) else value
                                            for key, value in table.items()}, entry_place)
        first, last = (_read_date(getattr(keys, key), entry_place.at(key)) for key in ("date", "expiry"))
        entry_place.at("expiry").require(last >= first, f"a date from {first} on, not {last}")
        distribution, half_width = _split_distribution(keys.u)
        u = _read_size(half_width, signal.unit, entry_place.at("u")) / WIDTHS[distribution]
        noise = 0.0 if keys.noise is None else _read_size(keys.noise, signal.unit, entry_place.at("noise"))
        calibrations[signal.name] = SensorCalibration(signal.name, signal.unit, keys.identifier, first, last, u,
                                                      distribution, keys.gain, noise)
    return decision, calibrations


def _read_date(text: str, place: Place) -> datetime.date:
    try:
        return datetime.date.fromisoformat(text)
    except ValueError:
        raise place.refuse(f"a date such as 2026-03-01, not {text[:40]!r}") from None


def _split_distribution(text: str) -> tuple[str, str]:
    """The distribution that a text names, and the size behind it.

    >>> _split_distribution("rectangular ±5 um"), _split_distribution("2 um")
    (('rectangular', '5 um'), ('normal', '2 um'))
    """
    word, _, rest = text.strip().partition(" ")
    return (word, rest.strip().removeprefix("±")) if word in WIDTHS else ("normal", text)


def _read_size(text: str, unit: str, place: Place) -> float:
    """A size above 0 in an SI unit."""
    size = float(parse_quantity(text, unit, place))
    place.require(size > 0.0, f"a size above 0, not {text!r}")
    return size
