"""A step of the reference model: its cost beside the same step in C, and the error that the step size makes.

Costs are medians over rounds that alternate between the rivals, in one process.
"""
from __future__ import annotations

import ctypes
import subprocess
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant import Model, simulate
from plant.model import STEPS, build_kernel
from plant.run import sample_noise
from plant.solve import run_closed_loop
from rig.studies.benchmarks.rivals import FLAGS, SAME_ROUNDING, build_library, find_gcc
from rig.studies.benchmarks.stopwatch import Work, measure_durations

Array = NDArray[np.float64]

FRICTIONLESS = {f"{body}.{kind}_friction": 0.0 for body in ("spool", "jack") for kind in ("static", "dynamic")}
QUIET = {f"sensors.{quantity}_noise": 0.0 for quantity in ("position", "pressure", "spool")}


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


def compare_step_with_c(command: Array, rounds: int = 15, steps: int = STEPS) -> StepCost | None:
    """The nominal plant over `command` (n,) m, compiled from Python and from step.c; None without gcc."""
    if not find_gcc():
        return None
    model, draws = Model(), sample_noise(0, len(command))
    with tempfile.TemporaryDirectory() as folder:
        runs, outs = {}, {}
        runs["python"], outs["python"] = _make_python_run(model, command, draws, steps)
        for name, flags in (("c", FLAGS), ("c_same_rounding", SAME_ROUNDING)):
            library = build_library("step.c", flags, Path(folder) / f"{name}.so")
            runs[name], outs[name] = _make_c_run(library, model, command, draws, steps)
        seconds = measure_durations(runs, rounds)
    each = {name: float(np.median(t)) / (len(command) * steps) * 1e9 for name, t in seconds.items()}
    ratios = {name: float(np.median(seconds["python"] / t)) for name, t in seconds.items()}  # round by round
    version = subprocess.run([find_gcc(), "-dumpfullversion"], capture_output=True, text=True, check=True)
    return StepCost(each["python"], each["c"], each["c_same_rounding"], ratios["c"], ratios["c_same_rounding"],
                    float(np.abs(outs["python"] - outs["c"])[:, 0].max()),
                    bool((outs["python"] == outs["c_same_rounding"]).all()), f"gcc {version.stdout.strip()}")


def _make_python_run(model: Model, command: Array, draws: Array, steps: int) -> tuple[Work, Array]:
    out, load = np.empty((len(command), 4)), np.zeros_like(command)
    run, state, record = build_kernel(run_closed_loop, model.effects), model.build_state(), model.build_record()
    return lambda: run(state, command, load, draws, record, steps, out), out


def _make_c_run(library: ctypes.CDLL, model: Model, command: Array, draws: Array, steps: int) -> tuple[Work, Array]:
    record = model.build_record()
    assert library.model_bytes() == record.nbytes, "step.c knows other parameters than plant.parameters"
    out, load = np.empty((len(command), 4)), np.zeros_like(command)
    # the arrays themselves, not their addresses: the closure keeps them alive
    pointers = [np.ctypeslib.as_ctypes(a.view(np.float64).reshape(-1)) for a in (record, command, load, draws)]
    result = np.ctypeslib.as_ctypes(out.reshape(-1))
    return lambda: library.closed_loop(*pointers, len(command), steps, result), out


def measure_accuracy(command: Array, steps: tuple[int, ...] = (20, 50, 100, 200, 500), finest: int = 5000
                     ) -> list[Accuracy]:
    """Error in XJ of some step sizes over `command` (n,) m, closed loop, without noise; friction off and on.

    The truth is the same run with `finest` steps a cycle: 5000 are steps of 0.2 us.
    """
    columns = {}
    for friction in (False, True):
        model = Model().replace(QUIET | ({} if friction else FRICTIONLESS))
        truth = simulate(model, command, steps=finest).xj
        columns[friction] = [_measure_error(simulate(model, command, steps=n).xj - truth) for n in steps]
    return [Accuracy(n, *off, *on) for n, off, on in zip(steps, columns[False], columns[True], strict=True)]


def _measure_error(error: Array) -> tuple[float, float]:
    """RMS and largest absolute value, um."""
    return float(np.sqrt((error**2).mean())) * 1e6, float(np.abs(error).max()) * 1e6
