"""The plants: each is declared by one file, a shipped one or a user's (docs/plants.md), and run by the same kernels.

A plant's `step` and the functions beside it stand in place of placeholders in every kernel (`plant.compile` binds by
name), so single runs, lanes, emulator and fits work with every plant.
"""

import hashlib
import importlib
import inspect
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, cast

import numpy as np

from plant.compile import Function, find_called_functions, find_fields_of, raise_unbound
from plant.effects import CATALOGUE, Effect, Group, build_base_effect, build_effect, combine_laws
from plant.errors import InputError, require
from plant.faults import Fault
from plant.foreign import Program
from plant.kernels import make_packers, write_constant, write_function, write_mover, write_signal_functions
from plant.pid import Loop, control_by_pid
from plant.plant_check import check_declaration
from plant.ports import (
    PORTS,
    Port,
    at_command,
    at_reading,
    bind_port,
    bind_shifts,
    chain_shifts,
    make_memory_type,
    port,
)
from plant.quantity import Quantity, make_group
from plant.segments import Array, Segment, build_profile
from plant.signals import Signal, Signals
from plant.state import Sampled
from plant.tables import read_file
from plant.user_code import explain_errors, run_file

__all__ = ["Fault", "MeasuredPressures", "Plant", "Table", "Term", "base_effect", "effect", "find_plant", "list_plants",
           "load_plant", "port"]

MODULES = {"eha": "plant.eha", "ehs": "plant.ehs", "ema": "plant.ema"}  # the shipped plants; read when first named
CONTROL_AT = 2  # of an exported unit: behind the cycles of its plant and the answer of its controller
OWN_EFFECTS = "__effects__"  # where a plant file keeps the effects that it declares


class Term(NamedTuple):
    """A part of a trace's column: `factor` times a column of the plant's own file, taken `later` rows further down.

    A mean of the last m rows stands (m - 1)/2 rows late in its file: `later` puts it back.
    """

    source: str
    factor: float = 1.0
    later: int = 0


@dataclass(frozen=True)
class Table:
    """How a file of the plant's own rig becomes a trace."""

    columns: Mapping[str, tuple[Term, ...]]  # t, com, xj, cor and what else of a trace there is, as sums
    derive: Callable[[Mapping[str, Array]], dict[str, Array]] | None = None  # further columns, from the file's own
    derived_from: tuple[str, ...] = ()  # the file's columns that this needs
    skip: int = 0  # rows of start-up
    separator: str = ","
    load: Callable[[Mapping[str, Array]], Array] | None = None  # from these columns, (n,) N

    @property
    def sources(self) -> set[str]:
        """The columns that a file must have."""
        return {term.source for terms in self.columns.values() for term in terms} | set(self.derived_from)


class MeasuredPressures(NamedTuple):
    """How measured chamber pressures drive a plant: as the force on the ram, so that its flow alone moves it."""

    # The force, (n,) N, positive against extension: from parameter values, chamber pressures, (n, 2) Pa, drive `cor`,
    # (n,), and period, s.
    compute_force: Callable[[Mapping[str, float], Array, Array, float], Array]
    used: frozenset[str]  # parameters that it needs
    given: Mapping[str, float]  # parameters with which the step takes the load for this force


