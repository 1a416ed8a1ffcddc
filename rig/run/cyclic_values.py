"""Which values a cycle has: those that the rig gives, those that it sends besides, and those that come back."""
from __future__ import annotations

from collections.abc import Mapping
from math import nan
from typing import NamedTuple

from rig.benches.bench import OUTPUTS, Bench
from rig.benches.frame_map import Role

# Numbers of phases: set-up, main, clean-up; then those of the probes, of which the log has the frames only
BEFORE, AFTER, BEFORE_MAIN = 3, 4, 5
_PHASES = ("setup", "main", "cleanup", "setup", "cleanup", "main")  # whose values are sent
_GIVEN = ("position_demand", "load_force", "control_word", "mode")
_READ = ("ram_position", "load_pressure", "spool_position", "flags")  # in the order of the transducers


class CycleInput(NamedTuple):
    """Inputs of one cycle."""

    phase: int  # 0 set-up, 1 main, 2 clean-up; of the probes see above
    demand: float  # m
    load: float  # N, force on the ram from the scenario
    control: int  # control word; of a controller without one: 0 for the values of the safe state
    is_counted: bool = True  # False: the controller is being enabled, the run has not begun and the plant rests


class CyclicValues:
    """The values of a bench by name, in one order: given by the rig, sent by it besides, received."""

    def __init__(self, bench: Bench) -> None:
        controller = bench.nodes.get(Role.CONTROLLER)
        self._mode = 0.0 if controller is None else float(controller.mode or 0)
        self._phases = bench.phases
        self.given = (*_GIVEN, *bench.phases)
        self.sent = self.given if bench.has_plant_node else (*self.given, *_READ)
        received = [name for name in (*_READ, *OUTPUTS, *bench.ready) if name not in self.sent and name != "cycle"]
        self.names = (*self.sent, *dict.fromkeys(received))
        self.place = {name: i for i, name in enumerate(self.names)}

    def list_given(self, step: CycleInput) -> list[float]:
        """The values that the rig gives in a cycle, SI; of fields of the device the physical value of its DBC."""
        phase = _PHASES[step.phase] if step.control else "safe"
        return [step.demand, step.load, float(step.control), self._mode,
                *(find_phase_value(values, phase) for values in self._phases.values())]

    def list_safe(self, control: int) -> list[float]:
        """What replaces the given values in the safe state; NaN where nothing does."""
        return [nan, nan, float(control), nan, *(find_phase_value(values, "safe") for values in self._phases.values())]


def find_phase_value(values: Mapping[str, float], phase: str) -> float:
    """The value of a field in a phase; in the safe state that of clean-up, if the bench file says nothing else."""
    return float(values.get(phase, values.get("cleanup", 0.0)))
