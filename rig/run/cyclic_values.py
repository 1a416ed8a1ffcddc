"""Which values a cycle has: those that the rig gives, those that it sends besides, and those that come back."""
from __future__ import annotations

from collections.abc import Collection, Mapping
from math import nan
from typing import Any, NamedTuple

from rig.benches.bench import RIG_OUTPUTS, Bench
from rig.benches.frame_map import Role
from rig.recorder.schema import Signals, make_row_record

# Numbers of phases: set-up, main, clean-up; then those of the probes, of which the log has the frames only
BEFORE, AFTER, BEFORE_MAIN = 3, 4, 5
_PHASES = ("setup", "main", "cleanup", "setup", "cleanup", "main")  # whose values are sent
_NO_LOAD = "load"  # stands for the load of a plant that has none


class CycleInput(NamedTuple):
    """Inputs of one cycle."""

    phase: int  # 0 set-up, 1 main, 2 clean-up; of the probes see above
    demand: float  # SI, as the load
    load: float  # on the plant, from the scenario
    control: int  # control word; of a controller without one: 0 for the values of the safe state
    is_counted: bool = True  # False: the controller is being enabled, the run has not begun and the plant rests


class CyclicValues:
    """The values of a bench by name, in one order: given by the rig, sent by it besides, received.

    And the rows that these make: a column for each signal of the plant, whatever it is called.
    """

    def __init__(self, bench: Bench) -> None:
        controller, signals = bench.nodes.get(Role.CONTROLLER), bench.signals
        self._mode = 0.0 if controller is None else float(controller.mode or 0)
        self._phases = bench.phases
        self.command, self.drive = signals.command.word, signals.drive.word
        self.load = _NO_LOAD if signals.load is None else signals.load.word
        self.readings = tuple(s.word for s in signals.outputs)  # in the order of the transducers
        self.given = (self.command, self.load, "control_word", "mode", *bench.phases)
        read = (*self.readings, "flags")
        self.sent = self.given if bench.has_plant_node else (*self.given, *read)
        received = [name for name in (*read, self.drive, *RIG_OUTPUTS, *bench.ready)
                    if name not in self.sent and name != "cycle"]
        self.names = (*self.sent, *dict.fromkeys(received))
        self.place = {name: i for i, name in enumerate(self.names)}
        fed = {each.name for spec in bench.frames.frames if "feedback" in spec.roles for each in spec.fields}
        role = {signals.drive.name: "drive", **{s.name: "feedback" if s.word in fed else "valve_state"
                                                for s in signals.outputs}}
        self._columns = [(s.name, s.word, role.get(s.name, "")) for s in signals[1:]]  # and the frame that brings each
        self._given = [s.name for s in (signals.command, signals.load) if s is not None]
        self._record: Any = make_row_record(signals)

    def open_row(self, k: int, phase: int, demand: float, load: float, control: int) -> Signals:
        """The row of cycle k before anything has come."""
        row: Signals = self._record(k, phase, *(nan for _ in self._columns), control, 0, 0)
        setattr(row, self._given[0], demand)
        if len(self._given) > 1:
            setattr(row, self._given[1], load)
        return row

    def fill_row(self, row: Signals, values: Mapping[str, float], came: Collection[str]) -> None:
        """Put the values of the bench into a row that the frames of these roles have brought."""
        for name, word, role in self._columns:
            if role in came:
                setattr(row, name, values[word])
        if "valve_state" in came:
            row.flags = int(values["flags"])
        if "drive" in came:
            row.status = int(values["status_word"])

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
