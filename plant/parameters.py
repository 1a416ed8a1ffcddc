"""The parameters of the actuator: a group for each component, every field with unit, symbol and range.

The values are data (`plant/models/nominal.toml`); this file gives their meaning and rejects impossible values. The
ranges are wide, about three orders of magnitude either way: a value outside is a mistake (a unit, an exponent), and for
every value inside the simulation stays finite.
"""

import math
import tomllib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from plant.errors import InputError, require, show_value, suggest_name
from plant.quantity import Quantity, list_quantities, make_group
from plant.tables import decode_text, parse_table, read_file

# Exponent of (1 - Kintas) on the pilot flow gain; pressures scale with (1 - Kintas) in all three. "sqrt": an orifice
# bridge fed through a filter; "linear": flow in proportion; "pressure": flow gain untouched.
FILTER_LAWS = {"sqrt": 0.5, "linear": 1.0, "pressure": 0.0}


# group: what it is, and its fields
_FIELDS: Mapping[str, tuple[str, Mapping[str, Quantity]]] = {
    "controller": ("The position loop of the reference firmware: a PID law on the sensed error, limited.", {
        "proportional_gain": Quantity("A/m", "GAP", low=0, high=1e6),
        "integral_gain": Quantity("A/(m s)", low=0, high=1e9),
        "derivative_gain": Quantity("A s/m", low=0, high=1e6),
        "current_limit": Quantity("A", "Imax", low=1e-6, high=20),
        "period": Quantity("s", low=1e-4, high=0.1)}),
    "torque_motor": ("Current to torque on the flapper.", {
        "gain": Quantity("N m/A", "GM", low=1e-3, high=1e3, tolerance=0.015)}),
    "flapper": ("The armature and flapper, between two inelastic stops.", {
        "inertia": Quantity("N m s2/m", "JF", low=1e-9, high=1, tolerance=0.015),
        "damping": Quantity("N m s/m", "BF", low=0, high=1e3, tolerance=0.015),
        "stiffness": Quantity("N m/m", "KF", low=1e-2, high=1e6, tolerance=0.015),
        "travel": Quantity("m", "XFM", low=1e-7, high=1e-2)}),
    "feedback_spring": ("The wire from spool to flapper.", {
        "stiffness": Quantity("N m/m", "KSF", low=1e-6, high=1e5, tolerance=0.015)}),
    "filter": ("The pilot stage's filter.", {
        "clogging": Quantity("1", "Kintas", low=0, below=1),
        "law": Quantity("1", words=FILTER_LAWS)}),
    "pilot": ("The double nozzle with a clean filter.", {
        "flow_gain": Quantity("m2/s", "GQF", low=1e-5, high=1e2, tolerance=0.015),
        "pressure_gain": Quantity("Pa/m", "GPF", low=1e8, high=1e15, tolerance=0.015)}),
    "spool": ("The second stage.", {
        "end_area": Quantity("m2", "ASV", low=1e-8, high=0.1),
        "mass": Quantity("kg", "MS", low=1e-6, high=100),
        "damping": Quantity("N s/m", "CS", low=0, high=1e6),
        "static_friction": Quantity("N", "FSS", low=0, high=1e6),
        "dynamic_friction": Quantity("N", "FDS", low=0, high=1e6),
        "travel": Quantity("m", "XSM", low=1e-6, high=1)}),
    "valve": ("The metering edges, linearised.", {
        "flow_gain": Quantity("m2/s", "GQ", low=1e-5, high=1e3, tolerance=0.015),
        "pressure_gain": Quantity("Pa/m", "GP", low=1e8, high=1e15, tolerance=0.015)}),
    "supply": ("The hydraulic supply.", {
        "pressure": Quantity("Pa", "PSR", low=1e5, high=1e8, tolerance=0.015)}),
    "jack": ("The cylinder with the surface it moves.", {
        "area": Quantity("m2", "AJ", low=1e-7, high=1, tolerance=0.015),
        "mass": Quantity("kg", "MJ", low=1e-2, high=1e6, tolerance=0.015),
        "damping": Quantity("N s/m", "CJ", low=0, high=1e9, tolerance=0.015),
        "static_friction": Quantity("N", "FSJ", low=0, high=1e7, tolerance=0.015),
        "dynamic_friction": Quantity("N", "FDJ", low=0, high=1e7, tolerance=0.015),
        "leakage": Quantity("m3/s/Pa", "CLK", low=0, high=1e-6, tolerance=0.015),
        "travel": Quantity("m", "XJM", low=1e-4, high=10)}),
    "sensors": ("White noise of the bench's transducers, one sample a cycle.", {
        "position_noise": Quantity("m rms", low=0, high=1),
        "pressure_noise": Quantity("Pa rms", low=0, high=1e8),
        "spool_noise": Quantity("m rms", low=0, high=1)}),
}
GROUPS = {name: make_group(name.title().replace("_", ""), meaning, fields, __name__)
          for name, (meaning, fields) in _FIELDS.items()}
