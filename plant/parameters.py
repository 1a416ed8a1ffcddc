"""What the actuator is made of: one NamedTuple a component, every field with unit, symbol and range.

The values are data (`plant/models/nominal.toml`); this file gives their meaning and rejects impossible values. The
ranges are wide, about three orders of magnitude either way: a value outside is a mistake (a unit, an exponent), and for
every value inside the simulation stays finite.
"""
from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from difflib import get_close_matches
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, NamedTuple, cast

from plant.errors import InputError
from plant.quantity import Quantity, quantities

FILTER_LAWS = {"sqrt": 0.5, "linear": 1.0, "pressure": 0.0}
"""Exponent of (1 - Kintas) on the pilot flow gain; pressures scale with (1 - Kintas) in all three.

"sqrt": an orifice bridge fed through a filter; "linear": flow in proportion; "pressure": flow gain untouched.
"""


def _q(unit: str, symbol: str = "", **more: Any) -> Quantity:
    return Quantity(unit, symbol, **more)


class Controller(NamedTuple):
    """The position loop of the reference firmware: a PID law on the sensed error, limited."""

    proportional_gain: Annotated[float, _q("A/m", "GAP", low=0, high=1e6)]
    integral_gain: Annotated[float, _q("A/(m s)", low=0, high=1e9)]
    derivative_gain: Annotated[float, _q("A s/m", low=0, high=1e6)]
    current_limit: Annotated[float, _q("A", "Imax", low=1e-6, high=20)]
    period: Annotated[float, _q("s", low=1e-4, high=0.1)]


class TorqueMotor(NamedTuple):
    """Current to torque on the flapper."""

    gain: Annotated[float, _q("N m/A", "GM", low=1e-3, high=1e3, tolerance=0.015)]


class Flapper(NamedTuple):
    """The armature and flapper, between two inelastic stops."""

    inertia: Annotated[float, _q("N m s2/m", "JF", low=1e-9, high=1, tolerance=0.015)]
    damping: Annotated[float, _q("N m s/m", "BF", low=0, high=1e3, tolerance=0.015)]
    stiffness: Annotated[float, _q("N m/m", "KF", low=1e-2, high=1e6, tolerance=0.015)]
    travel: Annotated[float, _q("m", "XFM", low=1e-7, high=1e-2)]


class FeedbackSpring(NamedTuple):
    """The wire from spool to flapper."""

    stiffness: Annotated[float, _q("N m/m", "KSF", low=1e-6, high=1e5, tolerance=0.015)]


class Filter(NamedTuple):
    """The pilot stage's filter."""

    clogging: Annotated[float, _q("1", "Kintas", low=0, below=1)]
    law: Annotated[float, _q("1", words=FILTER_LAWS)]


class Pilot(NamedTuple):
    """The double nozzle with a clean filter."""

    flow_gain: Annotated[float, _q("m2/s", "GQF", low=1e-5, high=1e2, tolerance=0.015)]
    pressure_gain: Annotated[float, _q("Pa/m", "GPF", low=1e8, high=1e15, tolerance=0.015)]


class Spool(NamedTuple):
    """The second stage."""

    end_area: Annotated[float, _q("m2", "ASV", low=1e-8, high=0.1)]
    mass: Annotated[float, _q("kg", "MS", low=1e-6, high=100)]
    damping: Annotated[float, _q("N s/m", "CS", low=0, high=1e6)]
    static_friction: Annotated[float, _q("N", "FSS", low=0, high=1e6)]
    dynamic_friction: Annotated[float, _q("N", "FDS", low=0, high=1e6)]
    travel: Annotated[float, _q("m", "XSM", low=1e-6, high=1)]


class Valve(NamedTuple):
    """The metering edges, linearised."""

    flow_gain: Annotated[float, _q("m2/s", "GQ", low=1e-5, high=1e3, tolerance=0.015)]
    pressure_gain: Annotated[float, _q("Pa/m", "GP", low=1e8, high=1e15, tolerance=0.015)]


class Supply(NamedTuple):
    """The hydraulic supply."""

    pressure: Annotated[float, _q("Pa", "PSR", low=1e5, high=1e8, tolerance=0.015)]


class Jack(NamedTuple):
    """The cylinder with the surface it moves."""

    area: Annotated[float, _q("m2", "AJ", low=1e-7, high=1, tolerance=0.015)]
    mass: Annotated[float, _q("kg", "MJ", low=1e-2, high=1e6, tolerance=0.015)]
    damping: Annotated[float, _q("N s/m", "CJ", low=0, high=1e9, tolerance=0.015)]
    static_friction: Annotated[float, _q("N", "FSJ", low=0, high=1e7, tolerance=0.015)]
    dynamic_friction: Annotated[float, _q("N", "FDJ", low=0, high=1e7, tolerance=0.015)]
    leakage: Annotated[float, _q("m3/s/Pa", "CLK", low=0, high=1e-6, tolerance=0.015)]
    travel: Annotated[float, _q("m", "XJM", low=1e-4, high=10)]


