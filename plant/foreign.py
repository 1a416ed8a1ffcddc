"""Runs of a plant whose equations are another program's, such as an FMU: in closed loop, and replays of recordings.

`Plant.foreign` gives the program for cycles of so many seconds.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any, Protocol

import numpy as np

from plant.errors import RigError
from plant.pid import control_by_pid
from plant.segments import Array


class Diverged(RigError):
    """A program cannot run with its parameters: it stopped, or returned a number that is not finite."""


class Program(Protocol):
    """What moves a plant, a cycle at a time. A plant without load does not look at the load.

    Each function raises `Diverged`.
    """

    def begin(self, values: Mapping[str, float]) -> Array:
        """Start anew with these parameters, and the `seed` of the run; the readings at time 0."""

    def step(self, drive: float, load: float) -> Array:
        """One cycle with these inputs; the readings at its end."""

    def change(self, name: str, value: float) -> None:
        """Change a parameter while it runs."""

    def run(self, values: Mapping[str, float], given: Array) -> Array:
        """The readings (n, outputs) before each cycle of a whole run; `given` has drive and load of each, (n, 2)."""


@lru_cache(2)
def _find_program(foreign: Callable[[float], Program], period: float) -> Program:
    """The program for replays: one serves them all, because each begins anew."""
    return foreign(period)


def run_foreign_loop(actuator: Any, com: Array, load: Array, out: Array) -> None:
    """A plant in closed loop with its controller: as `plant.solve.run_closed_loop`, for a `plant.run.Actuator`.

    Args:
        actuator: the plant.
        com: (n,) demand.
        load: (n,) external load.
        out: (n, columns), written: readings, and the drive that the controller answers.
    """
    actuator.warm()
    kind, p = actuator.model.kind, actuator.model.build_record()[0]
    names = [s.name for s in kind.signals.columns]
    columns, drive_column = [names.index(s.name) for s in kind.signals.outputs], names.index(kind.signals.drive.name)
    drive, memory = 0.0, kind.build_control_memory()
    for k in range(len(com)):
        out[k, columns] = readings = actuator.sample()
        actuator.advance(drive, float(load[k]))
        drive, memory = (kind.control or control_by_pid)(memory, float(com[k]), readings, p)
        out[k, drive_column] = drive


def run_foreign(model: Any, names: Sequence[str], values: Array, driven: Array, load: Array, position: Array,
                anchor: float, is_closed: bool, parts: Sequence[Any]) -> Array:
    """The runs of `plant.lanes.Lanes` for a plant that another program moves, one after the other.

    Its state cannot be pulled to the measured position. So the movement that it shows from row to row is added up, and
    what has been added up is pulled. Trials of a fit, which have `names`, are NaN where they diverge.
    """
    if is_closed:
        from plant.run import simulate

        runs = (simulate(model.replace(dict(zip(names, row.tolist(), strict=True))), driven, load) for row in values)
        return np.array([[getattr(run, s.name) for s in model.kind.signals.columns] for run in runs]).transpose(0, 2, 1)
    period = model["controller.period"]
    program = _find_program(model.kind.foreign, period)
    out = np.empty((len(values), len(driven), len(model.kind.signals.outputs)))
    for first, stop in [(part.first, part.stop) for part in parts] or [(0, len(driven))]:
        inputs = np.column_stack([np.append(0.0, driven[first:stop - 1]), load[first:stop]])
        for i, row in enumerate(values):
            try:
                out[i, first:stop] = program.run({**model.values, **dict(zip(names, row, strict=True))}, inputs)
            except Diverged:
                if not names:
                    raise
                out[i, first:stop] = np.nan
        if len(position):
            movements = np.diff(out[:, first:stop, 0], append=0.0)
            x = out[:, first, 0].copy() if np.isnan(position[first]) else np.full(len(values), position[first])
            for k in range(first, stop):
                out[:, k, 0] = x
                pull = 0.0 if np.isnan(position[k]) else anchor * period * (position[k] - x)
                x = x + movements[:, k - first] + pull
    return out
