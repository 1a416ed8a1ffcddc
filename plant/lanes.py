"""Many runs of one model that differ in a few parameters: fits, Jacobians, null simulations, grids."""
from __future__ import annotations

import os
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from plant import replay as replay_module
from plant.compile import compiled
from plant.errors import InputError
from plant.model import Model, bindings, kernel

Array = NDArray[np.float64]
STEPS = 20  # steps a cycle: 50 us


class Lanes:
    """Runs of `model` that differ in the parameters `names` ("group.field")."""

    def __init__(self, model: Model, names: Sequence[str], steps: int = STEPS, workers: int | None = None) -> None:
        self.model, self.names, self.steps = model, tuple(names), steps
        self.workers = workers or os.cpu_count() or 1
        known = model.names()
        for name in self.names:
            if name not in known or name == "controller.period":
                raise InputError("lanes", name, f"a parameter of the model {model.name} other than the period")
        self._places = [known.index(name) for name in self.names]

    def replay(self, values: Array, current: Array, load: Array, position: Array | None = None,
               anchor: float = 0.0) -> Array:
        """The plant without its controller, driven by a measured current.

        Args:
            values: (m, len(names)) parameters of each run, SI.
            current: (n,) A; current[k - 1] acts from sample k to k + 1, none before.
            load: (n,) N, external force on the ram, positive against extension.
            position: (n,) m, measured, NaN where missing: runs start at rest where it shows position[0].
            anchor: 1/s, how fast the ram is pulled to the measured position; 0 is a free run.

        Returns:
            (m, n, 3): XJ as sensed m, P12 Pa, XS m at each sample, without noise; `[..., i]` has contiguous rows.

        Raises:
            InputError: shapes that do not fit.
        """
        current, load = np.ascontiguousarray(current, float), np.ascontiguousarray(load, float)
        where = np.empty(0) if position is None else np.ascontiguousarray(position, float)
        records, out = self._records(values), np.empty((len(values), 3, len(current)))
        run = compiled(replay_module.replay, bindings(self.model.effects))
        for record, rows in zip(records, out, strict=True):
            run(self.model.state(), current, load, where, anchor, record, self.steps, rows.T)
        return out.transpose(0, 2, 1)

    def closed_loop(self, values: Array, com: Array, load: Array) -> Array:
        """The plant with its own controller over a command.

        Args:
            values: (m, len(names)) parameters of each run, SI.
            com: (n,) demand, m.
            load: (n,) N, external force on the ram, positive against extension.

        Returns:
            (m, n, 4): XJ as sensed m, Cor A, P12 Pa, XS m at each sample, without noise.

        Raises:
            InputError: shapes that do not fit.
        """
        com, load = np.ascontiguousarray(com, float), np.ascontiguousarray(load, float)
        run, none = kernel("closed_loop", self.model.effects), np.zeros((len(com), 4))
        out = np.empty((len(values), 4, len(com)))
        for record, rows in zip(self._records(values), out, strict=True):
            run(self.model.state(), com, load, none, record, self.steps, rows.T)
        return out.transpose(0, 2, 1)

    def _records(self, values: Array) -> Iterator[NDArray[np.void]]:
        values = np.asarray(values, float)
        if values.ndim != 2 or values.shape[1] != len(self.names):
            raise InputError("lanes", "values", f"one row a run of {len(self.names)} values, not shape {values.shape}")
        record = self.model.record()
        numbers = record.view(np.float64)
        for row in values:
            numbers[self._places] = row
            yield record
