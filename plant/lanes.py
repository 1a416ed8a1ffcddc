"""Many runs of one model that differ in a few parameters: fits, Jacobians, null simulations, grids."""
from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plant import block, flat
from plant.compile import Function, is_costly
from plant.effects import CATALOGUE, Effect
from plant.errors import InputError
from plant.model import Model, build_bare_model
from plant.threads import count_threads, map_in_threads

Array = NDArray[np.float64]
STEPS = 20  # steps a cycle: 50 us
FEW = 6  # effects that a model may have and still get one kernel for all its runs


class Lanes:
    """Runs of `model` that differ in the parameters `names` ("group.field")."""

    def __init__(self, model: Model, names: Sequence[str], steps: int = STEPS, workers: int | None = None) -> None:
        self.model, self.names, self.steps = model, tuple(names), steps
        self.workers = workers or count_threads()
        known = model.names()
        for name in self.names:
            if name not in known or name == "controller.period":
                raise InputError("lanes", name, f"a parameter of the model {model.name} other than the period")
        self._rungs = list_kernel_variants(model)

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
        out = np.empty((len(values) + 1, 4 if closed else 3, len(driven)))  # the last for idle lanes
        inputs = driven, load, position, float(anchor), closed, float(self.model["controller.period"]), self.steps
        work = [(run, buffer, rows) for rung, members in self._shared_out(values)
                for run, buffer, rows in rung.blocks(self.names, values, members)]

        def do(task: tuple[Function, Array, NDArray[np.uint64]]) -> None:
            run, buffer, rows = task
            run(buffer, *inputs, rows, out)

        map_in_threads(do, work, self.workers)
        return out[:-1].transpose(0, 2, 1)

    def _shared_out(self, values: Array) -> list[tuple[KernelVariant, NDArray[np.int64]]]:
        """Which runs go where: each to the model with the fewest effects that has all that are at work in it."""
        effects = self.model.effects
        if len(self._rungs) == 1:
            return [(self._rungs[0], np.arange(len(values)))]
        at_work = np.column_stack([self._at_work(CATALOGUE[name], values) for name in effects])
        left, shared = np.ones(len(values), bool), []
        for rung in self._rungs:
            others = [name not in rung.model.effects for name in effects]
            fits = left & ~at_work[:, others].any(axis=1)
            left &= ~fits
            if fits.any():
                shared.append((rung, np.flatnonzero(fits)))
        return shared

    def _at_work(self, effect: Effect, values: Array) -> NDArray[np.bool_]:
        """In which runs a parameter of the effect is off its off value."""
        changed = np.zeros(len(values), bool)
        for name, off in effect.off.items():
            column = values[:, self.names.index(name)] if name in self.names else self.model[name]
            changed |= column != off
        return changed


class KernelVariant:
    """A model's kernel, or that of the same model with fewer effects."""

    def __init__(self, model: Model, effects: tuple[str, ...]) -> None:
        own = set(build_bare_model(model.plant).having(effects).values)
        self.model = replace(model, effects=effects, values={n: v for n, v in model.values.items() if n in own})
        self._names, self._laws = self.model.names(), list_laws(effects)
        self._state: Array | None = None
        self._parameters = self.model.record().view(np.float64)[:, None]

    def blocks(self, names: Sequence[str], values: Array, members: NDArray[np.int64]
               ) -> Iterator[tuple[Function, Array, NDArray[np.uint64]]]:
        """The runs `members` in blocks: the kernel, the buffer at the start, and where the rows go.

        Idle lanes repeat the last run; their rows go behind all others.
        """
        model = self.model
        width = block.WIDE if len(members) >= 2 * block.WIDE and not model.effects else block.NARROW
        plan, run = _compile_layout(model.effects, self._laws, model.plant, width)
        if self._state is None:  # not sooner: it asks laws, which may be wrong
            self._state = np.array(flat.list_state_values(model.state()))
        start = np.zeros((plan.numbers, width))
        start[:len(self._state)] = self._state[:, None]
        start[plan.parameters:] = self._parameters
        for first in range(0, len(members), width):
            lanes = members[first:first + width]
            buffer = start.copy()
            for column, name in enumerate(names):
                if name in self._names:
                    place = buffer[plan.parameters + self._names.index(name)]
                    place[:len(lanes)], place[len(lanes):] = values[lanes, column], values[lanes[-1], column]
            rows = np.r_[lanes, np.full(width - len(lanes), len(values))]
            yield run, buffer.reshape(-1), rows.astype(np.uint64)  # unsigned: no test for counting from the end


def list_kernel_variants(model: Model) -> list[KernelVariant]:
    """Kernels for the runs of a model, from few effects to all it has.

    An effect at its off value changes no bit, so a run may be made without it. A model with many effects has three:
    none of them, those whose laws are cheap, and all; they run at 400, 200 and 70 million steps a second. More kernels
    would save less than they take to compile.
    """
    if len(model.effects) <= FEW:
        return [KernelVariant(model, model.effects)]
    cheap = tuple(name for name in model.effects if _is_cheap(CATALOGUE[name]))
    return [KernelVariant(model, effects) for effects in dict.fromkeys(((), cheap, model.effects))]


def compile_kernels(model: Model, progress: Callable[[str, float], None] = lambda stage, share: None) -> None:
    """Compile what runs of the model may need, or load it from the cache.

    `progress` is called with each stage and the share done.
    The first time this takes some 3 s without effects and 15 s with the whole catalogue, later half a second.
    """
    rungs = list_kernel_variants(model)
    for done, rung in enumerate(rungs):
        progress(f"compiling the plant with {len(rung.model.effects)} effects, once", done / len(rungs))
        for run, buffer, rows in rung.blocks((), np.zeros((1, 0)), np.arange(1)):
            none = np.empty(0)
            run(buffer, none, none, none, 0.0, False, 1.0, 1, rows, np.empty((2, 3, 0)))
    progress("", 1.0)


def _is_cheap(effect: Effect) -> bool:
    """Whether a law of ours neither divides nor calls elementary functions, nor changes the oil, which does both."""
    if effect.port in ("supply", "viscosity") or effect.function is None:
        return False
    return effect.function.__module__.startswith("plant.") and not is_costly(effect.function)


def list_laws(effects: tuple[str, ...]) -> tuple[Any, ...]:
    """The functions behind the names, as a user's file may have been loaded anew."""
    return tuple(CATALOGUE[e].function for e in effects)


@cache
def _compile_layout(effects: tuple[str, ...], functions: tuple[Any, ...], plant: str, width: int
              ) -> tuple[block.Layout, Function]:
    plan = block.plan_layout(effects, plant, width)
    return plan, block.compile_block_kernel(plan)
