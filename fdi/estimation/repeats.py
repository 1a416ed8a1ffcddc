"""Repeats of a test: the same command again, brought onto the rows of the trace it repeats."""
from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.estimation.replay import Columns
from fdi.trace.cycles import Cycles, readings
from fdi.trace.trace import Trace
from plant.errors import InputError
from plant.model import Model

Floats = NDArray[np.float64]

SAME = 2e-6  # m; commands that differ by less in nearly all rows are one command
NEARLY = 0.98
OVERLAP = 0.5  # of the trace that a repeat must cover


class Repeat(NamedTuple):
    """A repeat and its place."""

    cycles: Cycles
    late: int  # rows; its row k corresponds to row k + late of the trace


def matching(c: Cycles, trace: Trace, model: Model, number: int) -> Repeat:
    """A repeat of `c`, found by its command.

    Raises:
        InputError: another command, other cycles, or nothing in it that the trace has too.
    """
    where = f"--repeat {trace.provenance.get('source', number)}"
    there = [name for name in c.signals if name in trace.signals]
    if not there:
        raise InputError(where, ", ".join(c.signals), "a signal that the trace has too")
    ways = [way for way in readings(trace, model, there, where) if way.period == c.period]
    if not ways:
        raise InputError(where, "t", f"rows as in the trace it repeats; they are {1e3 * trace.period:g} ms apart")
    late = _first_move(c.com) - _first_move(ways[0].com)
    for rows in (0, late):
        if _agreement(c.com, ways[0].com, rows) >= NEARLY:
            return Repeat(ways[0], rows)
    raise InputError(where, "com", "the command of the trace it repeats; another command is no repeat")


def _first_move(com: Floats) -> int:
    return int(np.argmax(np.abs(com - com[0]) > SAME))


def _agreement(a: Floats, b: Floats, late: int) -> float:
    """The part of the rows in which b, `late` rows later, is a; 0 if they hardly overlap."""
    first, last = max(0, late), min(len(a), len(b) + late)
    if last - first < OVERLAP * len(a):
        return 0.0
    return float(np.mean(np.abs(a[first:last] - b[first - late:last - late]) <= SAME))


def aligned(columns: Columns, late: int, rows: int) -> Columns:
    """A repeat's columns on the rows of the trace, NaN where it has none."""
    out = {}
    for name, column in columns.items():
        out[name] = np.full(rows, np.nan)
        first, last = max(0, late), min(rows, len(column) + late)
        out[name][first:last] = column[first - late:last - late]
    return out
