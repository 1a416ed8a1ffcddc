"""The plants: each is declared by one file, a shipped one or a user's (docs/plants.md), and run by the same kernels.

A plant's `step` and the functions beside it stand in place of placeholders in every kernel (`plant.compile` binds by
name), so single runs, lanes, emulator and fits work with every plant.
"""
from __future__ import annotations

import hashlib
import importlib
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from plant import signals
from plant import step as reference
from plant.compile import Function, list_called_names
from plant.effects import Effect, build_base_effect, build_effect
from plant.errors import InputError
from plant.faults import Fault
from plant.parameters import GROUPS, load_nominal_values
from plant.ports import port
from plant.quantity import Quantity
from plant.segments import Segment
from plant.signals import Signals
from plant.state import State

__all__ = ["Fault", "MeasuredPressures", "Plant", "Table", "Term", "base_effect", "effect", "find_plant", "list_plants",
           "load_plant", "port"]

Array = NDArray[np.float64]
MODULES = {"ehs": "plant.ehs"}  # plants beside the reference model; read when first named
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
    faults: tuple[Fault, ...] = ()  # its own, for rig fdi
    profile: tuple[Segment, ...] = field(default=(), repr=False)  # nominal test: segments of its command
    values: Mapping[str, float] = field(default_factory=dict, repr=False)  # nominal, in place of the types' defaults
    has: tuple[str, ...] = ()  # effects of the nominal model
    lacks: tuple[str, ...] = ()  # shared effects that cannot be
    scatter: Mapping[str, float] | None = None  # tolerances, a fraction, of parameters; None: as their types say
    balances: bool = False  # `plant.forced` balances flow and force of its jack, as measured signals have them
    solver_step: float = 1e-5  # s
    tables: tuple[Table, ...] = field(default=(), repr=False)  # of the files that its rig writes
    measured_pressures: MeasuredPressures | None = None  # how they drive the plant; None: they cannot
    file: Path | None = None  # of a user's plant
    effects: Mapping[str, Effect] = field(default_factory=dict, repr=False)  # its own

    def __post_init__(self) -> None:
        parameters = self.parameters
        if not isinstance(parameters, Mapping):
            parameters = {name_group(cls): cls for cls in parameters}
        levels = {s.name: s.noise for s in self.signals if isinstance(s.noise, float | int)}
        if levels:
            units = {s.name: s.unit for s in self.signals}
            parameters = {**parameters, "sensors": make_noise_group(levels, units)}
        named = (s._replace(noise=f"sensors.{s.name}_noise") if s.name in levels else s
                 for s in self.signals if s.role != "time")
        for key, value in (("parameters", parameters), ("signals", Signals(*named))):
            object.__setattr__(self, key, value)

    @property
    def groups(self) -> Mapping[str, type[Any]]:
        """Its parameters, group name to NamedTuple."""
        return self.parameters

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

    def find_tolerance(self, name: str, q: Quantity) -> float:
        """Scatter of a parameter from unit to unit, as a fraction; 0 where the nominal value is zero."""
        if self.nominal.get(name) == 0.0:
            return 0.0
        return q.tolerance if self.scatter is None else self.scatter.get(name, 0.0)

    @cached_property
    def ports(self) -> frozenset[str]:
        """The ports at which effects can act: those that its step calls, and those of the sampled loop around it."""
        calls = list_called_names(self.step)
        if self.step is reference.step_plant:
            calls = calls | list_called_names(reference.apply_changing_oil)
        return frozenset({"command", "reading"} | {name[3:] for name in calls if name.startswith("at_")})

    @property
    def unit(self) -> str:
        """Unit of what drives it."""
        return self.signals.drive.unit

    def offers(self, e: Effect) -> bool:
        """Whether the plant has the port, the parameters and the unit of current that an effect needs."""
        if e.plant not in ("", self.name) or e.name in self.lacks:
            return False
        if e.base:
            return all(name in self.nominal for name in e.fitted)
        return e.port in self.ports and (self.unit == "A" or "A" not in {q.unit for q in e.parameters.values()})


