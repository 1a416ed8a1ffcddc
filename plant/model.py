"""A model: a plant, its parameter values, and the effects it has. Data; it becomes code when it is run."""
from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plant import flat, plants, solve
from plant import step as step_module
from plant.compile import Function, cache_folder, compiled, fingerprint, interpreted
from plant.effects import CATALOGUE, Effect, at
from plant.errors import InputError
from plant.machine_code import StoredCode
from plant.parameters import accept, flatten, read_toml, resolve, sensible
from plant.plants import Plant
from plant.quantity import Quantity
from plant.state import Input, Ports, State

STEPS = 100  # steps a cycle: 10 us; its error is measured in the docs


def known_groups(effects: Iterable[str] | None = None, plant: str = "eha") -> dict[str, type[Any]]:
    """Every parameter group: the plant's own and those of `effects` (default: all in the catalogue that suit it)."""
    kind = plants.find(plant)
    chosen = offered(plant) if effects is None else [CATALOGUE[name] for name in effects]
    return {**kind.groups, **{e.name: e.group for e in chosen if e.group is not None}}


def offered(plant: str = "eha") -> list[Effect]:
    """The effects of the catalogue that make sense in a plant."""
    kind = plants.find(plant)
    return [e for e in CATALOGUE.whole().values() if kind.offers(e)]


def meaning(name: str, where: object = "--set", plant: str = "eha") -> Quantity:
    """What the parameter "group.field" means, whichever effect it belongs to.

    Raises:
        InputError: there is no such parameter.
    """
    return resolve(where, name, known_groups(plant=plant))


@dataclass(frozen=True)
class Model:
    """A plant with parameter `values` ("group.field" to SI number) and `effects`, in catalogue order."""

    name: str = "eha"
    values: Mapping[str, float] = field(default_factory=lambda: dict(plants.find("eha").nominal))
    effects: tuple[str, ...] = ()
    plant: str = "eha"

    @property
    def kind(self) -> Plant:
        """The plant itself: what the values are values of."""
        return plants.find(self.plant)

    def replace(self, changes: Mapping[str, object], where: object = "--set") -> Model:
        """The model with some parameters changed; naming an effect's parameter gives the model that effect.

        Raises:
            InputError: an unknown name, an impossible value, or values that contradict each other.
        """
        known = known_groups(plant=self.plant)
        values = {name: accept(where, name, resolve(where, name, known), value) for name, value in changes.items()}
        model = self.having(name.partition(".")[0] for name in changes)
        merged = {**model.values, **values}
        sensible(where, merged)
        compatible(where, model.effects, merged)
        return replace(model, values=merged)

    def having(self, groups: Iterable[str]) -> Model:
        """The model with the effects among `groups` added at their off values."""
        wanted = set(groups) | set(self.effects)
        effects = tuple(e.name for e in CATALOGUE.whole().values() if e.name in wanted and not e.base)
        usual = self.kind.nominal
        off = {name: usual.get(name, value) for e in effects if e not in self.effects
               for name, value in CATALOGUE[e].off.items()}
        return replace(self, values={**self.values, **off}, effects=effects)

    def __getitem__(self, name: str) -> float:
        return self.values[name]

    def differences(self) -> dict[str, float]:
        """What is not nominal: changed parameters, and all parameters of the effects it has."""
        base = self.kind.nominal
        return {name: value for name, value in self.values.items() if base.get(name) != value}

    def to_toml(self) -> str:
        """The model file that `load_model` reads back."""
        effects = ", ".join(f'"{e}"' for e in self.effects)
        name = json.dumps(self.name, ensure_ascii=False).replace("\x7f", "\\u007f")  # a JSON text is TOML but for this
        plant = [] if self.plant == "eha" else [f'plant = "{self.plant}"']
        lines = [f"name = {name}", *plant, f"effects = [{effects}]"]
        group = ""
        for name, value in self.differences().items():
            head, _, tail = name.partition(".")
            if head != group:
                group = head
                lines += ["", f"[{group}]"]
            quantity = meaning(name, plant=self.plant)
            word = next((f'"{w}"' for w, number in quantity.words.items() if number == value), repr(value))
            lines.append(f"{tail} = {word}" + (f"  # {quantity.unit}" if quantity.unit != "1" else ""))
        return "\n".join(lines) + "\n"

    def names(self) -> list[str]:
        """The parameters "group.field", in the order of `record`."""
        return [f"{group}.{f}" for group, cls in self._groups().items() for f in cls._fields]

    def _groups(self) -> dict[str, type[Any]]:
        return known_groups(self.effects, self.plant)

    def record(self) -> NDArray[Any]:
        """The values as a one-row record array, fields group.field: what compiled code reads, live."""
        groups = self._groups()
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
    """The nominal model of a plant ("eha", "ehs") or the model in a TOML file: what differs from nominal, by group.

    Raises:
        InputError: no such file, or an unknown group, field, effect or impossible value in it.
    """
    if str(source) in plants.names():
        return bare(str(source)).having(plants.find(str(source)).has)
    path = Path(source)
    if not path.is_file():
        raise InputError(source, "", f"a model file, or one of {', '.join(plants.names())} for a nominal model")
    return parse_model(read_toml(path), path, path.stem)


