"""The signals of all cycles as columns, for the verdict: 120 bytes per cycle, so that an hour fits in memory."""
from __future__ import annotations

from array import array

import numpy as np

from plant.segments import Array
from rig.recorder import Signals, Timing

_FIELDS = ("phase", "com", "xj", "cor", "p12", "xs", "load", "flags", "lateness", "response",
           "feedback_response", "valve_response", "execution", "control", "status")


class History:
    """The complete cycles of a run. A field by name is a column, (cycles,) SI; missing samples are NaN."""

    def __init__(self) -> None:
        self._numbers = array("d")

    def __len__(self) -> int:
        return len(self._numbers) // len(_FIELDS)

    def add(self, row: Signals, timing: Timing) -> None:
        """Append one cycle."""
        self._numbers.extend((row.phase, row.com, row.xj, row.cor, row.p12, row.xs, row.load, row.flags,
                              timing.lateness, timing.response, timing.feedback_response, timing.valve_response,
                              timing.execution, row.control, row.status))

    def column(self, name: str, phase: int | None = None) -> Array:
        """All cycles, or those of one phase. Raises ValueError for a name that is no field."""
        table = np.frombuffer(self._numbers).reshape(-1, len(_FIELDS))
        column: Array = table[:, _FIELDS.index(name)]
        return column.copy() if phase is None else column[table[:, 0] == phase]  # no view: it would pin the buffer
