"""A model is data: a plant, its parameter values and its effects. `build_kernel` turns it into code."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import files
from itertools import groupby
from pathlib import Path
from textwrap import shorten
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from plant.compile import Function, compile_function, interpret_function
from plant.effects import CATALOGUE, Effect
from plant.errors import InputError, require, suggest_name
from plant.kernels import list_state_values
from plant.parameters import check_combinations, find_field, flatten_tables, parse_value
from plant.plant_files import READERS, read_model_tables, read_named_plant
from plant.plants import Plant, find_loaded_plant, find_plant, is_known, list_plants, load_plant
from plant.quantity import Quantity
from plant.solve import show_start
from plant.tables import quote_text

SHIPPED_MODELS = ("servo", "emps")  # plant/models/NAME.toml, beside the nominal values of the plants


def list_searched_effects(plant: str = "eha") -> list[Effect]:
    """The effects that `rig explain` tests on a plant without being asked."""
    return [e for e in find_plant(plant).list_effects() if not e.searched_in or plant in e.searched_in]


def find_quantity(name: str, where: object = "--set", plant: str = "eha") -> Quantity:
    """Unit, symbol and range of the parameter "group.field" of a plant or of any effect.

    Raises:
        InputError: there is no such parameter.
    """
    group = name.partition(".")[0]  # of parameters too, where a plant calls an effect by it
    own = {e.name: e.fitted for e in find_plant(plant).list_effects() if e.base}.get(group)
    require(not own or group in find_plant(plant).parameters, where, name,
            f"{' or '.join(own or ())}: the parameter that this effect is in this plant")
    return find_field(where, name, find_plant(plant).list_groups())


class ParameterRecord(np.record):  # type: ignore[misc]  # its stubs call the base final
    """Parameters by name; a field comes before an attribute that NumPy's records have for themselves, such as size."""

    def __getattribute__(self, name: str) -> Any:
        try:
            return self[name]
        except (ValueError, KeyError):  # there is no such field
            return super().__getattribute__(name)


