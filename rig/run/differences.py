"""What of a run differs from the nominal test: the model, its parameters and effects, the faults of the sequence."""
from __future__ import annotations

from typing import Any, NamedTuple

from plant.model import find_quantity
from rig.run.job import Job


class Differences(NamedTuple):
    """What differs from the nominal unit in a test without faults."""

    model: str  # its name, if it is not the nominal model; else ""
    parameters: dict[str, float]  # SI, those that are not nominal, and all of the model's effects
    effects: tuple[str, ...]  # of the model
    effect_files: tuple[str, ...]  # the user's own
    faults: tuple[str, ...]  # of the sequence, with their times

    def describe(self) -> str:
        """All differences in one line; "nothing" if there are none."""
        parts = [f"model {self.model}"] if self.model else []
        parts += [_describe_parameter(name, value) for name, value in self.parameters.items()]
        parts += [f"effect {name}" for name in self.effects if not any(key.startswith(f"{name}.")
                                                                       for key in self.parameters)]
        parts += [f"effects of {name}" for name in self.effect_files]
        parts += [f"fault {text}" for text in self.faults]
        return "; ".join(parts) or "nothing"

    def to_json(self) -> dict[str, Any]:
        """The entry `differences` of verdict.json."""
        return {**self._asdict(), "text": self.describe()}


def find_differences(job: Job) -> Differences:
    """What of a job differs from the nominal test."""
    model = job.model
    faults = []
    for fault in job.sequence.faults:
        until = "" if fault.end is None else f" to {fault.end:g} s"
        faults.append(f"{fault.label!r} from {fault.start:g} s{until}")
    return Differences(model="" if model.name == "eha" else model.name, parameters=model.list_changes(),
                       effects=tuple(model.effects), effect_files=tuple(path.name for path in job.effects),
                       faults=tuple(faults))


def _describe_parameter(name: str, value: float) -> str:
    quantity = find_quantity(name)
    word = next((word for word, number in quantity.words.items() if number == value), None)
    unit = "" if quantity.unit == "1" else f" {quantity.unit}"
    return f"{name} = {word}" if word else f"{name} = {value:g}{unit}"
