"""The catalogue: physical effects that a model may have or lack.

An effect is a law at one port of the signal path (`plant.ports`): it gets the port's signal, the state at the
start of the step, the inputs and the parameters, and returns the signal changed. Several effects at one port act in the
order of the catalogue. A law that remembers something also gets and returns its memory, a NamedTuple of floats.

    @effect("current", {"current": Quantity("A")}, law="i = i + i0")  # at 0 A the law changes nothing
    def null_bias(x, s, u, p):
        return x + p.null_bias.current

In files of users the parameters may be a NamedTuple of `Annotated[float, Quantity("A")]` as well.

The effects of `base` are parameters of the reference model itself; they have no law of their own.
"""

import importlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from plant.compile import Function
from plant.errors import require
from plant.friction import clip, play, soften
from plant.parameters import GROUPS, find_field
from plant.ports import PORTS, chain_laws
from plant.quantity import Quantity, list_quantities, make_group
from plant.state import Drag, Held, Lag, Line, Memory
from plant.tables import read_file
from plant.user_code import run_file

# some of them for files of effects: this package has all names of ours that one needs
__all__ = ["CATALOGUE", "Drag", "Effect", "Held", "Lag", "Law", "Line", "Quantity", "clip", "combine_laws", "effect",
           "load_effects", "play", "register_base", "soften"]

Law = Function


@dataclass(frozen=True, eq=False)
class Effect:
    """One entry of the catalogue."""

    name: str
    port: str  # where it acts; "" for parameters of the reference model
    law: str  # the formula, for people
    symptoms: str  # what tells it apart
    parameters: Mapping[str, Quantity]  # "group.field" to meaning
    off: Mapping[str, float]  # values at which it is absent; empty for `base` effects (there: the nominal)
    group: type[Any] | None = None
    function: Law | None = None
    memory: type[Any] | None = None
    disturbance: bool = False  # noise of the bench rather than physics of the actuator
    fitted: tuple[str, ...] = ()  # "group.field" that a fit frees; the others keep their values
    starts: tuple[Mapping[str, float], ...] = ()  # where fits and scans begin: all `fitted`, small to large, SI
    excludes: tuple[str, ...] = ()  # effects that cannot be at work together with this one
    confused_with: tuple[str, ...] = ()  # effects, or parameters, that position alone cannot tell from it
    revealed_by: str = ""  # what shows it where a usual test does not, for people
    source: str = ""  # where the law is from
    plant: str = ""  # the one plant that has it; "" for any that has its port
    searched_in: tuple[str, ...] = ()  # the plants where `rig explain` tests it unasked; () for all that can have it
    shift: Function | None = None  # (memory, m) -> memory, after an anchored replay has moved the ram by so much

    @property
    def file(self) -> Path | None:
        """Where its law is written; None for those of the reference model."""
        return Path(self.function.__code__.co_filename) if self.function else None

    @property
    def firmware(self) -> bool:
        """True when it acts in the controller: seen in Cor against Com and XJ alone."""
        return self.port == "command"

    def is_active(self, values: Mapping[str, float]) -> bool:
        """Whether parameters "group.field" leave it anything to do. (Not for `base` effects: they always do.)"""
        return any(values.get(name, self.off.get(name)) != self.off.get(name) for name in self.fitted)

    @property
    def base(self) -> bool:
        """True when the reference model has it already, so that "missing" means off its nominal value."""
        return self.function is None


class Catalogue(dict[str, Effect]):
    """Effects by name. Those of one plant, or searched in some plants only, are found by name, but not listed.

    Effects that a plant file declares are found by name where no other has it: `Model.find_effect` knows the right one.
    """

    def __init__(self) -> None:
        super().__init__()
        self.special: dict[str, Effect] = {}
        self.of_plants: dict[str, Effect] = {}

    def __missing__(self, name: str) -> Effect:
        return self.special[name] if name in self.special else self.of_plants[name]

    def add_effect(self, e: Effect) -> None:
        """Put an effect in its place."""
        (self.special if e.plant or e.searched_in else self)[e.name] = e

    def list_all(self) -> dict[str, Effect]:
        """All of them."""
        return {**self, **self.special}


CATALOGUE = Catalogue()


Start = float | tuple[float, ...]  # values of the fitted parameters, in their order
Group = type[Any] | Mapping[str, Quantity]