@dataclass(frozen=True, eq=False)
class Plant:
    """One kind of actuator, as its file declares it.

    Functions get the state s, the memories m of effects, the input u of the step (`plant.state.Input`), the
    parameters p as p.GROUP.FIELD and the coefficients k; the readings y are a tuple in the order of the outputs.
    """

    signals: Signals  # or a tuple of `Signal`: what commands it, drives it, loads it and is measured of it
    parameters: Mapping[str, type[Any]]  # or a tuple of their types: class LeadScrew is the group lead_screw
    state: type[Any]  # a NamedTuple of floats, its defaults the plant at rest
    step: Function  # (s, m, u, p) -> (s, m), or (s, m, u, p, k)
    measure: Function  # (s, p) -> one reading for each output, without noise
    moves: Any  # names of the fields of the state that move with the controlled signal; or (s, distance, p) -> s
    title: str = ""  # for people
    name: str = ""  # default: that of its file
    control: Function | None = None  # (c, demand, y, p) -> (drive, c); None: it is unknown, and a PID law stands in
    control_memory: type[Any] | None = None  # of c, a NamedTuple of floats; None: a number that nobody needs
    coefficients: Function = None  # (p, h) -> a NamedTuple of floats, once for all steps
    sense: Function | None = None  # (s, m, u, p) -> (s, m): sensors with dynamics follow a plant at rest
    # (s, distance, p) -> s: how a replay that departs from the measured signal is corrected, by `distance` in a cycle
    # (20 1/s times period times error); None: it is moved. An observer corrects the speed as well.
    correct: Function | None = None
    # (x, v, a, m, u, p) -> (drive, m): the drive that a motion of the controlled signal needs
    inverse: Function | None = None
    faults: tuple[Fault, ...] = ()  # its own, for rig fdi
    profile: tuple[Segment, ...] = field(default=(), repr=False)  # nominal test: segments of its command
    values: Mapping[str, float] = field(default_factory=dict, repr=False)  # nominal, in place of the types' defaults
    has: tuple[str, ...] = ()  # effects of the nominal model
    lacks: tuple[str, ...] = ()  # shared effects that cannot be
    loaded_by: tuple[str, ...] = ()  # effects through which alone its load acts; none: its step takes it
    shared_starts: bool = False  # the starts of shared effects, which are those of the EHA, suit it
    scatter: Mapping[str, float] | None = None  # tolerances, a fraction, of parameters; None: as their types say
    balances: bool = False  # `plant.forced` balances flow and force of its jack, as measured signals have them
    solver_step: float = 1e-5  # s
    # functions of its code by name, marked by `plant.compile.bind_later`, that others replace where an effect acts at
    # one of the ports; none: always
    variants: Mapping[str, tuple[Function, frozenset[str]]] = field(default_factory=dict, repr=False)
    tables: tuple[Table, ...] = field(default=(), repr=False)  # of the files that its rig writes
    measured_pressures: MeasuredPressures | None = None  # how they drive the plant; None: they cannot
    file: Path | None = None  # of a user's plant
    key: str = ""  # what a model calls it: its name, or the path of a user's file as it was named
    source: bytes = field(default=b"", repr=False)  # of a user's file
    foreign: Callable[[float], Program] | None = field(default=None, repr=False)  # runs it in place of its step
    # its own, and shared ones with starts of its own
    effects: Mapping[str, Effect] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        parameters = self.parameters
        if not isinstance(parameters, Mapping):
            parameters = {name_group(cls): cls for cls in parameters}
        noisy = [s for s in self.signals if isinstance(s.noise, float | int)]
        signals = Signals(*(s._replace(noise=f"sensors.{s.name}_noise") if s in noisy else s
                            for s in self.signals if s.role != "time"))
        if noisy:
            parameters = {**parameters, "sensors": make_noise_group(noisy)}
        for key, value in (("parameters", parameters), ("signals", signals)):
            object.__setattr__(self, key, value)

    @property
    def sha256(self) -> str:
        """SHA-256 of a user's file, hexadecimal; empty for a shipped plant."""
        return hashlib.sha256(self.source).hexdigest() if self.source else ""

    @property
    def controller(self) -> bool:
        """Whether its controller is known, so that its drive can be held against command and controlled signal."""
        return self.control is not None

    @cached_property
    def nominal(self) -> Mapping[str, float]:
        """All values of the nominal plant, "group.field" to SI value."""
        own = {f"{group}.{name}": cls._field_defaults.get(name, 0.0)
               for group, cls in self.parameters.items() for name in cls._fields}
        return {**own, **self.values}

    def build_nominal_command(self, period: float = 0.0) -> Array:
        """The demand of its nominal test, (n,), one for each cycle of `period` s, by default its own; else empty.

        Raises:
            InputError: a segment that is not whole cycles.
        """
        try:
            return build_profile(self.profile, rate=1.0 / (period or self.nominal["controller.period"])).command
        except InputError as error:  # of a segment, which does not know its file
            field = ", ".join(filter(None, (error.where, error.field)))
            raise InputError(str(self.file or self.name), field, error.expected) from error

    def find_tolerance(self, name: str, q: Quantity) -> float:
        """Scatter of a parameter from unit to unit, as a fraction; 0 where the nominal value is zero."""
        if self.nominal.get(name) == 0.0:
            return 0.0
        return q.tolerance if self.scatter is None else self.scatter.get(name, 0.0)

    @cached_property
    def ports(self) -> Mapping[str, Port]:
        """The ports at which effects can act, in their order: those of its step, and those of the sampled loop."""
        whole = [f for f in (self.step, self.sense, *(v for v, _ in self.variants.values())) if f is not None]
        ports = {name[3:]: g.port for f in whole for name, g in find_called_functions(f).items() if hasattr(g, "port")}
        ordered = sorted(ports.items(), key=lambda item: item[1].number)
        command, reading = (f.port._replace(unit=self.signals.controlled.unit) for f in (at_command, at_reading))
        return {"command": command, **dict(ordered), "reading": reading}

    @cached_property
    def memory(self) -> type[Any]:
        """The type of the memories of effects."""
        return make_memory_type(list(self.ports))

    def require_equations(self) -> None:
        """Refuse a plant whose equations are another program's. Raises InputError."""
        require(self.foreign is None, self.file, "", "a plant with equations for this; those of an FMU cannot be read")

    def list_effects(self) -> list[Effect]:
        """The effects it can have: those of the catalogue that suit it, then its own, which may have their names."""
        everything = CATALOGUE.list_all()
        catalogue_effects = (e for e in map(self.find_effect, everything) if is_offered(e, self))
        return [*catalogue_effects, *(e for name, e in self.effects.items() if name not in everything)]

    def list_groups(self, names: Iterable[str] | None = None) -> dict[str, type[Any]]:
        """The parameter groups of the plant and of the effects `names`, by default of all that it can have."""
        effects = self.list_effects() if names is None else [self.find_effect(name) for name in names]
        return {**self.parameters, **{e.name: e.group for e in effects if e.group is not None}}

    def find_effect(self, name: str) -> Effect:
        """Its own effect of that name, else that of the catalogue. Raises KeyError."""
        return self.effects.get(name) or CATALOGUE[name]

    def list_laws(self, names: tuple[str, ...]) -> tuple[Any, ...]:
        """The laws of the effects as they are now: a user's file may have been loaded again."""
        return tuple(self.find_effect(name).function for name in names)

    def replace_effect(self, e: Effect) -> None:
        """Put an effect with other start values in the place of the one of its name."""
        if e.name in self.effects or CATALOGUE[e.name].starts:
            cast("dict[str, Effect]", self.effects)[e.name] = e
        else:
            CATALOGUE[e.name] = e

    def bind_functions(self, names: tuple[str, ...]) -> dict[str, Function]:
        """The functions that take the place of the placeholders in every kernel, for the plant with these effects."""
        effects = [self.find_effect(name) for name in names]
        functions = dict(self._functions)
        for name in self.ports:
            acting = [e for e in effects if e.port == name]
            law, _ = combine_laws(name, acting)
            functions[f"at_{name}"] = law if not acting else bind_port(
                name, law, any(e.memory is not None for e in acting), self.memory)
        shifts = {name: [e.shift for e in effects if e.port == name] for name in self.ports}
        functions["shift_memories"] = bind_shifts(
            ((name, chain_shifts(own)) for name, own in shifts.items() if any(own)), self.memory)
        functions["pack_state"], functions["unpack_state"], _ = make_packers(self.build_start(names))
        acting_at = {e.port for e in effects}
        return functions | {name: f for name, (f, ports) in self.variants.items() if not ports or ports & acting_at}

    @cached_property
    def move(self) -> Function:
        """(s, distance, p): the state with the controlled signal `distance` further.

        Fields that are named may be in another unit than the signal, such as rad and deg.
        """
        if callable(self.moves):
            return self.moves
        return write_mover(self.state, self.moves, 1.0 / self.find_share_moved(write_mover(self.state, self.moves)))

    def find_share_moved(self, move: Function) -> float:
        """How far a move changes the reading of the controlled signal, over the distance; 1 for whatever is within a
        factor of two of it, as in a bent linkage, and where the reading follows later.

        The distance is a tenth of the largest demand of the nominal test, from rest.
        """
        from plant.model import build_bare_model

        start, p = self.state(), build_bare_model(self.key).build_record()[0]
        distance = 0.1 * float(np.abs(self.build_nominal_command()).max(initial=0.0)) or 1e-3
        share = float(self.measure(move(start, distance, p), p)[0] - self.measure(start, p)[0]) / distance
        return 1.0 if share == 0.0 or 0.5 <= share <= 2.0 else share

    @cached_property
    def _functions(self) -> dict[str, Function]:
        """What does not depend on effects."""
        step = self.step
        if len(inspect.signature(step).parameters) == 4:
            step = write_function("step_plant", "s, m, u, p, k", ["return step(s, m, u, p)"], step=step)
        store, load, _ = make_packers(self.build_control_memory(), first=CONTROL_AT)
        return {"step_plant": step, "store_control": store, "load_control": load,
                "measure_plant": self.measure, "move_plant": self.move, "correct_plant": self.correct or self.move,
                "invert_plant": self.inverse or raise_unbound,
                "sense_plant": self.sense or _sense_nothing, "control_plant": self.control or control_by_pid,
                "start_control": write_constant("start_control", self.build_control_memory()),
                "compute_plant_coefficients": self.coefficients or _compute_no_coefficients,
                **write_signal_functions(self.signals)}

    def find_shown_fields(self) -> list[int] | None:
        """The numbers of the fields of the state that `measure` shows as they are; None: it computes something."""
        marks = [object() for _ in self.state._fields]
        try:
            readings = self.measure(self.state(*marks), None)
        except Exception:  # it computes with what is no number here
            return None
        numbers = [i for y in readings for i, mark in enumerate(marks) if y is mark]
        return numbers if len(numbers) == len(self.signals.outputs) else None

    def build_control_memory(self) -> Any:
        """What the law of the controller remembers at the start."""
        if self.control is None:
            return Loop()
        if self.control_memory is None:
            return 0.0
        return self.control_memory(*map(float, self.control_memory()))  # a default may be written as a whole number

    def build_start(self, names: tuple[str, ...]) -> tuple[Any, Any]:
        """The plant at rest and the memories of the effects `names` at the start."""
        effects = [self.find_effect(name) for name in names]
        return self.state(), self.memory(*(combine_laws(port, effects)[1] for port in self.ports))


