"""Guards: limits that are monitored in every cycle; the run goes to its safe state when one is exceeded."""
from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import inf
from typing import Literal

from plant.errors import InputError
from rig.sequences.units import UNIT_OF_SIGNAL, find_scale


@dataclass(frozen=True, kw_only=True)
class Guard:
    """`signal` must not be outside low..high (in `unit`, default SI) for `cycles` cycles in a row."""

    name: str
    signal: Literal["com", "xj", "error", "cor", "p12", "xs", "load"]
    low: float | None = None
    high: float | None = None
    unit: str = ""
    cycles: int = 3  # one noisy sample is no excursion

    def __post_init__(self) -> None:
        low, high = self.compute_limits()
        if low >= high or (low, high) == (-inf, inf):
            raise InputError("guard", "", "a low, a high, or both with low below high")
        if self.cycles < 1:
            raise InputError("guard", "cycles", f"1 or more cycles, not {self.cycles}")

    def compute_limits(self) -> tuple[float, float]:
        """Low and high in SI; infinite where there is none."""
        si = UNIT_OF_SIGNAL[self.signal]
        size = find_scale(self.unit or si, si)
        return (-inf if self.low is None else self.low * size), (inf if self.high is None else self.high * size)


class GuardWatch:
    """Monitors the guards of a run, cycle by cycle."""

    def __init__(self, guards: Iterable[Guard]) -> None:
        self._watched = [(guard, *guard.compute_limits()) for guard in guards]
        self._outside = [0] * len(self._watched)

    def __bool__(self) -> bool:
        return bool(self._watched)

    def find_passed(self, values: Mapping[str, float]) -> Guard | None:
        """The first guard whose limit this cycle's `values` (SI, by signal) exceed for its number of cycles.

        A missing value (absent or NaN) is not outside, and does not count as back inside either.
        """
        passed = None
        for i, (guard, low, high) in enumerate(self._watched):
            value = values.get(guard.signal)
            if value is None or value != value:
                continue
            self._outside[i] = 0 if low <= value <= high else self._outside[i] + 1
            if passed is None and self._outside[i] >= guard.cycles:
                passed = guard
        return passed
