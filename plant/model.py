"""A model: a plant, its parameter values, and the effects it has. Data; it becomes code when it is run."""
from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plant import flat, plants, solve
from plant import step as step_module
from plant.compile import Function, compile_function, compute_fingerprint, find_cache_folder, interpret_function
from plant.effects import CATALOGUE, Effect, combine_laws
from plant.errors import InputError
from plant.machine_code import StoredCode
from plant.parameters import check_combinations, find_field, flatten_tables, parse_value, read_toml
from plant.plants import Plant
from plant.quantity import Quantity
from plant.state import Input, Ports, State

STEPS = 100  # steps a cycle: 10 us; its error is measured in the docs


def find_parameter_groups(effects: Iterable[str] | None = None, plant: str = "eha") -> dict[str, type[Any]]:
    """Every parameter group: the plant's own and those of `effects` (default: all in the catalogue that suit it)."""
    kind = plants.find_plant(plant)
    chosen = list_offered_effects(plant) if effects is None else [CATALOGUE[name] for name in effects]
    return {**kind.groups, **{e.name: e.group for e in chosen if e.group is not None}}


def list_offered_effects(plant: str = "eha") -> list[Effect]:
    """The effects of the catalogue that make sense in a plant."""
    kind = plants.find_plant(plant)
    return [e for e in CATALOGUE.whole().values() if kind.offers(e)]


def find_quantity(name: str, where: object = "--set", plant: str = "eha") -> Quantity:
    """What the parameter "group.field" means, whichever effect it belongs to.

    Raises:
        InputError: there is no such parameter.
    """
    return find_field(where, name, find_parameter_groups(plant=plant))


@dataclass(frozen=True)
class Model:
    """A plant with parameter `values` ("group.field" to SI number) and `effects`, in catalogue order."""

    name: str = "eha"
    values: Mapping[str, float] = field(default_factory=lambda: dict(plants.find_plant("eha").nominal))
    effects: tuple[str, ...] = ()
    plant: str = "eha"

    @property
    def kind(self) -> Plant:
        """The plant itself: what the values are values of."""
        return plants.find_plant(self.plant)

    def replace(self, changes: Mapping[str, object], where: object = "--set") -> Model:
        """The model with some parameters changed; naming an effect's parameter gives the model that effect.

        Raises:
            InputError: an unknown name, an impossible value, or values that contradict each other.
        """
        known = find_parameter_groups(plant=self.plant)
        values = {name: parse_value(where, name, find_field(where, name, known), value)
                  for name, value in changes.items()}
        model = self.having(name.partition(".")[0] for name in changes)
        merged = {**model.values, **values}
        check_combinations(where, merged)
        check_exclusions(where, model.effects, merged)
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
            quantity = find_quantity(name, plant=self.plant)
            word = next((f'"{w}"' for w, number in quantity.words.items() if number == value), repr(value))
            lines.append(f"{tail} = {word}" + (f"  # {quantity.unit}" if quantity.unit != "1" else ""))
        return "\n".join(lines) + "\n"

    def names(self) -> list[str]:
        """The parameters "group.field", in the order of `record`."""
        return [f"{group}.{f}" for group, cls in self._groups().items() for f in cls._fields]

    def _groups(self) -> dict[str, type[Any]]:
        return find_parameter_groups(self.effects, self.plant)

    def record(self) -> NDArray[Any]:
        """The values as a one-row record array, fields group.field: what compiled code reads, live."""
        groups = self._groups()
        inner = {group: np.dtype((np.record, [(f, float) for f in cls._fields])) for group, cls in groups.items()}
        row = tuple(tuple(self.values[f"{group}.{f}"] for f in cls._fields) for group, cls in groups.items())
        return np.array([row], np.dtype((np.record, list(inner.items()))))

    def state(self) -> State:
        """The centred actuator at rest, with the memory of this model's effects, as its transducer shows it."""
        s = build_initial_state(self.effects)
        if not any(CATALOGUE[e].port == "position" for e in self.effects):
            return s
        # once in plain Python, because the first sample is read before the first step
        law = combine_laws("position", self.effects)[0]
        return s._replace(sensed=float(law(s.jack_position, s.memory.position, s, Input(), self.record()[0])[0]))