@dataclass(frozen=True)
class Model:
    """A plant with parameter `values` ("group.field" to SI number) and `effects`, in catalogue order."""

    name: str = "eha"
    values: Mapping[str, float] = field(default_factory=lambda: dict(find_plant("eha").nominal))
    effects: tuple[str, ...] = ()
    plant: str = "eha"
    design: Mapping[str, float] = field(default_factory=dict)  # nominal values of an actuator of another size

    def __repr__(self) -> str:
        effects = f" with {', '.join(self.effects)}" if self.effects else ""
        changes = ", ".join(f"{name} = {value:g}" for name, value in self.list_changes().items())
        text = f"Model {self.name} of plant {self.plant}{effects}: {changes or 'nominal'}"
        return f"<{shorten(text, 140, placeholder=' ..')}>"

    @property
    def nominal(self) -> Mapping[str, float]:
        """The nominal values of this design, "group.field" to SI value: the plant's own where it is of usual size."""
        return {**self.kind.nominal, **self.design}

    @property
    def steps(self) -> int:
        """Steps of the solver in a cycle of the controller."""
        return max(1, round(self["controller.period"] / self.kind.solver_step))

    @property
    def kind(self) -> Plant:
        """The plant that the values belong to."""
        return find_plant(self.plant)

    def find_effect(self, name: str) -> Effect:
        """The effect of that name, as the plant has it. Raises KeyError."""
        return self.kind.find_effect(name)

    def replace(self, changes: Mapping[str, object], where: object = "--set") -> Self:
        """The model with some parameters changed; naming an effect's parameter gives the model that effect.

        Raises:
            InputError: an unknown name, an impossible value, or values that contradict each other.
        """
        values = {name: parse_value(where, name, find_quantity(name, where, self.plant), value)
                  for name, value in changes.items()}
        model = self.with_effects(name.partition(".")[0] for name in changes)
        all_values = {**model.values, **values}
        check_combinations(where, all_values)
        check_exclusions(where, model, all_values)
        return replace(model, values=all_values)

    def require_acting_load(self, load: NDArray[np.float64] | None, where: object) -> None:
        """Refuse a load, (n,), that acts through effects alone of which the model has none. Raises InputError."""
        changes = [f"--set {self.find_effect(name).fitted[0]}=1" for name in self.kind.loaded_by]
        is_loaded = load is not None and load.any() and changes and not {*self.kind.loaded_by} & {*self.effects}
        require(not is_loaded, where, "load", f"0, or a model in which it acts: {' or '.join(changes)}")

    def with_effects(self, groups: Iterable[str]) -> Self:
        """The model with the effects among `groups` added at their off values."""
        names = set(groups) | set(self.effects)
        effects = [e for e in self.kind.list_effects() if e.name in names and not e.base]
        usual = self.nominal
        off = {name: usual.get(name, value) for e in effects if e.name not in self.effects
               for name, value in e.off.items()}
        return replace(self, values={**self.values, **off}, effects=tuple(e.name for e in effects))

    def __getitem__(self, name: str) -> float:
        return self.values[name]

    def list_changes(self) -> dict[str, float]:
        """The parameters that are not those of the plant's nominal model, and all parameters of its effects."""
        return {name: value for name, value in self.values.items() if self.kind.nominal.get(name) != value}

    def describe_value(self, name: str) -> str:
        """A parameter for people: its SI value with the unit, or the word of a choice."""
        return find_quantity(name, plant=self.plant).describe(self[name])

    def to_toml(self, remarks: Mapping[str, str] | None = None) -> str:
        """The text of a model file, which `load_model` reads; `remarks` stand beside parameters, by "group.field"."""
        effects = ", ".join(f'"{e}"' for e in self.effects)
        plant = [] if self.plant == "eha" else [f"plant = {quote_text(self.plant)}"]
        plant += [f'plant_sha256 = "{self.kind.sha256}"'] if self.kind.sha256 else []
        lines = [f"name = {quote_text(self.name)}", *plant, f"effects = [{effects}]"]
        usual = self.nominal
        own = {name: value for name, value in self.values.items() if usual.get(name) != value}
        for heading, values in (("design.", self.design), ("", own)):
            for group, fields in groupby(values.items(), lambda item: item[0].partition(".")[0]):
                lines += ["", f"[{heading}{group}]"]
                for name, value in fields:
                    tail = name.partition(".")[2]
                    quantity = find_quantity(name, plant=self.plant)
                    word = next((f'"{w}"' for w, number in quantity.words.items() if number == value), repr(value))
                    remark = "" if heading and name in own else (remarks or {}).get(name, "")  # a fitted value's, once
                    notes = [note for note in (quantity.unit, remark) if note not in ("", "1")]
                    lines.append(f"{tail} = {word}" + (f"  # {', '.join(notes)}" if notes else ""))
        return "\n".join(lines) + "\n"

    def list_names(self) -> list[str]:
        """The parameters "group.field", in the order of `build_record`."""
        return [f"{group}.{f}" for group, cls in self.kind.list_groups(self.effects).items() for f in cls._fields]

    def build_record(self) -> NDArray[Any]:
        """The values as a record array of one row, fields group.field; compiled code reads it in each step."""
        groups = self.kind.list_groups(self.effects)
        inner = {group: np.dtype((ParameterRecord, [(f, float) for f in cls._fields])) for group, cls in groups.items()}
        row = tuple(tuple(self.values[f"{group}.{f}"] for f in cls._fields) for group, cls in groups.items())
        return np.array([row], np.dtype((ParameterRecord, list(inner.items()))))

    def build_start(self) -> tuple[Any, Any]:
        """The plant at rest as its sensors show it, and the memories of its effects."""
        s, m = self.kind.build_start(self.effects)
        if self.kind.sense is None:
            return s, m
        # once in plain Python, because the first sample is read before the first step
        state = build_kernel(show_start, self.effects, False, self.plant)(s, m, self.build_record()[0])
        return self.kind.state(*map(float, state)), m

    def build_flat_state(self) -> NDArray[np.float64]:
        """`build_start` as an array, the state first."""
        return np.array(list_state_values(self.build_start()))


def load_model(source: str | Path = "eha") -> Model:
    """The nominal model of a plant ("eha", "my_plant.py"), a shipped model ("servo"), or the model of a TOML file.

    A file lists what is not nominal. One that has the name of a plant or of a shipped model is given with its folder.
    A plant file runs; one that a model file names must have been loaded before (`plant.plants.load_plant`).

    Raises:
        InputError: no such file, or an unknown group, field, effect or impossible value in it.
    """
    if Path(source).suffix == ".py":
        load_plant(Path(source))
    if str(source) in list_plants() or Path(source).suffix == ".py":
        return build_bare_model(str(source)).with_effects(find_plant(str(source)).has)
    path = _find_model_file(source)
    return parse_model(read_model_tables(path), path, path.stem)


def _find_model_file(source: str | Path) -> Path:
    path = find_shipped_model(str(source)) or Path(source)
    if not path.is_file():
        names = ", ".join((*list_plants(), *SHIPPED_MODELS))
        missing = "; it does not exist" if path.suffix in READERS else ""
        raise InputError(source, "", f"a model file, or one of {names}{missing}")
    return path


