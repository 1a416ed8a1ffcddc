"""The speed of one run: simulated as a whole, cycle by cycle from Python, and on the embedded bus."""
from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fdi.progress import ignore_progress
from plant import Actuator, Model, simulate
from rig.studies.benchmarks.stopwatch import measure_median_duration

Array = NDArray[np.float64]


def measure_cycle_cost(cycles: int = 5000, rounds: int = 9) -> float:
    """The cost of `Actuator.sample` and `advance` called from Python, s a cycle."""
    plant = Actuator(Model())
    plant.warm()

    def run_cycles() -> None:
        for _ in range(cycles):
            plant.advance(1e-3 * plant.sample()[0])

    return measure_median_duration(run_cycles, rounds) / cycles


def measure_simulation_speed(command: Array, rounds: int = 9) -> float:
    """The speed of a simulated run over `command` (n,) m, with noise and columns, as a multiple of real time."""
    model = Model()
    seconds = measure_median_duration(lambda: simulate(model, command), rounds)
    return len(command) * model["controller.period"] / seconds


def measure_bus_run_speed(runs: int = 3) -> float:
    """The speed of a preflight run on the embedded bus, with its log, as a multiple of real time; best of `runs`."""
    from rig.run.job import Job
    from rig.run.runner import run_job
    from rig.sequences import load_sequence

    job = Job(sequence=load_sequence("preflight"), model=Model())
    speeds = []
    for _ in range(runs):
        with tempfile.TemporaryDirectory() as folder:
            speeds.append(run_job(job, Path(folder), ignore_progress, lambda: False).speed)
    return max(speeds)
