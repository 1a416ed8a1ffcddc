"""The parts of a sequence that a user writes in Python: a segment, a check, and steps before and after the run."""
from __future__ import annotations

import contextlib
import inspect
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite, nan
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any, Literal, NamedTuple

import numpy as np

from plant.errors import InputError
from plant.segments import RATE, Array, Timed, require
from rig.sequences.check import Check, require_check
from rig.sequences.measures import NotMeasurable, RunData

_OWN = {"key": False}  # a field that the program fills in
_SIGNALS = ("com", "xj", "cor", "p12", "xs", "load")


@dataclass(frozen=True, kw_only=True)
class PythonSegment(Timed):
    """A demand that a function computes: f(t, start, **arguments).

    The function gets the times of the cycles in s from the segment's start, and the demand where it starts; it returns
    a demand in m (N for a load) for each. The time after the last cycle is among them: the next segment starts there.
    """

    kind = "python"
    python: str
    arguments: Mapping[str, Argument] = field(default_factory=dict)
    function: UserFunction | None = field(default=None, repr=False, compare=False, metadata=_OWN)
    known: dict[float, Array] = field(default_factory=dict, repr=False, compare=False, metadata=_OWN)  # by start

    def __post_init__(self) -> None:
        super().__post_init__()
        require_function_name(self.python)

    def demand(self, t: Array, last: float) -> Array:
        if last not in self.known:  # a profile is built several times; it must be the same each time
            self.known[last] = self._compute(t.copy(), last)
        return self.known[last].copy()

    def _compute(self, t: Array, last: float) -> Array:
        assert self.function is not None
        returned = self.function.call(t, last, **self.arguments)
        try:
            values = np.asarray(returned, dtype=np.float64)
        except (TypeError, ValueError):
            values = np.empty(0)
        is_whole = values.shape == t.shape and bool(np.isfinite(values).all())
        require(is_whole, "python", f"a function that returns {len(t)} finite numbers, one for each time; "
                                    f"{self.python} returned {_describe_value(returned)}")
        return values


class Window(NamedTuple):
    """What a user's check gets: the cycles of its window as columns, SI units, NaN where a sample is missing."""

    t: Array  # s of main
    com: Array  # m
    xj: Array  # m
    cor: Array  # A
    p12: Array  # Pa
    xs: Array  # m
    load: Array  # N

    @property
    def error(self) -> Array:
        """Demand minus position, m."""
        return self.com - self.xj


@dataclass(frozen=True, kw_only=True)
class PythonCheck(Check):
    """A number that a function of yours measures.

    It is called as f(window, **arguments) and returns the number in the check's unit, which may be any text.
    """

    kind, si = "python", "1"
    python: str
    arguments: Mapping[str, Argument] = field(default_factory=dict)
    function: UserFunction | None = field(default=None, repr=False, compare=False, metadata=_OWN)

    def __post_init__(self) -> None:
        super().__post_init__()
        require_function_name(self.python)
        require_check(self.unit.isprintable() and len(self.unit) <= 20, "unit", "a unit of at most 20 characters")

    @property
    def scale(self) -> float:
        return 1.0

    def measure(self, run: RunData, span: slice) -> float:
        assert self.function is not None
        nothing = np.full(span.stop - span.start, nan)
        columns = [getattr(run.trace, name, None) for name in _SIGNALS]
        cut = [nothing if column is None else np.array(column[span], dtype=np.float64) for column in columns]
        t = np.arange(span.start, span.stop) / RATE
        value = self.function.call(Window(t, *cut), **self.arguments)
        if value is None:
            raise NotMeasurable(f"{self.python} returned no value")
        try:
            number = float(value)
        except (TypeError, ValueError):
            raise NotMeasurable(f"{self.python} returned {_describe_value(value)}, not a number") from None
        if not isfinite(number):
            raise NotMeasurable(f"{self.python} returned {number:g}")
        return number


class StepRun(NamedTuple):
    """What a user's step gets of the run."""

    title: str  # of the sequence
    folder: Path  # of the results
    seed: int
    settings: Mapping[str, object]  # bus, pace, controller, model, ..
    verdict: str  # "" before the run, and after one that has none


