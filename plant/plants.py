"""The plants: each is a step function with its parameters, built from the same parts and effects.

A plant's `step` and `coefficients` stand in place of the reference model's in every kernel (`plant.compile` binds by
name), so single runs, lanes, emulator and fits work with every plant.
"""
from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant import signals
from plant import step as reference
from plant.compile import Function, list_called_names
from plant.effects import Effect
from plant.errors import InputError
from plant.parameters import GROUPS, load_nominal_values
from plant.quantity import Quantity
from plant.signals import Signals

Array = NDArray[np.float64]
MODULES = {"ehs": "plant.ehs"}  # plants beside the reference model; read when first named


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
    """One kind of actuator."""

    name: str
    signals: Signals  # what commands it, drives it and is measured of it
    step: Function  # (state, input, parameters, coefficients) -> state
    coefficients: Function  # (parameters, step length) -> a NamedTuple of floats
    groups: Mapping[str, type[Any]]  # its parameters
    given: Mapping[str, float]  # their values, 0 if not given; and what is not as usual here of effects' parameters
    has: tuple[str, ...] = ()  # effects of the nominal model
    lacks: tuple[str, ...] = ()  # effects that cannot be
    scatter: Mapping[str, float] | None = None  # tolerances, a fraction, of parameters; None: as their groups say
    controller: bool = True  # the controller is known, so that the drive can be held against command and output
    balances: bool = False  # `plant.forced` balances flow and force of its jack, as measured signals have them
    tables: tuple[Table, ...] = field(default=(), repr=False)  # of the files that its rig writes
    measured_pressures: MeasuredPressures | None = None  # how they drive the plant; None: they cannot

    @cached_property
    def nominal(self) -> Mapping[str, float]:
        """All values of the nominal plant, "group.field" to SI value."""
        zero = {f"{group}.{name}": 0.0 for group, cls in self.groups.items() for name in cls._fields}
        return {**zero, **self.given}

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
    return Plant("eha", signals.EHA, reference.step_plant, reference.compute_coefficients, GROUPS,
                 load_nominal_values(), balances=True)
