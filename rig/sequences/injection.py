"""Effects of faults on sensor samples and on frames, computed before the run."""
from __future__ import annotations

import numpy as np


class AddedSignal:
    """An additive sensor fault: `values`, one per cycle, are added from cycle `first` on."""

    def __init__(self, first: int, values: list[float]) -> None:
        self.first, self.values = first, values

    def __call__(self, cycle: int, value: float) -> float:
        k = cycle - self.first
        return value + self.values[k] if 0 <= k < len(self.values) else value


class StuckSignal:
    """A sensor that is stuck during `cycles`, at `value` or, without one, at its last reading."""

    def __init__(self, cycles: range, value: float | None) -> None:
        self.cycles, self.value = cycles, value
        self._last_read = 0.0

    def __call__(self, cycle: int, value: float) -> float:
        if cycle in self.cycles:
            return self._last_read if self.value is None else self.value
        self._last_read = value
        return value


def choose_frames(cycles: int, every: int, count: int | None, probability: float, rng: np.random.Generator) -> bytes:
    """One byte a cycle, 1 where a frame is hit: every `every`-th with a probability; up to the last if counted."""
    hit = (np.arange(cycles) % every == 0) & (rng.random(cycles) < probability)
    if count is not None and hit.sum() >= count:
        hit = hit[:np.flatnonzero(hit)[count - 1] + 1]
    return bytes(hit.tobytes())