@dataclass(frozen=True, kw_only=True)
class Step:
    """A function that runs before the bus is opened, or after the log is closed: f(run, **arguments)."""

    python: str
    when: Literal["before", "after"]
    arguments: Mapping[str, Argument] = field(default_factory=dict)
    function: UserFunction | None = field(default=None, repr=False, compare=False, metadata=_OWN)

    def __post_init__(self) -> None:
        require_function_name(self.python)

    def play(self, run: StepRun) -> None:
        """Call the function. Raises InputError with file and line if it raises an exception."""
        assert self.function is not None
        self.function.call(run, **self.arguments)


PythonPart = PythonSegment | PythonCheck | Step
VALUES_OF_PART: dict[type[Any], int] = {PythonSegment: 2, PythonCheck: 1, Step: 1}  # that the function gets


def _describe_value(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}" + ("" if np.isfinite(value).all() else " with NaN or infinity")
    return f"{type(value).__name__} {value!r:.60}"


Argument = float | str | bool
_NAME = re.compile(r"(\w[\w-]*\.py):([A-Za-z_]\w*)")


@dataclass(frozen=True)
class UserFunction:
    """A function of a user's file; `file` is where messages say that it stands."""

    file: str
    name: str
    function: Any

    def call(self, *values: object, **arguments: Argument) -> Any:
        """What the function returns.

        Raises:
            InputError: it raised an exception or ended the program; the error names file and line.
        """
        try:
            with contextlib.redirect_stdout(sys.stderr):  # standard output may be one JSON object
                return self.function(*values, **arguments)
        except InputError:
            raise
        except (Exception, SystemExit) as error:
            raise explain_error(self.file, self.name, error) from error

    def require_arguments(self, given: int, arguments: Mapping[str, Argument]) -> None:
        """Refuse a function that does not take so many values and these named arguments.

        Raises:
            InputError: it names the function.
        """
        try:
            inspect.signature(self.function).bind(*range(given), **arguments)
        except TypeError as error:
            line = self.function.__code__.co_firstlineno if inspect.isfunction(self.function) else 1
            raise InputError(f"{self.file}:{line}", self.name,
                             f"a function of {describe_call(given, arguments)} ({error})") from error
        except ValueError:  # a function in C without a signature
            return


def describe_call(given: int, arguments: Mapping[str, Argument]) -> str:
    """How a function is called, in words."""
    named = f" and the arguments {', '.join(arguments)}" if arguments else ""
    return f"{given} value{'s' if given > 1 else ''}{named}"


def require_function_name(text: str) -> tuple[str, str]:
    """File and function of "FILE.py:FUNCTION".

    Raises:
        InputError: another text, or a file in another folder than the sequence.
    """
    match = _NAME.fullmatch(text)
    if match is None:
        raise InputError("python", "python", f"FILE.py:FUNCTION, a file beside the sequence, not {text!r}")
    return match[1], match[2]


@dataclass
class UserModules:
    """The user's files of one sequence; each runs once. `folder` is where messages say that they stand."""

    folder: Path
    modules: dict[str, ModuleType] = field(default_factory=dict)

    def find_function(self, file: str, source: bytes, name: str) -> UserFunction:
        """A function of a file with this source.

        Raises:
            InputError: the file cannot be run, or has no such function.
        """
        path = self.folder / file
        if file not in self.modules:
            self.modules[file] = run_file(path, source)
        function = getattr(self.modules[file], name, None)
        if not callable(function):
            raise InputError(path, name, "a function of this name in that file")
        return UserFunction(str(path), name, function)


def run_file(path: Path, source: bytes) -> ModuleType:
    """Run a user's file as a module of its own.

    Raises:
        InputError: it is not Python, or raises an exception; the error names the line.
    """
    module = ModuleType(f"steps_of_{path.stem}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # where dataclasses look up their annotations
    try:
        with contextlib.redirect_stdout(sys.stderr):
            exec(compile(source, str(path), "exec", dont_inherit=True), module.__dict__)
    except (Exception, SystemExit) as error:
        raise explain_error(str(path), "", error) from error
    return module


def explain_error(file: str, name: str, error: BaseException) -> InputError:
    """An exception of a user's code as bad input, with the last line of his file that it came through."""
    if isinstance(error, SyntaxError) and error.filename == file:
        return InputError(f"{file}:{error.lineno}", name, f"Python ({error.msg})")
    line = _find_line(error.__traceback__, file)
    text = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return InputError(f"{file}:{line}" if line else file, name, f"code that runs without an exception, not {text}")


def _find_line(trace: TracebackType | None, file: str) -> int:
    line = 0
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == file:
            line = trace.tb_lineno
        trace = trace.tb_next
    return line