Controller = GROUPS["controller"]


def convert_group_unit(group: type[Any], unit: str, other: str, wider: float) -> type[Any]:
    """A parameter group whose fields are in another unit, such as raw/m for A/m, and as much wider in range."""
    quantities = {name: q._replace(unit=q.unit.replace(unit, other), high=wider * q.high) if unit in q.unit else q
                  for name, q in list_quantities(group).items()}
    return make_group(group.__name__, str(group.__doc__), quantities, __name__)


def parse_value(where: object, name: str, quantity: Quantity, value: object) -> float:
    """The number that `value`, a number or a word, stands for.

    Raises:
        InputError: not a number (or, for a choice, not one of its words), or out of range.
    """
    if isinstance(value, str) and value in quantity.words:
        return quantity.words[value]
    if isinstance(value, str):
        try:
            value = float(value)
        except ValueError:
            raise InputError(where, name, f"{quantity.expected}, not {show_value(value)}") from None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or abs(value) > 1e308:
        raise InputError(where, name, f"{quantity.expected}, not {show_value(value)}")
    require(not quantity.refuses(float(value)) and float(value) in (quantity.words.values() or (value,)), where, name,
            f"{quantity.expected}, not {value:g}")
    return float(value)


def find_field(where: object, name: str, groups: Mapping[str, type[Any]]) -> Quantity:
    """Unit, symbol and range of "group.field".

    Raises:
        InputError: no such group or field; the nearest name is offered.
    """
    group, _, field = name.partition(".")
    if group not in groups:
        raise InputError(where, name, f"a known group{_suggest_nearest(group, groups)}")
    quantities = list_quantities(groups[group])
    if field not in quantities:
        hint = _suggest_nearest(field, quantities) or f" ({', '.join(quantities)})"
        raise InputError(where, name, f"a field of {group}{hint}")
    return quantities[field]


def _suggest_nearest(word: str, names: Mapping[str, Any]) -> str:
    return suggest_name(word, names) or (f" ({', '.join(names)})" if len(names) < 8 else "")


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        InputError: unreadable, or not TOML (with the line).
    """
    return parse_toml(decode_text(read_file(path), path), path)


def parse_toml(text: str, where: object) -> dict[str, Any]:
    """The tables of a TOML text.

    Raises:
        InputError: not TOML (with the line), or nested too deeply.
    """
    return parse_table(text, str(where))[0]


def flatten_tables(where: object, tables: Mapping[str, Any], groups: Mapping[str, type[Any]]) -> dict[str, float]:
    """{"group": {"field": value}} as {"group.field": value}, with every value checked.

    Raises:
        InputError: an unknown group or field, or an impossible value, by name.
    """
    values: dict[str, float] = {}
    for group, fields in tables.items():
        require(isinstance(fields, Mapping), where, group, f"a table [{group}] of fields")
        for field, value in fields.items():
            name = f"{group}.{field}"
            values[name] = parse_value(where, name, find_field(where, name, groups), value)
    return values


def load_nominal_values() -> dict[str, float]:
    """The values of the nominal actuator, "group.field" to SI value."""
    return read_shipped_model("nominal.toml", GROUPS)


def read_shipped_model(file: str, groups: Mapping[str, type[Any]]) -> dict[str, float]:
    """The values in `plant/models/<file>`, "group.field" to SI value; `groups` are the parameter groups it may have.

    Raises:
        InputError: an unknown group or field, or a value out of range.
    """
    tables = tomllib.loads(files("plant").joinpath("models", file).read_text(encoding="utf-8"))
    tables.pop("identify", None)  # which parameters rig identify fits
    return flatten_tables(f"plant/models/{file}", tables, groups)


def check_combinations(where: object, values: Mapping[str, float]) -> None:
    """Refuse values that are possible alone and impossible together.

    Raises:
        InputError: such as a dynamic friction above the static one.
    """
    for body in ("spool", "jack"):
        static = values.get(f"{body}.static_friction", math.inf)  # a plant may lack one of them
        dynamic = values.get(f"{body}.dynamic_friction", -math.inf)
        require(dynamic <= static or math.isclose(dynamic, static), where, f"{body}.dynamic_friction",
                f"at most {body}.static_friction ({static:g} N), not {dynamic:g}")