def bare(plant: str, name: str = "") -> Model:
    """A plant at its nominal values, without effects."""
    kind = plants.find(plant)
    own = {n: v for n, v in kind.nominal.items() if n.partition(".")[0] in kind.groups}
    return Model(name or plant, own, (), plant)


def parse_model(tables: Mapping[str, Any], where: object, name: str = "eha") -> Model:
    """The model from the tables of a model file."""
    tables = dict(tables)
    name, effects = tables.pop("name", name), tables.pop("effects", [])
    plant = tables.pop("plant", "eha")
    tables.pop("provenance", None)
    if not isinstance(name, str) or not name:
        raise InputError(where, "name", f"a text, not {name!r}")
    if plant not in plants.names():
        raise InputError(where, "plant", f"one of {', '.join(plants.names())}, not {plant!r}")
    known = [e.name for e in offered(plant)]  # a list, as what stands in a file need not be hashable
    unknown = [e for e in effects if e not in known] if isinstance(effects, list) else [effects]
    if unknown:
        raise InputError(where, "effects", f"names of effects (rig effects lists them), not {unknown[0]!r}")
    return bare(plant, name).having(effects).replace(flatten(where, tables, known_groups(plant=plant)), where)


def compatible(where: object, effects: Iterable[str], values: Mapping[str, float]) -> None:
    """Refuse two effects at work that exclude each other; at its off value one may stand beside the other."""
    working = {e for e in effects if CATALOGUE[e].acts(values)}
    for e in sorted(working):
        for other in working.intersection(CATALOGUE[e].excludes):
            raise InputError(where, e, f"{e} or {other}, not both at work")


def entry(name: str, plant: str = "eha") -> Effect:
    """An effect of the catalogue by name, as far as it makes sense in a plant.

    Raises:
        InputError: there is none of that name.
    """
    known = {e.name: e for e in offered(plant)}
    if name not in known:
        raise InputError("effect", name, f"one of {', '.join(known)}")
    return known[name]


def initial(effects: tuple[str, ...]) -> State:
    """The actuator at rest with the memory of `effects`."""
    return State(memory=Ports(*(at(port, effects)[1] for port in Ports._fields)))


def kernel(name: str, effects: tuple[str, ...], fast: bool = True, plant: str = "eha") -> Function:
    """The function `plant.solve.<name>` for a plant with `effects`, compiled once per set, or interpreted."""
    laws = tuple(CATALOGUE[e].function for e in effects)
    return _kernel(name, effects, laws, fast, plant)


@cache
def _kernel(name: str, effects: tuple[str, ...], laws: tuple[Any, ...], fast: bool, plant: str) -> Function:
    return (compiled if fast else interpreted)(getattr(solve, name), bindings(effects, plant))


def stored_advance(effects: tuple[str, ...], plant: str = "eha") -> StoredCode:
    """The compiled `plant.solve.advance` for a plant with `effects`, from disk if it was stored there."""
    return _stored_advance(effects, tuple(CATALOGUE[e].function for e in effects), plant)


@cache
def _stored_advance(effects: tuple[str, ...], laws: tuple[Any, ...], plant: str) -> StoredCode:
    source = fingerprint(interpreted(solve.advance, bindings(effects, plant)))
    return StoredCode(cache_folder() / source, lambda: _kernel("advance", effects, laws, True, plant))


def bindings(effects: tuple[str, ...], plant: str = "eha") -> dict[str, Function]:
    """What stands for step, port functions and the packing of the state in a plant with `effects`."""
    ports = {f"at_{port}": at(port, effects)[0] for port in Ports._fields}
    kind = plants.find(plant)
    ports["step"], ports["coefficients"] = kind.step, kind.coefficients
    ports["pack"], ports["unpack"] = flat.packers(initial(effects))
    if any(CATALOGUE[e].port in ("supply", "viscosity") for e in effects):
        ports["oiled"] = step_module.changing_oil
    if kind.step is not step_module.step or any(CATALOGUE[e].port in ("valve", "jack_drag") for e in effects):
        ports["yielding"] = step_module.as_resisted
    return ports