def load_model(source: str | Path = "eha") -> Model:
    """The nominal model of a plant ("eha", "ehs") or the model in a TOML file: what differs from nominal, by group.

    Raises:
        InputError: no such file, or an unknown group, field, effect or impossible value in it.
    """
    if str(source) in plants.list_plants():
        return build_bare_model(str(source)).having(plants.find_plant(str(source)).has)
    path = Path(source)
    if not path.is_file():
        raise InputError(source, "", f"a model file, or one of {', '.join(plants.list_plants())} for a nominal model")
    return parse_model(read_toml(path), path, path.stem)


def build_bare_model(plant: str, name: str = "") -> Model:
    """A plant at its nominal values, without effects."""
    kind = plants.find_plant(plant)
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
    if plant not in plants.list_plants():
        raise InputError(where, "plant", f"one of {', '.join(plants.list_plants())}, not {plant!r}")
    known = [e.name for e in list_offered_effects(plant)]  # a list, as what stands in a file need not be hashable
    unknown = [e for e in effects if e not in known] if isinstance(effects, list) else [effects]
    if unknown:
        raise InputError(where, "effects", f"names of effects (rig effects lists them), not {unknown[0]!r}")
    values = flatten_tables(where, tables, find_parameter_groups(plant=plant))
    return build_bare_model(plant, name).having(effects).replace(values, where)


def check_exclusions(where: object, effects: Iterable[str], values: Mapping[str, float]) -> None:
    """Refuse two effects at work that exclude each other; at its off value one may stand beside the other."""
    working = {e for e in effects if CATALOGUE[e].acts(values)}
    for e in sorted(working):
        for other in working.intersection(CATALOGUE[e].excludes):
            raise InputError(where, e, f"{e} or {other}, not both at work")


def find_effect(name: str, plant: str = "eha") -> Effect:
    """An effect of the catalogue by name, as far as it makes sense in a plant.

    Raises:
        InputError: there is none of that name.
    """
    known = {e.name: e for e in list_offered_effects(plant)}
    if name not in known:
        raise InputError("effect", name, f"one of {', '.join(known)}")
    return known[name]


def build_initial_state(effects: tuple[str, ...]) -> State:
    """The actuator at rest with the memory of `effects`."""
    return State(memory=Ports(*(combine_laws(port, effects)[1] for port in Ports._fields)))


def build_kernel(name: str, effects: tuple[str, ...], fast: bool = True, plant: str = "eha") -> Function:
    """The function `plant.solve.<name>` for a plant with `effects`, compiled once per set, or interpreted."""
    laws = tuple(CATALOGUE[e].function for e in effects)
    return _build_kernel(name, effects, laws, fast, plant)


@cache
def _build_kernel(name: str, effects: tuple[str, ...], laws: tuple[Any, ...], fast: bool, plant: str) -> Function:
    return (compile_function if fast else interpret_function)(getattr(solve, name), collect_bindings(effects, plant))


def stored_advance(effects: tuple[str, ...], plant: str = "eha") -> StoredCode:
    """The compiled `plant.solve.advance` for a plant with `effects`, from disk if it was stored there."""
    return _stored_advance(effects, tuple(CATALOGUE[e].function for e in effects), plant)


@cache
def _stored_advance(effects: tuple[str, ...], laws: tuple[Any, ...], plant: str) -> StoredCode:
    source = compute_fingerprint(interpret_function(solve.advance_flat_state, collect_bindings(effects, plant)))
    compile_code = partial(_build_kernel, "advance_flat_state", effects, laws, True, plant)
    return StoredCode(find_cache_folder() / source, compile_code)


def collect_bindings(effects: tuple[str, ...], plant: str = "eha") -> dict[str, Function]:
    """What stands for step, port functions and the packing of the state in a plant with `effects`."""
    ports = {f"at_{port}": combine_laws(port, effects)[0] for port in Ports._fields}
    kind = plants.find_plant(plant)
    ports["step_plant"], ports["compute_coefficients"] = kind.step, kind.coefficients
    ports["pack_state"], ports["unpack_state"] = flat.make_packers(build_initial_state(effects))
    if any(CATALOGUE[e].port in ("supply", "viscosity") for e in effects):
        ports["apply_oil"] = step_module.apply_changing_oil
    if kind.step is not step_module.step_plant or any(CATALOGUE[e].port in ("valve", "jack_drag") for e in effects):
        ports["compute_compliance"] = step_module.update_compliance
    return ports
