"""The project's own benchmarks: what a step costs beside the same step in C, and what error the default step makes.

Costs are medians of rounds that alternate between the rivals, all in one process: the machine's moods hit them alike.
"""
from __future__ import annotations

import ctypes
import subprocess
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.progress import Progress, ignore_progress
from plant import Actuator, Model, simulate
from plant.model import STEPS, kernel
from plant.run import noise
from rig.studies.benchmarks.many_runs import many
from rig.studies.benchmarks.peers import FLAGS, SAME_ROUNDING, built, gcc
from rig.studies.benchmarks.peers_grid import grid
from rig.studies.benchmarks.stopwatch import Run, duration, durations

Array = NDArray[np.float64]

FRICTIONLESS = {f"{body}.{kind}_friction": 0.0 for body in ("spool", "jack") for kind in ("static", "dynamic")}
QUIET = {f"sensors.{quantity}_noise": 0.0 for quantity in ("position", "pressure", "spool")}
FINEST = 5000  # steps a cycle that stand for the truth, 0.2 us
MICRO = 1e6


class StepCost(NamedTuple):
    """A step of the reference model in Python and in C, ns; `ratio` is Python's over C's."""

    python: float
    c: float  # gcc -O3 -march=native, free to fuse multiply and add
    c_same_rounding: float  # without fusing
    ratio: float
    ratio_same_rounding: float
    difference: float  # m, largest between the positions of Python and C over the run
    identical: bool  # all columns, against C with the same rounding
    compiler: str


class Accuracy(NamedTuple):
    """Error of one step size over a command, against the finest; position in um."""

    steps: int  # a cycle
    rms: float
    largest: float
    rms_friction: float
    largest_friction: float


def step_vs_c(command: Array, rounds: int = 15, steps: int = STEPS) -> StepCost | None:
    """The nominal plant over `command` (n,) m, compiled from Python and from step.c; None without gcc."""
    if not gcc():
        return None
    model, draws = Model(), noise(0, len(command))
    with tempfile.TemporaryDirectory() as folder:
        runs, outs = {}, {}
        runs["python"], outs["python"] = _python_run(model, command, draws, steps)
        for name, flags in (("c", FLAGS), ("c_same_rounding", SAME_ROUNDING)):
            library = built("step.c", flags, Path(folder) / f"{name}.so")
            runs[name], outs[name] = _c_run(library, model, command, draws, steps)
        seconds = durations(runs, rounds)
    each = {name: float(np.median(t)) / (len(command) * steps) * 1e9 for name, t in seconds.items()}
    ratios = {name: float(np.median(seconds["python"] / t)) for name, t in seconds.items()}  # round by round
    version = subprocess.run([gcc(), "-dumpfullversion"], capture_output=True, text=True, check=True).stdout.strip()
    return StepCost(each["python"], each["c"], each["c_same_rounding"], ratios["c"], ratios["c_same_rounding"],
                    float(np.abs(outs["python"] - outs["c"])[:, 0].max()),
                    bool((outs["python"] == outs["c_same_rounding"]).all()), f"gcc {version}")


def _python_run(model: Model, command: Array, draws: Array, steps: int) -> tuple[Run, Array]:
    out, load = np.empty((len(command), 4)), np.zeros_like(command)
    run, state, record = kernel("closed_loop", model.effects), model.state(), model.record()
    return lambda: run(state, command, load, draws, record, steps, out), out


def _c_run(library: ctypes.CDLL, model: Model, command: Array, draws: Array, steps: int) -> tuple[Run, Array]:
    record = model.record()
    assert library.model_bytes() == record.nbytes, "step.c knows other parameters than plant.parameters"
    out, load = np.empty((len(command), 4)), np.zeros_like(command)
    # the arrays themselves, not their addresses: the closure keeps them alive
    pointers = [np.ctypeslib.as_ctypes(a.view(np.float64).reshape(-1)) for a in (record, command, load, draws)]
    result = np.ctypeslib.as_ctypes(out.reshape(-1))
    return lambda: library.closed_loop(*pointers, len(command), steps, result), out


def cycle_cost(cycles: int = 5000, rounds: int = 9) -> float:
    """What `Actuator.sample` and `advance` cost called from Python, s a cycle."""
    plant = Actuator(Model())
    plant.warm()

    def run() -> None:
        for _ in range(cycles):
            plant.advance(1e-3 * plant.sample()[0])

    return duration(run, rounds) / cycles


def speed(command: Array, rounds: int = 9) -> float:
    """How many times faster than real time a whole simulated run is, its noise and its columns included."""
    model = Model()
    return len(command) * model["controller.period"] / duration(lambda: simulate(model, command), rounds)


def accuracy(command: Array, steps: tuple[int, ...] = (20, 50, 100, 200, 500), finest: int = FINEST) -> list[Accuracy]:
    """Error in XJ of some step sizes over `command`, closed loop, without noise; friction off and on."""
    columns = {}
    for friction in (False, True):
        model = Model().replace(QUIET | ({} if friction else FRICTIONLESS))
        truth = simulate(model, command, steps=finest).xj
        columns[friction] = [_error(simulate(model, command, steps=n).xj - truth) for n in steps]
    return [Accuracy(n, *off, *on) for n, off, on in zip(steps, columns[False], columns[True], strict=True)]


def _error(e: Array) -> tuple[float, float]:
    return float(np.sqrt((e**2).mean())) * MICRO, float(np.abs(e).max()) * MICRO


def lockstep() -> float:
    """A whole preflight run on the embedded bus, log and all, as a multiple of real time; the best of three."""
    from rig.run.job import Job
    from rig.run.runner import run
    from rig.sequences import load_sequence

    job = Job(sequence=load_sequence("preflight"), model=Model())
    speeds = []
    for _ in range(3):
        with tempfile.TemporaryDirectory() as folder:
            speeds.append(run(job, Path(folder), ignore_progress, lambda: False).speed)
    return max(speeds)


def report(command: Array, progress: Progress = ignore_progress) -> dict[str, Any]:
    """Everything about cost as one JSON object; `step` is None without gcc. `progress` gets the stage."""
    progress("one run, and a run on the embedded bus", 0.0)
    cost = step_vs_c(command)
    one = {"step": cost and cost._asdict(), "times_real_time": speed(command), "cycle": cycle_cost(),
           "lockstep": lockstep()}
    return one | {"many": [rival._asdict() for rival in many(command, progress)],
                  "grid": [rival._asdict() for rival in grid(command, progress)]}
