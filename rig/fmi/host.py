"""Runs a foreign unit in a process of its own: `python -m rig.fmi.host CONNECTION FOLDER`.

A unit is somebody else's machine code. If it crashes or hangs, only this process does. Requests are a name and its
arguments, the first one `load`; answers are ("done", result) or ("failed", what went wrong). rig/fmi/foreign.py asks.
"""

import ctypes
import os
import shutil
import sys
import threading
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any

Variable = tuple[int, str]  # value reference, and type in the names of FMPy's functions: Real, Float64, Boolean, ..
Settings = Sequence[tuple[Variable, float]]


Groups = dict[str, tuple[list[int], list[int]]]  # by type: places in a list of values, and value references


def _group(variables: Sequence[Variable]) -> Groups:
    """Variables of one type are set and read by one call."""
    groups: Groups = {}
    for i, (reference, kind) in enumerate(variables):
        places, references = groups.setdefault(kind, ([], []))
        places.append(i)
        references.append(reference)
    return groups


class Library(ctypes.CDLL):
    """A library that may lack functions of the interface that nobody calls: FMPy looks for all of them."""

    def __getattr__(self, name: str) -> Any:
        try:
            return super().__getattr__(name)
        except AttributeError:
            return lambda *arguments: 3  # the status fmiError


class Host:
    """An instance of an unpacked unit."""

    def __init__(self, folder: str, library: str, inputs: Sequence[Variable], outputs: Sequence[Variable],
                 cycle: float) -> None:
        import fmpy

        self._place, self._cycle = (folder, library), cycle
        self._inputs, self._outputs = _group(inputs), _group(outputs)
        self._count = len(outputs)
        self._description = fmpy.read_model_description(folder, validate=False)
        self._unit: Any = None
        self._k = -1  # the step to come; -1 until it is initialised
        self.message = ""  # its last message

    def begin(self, settings: Settings) -> list[float]:
        """Start anew with these parameters; the outputs at time 0."""
        self._k = -1
        if self._unit is not None and self._description.coSimulation.canBeInstantiatedOnlyOncePerProcess:
            self._unit.reset()
        else:
            self._instantiate()
        if self._description.fmiVersion.startswith("2"):
            self._unit.setupExperiment(startTime=0.0)
        self.change(settings)
        self._unit.enterInitializationMode()
        self._unit.exitInitializationMode()
        outputs = self._read()
        self._k = 0
        return outputs

    def change(self, settings: Settings) -> None:
        """Set parameters, those of a running unit too."""
        self._write(_group([variable for variable, _ in settings]), [value for _, value in settings])

    def step(self, values: Sequence[float]) -> list[float]:
        """One cycle with these inputs; the outputs at its end."""
        self._write(self._inputs, values)
        t = self._k * self._cycle
        answer = self._unit.doStep(t, self._cycle)
        if answer and answer[1]:
            raise RuntimeError("the unit asks to end the simulation")
        if answer and abs(answer[3] - t - self._cycle) > 0.5 * self._cycle:
            raise RuntimeError(f"the unit stopped within a step, at {answer[3]:.6g} s")
        self._k += 1
        return self._read()

    def run(self, rows: Sequence[Sequence[float]]) -> list[list[float]]:
        """The outputs at the end of each of some cycles, from the inputs of each."""
        return [self.step(row) for row in rows]

    def describe_failure(self, error: Exception) -> str:
        """When and how a call failed, with the last message of the unit."""
        message = f"; its message: {self.message}" if self.message else ""
        tool = "; it needs the tool that made it" if self._description.coSimulation.needsExecutionTool else ""
        usual = self._description.defaultExperiment
        if self._k == 0 and usual is not None and usual.stepSize:
            tool += f"; the steps that it suggests are of {usual.stepSize} s, controller.period"
        if "Failed to instantiate" in str(error) and not message:
            message = "; the guid, or instantiationToken, in its modelDescription.xml may not be that of its binary"
        return f"{str(error).rstrip('.')} at {max(self._k, 0) * self._cycle:.6g} s{message}{tool}"

    def _instantiate(self) -> None:
        from fmpy import fmi1  # the base of all versions
        from fmpy.simulation import instantiate_fmu

        fmi1.cdll = ctypes.LibraryLoader(Library)
        if self._unit is not None:
            self._unit.freeInstance()
        self._unit = None
        folder, library = self._place
        self._unit = instantiate_fmu(folder, self._description, "CoSimulation", logger=self._log, library_path=library,
                                     require_functions=False)

    def _write(self, groups: Groups, values: Sequence[float]) -> None:
        for kind, (places, references) in groups.items():
            exact = [values[i] if kind in ("Real", "Float64", "Float32") else round(values[i]) for i in places]
            getattr(self._unit, f"set{kind}")(references, exact)

    def _read(self) -> list[float]:
        outputs = [0.0] * self._count
        for kind, (places, references) in self._outputs.items():
            for i, value in zip(places, getattr(self._unit, f"get{kind}")(references), strict=True):
                outputs[i] = float(value)
        return outputs

    def _log(self, *words: Any) -> None:
        """A message of the unit; its text is the last argument in both versions."""
        self.message = " ".join(words[-1].decode(errors="replace").split())
        print(self.message, file=sys.stderr, flush=True)


def serve(connection: Connection) -> None:
    """Answer requests until the other end closes."""
    host: Host | None = None
    while True:
        try:
            name, arguments = connection.recv()
        except (EOFError, OSError):
            return
        try:
            if host is None:
                host, result = Host(*arguments), None
            else:
                result = getattr(host, name)(*arguments)
        except Exception as error:
            connection.send(("failed", str(error) if host is None else host.describe_failure(error)))
        else:
            connection.send(("done", result))


def end_after_rig(parent: int, folder: str) -> None:
    """Remove the unpacked unit and end this process, hung or not, as soon as the rig has ended.

    `rig.interrupts.end_with` would end it with the thread that has started it, and analyses start units in threads.
    """
    never = threading.Event()
    while os.getppid() == parent:
        never.wait(0.5)
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)


if __name__ == "__main__":
    threading.Thread(target=end_after_rig, args=(os.getppid(), sys.argv[2]), daemon=True).start()
    serve(Connection(int(sys.argv[1])))