def find_plant_of_model(source: str | Path) -> str:
    """What models call the plant of a model as `load_model` takes it; its effects need not be known.

    Raises:
        InputError: no such file, or a plant that is not known or loaded.
    """
    if str(source) in list_plants() or Path(source).suffix == ".py":
        return str(source)
    path = _find_model_file(source)
    return _find_plant(read_model_tables(path).get("plant", "eha"), path)


def _find_plant(plant_entry: Any, where: object) -> str:
    plant = read_named_plant(plant_entry, where)
    loaded_plant = find_loaded_plant(plant, where) if isinstance(plant, str) and plant.endswith(".py") else None
    if loaded_plant is None and not (isinstance(plant, str) and is_known(plant)):
        more = "an FMU, or a plant file (.py), which runs with --trust"
        raise InputError(where, "plant", f"one of {', '.join(list_plants())}, or {more}, not {plant!r}")
    return str(plant) if loaded_plant is None else loaded_plant.key


def find_shipped_model(name: str) -> Path | None:
    """The file of a shipped model; None for any other name."""
    return Path(str(files("plant").joinpath("models", f"{name}.toml"))) if name in SHIPPED_MODELS else None


def build_bare_model(plant: str, name: str = "") -> Model:
    """A plant at its nominal values, without effects."""
    kind = find_plant(plant)
    own = {n: v for n, v in kind.nominal.items() if n.partition(".")[0] in kind.parameters}
    return Model(name or plant, own, (), plant)


def parse_model(tables: Mapping[str, Any], where: object, name: str = "eha") -> Model:
    """The model from the tables of a model file; errors name `where` they are from.

    Raises:
        InputError: an unknown plant, effect or parameter, or a value that the parameter cannot have.
    """
    tables = {key: x for key, x in tables.items() if key not in ("provenance", "identify", "plant_sha256")}
    name, effects = tables.pop("name", name), tables.pop("effects", [])
    plant_entry = tables.pop("plant", "eha")
    design = tables.pop("design", {})
    require(isinstance(name, str) and name, where, "name", f"a text, not {name!r}")
    plant = _find_plant(plant_entry, where)
    names = [e.name for e in find_plant(plant).list_effects()]  # a list, as what stands in a file need not be hashable
    unknown = [e for e in effects if e not in names] if isinstance(effects, list) else [effects]
    if unknown:
        hint = suggest_name(str(unknown[0]), names)
        raise InputError(where, "effects", f"names of effects (rig effects lists them), not {unknown[0]!r}{hint}")
    require(isinstance(design, Mapping), where, "design", "tables [design.GROUP] of nominal values")
    values = flatten_tables(where, tables, find_plant(plant).list_groups())
    usual = flatten_tables(where, design, find_plant(plant).list_groups(()))
    bare = build_bare_model(plant, name)
    sized = replace(bare, values={**bare.values, **usual}, design=usual)
    check_combinations(where, sized.values)
    return sized.with_effects(effects).replace(values, where)


def check_exclusions(where: object, model: Model, values: Mapping[str, float]) -> None:
    """Refuse two active effects that exclude each other; an effect at its off value is not active.

    Raises:
        InputError: the names of both.
    """
    working = {e for e in model.effects if model.find_effect(e).is_active(values)}
    for e in sorted(working):
        for other in working.intersection(model.find_effect(e).excludes):
            raise InputError(where, e, f"{e} or {other}, not both at work")


def find_effect(name: str, plant: str = "eha") -> Effect:
    """The effect of that name, if it suits the plant.

    Raises:
        InputError: there is none of that name.
    """
    effects = {e.name: e for e in find_plant(plant).list_effects()}
    if name not in effects:
        hint = suggest_name(name, effects, 0.5) or " (rig effects lists them)"
        hint = f" that suits the plant {plant}" if name in CATALOGUE.list_all() else hint
        raise InputError("effect", name, f"an effect of the catalogue{hint}")
    return effects[name]


def build_kernel(function: Function, effects: tuple[str, ...], fast: bool = True, plant: str = "eha") -> Function:
    """`function`, which calls the physics, for a plant with `effects`.

    Args:
        function: of `plant.solve` or the like, on floats, tuples and arrays.
        effects: names, in catalogue order.
        fast: compiled, once for each set of effects; False runs the same source in plain Python.
        plant: whose step it takes.
    """
    kind = find_plant(plant)
    if fast:
        kind.require_equations()
    return _build_kernel(function, effects, kind.list_laws(effects), fast, kind)


@cache
def _build_kernel(function: Function, effects: tuple[str, ...], laws: tuple[Any, ...], fast: bool, kind: Plant
                  ) -> Function:
    # `laws` is part of keys only: a user may load a changed file under the same effect names
    ports = kind.bind_functions(effects)
    return compile_function(function, ports, (kind, laws)) if fast else interpret_function(function, ports)
