"""Durations: rounds that alternate between rivals, so that a disturbance of the machine hits all of them."""
from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from rig.network.clock import WallClock

Array = NDArray[np.float64]
Work = Callable[[], object]


def measure_durations(works: Mapping[str, Work], rounds: int) -> dict[str, Array]:
    """Durations of each work, (rounds,) s, after one warm-up; the rounds alternate between them."""
    clock = WallClock()
    taken: dict[str, list[int]] = {name: [] for name in works}
    for turn in range(rounds + 1):
        for name, work in works.items():
            start = clock.now()
            work()
            if turn > 0:
                taken[name].append(clock.now() - start)
    return {name: np.array(times) * 1e-9 for name, times in taken.items()}


def measure_median_duration(work: Work, rounds: int) -> float:
    """The median duration of one work, s."""
    return float(np.median(measure_durations({"": work}, rounds)[""]))
