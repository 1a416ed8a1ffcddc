"""The limits of travel and current that a run reached: ram and spool at their stops, the current of the controller."""
from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant.model import Model

NEAR_A_STOP = 5.0  # standard deviations of the sensor's noise from a stop within which a reading is at it


class LimitReached(NamedTuple):
    """A limit that a run reached."""

    parameter: str  # of the model: the limit
    signal: str
    limit: float  # SI; reached on either side of zero
    t: float  # s of main, when it was reached first
    seconds: float  # how long the signal was there, in all

    def describe(self) -> str:
        """The limit in words, such as "ram at its stop (40 mm) for 120 ms, first at t = 1.250 s"."""
        scale, unit = (1e3, "mA") if self.signal == "cor" else (1e3, "mm")
        return (f"{WORDS[self.signal]} ({scale * self.limit:.3g} {unit}) for {1e3 * self.seconds:.0f} ms, "
                f"first at t = {self.t:.3f} s")


WORDS = {"xj": "ram at its stop", "xs": "spool at its stop", "cor": "current at its limit"}


def find_limits(column: Callable[[str], NDArray[np.float64]], model: Model, zero: int) -> tuple[LimitReached, ...]:
    """The limits that the signals of a run reached.

    Args:
        column: gives a signal of all cycles, SI; NaN for missing samples.
        model: its travels, current limit, cycle and sensor noise.
        zero: the cycle in which main starts.
    """
    margins = {
        "xj": ("jack.travel", NEAR_A_STOP * model["sensors.position_noise"]),
        "xs": ("spool.travel", NEAR_A_STOP * model["sensors.spool_noise"]),
        "cor": ("controller.current_limit", 2e-8),  # A: two counts of the drive frame
    }
    period, found = model["controller.period"], []
    for signal, (parameter, margin) in margins.items():
        limit = model.values.get(parameter)
        if limit is None:  # another plant
            continue
        rows = np.flatnonzero(np.abs(column(signal)) >= limit - margin)
        if len(rows):
            found.append(LimitReached(parameter, signal, limit, (int(rows[0]) - zero) * period, len(rows) * period))
    return tuple(found)