def find_plant(name: str) -> Plant:
    """The plant of that name.

    Raises:
        InputError: there is none.
    """
    if name == "eha":
        return _build_reference_plant()
    if name not in MODULES:
        raise InputError("plant", name, f"one of {', '.join(list_plants())}")
    plant: Plant = importlib.import_module(MODULES[name]).PLANT
    return plant


def list_plants() -> tuple[str, ...]:
    """All plants."""
    return ("eha", *MODULES)


@cache
def _build_reference_plant() -> Plant:
    return Plant(name="eha", title="electrohydraulic actuator", signals=signals.EHA, parameters=GROUPS, state=State,
                 step=reference.step_plant, measure=reference.measure, moves=("jack_position",),
                 control=reference.measure, coefficients=reference.compute_coefficients, values=load_nominal_values(),
                 balances=True)


def name_group(cls: type[Any]) -> str:
    """The parameter group of a type: LeadScrew is lead_screw."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()


def make_noise_group(levels: Mapping[str, float], units: Mapping[str, str]) -> type[Any]:
    """The group `sensors` of a plant whose signals give the noise of their sensors as numbers."""
    made: Any = NamedTuple("Sensors", [  # type: ignore[misc]
        (f"{name}_noise", Annotated[float, Quantity(f"{units[name]} rms", low=0, high=max(1.0, 1e4 * level))])
        for name, level in levels.items()])
    made.__new__.__defaults__ = tuple(levels.values())
    made._field_defaults = {f"{name}_noise": float(level) for name, level in levels.items()}
    made.__doc__ = "White noise of the sensors, one sample a cycle."
    return cast("type[Any]", made)


def effect(port: str, group: type[Any], **more: Any) -> Callable[[Function], Function]:
    """`plant.effects.effect` in a plant file: the effect belongs to that plant, and its port is one of the file's.

    `more`: law, symptoms, memory, fitted, starts, source, ..., see there.
    """
    def register(function: Function) -> Function:
        made = build_effect(function, port, group, **more)
        function.__globals__.setdefault(OWN_EFFECTS, {})[made.name] = made
        return function

    return register


def base_effect(name: str, group: type[Any], *fields: str, **more: Any) -> None:
    """An effect that the plant has already, by `fields` of a parameter group: missing means off their nominal values.

    `more`: law, symptoms, starts, source, ..., as those of an effect.
    """
    there = sys._getframe(1).f_globals
    names = [f"{name_group(group)}.{field}" for field in fields]
    made = build_base_effect(name, *names, groups={name_group(group): group}, **more)
    there.setdefault(OWN_EFFECTS, {})[made.name] = made


def load_plant(path: Path, source: bytes | None = None) -> Plant:
    """Run a user's plant file; the plant that it declares as PLANT.

    `source` is its content where that has been read already; exactly these bytes run.

    Raises:
        InputError: unreadable, not Python, or what it declares is incomplete.
    """
    path = path.absolute()
    if not path.is_file() and source is None:
        raise InputError(path, "", "a Python file that declares a plant; it does not exist")
    try:
        code = path.read_bytes() if source is None else source
    except OSError as error:
        raise InputError(path, "", f"a readable file ({error.strerror})") from error
    module = ModuleType(f"plant_of_{path.stem}_{hashlib.sha256(code).hexdigest()[:8]}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # where annotations written as text, and types, are looked up
    try:
        exec(compile(code, path, "exec", dont_inherit=True), module.__dict__)
    except SyntaxError as error:
        raise InputError(f"{path}:{error.lineno}", "", f"Python ({error.msg})") from error
    except Exception as error:
        raise InputError(path, "", f"a file that Python can run ({type(error).__name__}: {error})") from error
    return find_declared_plant(module, path.stem, path)


def find_declared_plant(module: ModuleType, name: str, file: Path | None = None) -> Plant:
    """The plant that a module declares as PLANT, with the effects beside it.

    Raises:
        InputError: there is none.
    """
    plant = vars(module).get("PLANT")
    if not isinstance(plant, Plant):
        raise InputError(file or name, "PLANT", "PLANT = Plant(...)")
    own = vars(module).get(OWN_EFFECTS, {})
    return replace(plant, name=plant.name or name, file=file, effects=own)
