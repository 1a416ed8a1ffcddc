"""How fast many runs at once are, beside C, jax and ProgPy: the same runs of the same equations, in one process."""
from __future__ import annotations

import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.progress import Progress, ignore_progress
from plant import Model, simulate
from plant.lanes import STEPS, Lanes
from rig.studies.benchmarks.peers import (
    FLAGS,
    GET_GCC,
    SAME_ROUNDING,
    Replay,
    Task,
    gcc,
    in_c,
    in_jax,
    in_progpy,
    missing,
)
from rig.studies.benchmarks.stopwatch import durations

Array = NDArray[np.float64]
OURS = "ours, one thread"
NAMES = ("spool.static_friction", "jack.damping")
MEMBERS, CYCLES, FIRST = 64, 5000, 500  # the runs begin where the preflight's first step does
PIECE = 5  # cycles for a rival that is slower by orders of magnitude


class Rival(NamedTuple):
    """One way to make many runs."""

    name: str
    speed: float | None  # steps of a run per second; None where it could not be measured
    ratio: float | None  # our speed over its, round by round
    difference: float | None  # m, largest between its positions and ours
    note: str


def many(command: Array, progress: Progress = ignore_progress, rounds: int = 7,
         cycles: int = CYCLES) -> list[Rival]:
    """Runs of the bare model, with different friction and drag, from the current of a run over `command` (n,) m."""
    task = _task(command, cycles)
    with tempfile.TemporaryDirectory() as folder:
        progress("many runs at once: compiling the rivals", 0.0)
        runs, skipped = _rivals(task, Path(folder))
        rows = {name: run().copy() for name, run in runs.items()}
        progress("many runs at once", 0.0)
        seconds = durations(runs, rounds)
    work = MEMBERS * cycles * task.steps
    found = [Rival(name, float(work / np.median(s)), float(np.median(s / seconds[OURS])),
                   float(np.abs(rows[name] - rows[OURS])[..., 0].max()), "") for name, s in seconds.items()]
    return [*found, *skipped, _progpy(task, work / float(np.median(seconds[OURS])), rows[OURS], progress)]


def _task(command: Array, cycles: int) -> Task:
    model = Model()
    current = simulate(model, command).cor[FIRST:FIRST + cycles].copy()
    spread = np.random.default_rng(0).uniform([5.0, 1.0], [50.0, 2.0], (MEMBERS, 2))
    return Task(model, NAMES, spread * [1.0, model[NAMES[1]]], current, np.zeros(cycles), STEPS)


def _rivals(task: Task, folder: Path) -> tuple[dict[str, Replay], list[Rival]]:
    def ours(workers: int | None) -> Replay:
        lanes = Lanes(task.model, task.names, task.steps, workers)
        return lambda: lanes.replay(task.values, task.current, task.load)

    runs, skipped = {OURS: ours(1), "ours, a thread a core": ours(None)}, []
    in_gcc = {"C, one run after the other": ("replay_each", FLAGS), "C, 16 runs side by side": ("replay_lanes", FLAGS),
              "C, 64 runs side by side": ("replay_lanes", (*FLAGS, "-DWIDTH=64")),
              "C, 16 runs, -ffp-contract=off": ("replay_lanes", SAME_ROUNDING)}
    for i, (name, (function, flags)) in enumerate(in_gcc.items()):
        if gcc():
            runs[name] = in_c(task, function, flags, folder / f"{i}.so")
        else:
            skipped.append(Rival(name, None, None, None, f"skipped, there is no gcc; to get it: {GET_GCC}"))
    if why := missing("jax"):
        skipped.append(Rival("jax, vmap", None, None, None, f"skipped, {why}"))
    else:
        runs["jax, vmap"] = in_jax(task)
    return runs, skipped


def _progpy(task: Task, our_speed: float, our_rows: Array, progress: Progress) -> Rival:
    """On a short piece, as it is so much slower."""
    if why := missing("progpy"):
        return Rival("ProgPy, vectorised", None, None, None, f"skipped, {why}")
    progress("many runs at once: ProgPy", 0.0)
    run = in_progpy(task._replace(current=task.current[:PIECE], load=task.load[:PIECE]))
    rows, seconds = run(), float(np.median(durations({"": run}, 3)[""]))
    speed = MEMBERS * (PIECE - 1) * task.steps / seconds  # the last row is a state, not a cycle
    return Rival("ProgPy, vectorised", speed, our_speed / speed,
                 float(np.abs(rows - our_rows[:, :PIECE])[..., 0].max()), f"measured on {PIECE - 1} cycles")
