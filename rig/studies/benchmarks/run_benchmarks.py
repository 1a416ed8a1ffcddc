"""All benchmarks of speed, as one JSON object."""
from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi.progress import Progress, ignore_progress
from rig.studies.benchmarks.grid_runs import compare_grid_runs
from rig.studies.benchmarks.many_runs import compare_many_runs
from rig.studies.benchmarks.plant_step import compare_step_with_c
from rig.studies.benchmarks.single_run import measure_bus_run_speed, measure_cycle_cost, measure_simulation_speed
from rig.studies.benchmarks.whole_process import measure_help_time, measure_run_process_speed

Array = NDArray[np.float64]


def run_benchmarks(command: Array, progress: Progress = ignore_progress) -> dict[str, Any]:
    """Measure everything over `command` (n,) m; `step` is None without gcc."""
    progress("one run, and a run on the embedded bus", 0.0)
    cost = compare_step_with_c(command)
    return {"step": cost and cost._asdict(),
            "times_real_time": measure_simulation_speed(command),
            "cycle": measure_cycle_cost(),
            "lockstep": measure_bus_run_speed(),
            "run_process": measure_run_process_speed(),
            "help_process": measure_help_time(),
            "many": [rival._asdict() for rival in compare_many_runs(command, progress)],
            "grid": [rival._asdict() for rival in compare_grid_runs(command, progress)]}
