"""Repeats of a test: the same command run again, found by its command and put on the rows of the first run."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.estimation.preparation import COLUMNS, read_cycles
from fdi.trace.trace import Trace
from plant.errors import InputError
from plant.model import Model

Floats = NDArray[np.float64]

SAME = 2e-6  # m; demands that differ by less are the same


class Repeat(NamedTuple):
    """A prepared repeat and its place: its row k corresponds to row k + `late` of the first run."""

    trace: Trace
    late: int


def find_repeat(first: Trace, trace: Trace, model: Model, number: int, same_share: float = 0.98) -> Repeat:
    """Prepare a repeat of the prepared run `first`, and find its place by its command.

    Args:
        first: the prepared run.
        trace: the repeat as it was recorded.
        model: as for `first`.
        number: of the repeat, for error messages.
        same_share: share of the rows in which both commands must be the same.

    Raises:
        InputError: another command, other cycles, or no signal in common.
    """
    source = f"--repeat {trace.provenance.get('source', number)}"
    outputs = [name for name in first.outputs if name in trace.signals]
    if not outputs:
        raise InputError(source, ", ".join(first.outputs), "a signal that the trace has too")
    ways = [way for way in read_cycles(trace, model, outputs, source) if way.period == first.period]
    if not ways:
        raise InputError(source, "t", f"rows as in the trace it repeats; they are {1e3 * trace.period:g} ms apart")
    repeat = ways[0]
    for late in (0, _find_first_move(first.com) - _find_first_move(repeat.com)):
        if _measure_agreement(first.com, repeat.com, late) >= same_share:
            return Repeat(repeat, late)
    raise InputError(source, "com", "the command of the trace it repeats; another command is no repeat")


def _find_first_move(com: Floats) -> int:
    return int(np.argmax(np.abs(com - com[0]) > SAME))


def _measure_agreement(a: Floats, b: Floats, late: int, overlap: float = 0.5) -> float:
    """The share of the common rows in which b, `late` rows later, is a; 0 if these are less than `overlap` of a."""
    first, last = max(0, late), min(len(a), len(b) + late)
    if last - first < overlap * len(a):
        return 0.0
    return float(np.mean(np.abs(a[first:last] - b[first - late:last - late]) <= SAME))


def align_columns(columns: Mapping[str, Floats], late: int, rows: int) -> dict[str, Floats]:
    """A repeat's columns on the `rows` of the first run, NaN where it has none."""
    out = {}
    for name, column in columns.items():
        out[name] = np.full(rows, np.nan)
        first, last = max(0, late), min(rows, len(column) + late)
        out[name][first:last] = column[first - late:last - late]
    return out


def align_repeat(repeat: Repeat, rows: int) -> Trace:
    """A repeat on the `rows` of the first run; before its own first row the ram rests, and nothing was measured."""
    trace = repeat.trace
    wanted = np.arange(rows) - repeat.late
    place = np.clip(wanted, 0, len(trace) - 1)
    columns: dict[str, Any] = {name: getattr(trace, name)[place] for name in COLUMNS}
    usable = (wanted == place) & trace.usable[place]
    return replace(trace, **columns | {"usable": usable, "incomplete": columns["incomplete"] | ~usable})
