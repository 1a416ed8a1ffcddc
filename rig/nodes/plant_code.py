"""The plant as compiled loops call it: by the address of what reads it and of what moves it a cycle on."""

import ctypes
from collections.abc import Callable
from math import nan
from typing import Any

import numpy as np

from plant import Actuator, Model, RigError
from plant.machine_code import ADVANCE_CALL, READ_CALL, find_function_address
from plant.model import build_kernel
from plant.run import find_direct_readings, load_stored_advance, report_law_errors
from plant.solve import read_flat_sensors
from rig.nodes.scenario import Scenario

_KINDS: dict[str, Any] = {"i": ctypes.c_int32, "q": ctypes.c_int64, "d": ctypes.c_double}
_RESULT, _DRIVE, _LOAD, _LIVE = 0, 9, 10, 21  # places among the arguments of the calls


def compile_plant(model: Model) -> tuple[int, int]:
    """Addresses of the compiled plant for `make_memory`; some seconds for what was never compiled before.

    Raises:
        InputError: a law that cannot be compiled.
    """
    with report_law_errors(model):
        flat, record = model.build_flat_state(), model.build_record()
        code = load_stored_advance(model.effects, model.plant)
        code.warm(lambda: (flat.copy(), 5e-3, 100.0, 0.0, 0.0, record, 10))
        read = 0
        if not find_direct_readings(model):
            run = build_kernel(read_flat_sensors, model.effects, plant=model.plant)
            run(flat, np.zeros(len(model.kind.signals.outputs) + 1), 0.0, record)
            read = find_function_address(run)
    return code.find_address(), read


class PlantProgram:
    """A plant that another program moves, such as an FMU. `code`: addresses as those of `compile_plant`."""

    def __init__(self, scenario: Scenario) -> None:
        self.problem = ""  # why it can go on no more
        self._actuator = Actuator(scenario.model, scenario.seed)
        self._actuator.warm()
        self._names = scenario.model.list_names()
        self._live = [scenario.model[name] for name in self._names]
        self._calls = _declare(ADVANCE_CALL, self._advance), _declare(READ_CALL, self._read)  # kept with it
        self.code = [int(ctypes.cast(call, ctypes.c_void_p).value or 0) for call in self._calls]

    def _read(self, *words: Any) -> int:
        """Change the parameters that faults have changed, and write the readings where the caller wants them."""
        live = [*(ctypes.c_double * len(self._names)).from_address(words[_LIVE])]
        for name, value, before in zip(self._names, live, self._live, strict=True):
            if value != before:
                self._actuator.set(name, value)
        self._live, readings = live, self._actuator.sample()
        place = (ctypes.c_double * len(readings)).from_address(words[_RESULT])
        place[:] = [nan] * len(readings) if self.problem else [*readings]
        return 0

    def _advance(self, *words: Any) -> int:
        try:
            self._actuator.advance(words[_DRIVE], words[_LOAD])
        except RigError as error:  # its run ends, this one ends with a verdict
            self.problem = str(error)
        return 0


def _declare(signature: str, function: Callable[..., int]) -> Any:
    """The function for callers in machine code."""
    return ctypes.CFUNCTYPE(*(_KINDS[letter] for letter in signature))(function)