@cache  # asked for each parameter that is named
def is_offered(e: Effect, plant: Plant) -> bool:
    """Whether a shared effect suits a plant: it has the port, in the same unit, and what else the law names."""
    is_elsewhere = e.plant not in ("", plant.name) or (plant.file is not None and e.searched_in)
    if is_elsewhere or e.name in plant.lacks or plant.foreign is not None:
        return False
    if e.base:
        return all(name in plant.nominal for name in e.fitted)
    if e.port not in plant.ports:
        return False
    if e.plant == plant.name:
        return True
    unit, own_unit = PORTS[e.port].unit or "m", plant.ports[e.port].unit  # of the EHA, for which it was written
    is_own = e.function is not None and not e.function.__module__.startswith("plant.")  # in a file of the user's
    has_unit = unit == own_unit or not any(unit in re.split(r"[ /()]", q.unit) for q in e.parameters.values())
    return is_own or (has_unit and _has_what_law_names(e, plant))


def _has_what_law_names(e: Effect, plant: Plant) -> bool:
    """Whether the state has the fields, and the parameters the groups, that the law of an effect names."""
    state = Sampled if e.port == "command" else plant.state
    return all(name in state._fields for name in find_fields_of(e.function, "s")) and all(
        name in plant.nominal or name in plant.parameters or name.partition(".")[0] == e.name
        for name in find_fields_of(e.function, "p", 2))


