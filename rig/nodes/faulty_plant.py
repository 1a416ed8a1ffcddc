"""The plant of a run, cycle by cycle: the actuator with the faults and the load of its scenario. No bus, no clock."""

from math import isfinite

from plant import Actuator, RigError
from rig.nodes.scenario import Scenario
from rig.sequences.faults import Schedule

DIVERGED = "the plant has diverged: a signal is not a finite number"


class FaultyPlant:
    """What the emulator moves, or the rig itself where the plant is no node of its own."""

    def __init__(self, scenario: Scenario) -> None:
        """A plant at rest. Raises InputError for an effect that cannot be compiled: it is, now."""
        self.faults = Schedule(scenario.plan, scenario.model.values)
        self.drive = 0.0  # in force until the next cycle
        self._load = scenario.load()
        self.actuator = Actuator(scenario.model, scenario.seed)
        self.actuator.warm()
        self._names = [s.name for s in scenario.model.kind.signals.outputs]
        self.problem = ""  # why the plant can go on no more
        self._changed = -1  # the last cycle whose parameters are in force
        self._last: tuple[int, tuple[float, ...] | None] = -1, None  # cycle and what the transducers said

    def read(self, k: int) -> tuple[float, ...] | None:
        """What the transducers say in cycle k, in the order of the plant's outputs; None if the plant failed.

        The first call in a cycle draws the noise and puts the faults of this cycle in force; another one says the same.
        """
        if k != self._last[0]:
            self._last = k, self._draw_readings(k)
        return self._last[1]

    def _draw_readings(self, k: int) -> tuple[float, ...] | None:
        self._change_parameters(k)
        readings = self.actuator.sample()
        if not self.problem and not isfinite(sum(readings)):
            self.problem = DIVERGED
        if self.problem:
            return None
        return tuple(self.faults.change_signal(name, reading, k)
                     for name, reading in zip(self._names, readings, strict=True))

    def move(self, k: int) -> None:
        """Advance by cycle k under its load and the drive in force."""
        if not self.problem:
            try:
                self.actuator.advance(self.drive, self._load[k] if k < len(self._load) else 0.0)
            except RigError as error:  # another program moves the plant: its run ends, this one ends with a verdict
                self.problem = str(error)

    def pass_unread(self, k: int) -> None:
        """A cycle whose readings nobody asks for: the transducers go on as well."""
        self._change_parameters(k)
        self.actuator.sample()
        self.move(k)

    def list_loads(self, k: int, cycles: int) -> list[float]:
        """The load in the cycles from k on, N; those behind its end have none and are left out."""
        return self._load[k:k + cycles]

    def pass_quiet(self, cycles: int) -> None:
        """So many cycles were simulated elsewhere, on the state of the actuator; no fault changed in them."""
        self.actuator.noise.skip(cycles)
        self.actuator.cycle += cycles

    def _change_parameters(self, k: int) -> None:
        """Set what faults have made of the plant's parameters since the last cycle."""
        for name, value in self.faults.parameters_at(k, self._changed).items():
            self.actuator.set(name, value)
        self._changed = k
