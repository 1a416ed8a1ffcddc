"""The parts of a sequence that a user writes in Python: a segment, a check, and steps before and after the run."""

import contextlib
import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from plant import Array, InputError, Timed, explain_errors, require

Argument = float | str | bool
OWN = {"key": False}  # a field that the program fills in
_NAME = re.compile(r"(\w[\w-]*\.py):([A-Za-z_]\w*)")


@dataclass(frozen=True, kw_only=True)
class PythonPart:
    """What calls a function of the user's: `python` is FILE.py:FUNCTION."""

    given: ClassVar[int] = 1  # values that the function gets besides its `arguments`
    python: str
    arguments: Mapping[str, Argument] = field(default_factory=dict)
    function: Callable[..., Any] | None = field(default=None, repr=False, compare=False, metadata=OWN)

    def call(self, *values: object) -> Any:
        """What the function returns. Raises InputError with file and line if it raises an exception."""
        assert self.function is not None
        return self.function(*values, **self.arguments)


@dataclass(frozen=True, kw_only=True)
class PythonSegment(PythonPart, Timed):
    """A demand that a function computes: f(t, start, **arguments).

    The function gets the times of the cycles in s from the segment's start, and the demand where it starts; it returns
    a demand in m (N for a load) for each. The time after the last cycle is among them: the next segment starts there.
    """

    kind = "python"
    given = 2
    # what it returned, by start and number of times: a profile is built several times and must be the same each time
    known: dict[tuple[float, int], Array] = field(default_factory=dict, repr=False, compare=False, metadata=OWN)

    def __post_init__(self) -> None:
        super().__post_init__()
        require_function_name(self.python)

    def demand(self, t: Array, last: float) -> Array:
        if (last, len(t)) not in self.known:
            self.known[last, len(t)] = self._compute(t.copy(), last)
        return self.known[last, len(t)].copy()

    def _compute(self, t: Array, last: float) -> Array:
        returned = self.call(t, last)
        try:
            values = np.asarray(returned, dtype=np.float64)
        except (TypeError, ValueError):
            values = np.empty(0)
        is_whole = values.shape == t.shape and bool(np.isfinite(values).all())
        require(is_whole, "segment", "python", f"a function that returns {len(t)} finite numbers, one for each time; "
                                    f"{self.python} returned {describe_value(returned)}")
        return values


class StepRun(NamedTuple):
    """What a user's step gets of the run."""

    title: str  # of the sequence
    folder: Path  # of the results
    seed: int
    settings: Mapping[str, object]  # bus, pace, controller, model, ..
    verdict: str  # "" before the run, and after one that has none


@dataclass(frozen=True, kw_only=True)
class Step(PythonPart):
    """A function that runs before the bus is opened, or after the log is closed: f(run, **arguments)."""

    when: Literal["before", "after"]

    def __post_init__(self) -> None:
        require_function_name(self.python)


def describe_value(value: object) -> str:
    """What a user's function returned, in a few words."""
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}" + ("" if np.isfinite(value).all() else " with NaN or infinity")
    return f"{type(value).__name__} {value!r:.60}"


def require_function_name(text: str) -> tuple[str, str]:
    """File and function of "FILE.py:FUNCTION".

    Raises:
        InputError: another text, or a file in another folder than the sequence.
    """
    match = _NAME.fullmatch(text)
    if match is None:
        raise InputError("python", "python", f"FILE.py:FUNCTION, a file beside the sequence, not {text!r}")
    return match[1], match[2]


def load_function(module: ModuleType, name: str, count: int, arguments: Mapping[str, Argument]) -> Callable[..., Any]:
    """A function of a user's module that takes `count` values and these named arguments.

    Where it raises an exception or ends the program, it raises InputError, which names file and line.

    Raises:
        InputError: the module has no such function.
    """
    file, function = str(module.__file__), getattr(module, name, None)
    if not callable(function):
        raise InputError(file, name, "a function of this name in that file")
    with contextlib.suppress(ValueError):  # a function in C without a signature
        try:
            inspect.signature(function).bind(*range(count), **arguments)
        except TypeError as error:
            line = function.__code__.co_firstlineno if inspect.isfunction(function) else 1
            names = f" and the arguments {', '.join(arguments)}" if arguments else ""
            raise InputError(f"{file}:{line}", name, f"a function of {count} value{'s' if count > 1 else ''}{names} "
                                                     f"({error})") from error

    def call(*values: object, **keywords: Argument) -> Any:
        with explain_errors(file, name):
            return function(*values, **keywords)

    return call