def _compute_no_coefficients(p: Any, h: float) -> float:
    return 0.0


def _sense_nothing(s: Any, m: Any, u: Any, p: Any) -> Any:
    return s, m


_LOADED: dict[str, Plant] = {}  # by the name of a shipped plant, or the path that a user's was named by


def find_plant(name: str) -> Plant:
    """The shipped plant of that name, or the user's plant that `load_plant` has loaded from that path.

    Raises:
        InputError: there is none.
    """
    if name not in _LOADED:
        require(name in MODULES, "plant", name, f"one of {', '.join(MODULES)}, or a Python file that exists and is "
                f"that of --model or of the bench, not {name}")
        _LOADED[name] = find_declared_plant(importlib.import_module(MODULES[name]), name)
        CATALOGUE.of_plants.update(_LOADED[name].effects)
    return _LOADED[name]


def find_loaded_plant(name: str, where: object) -> Plant | None:
    """The user's plant that the model file `where` calls `name`: beside it, or from this folder; None: not loaded."""
    return next((_LOADED[key] for key in (str(Path(str(where)).parent / name), name) if key in _LOADED), None)


def find_key(name: str) -> str:
    """What this process calls a user's plant of another one, which may have loaded its file from another folder."""
    if name in _LOADED:
        return name
    return next((key for key in _LOADED if Path(key).name == Path(name).name), name)