class Sensors(NamedTuple):
    """White noise of the bench's transducers, one sample a cycle."""

    position_noise: Annotated[float, _q("m rms", low=0, high=1)]
    pressure_noise: Annotated[float, _q("Pa rms", low=0, high=1e8)]
    spool_noise: Annotated[float, _q("m rms", low=0, high=1)]


GROUPS: dict[str, type[Any]] = {
    "controller": Controller, "torque_motor": TorqueMotor, "flapper": Flapper, "feedback_spring": FeedbackSpring,
    "filter": Filter, "pilot": Pilot, "spool": Spool, "valve": Valve, "supply": Supply, "jack": Jack,
    "sensors": Sensors,
}


def in_unit(group: type[Any], unit: str, other: str, wider: float) -> type[Any]:
    """A parameter group whose fields are in another unit, such as raw/m for A/m, and as much wider in range."""
    known = quantities(group).items()
    changed = [(name, q._replace(unit=q.unit.replace(unit, other), high=wider * q.high) if unit in q.unit else q)
               for name, q in known]
    made: Any = NamedTuple(group.__name__, [(name, Annotated[float, q]) for name, q in changed])  # type: ignore[misc]
    made.__doc__ = group.__doc__
    return cast("type[Any]", made)


def accept(where: object, name: str, quantity: Quantity, value: object) -> float:
    """`value` as the number it stands for.

    Raises:
        InputError: not a number (or, for a choice, not one of its words), or out of range.
    """
    if isinstance(value, str) and value in quantity.words:
        return quantity.words[value]
    if isinstance(value, str):
        try:
            value = float(value)
        except ValueError:
            raise InputError(where, name, f"{quantity.expected}, not {value!r}") from None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(where, name, f"{quantity.expected}, not {value!r}")
    if quantity.refuses(float(value)) or (quantity.words and float(value) not in quantity.words.values()):
        raise InputError(where, name, f"{quantity.expected}, not {value:g}")
    return float(value)


def resolve(where: object, name: str, groups: Mapping[str, type[Any]]) -> Quantity:
    """What "group.field" means.

    Raises:
        InputError: no such group or field; the nearest name is offered.
    """
    group, _, field = name.partition(".")
    if group not in groups:
        raise InputError(where, name, f"a known group{_nearest(group, groups)}")
    known = quantities(groups[group])
    if field not in known:
        raise InputError(where, name, f"a field of {group}{_nearest(field, known) or ' (' + ', '.join(known) + ')'}")
    return known[field]


def _nearest(word: str, known: Mapping[str, Any]) -> str:
    near = get_close_matches(word, known, 1, 0.6)
    return f"; did you mean {near[0]}?" if near else f" ({', '.join(known)})" if len(known) < 8 else ""


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        InputError: unreadable, or not TOML (with the line).
    """
    try:
        return parse_toml(path.read_text(encoding="utf-8"), path)
    except OSError as error:
        raise InputError(path, "", f"a readable file ({error.strerror})") from None
    except UnicodeDecodeError:
        raise InputError(path, "", "text in UTF-8") from None


def parse_toml(text: str, where: object) -> dict[str, Any]:
    """The tables of a TOML text.

    Raises:
        InputError: not TOML (with the line).
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(where, "", f"TOML ({error})") from None


def flatten(where: object, tables: Mapping[str, Any], groups: Mapping[str, type[Any]]) -> dict[str, float]:
    """{"group": {"field": value}} as {"group.field": value}, every value accepted or refused by name."""
    values: dict[str, float] = {}
    for group, fields in tables.items():
        if not isinstance(fields, Mapping):
            raise InputError(where, group, f"a table [{group}] of fields")
        for field, value in fields.items():
            name = f"{group}.{field}"
            values[name] = accept(where, name, resolve(where, name, groups), value)
    return values


def nominal() -> dict[str, float]:
    """The nominal actuator, "group.field" to SI value."""
    return dict(_nominal())


@cache
def _nominal() -> Mapping[str, float]:
    return read_shipped_model("nominal.toml", GROUPS)


def read_shipped_model(file: str, groups: Mapping[str, type[Any]]) -> dict[str, float]:
    """The values in `plant/models/<file>`, "group.field" to SI value; `groups` are the parameter groups it may have.

    Raises:
        InputError: an unknown group or field, or a value out of range.
    """
    source = files("plant").joinpath("models", file)
    return flatten(f"plant/models/{file}", tomllib.loads(source.read_text(encoding="utf-8")), groups)


def sensible(where: object, values: Mapping[str, float]) -> None:
    """Refuse combinations that no actuator can have, each value being possible alone."""
    for body in ("spool", "jack"):
        if f"{body}.static_friction" not in values:
            continue
        static, dynamic = values[f"{body}.static_friction"], values[f"{body}.dynamic_friction"]
        if dynamic > static and not math.isclose(dynamic, static):
            raise InputError(where, f"{body}.dynamic_friction",
                             f"at most {body}.static_friction ({static:g} N), not {dynamic:g}")
