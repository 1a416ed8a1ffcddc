"""Tests of a controller with the pytest plugin: pytest test_controller.py --rig-out results."""
from typing import Any

import numpy as np


def test_preflight(rig_bench: Any) -> None:
    rig_bench.run("preflight").assert_passed()


def test_a_step_with_a_clogged_filter(rig_bench: Any) -> None:
    run = rig_bench.run("preflight", set={"filter.clogging": 0.2}, seed=3)
    run.assert_passed("overshoot, 5 mm", "rise time, 5 mm")


def test_own_command_with_lost_frames(rig_bench: Any) -> None:
    t = np.arange(1000) * 1e-3
    run = rig_bench.run(
        command=2e-3 * np.sin(2 * np.pi * t) ** 2,
        faults=[{"kind": "lost", "frame": "feedback", "start": 0.2, "end": 0.5, "every": 60}],
        checks=[{"name": "lag", "kind": "max_error", "high": 0.3, "unit": "mm"}])
    run.assert_passed()
    assert np.nanmax(np.abs(run.trace.p12)) < 60e5  # Pa