def is_loaded(path: Path, source: bytes) -> bool:
    """Whether this content of a plant file has run already."""
    return any(plant.file == path.absolute() and plant.source == source for plant in _LOADED.values())


def is_known(name: str) -> bool:
    """Whether `find_plant` finds it."""
    return name in _LOADED or name in MODULES


def list_plants() -> tuple[str, ...]:
    """All shipped plants."""
    return tuple(MODULES)


def name_group(cls: type[Any]) -> str:
    """The parameter group of a type: LeadScrew is lead_screw."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()


def make_noise_group(signals: Sequence[Signal]) -> type[Any]:
    """The group `sensors` of a plant whose `signals` give the noise of their sensors as numbers."""
    fields = {f"{s.name}_noise": Quantity(f"{s.unit} rms", low=0, high=max(1.0, 1e4 * s.noise)) for s in signals}
    return make_group("Sensors", "White noise of the sensors, one sample a cycle.", fields, __name__,
                      [float(s.noise) for s in signals])


def effect(port: str, group: Group, **more: Any) -> Callable[[Function], Function]:
    """`plant.effects.effect` in a plant file: the effect belongs to that plant, and its port is one of the file's.

    `more`: law, symptoms, memory, fitted, starts, source, ..., see there.
    """
    def register(function: Function) -> Function:
        new_effect = build_effect(function, port, group, **more)
        function.__globals__.setdefault(OWN_EFFECTS, {})[new_effect.name] = new_effect
        return function

    return register


def base_effect(name: str, group: type[Any], *fields: str, **more: Any) -> None:
    """An effect that the plant has already, by `fields` of a parameter group: missing means off their nominal values.

    `more`: law, symptoms, starts, source, ..., as those of an effect.
    """
    namespace = sys._getframe(1).f_globals
    names = [f"{name_group(group)}.{field}" for field in fields]
    new_effect = build_base_effect(name, *names, groups={name_group(group): group}, **more)
    namespace.setdefault(OWN_EFFECTS, {})[new_effect.name] = new_effect


def load_plant(path: Path, source: bytes | None = None, key: str = "") -> Plant:
    """Run a user's plant file; the plant that it declares as PLANT. From now on `find_plant` finds it by its path.

    Args:
        path: of the file.
        source: its content where that has been read already; exactly these bytes run.
        key: what models call it instead of the path.

    Raises:
        InputError: unreadable, not Python, or what it declares is incomplete.
    """
    key, path = key or str(path), path.absolute()
    require(source is not None or path.is_file(), path, "", "a Python file that declares a plant; it does not exist")
    code = read_file(path) if source is None else source
    loaded_plant = _LOADED.get(key)
    if loaded_plant is not None and (loaded_plant.file, loaded_plant.source) == (path, code):
        return loaded_plant
    plant = replace(find_declared_plant(run_file(path, code), path.stem, path, key), source=code)
    before, _LOADED[key] = loaded_plant, plant
    try:
        check_declaration(plant, path)
    except InputError:
        _LOADED.pop(key)
        _LOADED.update({key: before} if before is not None else {})
        raise
    CATALOGUE.of_plants.update(plant.effects)
    return plant


def keep_plant(plant: Plant) -> Plant:
    """Let `find_plant` find a plant by its key."""
    _LOADED[plant.key] = plant
    return plant


def find_declared_plant(module: ModuleType, name: str, file: Path | None = None, key: str = "") -> Plant:
    """The plant that a module declares as PLANT, with the effects beside it.

    Raises:
        InputError: there is none.
    """
    plant = vars(module).get("PLANT")
    if not isinstance(plant, Plant):
        raise InputError(file or name, "PLANT", "PLANT = Plant(...)")
    title = plant.name or name
    own = {e.name: replace(e, plant=title) for e in vars(module).get(OWN_EFFECTS, {}).values()}
    plant = replace(plant, name=title, file=file, effects=own, key=key or name)
    with explain_errors(str(file or name), "step"):  # its ports are those of the functions that it calls
        ports = plant.ports
    PORTS.update({name: port for name, port in ports.items() if name not in PORTS})
    return plant
