"""Short measured runs for searches and fits: the plant with something hidden, at a tenth of the step of any fit."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fdi.trace import Trace
from plant import Model, simulate

STEPS = 200  # a cycle: 5 us
HIDDEN = {"null_bias.current": 1.5e-4}


def build_command() -> np.ndarray:
    """A step, a slow ramp and a sine: 4 s; rounded, because NumPy's sin differs by CPU in the last bit."""
    t = np.arange(4000) / 1000.0
    ramp = np.interp(t, [1.1, 2.1], [0.0, 1e-3])
    wave = np.where((t > 2.3) & (t < 3.55), 2e-3 * np.sin(4.0 * np.pi * (t - 2.3)), 0.0)
    return np.round(np.where((t >= 0.2) & (t < 0.7), 3e-3, ramp + wave), 15)


def build_other_command() -> np.ndarray:
    """Another command, for the held-out run: 3 s."""
    t = np.arange(3000) / 1000.0
    wave = np.where(t > 1.2, 1.5e-3 * np.sin(3.0 * np.pi * (t - 1.2)), 0.0)
    return np.round(np.where((t > 0.2) & (t < 1.0), -2e-3, wave), 15)


def simulate_trace(model: Model, command: np.ndarray, load: np.ndarray | None = None, **options: Any) -> Trace:
    """What a simulation would have recorded."""
    return Trace.from_columns(simulate(model, command, load, **options)._asdict(), 1e-3, {}, model.kind.signals)


def write_measured_runs(folder: Path, changes: Mapping[str, float]) -> dict[str, Path]:
    """Files `est`, `repeat` and `holdout` of the nominal plant with `changes`."""
    files = {}
    for seed, name in enumerate(("est", "repeat", "holdout"), 1):
        demand = build_other_command() if name == "holdout" else build_command()
        files[name] = folder / f"{name}.csv"
        simulate_trace(Model().replace(changes), demand, seed=seed, steps=STEPS).write_csv(files[name])
    return files


def list_trace_arguments(files: Mapping[str, Path]) -> list[object]:
    """The runs as words of a command."""
    return [files["est"], "--repeat", files["repeat"], "--holdout", files["holdout"]]
