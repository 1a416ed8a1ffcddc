"""A model: the reference plant, its parameter values, and the effects it has. Data; it becomes code when it is run."""
from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plant import flat, solve
from plant import step as step_module
from plant.compile import Function, compiled, interpreted
from plant.effects import CATALOGUE, Effect, at
from plant.errors import InputError
from plant.parameters import GROUPS, accept, flatten, nominal, read_toml, resolve, sensible
from plant.quantity import Quantity
from plant.state import Input, Ports, State

STEPS = 100  # steps a cycle: 10 us; its error is measured in the docs


def known_groups(effects: Iterable[str] | None = None) -> dict[str, type[Any]]:
    """Every parameter group: the reference model's and those of `effects` (default: all in the catalogue)."""
    chosen = [CATALOGUE[name] for name in effects] if effects is not None else list(CATALOGUE.values())
    return GROUPS | {e.name: e.group for e in chosen if e.group is not None}


def meaning(name: str, where: object = "--set") -> Quantity:
    """What the parameter "group.field" means, whichever effect it belongs to.

    Raises:
        InputError: there is no such parameter.
    """
    return resolve(where, name, known_groups())


@dataclass(frozen=True)
class Model:
    """The reference plant with parameter `values` ("group.field" to SI number) and `effects`, in catalogue order."""

    name: str = "eha"
    values: Mapping[str, float] = field(default_factory=nominal)
    effects: tuple[str, ...] = ()

    def replace(self, changes: Mapping[str, object], where: object = "--set") -> Model:
        """The model with some parameters changed; naming an effect's parameter gives the model that effect.

        Raises:
            InputError: an unknown name, an impossible value, or values that contradict each other.
        """
        values = {name: accept(where, name, meaning(name, where), value) for name, value in changes.items()}
        model = self.having(name.partition(".")[0] for name in changes)
        merged = {**model.values, **values}
        sensible(where, merged)
        compatible(where, model.effects, merged)
        return Model(model.name, merged, model.effects)

    def having(self, groups: Iterable[str]) -> Model:
        """The model with the effects among `groups` added at their off values."""
        wanted = set(groups) | set(self.effects)
        effects = tuple(e.name for e in CATALOGUE.values() if e.name in wanted and not e.base)
        off = {name: value for e in effects if e not in self.effects for name, value in CATALOGUE[e].off.items()}
        return Model(self.name, {**self.values, **off}, effects)

    def __getitem__(self, name: str) -> float:
        return self.values[name]

    def differences(self) -> dict[str, float]:
        """What is not nominal: changed parameters, and all parameters of the effects it has."""
        base = nominal()
        return {name: value for name, value in self.values.items() if base.get(name) != value}

    def to_toml(self) -> str:
        """The model file that `load_model` reads back."""
        effects = ", ".join(f'"{e}"' for e in self.effects)
        name = json.dumps(self.name, ensure_ascii=False).replace("\x7f", "\\u007f")  # a JSON text is TOML but for this
        lines = [f"name = {name}", f"effects = [{effects}]"]
        group = ""
        for name, value in self.differences().items():
            head, _, tail = name.partition(".")
            if head != group:
                group = head
                lines += ["", f"[{group}]"]
            quantity = meaning(name)
            word = next((f'"{w}"' for w, number in quantity.words.items() if number == value), repr(value))
            lines.append(f"{tail} = {word}" + (f"  # {quantity.unit}" if quantity.unit != "1" else ""))
        return "\n".join(lines) + "\n"

    def names(self) -> list[str]:
        """The parameters "group.field", in the order of `record`."""
        return [f"{group}.{f}" for group, cls in known_groups(self.effects).items() for f in cls._fields]

    def record(self) -> NDArray[Any]:
        """The values as a one-row record array, fields group.field: what compiled code reads, live."""
        groups = known_groups(self.effects)
        inner = {group: np.dtype((np.record, [(f, float) for f in cls._fields])) for group, cls in groups.items()}
        row = tuple(tuple(self.values[f"{group}.{f}"] for f in cls._fields) for group, cls in groups.items())
        return np.array([row], np.dtype((np.record, list(inner.items()))))

    def state(self) -> State:
        """The centred actuator at rest, with the memory of this model's effects, as its transducer shows it."""
        s = initial(self.effects)
        if not any(CATALOGUE[e].port == "position" for e in self.effects):
            return s
        law = at("position", self.effects)[0]  # once in plain Python: the first sample comes before the first step
        return s._replace(sensed=float(law(s.jack_position, s.memory.position, s, Input(), self.record()[0])[0]))


def load_model(source: str | Path = "eha") -> Model:
    """The nominal model ("eha") or the model in a TOML file: what differs from nominal, by group.

    Raises:
        InputError: no such file, or an unknown group, field, effect or impossible value in it.
    """
    if str(source) == "eha":
        return Model()
    path = Path(source)
    if not path.is_file():
        raise InputError(source, "", 'a model file, or "eha" for the nominal model')
    return parse_model(read_toml(path), path, path.stem)


def parse_model(tables: Mapping[str, Any], where: object, name: str = "eha") -> Model:
    """The model from the tables of a model file."""
    tables = dict(tables)
    name, effects = tables.pop("name", name), tables.pop("effects", [])
    tables.pop("provenance", None)
    if not isinstance(name, str) or not name:
        raise InputError(where, "name", f"a text, not {name!r}")
    known = list(CATALOGUE)  # a list, as what stands in a file need not be hashable
    unknown = [e for e in effects if e not in known] if isinstance(effects, list) else [effects]
    if unknown:
        raise InputError(where, "effects", f"names of effects (rig effects lists them), not {unknown[0]!r}")
    return Model(name).having(effects).replace(flatten(where, tables, known_groups()), where)


def compatible(where: object, effects: Iterable[str], values: Mapping[str, float]) -> None:
    """Refuse two effects at work that exclude each other; at its off value one may stand beside the other."""
    working = {e for e in effects if CATALOGUE[e].acts(values)}
    for e in sorted(working):
        for other in working.intersection(CATALOGUE[e].excludes):
            raise InputError(where, e, f"{e} or {other}, not both at work")


def entry(name: str) -> Effect:
    """An effect of the catalogue by name.

    Raises:
        InputError: there is none of that name.
    """
    if name not in CATALOGUE:
        raise InputError("effect", name, f"one of {', '.join(CATALOGUE)}")
    return CATALOGUE[name]


def initial(effects: tuple[str, ...]) -> State:
    """The actuator at rest with the memory of `effects`."""
    return State(memory=Ports(*(at(port, effects)[1] for port in Ports._fields)))


def kernel(name: str, effects: tuple[str, ...], fast: bool = True) -> Function:
    """The function `plant.solve.<name>` for a model with `effects`, compiled once per set, or interpreted."""
    laws = tuple(CATALOGUE[e].function for e in effects)
    return _kernel(name, effects, laws, fast)


@cache
def _kernel(name: str, effects: tuple[str, ...], laws: tuple[Any, ...], fast: bool) -> Function:
    return (compiled if fast else interpreted)(getattr(solve, name), bindings(effects))


def bindings(effects: tuple[str, ...]) -> dict[str, Function]:
    """What stands for the port functions, and for the packing of the state, in a model with `effects`."""
    ports = {f"at_{port}": at(port, effects)[0] for port in Ports._fields}
    ports["pack"], ports["unpack"] = flat.packers(initial(effects))
    if any(CATALOGUE[e].port in ("supply", "viscosity") for e in effects):
        ports["oiled"] = step_module.changing_oil
    return ports
