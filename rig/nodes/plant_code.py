"""The plant as compiled loops call it: by the addresses of what reads it and of what moves it a cycle on."""

import ctypes
from math import nan
from typing import Any

import numpy as np

from plant import (
    ADVANCE_CALL,
    READ_CALL,
    Actuator,
    Model,
    RigError,
    build_kernel,
    find_direct_readings,
    find_function_address,
    load_stored_advance,
    read_flat_sensors,
    report_law_errors,
)
from rig.nodes.scenario import Scenario

_KINDS: dict[str, Any] = {"i": ctypes.c_int32, "q": ctypes.c_int64, "d": ctypes.c_double}
_RESULT, _LIVE_READ = 0, 21  # places among the arguments of READ_CALL: of the result, and of the parameters
_DRIVE, _LOAD, _LIVE_MOVED = 9, 10, 17  # and of ADVANCE_CALL


class CompiledPlant:
    """A plant whose code is compiled. `code`: addresses for `emulator_cycle.make_memory`."""

    problem = ""

    def __init__(self, model: Model) -> None:
        """It takes some seconds for what was never compiled before.

        Raises:
            InputError: a law that cannot be compiled.
        """
        with report_law_errors(model):
            flat, record = model.build_flat_state(), model.build_record()
            advance = load_stored_advance(model.effects, model.plant)
            advance.warm(lambda: (flat.copy(), 5e-3, 100.0, 0.0, 0.0, record, 10))
            read = 0
            if not find_direct_readings(model):
                run = build_kernel(read_flat_sensors, model.effects, plant=model.plant)
                run(flat, np.zeros(len(model.kind.signals.outputs) + 1), 0.0, record)
                read = find_function_address(run)
        self.code = advance.find_address(), read


class PlantProgram:
    """A plant that another program moves, such as an FMU. `code`: addresses of functions that ask the program."""

    def __init__(self, scenario: Scenario) -> None:
        self.problem = ""  # why it can go on no more
        self._actuator = Actuator(scenario.model, scenario.seed)
        self._actuator.warm()
        self._names = scenario.model.list_names()
        self._live = [scenario.model[name] for name in self._names]  # parameters
        self._sampled = -1  # the last cycle that was read
        functions = (ADVANCE_CALL, self._advance), (READ_CALL, self._read)
        # kept, because they are called by their addresses
        self._calls = [ctypes.CFUNCTYPE(*(_KINDS[letter] for letter in signature))(run) for signature, run in functions]
        advance, read = (int(ctypes.cast(call, ctypes.c_void_p).value or 0) for call in self._calls)
        self.code = advance, read

    def _sample(self, live_at: int) -> tuple[float, ...]:
        """The readings of this cycle; first, the parameters change that faults have changed."""
        live = [*(ctypes.c_double * len(self._names)).from_address(live_at)]
        for name, value, before in zip(self._names, live, self._live, strict=True):
            if value != before:
                self._actuator.set(name, value)
        self._live, self._sampled = live, self._actuator.cycle
        return self._actuator.sample()

    def _read(self, *words: Any) -> int:
        readings = self._sample(words[_LIVE_READ])
        place = (ctypes.c_double * len(readings)).from_address(words[_RESULT])
        place[:] = [nan] * len(readings) if self.problem else [*readings]
        return 0

    def _advance(self, *words: Any) -> int:
        if self._sampled != self._actuator.cycle:  # nobody has asked for the readings
            self._sample(words[_LIVE_MOVED])
        try:
            self._actuator.advance(words[_DRIVE], words[_LOAD])
        except RigError as error:  # its run ends, this one ends with a verdict
            self.problem = str(error)
        return 0


def load_plant(scenario: Scenario) -> CompiledPlant | PlantProgram:
    """The plant of a scenario at rest. Raises InputError for a law that cannot be compiled."""
    return CompiledPlant(scenario.model) if scenario.model.kind.foreign is None else PlantProgram(scenario)
