"""A trace as replays and fits need it: inputs without holes, measured signals with their holes marked."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fdi.trace.trace import Trace
from plant.errors import InputError

Floats = NDArray[np.float64]

SIGNALS = ("xj", "p12", "xs")  # the columns of a replay, in order
NOISE = {"xj": "sensors.position_noise", "p12": "sensors.pressure_noise", "xs": "sensors.spool_noise"}
SHORTEST = 200  # cycles; less cannot tell anything


@dataclass(frozen=True, eq=False)
class Record:
    """What was put into the actuator and what was measured.

    Columns of shape (n,): `current` A, `load` N, `com` m, `position` m (as measured, NaN where missing);
    `measured` (s, n) the chosen `signals`, NaN where missing; `columns` their places in a replay's output.
    """

    trace: Trace
    signals: tuple[str, ...]
    current: Floats
    load: Floats
    com: Floats
    position: Floats
    measured: Floats

    @property
    def columns(self) -> list[int]:
        """Where the signals stand among the columns of a replay."""
        return [SIGNALS.index(name) for name in self.signals]

    def __len__(self) -> int:
        return len(self.current)


def record(trace: Trace, signals: tuple[str, ...] | None = None, where: object = "trace") -> Record:
    """A trace with the chosen signals (default: those it has).

    A current or load that is missing for a few cycles is held; the position is the measured one.

    Raises:
        InputError: too short, no current, or a chosen signal that was not measured.
    """
    there = [name for name in SIGNALS if name in trace.signals]
    chosen = there if signals is None else [name for name in SIGNALS if name in signals]
    for name in chosen:
        if name not in there:
            raise InputError(where, name, f"a measured signal (it has {', '.join(there) or 'none'})")
    for name in ("com", "xj", "cor"):
        if name not in trace.signals:
            raise InputError(where, name, "a measured column")
    if len(trace) < SHORTEST:
        raise InputError(where, "t", f"at least {SHORTEST} cycles, not {len(trace)}")
    return Record(trace, tuple(chosen), held(trace.cor), held(trace.load), held(trace.com), trace.xj,
                  np.array([trace.column(name) for name in chosen]))


def held(x: Floats) -> Floats:
    """A column, shape (n,), in which a missing value is the last one before it, or 0."""
    last = np.maximum.accumulate(np.where(np.isnan(x), 0, np.arange(len(x))))
    filled: Floats = np.nan_to_num(x[last])
    return filled
