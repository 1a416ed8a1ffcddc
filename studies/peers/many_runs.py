"""Many runs at once, beside C, jax and ProgPy: the same runs of the same equations, in one process."""

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fdi.progress import Progress, ignore_progress
from plant import Model, simulate
from plant.lanes import STEPS, Lanes
from rig.bench.benchmarks import FLAGS, SAME_ROUNDING, measure_median_duration
from studies.peers.libraries import Task, make_c_replay, make_jax_replay, make_progpy_replay
from studies.peers.rivals import Race, Replay, Rival, explain_missing, explain_missing_gcc, race_rivals, skip_rival

Array = NDArray[np.float64]
OURS = "ours, one thread"
NAMES = ("spool.static_friction", "jack.damping")


def compare_many_runs(command: Array, progress: Progress = ignore_progress, rounds: int = 7, runs: int = 64,
                      cycles: int = 5000) -> list[Rival]:
    """Runs of the bare model with different friction and drag, from the current of a run over `command` (n,) m."""
    task = _make_task(command, runs, cycles)
    with tempfile.TemporaryDirectory() as folder:
        progress("many runs at once: compiling the rivals", 0.0)
        replays, skipped = _make_rivals(task, Path(folder))
        progress("many runs at once", 0.0)
        race = race_rivals(replays, OURS, runs * cycles * task.steps, rounds, _compare_positions)
    progress("many runs at once: ProgPy", 0.0)
    return [*race.rivals, *skipped, _measure_progpy(task, race)]


def _make_task(command: Array, runs: int, cycles: int, first: int = 500) -> Task:
    """Runs that begin at cycle `first`, where the first step of the preflight begins."""
    model = Model()
    current = simulate(model, command).cor[first:first + cycles].copy()
    spread = np.random.default_rng(0).uniform([5.0, 1.0], [50.0, 2.0], (runs, 2))
    return Task(model, NAMES, spread * [1.0, model[NAMES[1]]], current, np.zeros(cycles), STEPS)


def _make_rivals(task: Task, folder: Path) -> tuple[dict[str, Replay], list[Rival]]:
    """The rivals that can be measured here, and the others with the reason."""
    replays: dict[str, Replay] = {OURS: _make_own_replay(task, 1),
                                  "ours, a thread a core": _make_own_replay(task, None)}
    skipped = []
    in_c = {"C, one run after the other": ("replay_each", FLAGS), "C, 16 runs side by side": ("replay_lanes", FLAGS),
            "C, 64 runs side by side": ("replay_lanes", (*FLAGS, "-DWIDTH=64")),
            "C, 16 runs, -ffp-contract=off": ("replay_lanes", SAME_ROUNDING)}
    for number, (name, (function, flags)) in enumerate(in_c.items()):
        if reason := explain_missing_gcc():
            skipped.append(skip_rival(name, reason))
        else:
            replays[name] = make_c_replay(task, function, flags, folder / f"{number}.so")
    if reason := explain_missing("jax"):
        skipped.append(skip_rival("jax, vmap", reason))
    else:
        replays["jax, vmap"] = make_jax_replay(task)
    return replays, skipped


def _make_own_replay(task: Task, workers: int | None) -> Replay:
    lanes = Lanes(task.model, task.names, task.steps, workers)
    return lambda: lanes.replay(task.values, task.current, task.load)


def _compare_positions(rows: Array, reference: Array) -> float:
    return float(np.abs(rows - reference)[..., 0].max())


def _measure_progpy(task: Task, race: Race, cycles: int = 5) -> Rival:
    """ProgPy on the first `cycles` cycles alone, because it is slower by orders of magnitude."""
    name = "ProgPy, vectorised"
    if reason := explain_missing("progpy"):
        return skip_rival(name, reason)
    replay = make_progpy_replay(task._replace(current=task.current[:cycles], load=task.load[:cycles]))
    rows, seconds = replay(), measure_median_duration(replay, 3)
    speed = len(task.values) * (cycles - 1) * task.steps / seconds  # the last row is a state, not a cycle
    return Rival(name, speed, race.speed / speed, _compare_positions(rows, race.reference[:, :cycles]),
                 f"measured on {cycles - 1} cycles")
