"""How long something takes: medians of rounds that alternate between rivals, as the machine's moods hit all alike."""
from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from rig.network.clock import WallClock

Array = NDArray[np.float64]
Run = Callable[[], object]


def durations(runs: Mapping[str, Run], rounds: int) -> dict[str, Array]:
    """Durations of each run, (rounds,) s, after one to warm up; the rounds alternate."""
    clock = WallClock()
    taken: dict[str, list[int]] = {name: [] for name in runs}
    for turn in range(rounds + 1):
        for name, run in runs.items():
            start = clock.now()
            run()
            if turn:
                taken[name].append(clock.now() - start)
    return {name: np.array(times) * 1e-9 for name, times in taken.items()}


def duration(run: Run, rounds: int) -> float:
    """Median duration of a run, s."""
    return float(np.median(durations({"": run}, rounds)[""]))
