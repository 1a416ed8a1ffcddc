"""The parts of a sequence that a user writes in Python: a segment, a check, and steps before and after the run."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite, nan
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from plant.segments import RATE, Array, Timed, require
from rig.sequences.check import Check, require_check
from rig.sequences.measures import NotMeasurable
from rig.sequences.run_data import RunData
from rig.sequences.user_code import Argument, UserFunction, require_function_name

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