def effect(port: str, group: Group, *, off: Mapping[str, float] = {}, law: str, symptoms: str = "",
           memory: type[Any] | None = None, disturbance: bool = False, fitted: Sequence[str] | None = None,
           starts: Sequence[Start] = (), **more: Any) -> Callable[[Law], Law]:
    """Register a law at `port` with the parameters `group`; the function's name is the effect's.

    Args:
        port: where it acts.
        group: its parameters: a table, or a NamedTuple whose defaults are the off values.
        off: values of the table's fields at which the effect is absent, where that is not 0.
        law: the formula, for people.
        symptoms: what tells it apart, for people.
        memory: what it remembers, a NamedTuple of floats with defaults.
        disturbance: noise of the bench, which nobody fits.
        fitted: fields that a fit frees; default all.
        starts: values of these, one tuple a start; without any, `plant.starts` finds some.
        more: `shift`, `excludes`, `confused_with`, `revealed_by`, `source`, `plant`, `searched_in` of `Effect`.

    Raises:
        ValueError: unknown port, or a name already taken.
        InputError: unknown field, or a parameter without default or unit.
    """
    if port not in PORTS:
        raise ValueError(f"no port {port!r}; there are {', '.join(PORTS)}")

    def register(function: Law) -> Law:
        function = getattr(function, "py_func", function)  # an @njit function is welcome too
        if is_taken(function.__name__, Path(function.__code__.co_filename)):
            raise ValueError(f"{function.__name__}: the name is taken")
        CATALOGUE.add_effect(build_effect(function, port, group, off=off, law=law, symptoms=symptoms, memory=memory,
                                          disturbance=disturbance, fitted=fitted, starts=starts, **more))
        return function

    return register


def is_taken(name: str, file: Path) -> bool:
    """Whether a parameter group or an effect of another file has this name."""
    known = CATALOGUE.list_all().get(name)
    return name in GROUPS or (known is not None and known.file != file)


def build_effect(function: Law, port: str, group: Group, *, off: Mapping[str, float] = {}, law: str,
                 symptoms: str = "", memory: type[Any] | None = None, disturbance: bool = False,
                 fitted: Sequence[str] | None = None, starts: Sequence[Start] = (), **more: Any) -> Effect:
    """The effect of a law, with the arguments of `effect`.

    Raises:
        InputError: an unknown field, or a parameter without default or unit.
    """
    name = function.__name__
    if isinstance(group, Mapping):
        group = make_group(name, law, group, function.__module__, {**dict.fromkeys(group, 0.0), **off}.values())
    free = group._fields if fitted is None else tuple(fitted)
    if disturbance:
        free = ()
    require(set(free) <= set(group._fields), f"effect {name}", "fitted",
            f"fields of {group.__name__} ({', '.join(group._fields)}), not {', '.join(free)}")
    for field, q in list_quantities(group).items():
        require(field in group._field_defaults, f"effect {name}", field, "a default, its off value")
        require(q.unit, f"effect {name}", field, 'Quantity("unit"), "1" for none')
    meaning = {f"{name}.{field}": q for field, q in list_quantities(group).items()}
    absent = {f"{name}.{field}": float(x) for field, x in group._field_defaults.items()}
    names = tuple(f"{name}.{field}" for field in free)
    return Effect(name, port, law, symptoms, meaning, absent, group, function, memory, disturbance, names,
                  _name_starts(names, starts), **more)


def _name_starts(names: tuple[str, ...], values: Sequence[Start]) -> tuple[Mapping[str, float], ...]:
    return tuple(dict(zip(names, start if isinstance(start, tuple) else (start,), strict=True)) for start in values)


def register_base(name: str, *fields: str, **more: Any) -> None:
    """Register an effect that a plant has already: see `build_base_effect`."""
    CATALOGUE.add_effect(build_base_effect(name, *fields, **more))


def build_base_effect(name: str, *fields: str, law: str, symptoms: str = "", starts: Sequence[Start] = (),
                      groups: Mapping[str, type[Any]] = GROUPS, **more: Any) -> Effect:
    """An effect that a plant has already, by the parameters of `groups` that carry it; a fit frees all."""
    meaning = {field: find_field(f"effect {name}", field, groups) for field in fields}
    return Effect(name, "", law, symptoms, meaning, {}, fitted=fields, starts=_name_starts(fields, starts), **more)


def load_effects(path: str | Path, source: bytes | None = None) -> list[str]:
    """Run a user's effect file; the names of the effects it registered.

    `source` is its content where that has been read already; exactly these bytes run.

    Raises:
        InputError: unreadable, not Python, or it registers nothing.
    """
    path = Path(path).absolute()  # as the code of its functions will say where it comes from
    require(path.is_file(), path, "", "a Python file with effects; it does not exist")
    run_file(path, read_file(path) if source is None else source)
    new = [name for name, entry in CATALOGUE.list_all().items() if entry.file == path]
    require(new, path, "", "at least one function marked with @effect(...) of plant.effects")
    return new


def combine_laws(port: str, effects: Iterable[Effect]) -> tuple[Law, Memory]:
    """All of the effects that act at `port` as one function, with their initial memory."""
    return chain_laws((e.function, e.memory) for e in effects if e.port == port)


for _family in ("reference", "controller", "current", "servovalve", "supply", "jack", "sensors", "wear"):
    importlib.import_module(f"plant.effects.{_family}")
