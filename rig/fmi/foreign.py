"""A foreign unit as a plant: what its file says of it, and the process that runs it."""

import contextlib
import re
import signal as signals_of_processes
import socket
import subprocess
import sys
import tempfile
import weakref
import zipfile
from collections.abc import Mapping, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from threading import RLock
from typing import Any, NamedTuple

import numpy as np

from plant import Array, Diverged, InputError, Place, RigError, require, suggest_name
from rig.fmi.host import Settings, Variable

LONGEST_CALL = 20.0  # s, of starting, or of so many cycles: a unit that takes longer hangs
CYCLES_A_CALL = 100
_NUMBERS = {"Real": "Real", "Integer": "Integer", "Enumeration": "Integer", "Boolean": "Boolean"}  # FMI 2


class Port(NamedTuple):
    """A signal of the rig as a variable of the unit: signal = worth * variable."""

    name: str  # of the signal or parameter
    variable: Variable
    worth: float = 1.0  # of one of the variable, in the SI unit of the signal


class Description(NamedTuple):
    """What the file of a unit says of it."""

    path: Path
    library: str  # in the archive
    variables: Mapping[str, Any]  # of FMPy, by name
    version: str
    step: float | None  # s, where the unit has a fixed one


def read_description(path: Path) -> Description:
    """The description of a unit that can run here.

    Raises:
        InputError: no unit, or one that cannot run here, and what would.
    """
    try:
        import fmpy
    except ImportError:
        raise InputError(path, "", "the package fmpy to run FMUs: pip install 'eha-rig[fmu]'") from None
    require(zipfile.is_zipfile(path), path, "",
            "an FMU, a zip archive with a modelDescription.xml" if path.is_file() else "an FMU; it does not exist")
    version = "none"
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            version = (re.findall(rb"""fmiVersion\s*=\s*["'](.*?)["']""", archive.read("modelDescription.xml")) or
                       [b"none"])[0].decode(errors="replace")
        if version[:2] in ("2.", "3."):
            description = fmpy.read_model_description(str(path), validate=False)
    except Exception as error:  # FMPy raises Exception itself
        message = " ".join(str(error).split())
        raise InputError(path, "modelDescription.xml", f"that of an FMU 2.0 or 3.0 ({message})") from error
    require(version[:2] in ("2.", "3."), path, "fmiVersion", f"2.0 or 3.0, not {version}")
    unit = description.coSimulation
    kind = "model exchange" if description.modelExchange is not None else "scheduled execution"
    require(unit is not None, path, "", f"an FMU for co-simulation; this one is for {kind} only")
    folders = [fmpy.platform_tuple, *([fmpy.platform] if version[0] == "2" else [])]
    libraries = [f"binaries/{folder}/{unit.modelIdentifier}{fmpy.sharedLibraryExtension}" for folder in folders]
    library = next((name for name in libraries if name in names), None)
    if library is None:
        binaries = sorted(name for name in names if name.startswith("binaries/") and not name.endswith("/"))
        content = f"only {', '.join(binaries)}" if binaries else "none"
        if any(name.startswith("sources/") for name in names):
            content += f" and source code: python -m fmpy compile {path.name}"
        raise InputError(path, "binaries", f"a library {libraries[-1]}; it has {content}")
    variables = {v.name: v for v in description.modelVariables}
    step = unit.fixedInternalStepSize
    return Description(path, library, variables, version, None if step is None else float(step))


def find_variable(description: Description, name: str, causality: Sequence[str], place: Place) -> Variable:
    """A number of the unit, by its name; `place` is where it is named.

    Raises:
        InputError: there is none, or one of another kind.
    """
    variable = description.variables.get(name)
    if variable is None:
        hint = suggest_name(name, list(description.variables))
        raise place.refuse(f"a variable of {description.path.name}, not {name!r}{hint}")
    place.require(variable.causality in causality,
                  f"a variable that is {' or '.join(causality)}; {name} is {variable.causality}")
    kind = _NUMBERS.get(variable.type) if description.version[0] == "2" else (
        variable.type.replace("Enumeration", "Int64"))
    if kind is None or kind in ("String", "Binary", "Clock") or variable.dimensions:
        raise place.refuse(f"a variable that is one number; {name} is of type {variable.type}")
    return int(variable.valueReference), kind


