"""Makes a plant of a foreign unit: from a table [plant] that maps its variables, or from the names of the unit alone.

    [plant]
    file = "ema.fmu"
    seed = "noise_seed"                             # optional: the variable that takes the seed of a run
    [plant.inputs]                                  # signal = variable, or with what one of the variable is worth
    current = { variable = "motor.i_ref", count = "1 mA" }
    load_force = "F_ext"
    [plant.outputs]                                 # the first is the one that the controller controls
    ram_position = { variable = "x", count = "1 mm", noise = "1 um" }
    [plant.parameters]                              # what --set and rig identify may change
    screw.stiffness = { variable = "k", range = [1e6, 1e9] }
"""

import re
from collections import namedtuple
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from math import inf, nan
from pathlib import Path
from typing import Annotated, Any, NamedTuple, cast

from plant import (
    EHA,
    Controller,
    Place,
    Plant,
    Quantity,
    Signal,
    build_dataclass,
    convert_group_unit,
    decode_text,
    find_plant,
    find_unit,
    fit_unit,
    keep_plant,
    parse_quantity,
    parse_table,
    read_file,
)
from rig.fmi.foreign import Description, Port, Unit, find_variable, read_description

_COLUMNS = EHA.aliases  # these keep their columns and meaning; other names are new signals


@dataclass(frozen=True)
class Entry:
    """What a signal or parameter is in the unit."""

    variable: str
    count: str | None = None  # what one of the variable is worth; default: its unit in the description
    noise: str | None = None  # of the sensor of an output, RMS
    role: str | None = None  # "load" for a new input that is an external load; default: it drives the plant
    range: tuple[float, float] | None = None  # of a parameter


Entries = dict[str, tuple[Entry, Place]]


def load_fmu_plant(path: Path) -> Plant:
    """The plant of an FMU whose variables have the names of signals, or of a TOML file with a table [plant].

    Raises:
        InputError: the FMU cannot run here, or a key that cannot be used, and what was expected.
    """
    if path.suffix == ".fmu":
        return declare_plant(path, {}, Place(str(path)), str(path))
    tables, place = parse_table(decode_text(read_file(path), path), str(path))
    table = tables.get("plant")
    if not isinstance(table, dict) or not isinstance(table.get("file"), str):
        raise place.at("plant").refuse('a table [plant] with file = "NAME.fmu"')
    file_values = {f"{group}.{field}": value for group, fields in tables.items() if isinstance(fields, dict)
                   for field, value in fields.items() if isinstance(value, int | float)}  # checked with the model's
    return declare_plant(path.parent / table["file"], table, place.at("plant"), str(path), file_values)


def declare_plant(file: Path, table: Mapping[str, Any], place: Place, key: str,
                  file_values: Mapping[str, float] = {}) -> Plant:
    """The plant of the unit in `file` as `table` maps it; `key` is what models call it.

    `file_values`: parameters in the TOML file.

    Raises:
        InputError: see `load_fmu_plant`.
    """
    about = read_description(file)
    table_keys = ("file", "seed", "inputs", "outputs", "parameters")
    for name in table:
        place.at(name).require(name in table_keys, f"one of {', '.join(table_keys)}")
    inputs, outputs, parameters = (
        dict(_list_entries(table[name], place.at(name))) if name in table else _guess_entries(about, name, place)
        for name in table_keys[2:])
    variable_list = ", ".join(f"{v.causality} {n}" for n, v in about.variables.items()
                              if v.causality in ("input", "output"))
    place.require(inputs and outputs,
                  f"tables [plant.inputs] and [plant.outputs], SIGNAL = VARIABLE; the unit has {variable_list}")
    input_ports = [_map_signal(about, name, *entry, "input") for name, entry in inputs.items()]
    output_ports = [_map_signal(about, name, *entry, "output") for name, entry in outputs.items()]
    place.at("inputs").require(sorted(s.role for s, _ in input_ports) in (["drive"], ["drive", "load"]),
                               'one signal that drives the plant, and at most one of role = "load"')
    input_ports.sort(key=lambda item: item[0].role)
    first, drive = output_ports[0][0], input_ports[0][0]
    command = EHA.command if first.name == EHA.controlled.name else Signal(
        "demand", f"{first.symbol}_c", first.unit, f"demand of {first.quantity}", "command")
    groups: dict[str, dict[str, Any]] = {}
    values: dict[str, float] = {}
    ports = [Port("seed", find_variable(about, table.get("seed", "seed"), ("parameter",), place.at("seed")))
             ] if "seed" in table or (not table and "seed" in about.variables) else []
    for name, (entry, where) in parameters.items():
        port, quantity, start = _map_parameter(about, name, entry, where)
        values[name] = file_values.get(name, start)
        where.require(name in file_values or not quantity.refuses(start),
                      f"a start value of {entry.variable} in the unit, or {name} in this file: {quantity.expected}; "
                      f"the unit has {about.variables[entry.variable].start or 'none'}")
        group, _, field = name.partition(".")
        groups.setdefault(group, {})[field] = Annotated[float, quantity]
        ports.append(port)
    types: dict[str, Any] = {
        group: NamedTuple(group.title().replace("_", ""), list(fields.items()))
        for group, fields in groups.items()}
    is_usual = drive.name == EHA.drive.name
    same = EHA.controlled
    law = Controller if first.unit == same.unit else convert_group_unit(Controller, same.unit, first.unit, inf)
    types["controller"] = law if is_usual else convert_group_unit(law, EHA.drive.unit, drive.unit, inf)
    values |= {name: value for name, value in find_plant("eha").nominal.items()
               if name == "controller.period" or (is_usual and name.startswith("controller."))}
    values["controller.period"] = file_values.get("controller.period", values["controller.period"])
    values.setdefault("controller.current_limit", 1e9)  # of a drive in another unit none is known
    state = make_state_type(tuple(signal.name for signal, _ in output_ports))
    columns = (command, first, drive, *(s for s, _ in output_ports[1:]), *(s for s, _ in input_ports[1:]))
    # the unit keeps its step to itself; its state is what it has shown
    return keep_plant(Plant(
        signals=cast(Any, columns), parameters=types, state=state, step=lambda s, m, u, p: (s, m),
        measure=lambda s, p: s, moves=(), title=f"FMU {file.name}", name=file.stem, values=values, file=file, key=key,
        foreign=partial(Unit, about, [port for _, port in input_ports], [port for _, port in output_ports], ports)))


