"""Checks of the parameters that a sequence changes: they exist, their values are possible, none contradicts another."""
from __future__ import annotations

from collections.abc import Callable, Mapping
from math import ceil
from typing import Any

from plant.errors import InputError
from plant.model import Model
from plant.parameters import check_combinations, parse_value
from plant.quantity import Quantity
from plant.segments import RATE
from rig.sequences.faults import LATEST_START, Parameter, Plan, Schedule
from rig.sequences.tables import Place

Known = Callable[[str], object]  # raises InputError for a name that no parameter has


def check_overrides(overrides: Mapping[str, float | str], place: Place, known: Known) -> bool:
    """Names and, where `known` gives their meaning, values; refusals at their lines. True: all meanings are known."""
    whole = True
    for name, value in overrides.items():
        here = place.at(*name.split("."))  # where `overrides.spool.travel` stands in the file
        here = here if here.keys in place.lines else place.at(name)
        quantity = _find_meaning(name, here, known)
        whole &= quantity is not None
        if quantity is not None:
            try:
                parse_value("", "", quantity, value)
            except InputError as error:
                raise here.refuse(error.expected) from error
    return whole


def check_faults(plan: Plan, place: Place, known: Known) -> bool:
    """The same for the parameters that faults change."""
    whole = True
    for i, fault in enumerate(plan.faults):
        if isinstance(fault, Parameter):
            quantity = _find_meaning(fault.parameter, place.at(i, "parameter"), known)
            whole &= quantity is not None
            if quantity is not None:
                try:
                    fault.find_target(quantity)
                except InputError as error:
                    raise place.at(i, error.field).refuse(error.expected) from error
    return whole


def check_together(plan: Plan, model: Model, place: Place) -> None:
    """No fault may make a parameter contradict another one of `model` at the time; refusals at its line."""
    try:
        require_sensible(plan, model)
    except Contradiction as error:
        raise place.at(error.fault).refuse(error.said) from error


class Contradiction(InputError):
    """Two parameters that no actuator can have together, brought about by the fault of that number."""

    def __init__(self, fault: int, label: str, time: float, error: InputError) -> None:
        self.fault = fault
        self.said = f"{error.field} {error.expected} at {time:g} s of main"
        super().__init__("faults", label, self.said)


def require_sensible(plan: Plan, model: Model) -> None:
    """Refuse faults whose parameters contradict each other or the model's own (plant.parameters.check_combinations).

    Raises:
        Contradiction: it names the fault.
    """
    changing = [(i, fault) for i, fault in enumerate(plan.faults) if isinstance(fault, Parameter)]
    if not changing:
        return
    schedule = Schedule(plan, model.with_effects(fault.parameter.partition(".")[0] for _, fault in changing).values)
    for i, fault in changing:
        for cycle in _list_extreme_cycles(plan, fault):
            try:
                check_combinations("faults", schedule.list_parameters(cycle))
            except InputError as error:
                raise Contradiction(i, fault.label, (cycle - plan.start) / RATE, error) from error


def _list_extreme_cycles(plan: Plan, fault: Parameter) -> tuple[int, ...]:
    """The cycles in which a ramped parameter may be extreme: first, end of the ramp, last, and the one after."""
    first, last = plan.find_cycles(fault)
    end = max(first, last - 1)
    return first, min(first + ceil(min(fault.ramp, LATEST_START) * RATE), end), end, last


def _find_meaning(name: str, place: Place, known: Known) -> Quantity | None:
    try:
        quantity: Any = known(name)
    except InputError as error:
        raise place.refuse(f"{error.expected}, not {name!r}") from error
    return quantity if isinstance(quantity, Quantity) else None