class Unit:
    """A foreign unit that runs in a process of its own; the first call starts it."""

    def __init__(self, description: Description, inputs: Sequence[Port], outputs: Sequence[Port],
                 parameters: Sequence[Port], cycle: float) -> None:
        """Unpacks the unit. `cycle` is the length of a step in s.

        Raises:
            InputError: the unit takes steps of another length.
        """
        step = description.step
        require(not step or abs(cycle / step - round(cycle / step)) <= 1e-6, description.path,
                "fixedInternalStepSize",
                f"a step of which the cycle of {cycle * 1e3:g} ms is a multiple, not {(step or 0.0) * 1e3:g} ms")
        self._path, self._library, self._cycle = description.path, description.library, cycle
        self._inputs, self._outputs, self._parameters = tuple(inputs), tuple(outputs), tuple(parameters)
        self._lock = RLock()
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None
        self._hangs = ""  # what is said of a unit that has hung once

    def begin(self, values: Mapping[str, float]) -> Array:
        """Start anew with these parameters; the readings at time 0."""
        self._k = 0
        return self._scale(self._ask("begin", self._list_settings(values)))

    def change(self, name: str, value: float) -> None:
        """Change a parameter of the running unit."""
        self._ask("change", self._list_settings({name: value}))

    def step(self, drive: float, load: float) -> Array:
        """One cycle with these inputs; the readings at its end."""
        self._k += 1
        return self._scale(self._ask("step", [x / p.worth for x, p in zip((drive, load), self._inputs, strict=False)]))

    def run(self, values: Mapping[str, float], given: Array) -> Array:
        """The readings (n, outputs) before each cycle of a whole run; `given` has drive and load of each, (n, 2)."""
        worth = [port.worth for port in self._inputs]
        rows = (given[:-1, :len(worth)] / worth).tolist()
        with self._lock:  # no other run in between
            readings = [self._ask("begin", self._list_settings(values))]
            for k in range(0, len(rows), CYCLES_A_CALL):
                readings += self._ask("run", rows[k:k + CYCLES_A_CALL])
        return self._scale(readings)

    def close(self) -> None:
        """End the process."""
        process, self._process = self._process, None
        if process is not None and self._connection is not None:
            self._connection.close()
            process.kill()
            process.wait()

    def _scale(self, values: Any) -> Array:
        readings: Array = np.asarray(values, float) * [port.worth for port in self._outputs]
        if not np.isfinite(readings).all():
            rows = np.atleast_2d(readings)
            k, i = np.argwhere(~np.isfinite(rows))[0]
            t = (self._k if readings.ndim == 1 else k) * self._cycle
            raise Diverged(f"{self._path}: the unit gives {rows[k, i]} for {self._outputs[i].name} at {t:.6g} s")
        return readings

    def _list_settings(self, values: Mapping[str, float]) -> Settings:
        return [(port.variable, values[port.name] / port.worth) for port in self._parameters if port.name in values]

    def _ask(self, name: str, *arguments: Any) -> Any:
        """The answer of the process. Raises Diverged: the unit refuses. Raises RigError: it crashes or hangs."""
        with self._lock:  # analyses run in threads
            if self._hangs:
                raise RigError(self._hangs)
            if self._process is None:
                self._start()
            process, connection = self._process, self._connection
            assert process is not None and connection is not None
            with contextlib.suppress(OSError, EOFError):
                connection.send((name, arguments))
                if connection.poll(LONGEST_CALL):
                    word, result = connection.recv()
                    if word == "done":
                        return result
                    self.close()
                    raise Diverged(f"{self._path}: {result}")
                self.close()
                self._hangs = (f"{self._path}: the unit has not answered for {LONGEST_CALL:g} s in {name}; "
                               "it was stopped")
                raise RigError(self._hangs)
            status = process.wait()
            self.close()
            cause = signals_of_processes.Signals(-status).name if status < 0 else f"exit status {status}"
            message_lines = Path(self._folder.name, "messages.txt").read_text(errors="replace").split("\n")
            last = next((f"; its last message: {line.strip()}" for line in reversed(message_lines) if line.strip()), "")
            raise RigError(f"{self._path}: the unit crashed in {name} ({cause}){last}")

    def _start(self) -> None:
        """Unpack the unit, and load it in a process of its own."""
        self._folder = tempfile.TemporaryDirectory(prefix="eha-rig-fmu-")
        with zipfile.ZipFile(self._path) as archive:
            archive.extractall(self._folder.name)  # it refuses names that lead out of the folder
        rig_socket, host_socket = socket.socketpair()
        with Path(self._folder.name, "messages.txt").open("wb") as messages, host_socket:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "rig.fmi.host", str(host_socket.fileno()), self._folder.name],
                pass_fds=[host_socket.fileno()], stdin=subprocess.DEVNULL, stdout=messages, stderr=messages,
                start_new_session=True)
        self._connection = Connection(rig_socket.detach())
        weakref.finalize(self, self._process.kill)
        self._ask("load", self._folder.name, str(Path(self._folder.name, self._library)),
                  [port.variable for port in self._inputs], [port.variable for port in self._outputs], self._cycle)