def make_state_type(names: tuple[str, ...]) -> type[Any]:
    """The state of the plant as far as it is known: what the unit has shown last."""
    make: Any = namedtuple
    return cast("type[Any]", make("Held", names, defaults=(0.0,) * len(names)))


def _list_entries(table: object, place: Place, prefix: str = "") -> Iterator[tuple[str, tuple[Entry, Place]]]:
    """The entries of a table by name; a table without `variable` holds names with a dot."""
    if not isinstance(table, dict):
        raise place.refuse("a table NAME = VARIABLE")
    for key, value in table.items():
        at = place.at(key)
        if isinstance(value, str):
            yield prefix + key, (Entry(value), at)
        elif isinstance(value, dict) and isinstance(value.get("variable", {}), dict):
            yield from _list_entries(value, at, f"{prefix}{key}.")
        else:
            yield prefix + key, (build_dataclass(Entry, value, at), at)


def _guess_entries(about: Description, table: str, place: Place) -> Entries:
    """Variables with names of signals of the EHA; as parameters those with one dot in their name and a start value."""
    signal_names = {*_COLUMNS.values()} - {"com"}
    return {name: (Entry(name), place) for name, v in about.variables.items()
            if v.causality == table.removesuffix("s") and v.type in ("Real", "Float64")
            and (v.start is not None and re.fullmatch(r"(?!controller\b)\w+\.\w+", name) if table == "parameters" else
                 _COLUMNS.get(name, name) in signal_names)}


def _map_signal(about: Description, name: str, entry: Entry, place: Place, causality: str) -> tuple[Signal, Port]:
    """A signal and its variable."""
    signal = {s.name: s for s in EHA}.get(_COLUMNS.get(name, name))
    if signal is not None and (signal.role == "output") != (causality == "output"):
        signal = None  # a measured current is not that of the servovalve, which drives it
    worth, unit = _find_worth(about, entry, "" if signal is None else signal.unit, place)
    port = Port(name, find_variable(about, entry.variable, (causality,), place), worth)
    noise = float(parse_quantity(entry.noise, unit, place.at("noise"))) if entry.noise else ""
    if signal is None:
        signal = Signal(name, name, unit, name.replace("_", " "), entry.role or "drive")
    # the unit has stops of its own; the current's limit is the controller's, which this plant has
    return signal._replace(noise=noise, limit=signal.limit if signal.role == "drive" else "",
                           role="output" if causality == "output" else signal.role), port._replace(name=signal.name)


def _find_worth(about: Description, entry: Entry, unit: str, place: Place) -> tuple[float, str]:
    """What one of a variable is worth, and the SI unit; `unit` is that of the signal, "" if it has none of its own."""
    variable_unit = _find_attribute(about, entry.variable, "unit") or ""
    if entry.count is not None:
        number, _, unit_name = entry.count.partition(" ")
        definition = find_unit(unit_name)
        si = unit or (definition.si if definition else unit_name or "1")
        count, of = (entry.count, si) if unit or definition is not None else (number, "")
        worth = float(parse_quantity(count, of, place.at("count")))
        place.at("count").require(worth, "a number other than 0")
        return worth, si
    definition = find_unit(variable_unit)
    si_unit = unit or (definition.si if definition else "")
    if si_unit and (conversion := fit_unit(variable_unit, si_unit)) is not None:
        return float(conversion.factor), conversion.si
    if unit and variable_unit not in ("", unit):
        raise place.refuse(f'count = ".. {unit}": the variable {entry.variable} is in {variable_unit}')
    return 1.0, unit or variable_unit or "1"


def _map_parameter(about: Description, name: str, entry: Entry, place: Place) -> tuple[Port, Quantity, float]:
    """A parameter, its meaning and its start value, NaN without one."""
    place.require(re.fullmatch(r"\w+\.\w+", name), "GROUP.NAME = VARIABLE")
    port = Port(name, find_variable(about, entry.variable, ("parameter",), place))
    worth, unit = _find_worth(about, entry, "", place)
    variable = about.variables[entry.variable]
    ends = {"min": 0.0, "max": 1.0} if variable.type == "Boolean" else {"min": -inf, "max": inf}
    low, high = entry.range or sorted(worth * _read_number(_find_attribute(about, entry.variable, name), far)
                                      for name, far in ends.items())
    quantity = Quantity(unit, low=low, high=high, is_whole=port.variable[1] not in ("Real", "Float64", "Float32"))
    return port._replace(worth=worth), quantity, worth * _read_number(variable.start, nan)


def _find_attribute(about: Description, name: str, attribute: str) -> Any:
    """An attribute of a variable, else of its type; None if neither has it."""
    variable = about.variables.get(name)
    own = getattr(variable, attribute, None)
    return getattr(getattr(variable, "declaredType", None), attribute, None) if own is None else own


def _read_number(text: Any, default: float) -> float:
    """A number of the description; true is 1."""
    words = {"true": 1.0, "false": 0.0, None: default}
    return words[text] if text in words else float(text)
