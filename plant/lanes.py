"""Many runs of one model that differ in a few parameters: fits, Jacobians, null simulations, grids."""
from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plant import block, flat
from plant.compile import Function, compiled
from plant.effects import CATALOGUE
from plant.errors import InputError
from plant.model import Model

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
        where = np.empty(0) if position is None else position
        return self._run(values, current, load, where, anchor, False)

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
        return self._run(values, com, load, np.empty(0), 0.0, True)

    def _run(self, values: Array, driven: Array, load: Array, position: Array, anchor: float, closed: bool) -> Array:
        values, driven, load, position = (np.ascontiguousarray(x, float) for x in (values, driven, load, position))
        if values.ndim != 2 or values.shape[1] != len(self.names):
            raise InputError("lanes", "values", f"one row a run of {len(self.names)} values, not shape {values.shape}")
        if driven.ndim != 1 or load.shape != driven.shape or position.shape not in (driven.shape, (0,)):
            raise InputError("lanes", "load", "one number a cycle in each input, not shapes "
                             f"{driven.shape}, {load.shape} and {position.shape}")
        buffers = self._buffers(values)
        out = np.empty((len(buffers), block.WIDTH, 4 if closed else 3, len(driven)))
        run, period = self._kernel(), float(self.model["controller.period"])

        def work(i: int) -> None:
            run(buffers[i], driven, load, position, float(anchor), closed, period, self.steps, out[i])

        if min(self.workers, len(buffers)) < 2:
            for i in range(len(buffers)):
                work(i)
        else:
            with ThreadPoolExecutor(self.workers) as pool:
                list(pool.map(work, range(len(buffers))))
        return out.reshape(len(out) * block.WIDTH, *out.shape[2:])[:len(values)].transpose(0, 2, 1)

    def _buffers(self, values: Array) -> Array:
        """The blocks' buffers at the start, (blocks, numbers * WIDTH); idle lanes repeat the last run."""
        _, first, numbers = _laid_out(self.model.effects, _laws(self.model.effects), self.model.plant)
        blocks = -(-len(values) // block.WIDTH)
        a = np.zeros((blocks, numbers, block.WIDTH))
        state, record = flat.values(self.model.state()), self.model.record().view(np.float64)
        a[:, :len(state)] = np.array(state)[:, None]
        a[:, first:first + len(record)] = record[:, None]
        runs = np.minimum(np.arange(blocks * block.WIDTH), max(len(values), 1) - 1).reshape(blocks, block.WIDTH)
        for column, place in enumerate(self._places):
            a[:, first + place] = values[runs, column]
        return a.reshape(blocks, numbers * block.WIDTH)

    def _kernel(self) -> Function:
        return _compiled(self.model.effects, _laws(self.model.effects), self.model.plant)


def _laws(effects: tuple[str, ...]) -> tuple[Any, ...]:
    return tuple(CATALOGUE[e].function for e in effects)  # a user's file may have been loaded anew


@cache
def _laid_out(effects: tuple[str, ...], laws: tuple[Any, ...], plant: str) -> tuple[dict[str, Function], int, int]:
    return block.layout(effects, plant)


@cache
def _compiled(effects: tuple[str, ...], laws: tuple[Any, ...], plant: str = "eha") -> Function:
    return compiled(block.run, _laid_out(effects, laws, plant)[0])
