"""Simulates many runs of one model that differ in a few parameters: for fits, Jacobians, null simulations, grids.

Runs are made in blocks, side by side: one run in each lane of the processor's wide registers. A block keeps everything
in one flat buffer, number f of a lane at f * width + lane. All distances in memory are constants, so the compiler sees
that lanes are independent. With one array per quantity it would have to check that at run time, and gives up because
there are too many checks. The innermost loop runs over the lanes, has constant length, and calls the same step as a
single run; that step must not branch.
"""
from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant.compile import (
    Function,
    ReadRecord,
    compile_function,
    find_code_folder,
    is_costly,
    raise_unbound,
    rebind_names,
)
from plant.effects import Effect
from plant.errors import count_nouns, require
from plant.foreign import run_foreign
from plant.kernel_use import KernelUse
from plant.kernels import (
    compute_plant_coefficients,
    control_plant,
    keep_answer,
    keep_sample,
    make_packers,
    measure_plant,
    start_control,
    step_plant,
)
from plant.model import Model, build_bare_model
from plant.plants import MeasuredPressures, Plant
from plant.segments import Array
from plant.solve import pull_plant, read_controlled, rest_at_reading, show_start, take_demand
from plant.state import Input
from plant.threads import count_threads, do_together, map_in_threads

STEPS = 20  # steps a cycle: 50 us
FEW = 6  # effects that a model may have and still get one kernel for all its runs
FEW_COSTLY = 2  # costly effects that a kernel of their own may have
ALL_OVER_FEW = 4.0  # time of a step with all effects over that of one with few costly ones
WIDTH = 16  # lanes: this stands for a layout's own, which is put in its place
# one of the widest registers, or two, so that one computes while the other waits
NARROWEST, WIDEST = 8, 16
TURN = 20_000  # samples that a kernel makes in one call
KERNEL_USE = KernelUse()  # of this process


class Part(NamedTuple):
    """A piece of a longer recording, one of several that follow one another in an array.

    Its rows are first to stop - 1; they were `later` rows further on when they were recorded.
    """

    first: int
    stop: int
    later: int


class Block(NamedTuple):
    """Runs side by side: the kernel, the buffer at the start, and the row of the output for each lane."""

    run: Function
    buffer: Array
    rows: NDArray[np.uint64]


class Share(NamedTuple):
    """Runs that one kernel makes: its parameters `names`, their `values` (m, p), and the rows (m,) of the output."""

    kernel: KernelVariant
    names: tuple[str, ...]
    values: Array
    rows: NDArray[np.int64]


@dataclass(eq=False)
class Batch:
    """Runs over one set of inputs, that of `run_block`; `make_runs` fills `out`, (runs, columns, n)."""

    shares: list[Share]
    inputs: tuple[Any, ...]
    parts: tuple[Part, ...]
    runs: int
    columns: int
    out: Array = field(default_factory=lambda: np.empty((0, 0, 0)))

    @property
    def key(self) -> Hashable:
        """The same for batches with equal inputs."""
        return tuple(x.tobytes() if isinstance(x, np.ndarray) else x for x in self.inputs), self.parts, self.columns


def make_runs(batches: Sequence[Batch], workers: int) -> None:
    """Make the runs of some batches, those with equal inputs in common blocks."""
    equal: dict[Hashable, list[Batch]] = {}
    for batch in batches:
        equal.setdefault(batch.key, []).append(batch)
    map_in_threads(lambda task: task(), [task for group in equal.values() for task in _plan_group(group)], workers)


def _plan_group(batches: Sequence[Batch]) -> Iterator[Callable[[], None]]:
    """What is to be done for batches with equal inputs; each may be done in a thread of its own."""
    count, columns, inputs = sum(batch.runs for batch in batches), batches[0].columns, batches[0].inputs
    out = np.empty((count + 1, columns, len(inputs[0])))  # the last row is that of idle lanes
    shares, first = [], 0
    for batch in batches:
        batch.out = out[first:first + batch.runs]
        shares += [share._replace(rows=share.rows + first) for share in batch.shares]
        first += batch.runs

    def run_part(block: Block, part: Part) -> None:
        buffer = copy_to_cache_line(block.buffer) if batches[0].parts else block.buffer
        for first in range(part.first, part.stop, TURN):  # so that Ctrl-C is heard in between
            stop = min(first + TURN, part.stop)
            block.run(buffer, *inputs, first, stop, 0, part.later, first == part.first, block.rows, out)

    for block in build_blocks(shares, count):
        for part in batches[0].parts or (Part(0, len(inputs[0]), 0),):
            yield partial(run_part, block, part)


def build_blocks(shares: Iterable[Share], idle: int) -> list[Block]:
    """The runs in blocks, those of one kernel side by side.

    Idle lanes repeat the last run; the row of their output is `idle`.
    """
    by_kernel: dict[Hashable, list[Share]] = {}
    for share in shares:
        by_kernel.setdefault(share.kernel.key, []).append(share)
    blocks = []
    for group in by_kernel.values():
        kernel, rows = group[0].kernel, np.concatenate([share.rows for share in group])
        lanes = np.concatenate([share.kernel.fill_lanes(share.names, share.values) for share in group], axis=1)
        first = 0
        while first < len(rows):
            width = next((w for w in kernel.widths if first + w >= len(rows)), kernel.widths[-1])
            members = np.minimum(np.arange(first, first + width), len(rows) - 1)
            places = np.where(np.arange(first, first + width) < len(rows), rows[members], idle)
            # unsigned: no test for counting from the end
            buffer = copy_to_cache_line(lanes[:, members].reshape(-1))
            blocks.append(Block(kernel.compile(width), buffer, places.astype(np.uint64)))
            first += width
    return blocks


def copy_to_cache_line(numbers: Array) -> Array:
    """A copy of `numbers` (n,) that begins with a line of the cache: a register that lies in two takes twice as long.

    Measured: steps take up to 30 % longer where NumPy happens to put the buffer elsewhere.
    """
    line = 64  # bytes
    room = np.empty(len(numbers) + line // numbers.itemsize)
    first = -room.ctypes.data % line // numbers.itemsize
    aligned = room[first:first + len(numbers)]
    aligned[:] = numbers
    return aligned


class Lanes:
    """Runs of `model` that differ in the parameters `names` ("group.field")."""

    def __init__(self, model: Model, names: Sequence[str], steps: int = STEPS, workers: int | None = None) -> None:
        self.model, self.names, self.steps = model, tuple(names), steps
        self.workers = workers or count_threads()
        parameter_names = model.list_names()
        for name in self.names:
            require(name in parameter_names and name != "controller.period", "lanes", name,
                    f"a parameter of the model {model.name} other than the period")
        self._variants = list_kernel_variants(model)
        self._own: dict[tuple[str, ...], KernelVariant] = {}

    def replay(self, values: Array, current: Array, load: Array, position: Array | None = None,
               anchor: float = 0.0, parts: Sequence[Part] = (), chambers: Array | None = None,
               slack: float = 0.0) -> Array:
        """The plant without its controller, driven by a measured current or motor speed.

        The position of a plant whose chamber pressures were measured follows from its flow alone: they are given as a
        force, and all that acts on the ram is in them. P12 is predicted without them, from the drive and the model's
        forces. So no signal is predicted from itself.

        Args:
            values: (m, len(names)) parameters of each run, SI.
            current: (n,) drive; current[k - 1] acts from sample k to k + 1, none before.
            load: (n,) external load, of the EHA N on the ram, positive against extension.
            position: (n,) measured controlled signal, NaN where missing: runs start at rest where it shows the first.
            anchor: 1/s, how fast the plant is pulled to the measured signal; 0 is a free run.
            parts: pieces of a longer recording that the rows consist of: each begins anew; none: one piece.
            chambers: (n, 2) Pa, pressures of both chambers as they were read; None: the model's forces move the ram.
                A plant without `measured_pressures` does not use them.
            slack: how far the controlled signal may be off before an observer corrects the plant: half a step of a
                coarse sensor. A plant without an observer is pulled wherever it is off.

        Returns:
            (m, n, outputs): the readings at each sample, without noise; `[..., i]` has contiguous rows. Of the EHA XJ
            m, P12 Pa, XS m.

        Raises:
            InputError: shapes that do not fit.
        """
        where = np.empty(0) if position is None else position
        out = self._run(values, current, load, where, anchor, False, parts, slack)
        pressures = self.model.kind.measured_pressures
        if chambers is None or pressures is None:
            return out
        flow = self._replay_flow(pressures, values, current, chambers, where, anchor)
        return np.concatenate([flow, out[..., 1:]], axis=-1)

    def _replay_flow(self, pressures: MeasuredPressures, values: Array, current: Array, chambers: Array,
                     position: Array, anchor: float) -> Array:
        """XJ, (m, n, 1), with measured pressures as the force; runs with equal parameters of this force share it.

        Parts of a recording are one run: what pulls the ram to the measured position makes it forget the part before.
        """
        fixed_values = {name: value for name, value in pressures.given.items() if name in self.model.values}
        lanes = Lanes(self.model.replace(fixed_values), self.names, self.steps, self.workers)
        values = np.array(values, float)
        for i, name in enumerate(self.names):
            values[:, i] = pressures.given.get(name, values[:, i])
        columns = [i for i, name in enumerate(self.names) if name in pressures.used]
        kinds, of = np.unique(values[:, columns], axis=0, return_inverse=True)
        out = np.empty((len(values), len(current), 1))
        for i, kind in enumerate(kinds):
            rows = of.reshape(-1) == i
            parameters = dict(lanes.model.values) | dict(zip((self.names[j] for j in columns), kind, strict=True))
            force = pressures.compute_force(parameters, chambers, current, float(self.model["controller.period"]))
            out[rows] = lanes._run(values[rows], current, force, position, anchor, False)[..., :1]
        return out

    def replay_in_turns(self, values: Array, current: Array, load: Array, position: Array | None = None,
                        anchor: float = 0.0, rows: int = TURN, slack: float = 0.0) -> Iterator[tuple[int, Array]]:
        """The same replay, so many `rows` at a time: the first row of each piece, and its (m, k, outputs).

        Memory does not grow with the recording. The numbers are those of `replay`, to the last bit.

        Raises:
            InputError: shapes that do not fit.
        """
        where = np.empty(0) if position is None else position
        if self.model.kind.foreign is not None:
            yield 0, self.replay(values, current, load, position, anchor, slack=slack)
            return
        shares, inputs = self._prepare(values, current, load, where, anchor, False, slack)
        work = build_blocks(shares, len(values))
        for first in range(0, len(current), rows):
            stop = min(first + rows, len(current))
            out = np.empty((len(values) + 1, self._count_columns(False), stop - first))

            def go_on(block: Block, first: int = first, stop: int = stop, out: Array = out) -> None:
                block.run(block.buffer, *inputs, first, stop, first, 0, first == 0, block.rows, out)

            map_in_threads(go_on, work, self.workers)
            yield first, out[:-1].transpose(0, 2, 1)

    def closed_loop(self, values: Array, com: Array, load: Array) -> Array:
        """The plant with its own controller over a command.

        Args:
            values: (m, len(names)) parameters of each run, SI.
            com: (n,) demand, m.
            load: (n,) N, external force on the ram, positive against extension.

        Returns:
            (m, n, columns): readings without noise and drive at each sample, in the order of `Signals.columns`. Of the
            EHA XJ m, Cor A, P12 Pa, XS m.

        Raises:
            InputError: shapes that do not fit.
        """
        return self._run(values, com, load, np.empty(0), 0.0, True)

    def _run(self, values: Array, driven: Array, load: Array, position: Array, anchor: float, is_closed: bool,
             parts: Sequence[Part] = (), slack: float = 0.0) -> Array:
        if self.model.kind.foreign is not None:
            return run_foreign(self.model, self.names, values, driven, load, position, anchor, is_closed, parts)
        shares, inputs = self._prepare(values, driven, load, position, anchor, is_closed, slack)
        batch = Batch(shares, inputs, tuple(parts), len(values), self._count_columns(is_closed))
        do_together(batch, make_runs, self.workers)
        return batch.out.transpose(0, 2, 1)

    def _count_columns(self, is_closed: bool) -> int:
        signals = self.model.kind.signals
        return len(signals.columns if is_closed else signals.outputs)

    def _prepare(self, values: Array, driven: Array, load: Array, position: Array, anchor: float, is_closed: bool,
                 slack: float = 0.0) -> tuple[list[Share], tuple[Any, ...]]:
        """The runs by their kernels, and the inputs of all.

        Raises:
            InputError: shapes that do not fit.
        """
        values, driven, load, position = (np.ascontiguousarray(x, float) for x in (values, driven, load, position))
        require(values.ndim == 2 and values.shape[1] == len(self.names), "lanes", "values",
                f"one row a run of {len(self.names)} values, not shape {values.shape}")
        require(driven.ndim == 1 and load.shape == driven.shape and position.shape in (driven.shape, (0,)),
                "lanes", "load", "one number a cycle in each input, not shapes "
                f"{driven.shape}, {load.shape} and {position.shape}")
        slack = 0.0 if self.model.kind.correct is None else float(slack)
        shares = [Share(variant, self.names, values[members], members)
                  for variant, members in self._assign_runs(values, len(driven))]
        period = float(self.model["controller.period"])
        return shares, (driven, load, position, float(anchor), slack, is_closed, period, self.steps)

    def _assign_runs(self, values: Array, samples: int) -> list[tuple[KernelVariant, NDArray[np.int64]]]:
        """The runs of each kernel: a run goes to the kernel with the fewest effects that has all its active ones.

        `samples` is the length of a run.
        """
        effects = self.model.effects
        if len(self._variants) == 1:
            return [(self._variants[0], np.arange(len(values)))]
        at_work = np.column_stack([self._find_active_runs(self.model.find_effect(name), values) for name in effects])
        is_left, assignments = np.ones(len(values), bool), []
        for variant in self._variants:
            is_missing = [name not in variant.model.effects for name in effects]
            fits = is_left & ~at_work[:, is_missing].any(axis=1)
            is_left &= ~fits
            if fits.any():
                assignments.append((variant, np.flatnonzero(fits)))
        if assignments and assignments[-1][0] is self._variants[-1]:
            _, members = assignments.pop()
            assignments += self._share_costly_runs(members, at_work, samples)
        return assignments

    def _share_costly_runs(self, members: NDArray[np.int64], at_work: NDArray[np.bool_], samples: int
                           ) -> list[tuple[KernelVariant, NDArray[np.int64]]]:
        """The runs `members`, which have costly effects at work: many with the same ones get a kernel of their own.

        Args:
            members: numbers of these runs.
            at_work: (m, effects) of all runs.
            samples: of a run.
        """
        cheap = self._variants[-2].model.effects
        costly = [name for name in self.model.effects if name not in cheap]
        columns = [self.model.effects.index(name) for name in costly]
        kinds, kind_of, sizes = np.unique(at_work[members][:, columns], axis=0, return_inverse=True,
                                          return_counts=True)
        assignments, is_left = [], np.ones(len(members), bool)
        for kind in np.argsort(-sizes):
            is_of_kind = kind_of.reshape(-1) == kind
            fewer = _count_blocks(is_left.sum()) - _count_blocks((is_left & ~is_of_kind).sum())
            is_few = kinds[kind].sum() <= min(FEW_COSTLY, len(costly) - 1)
            if not is_few or ALL_OVER_FEW * fewer <= _count_blocks(sizes[kind]):
                continue
            kernel = self._find_own_kernel((*cheap, *(costly[i] for i in np.flatnonzero(kinds[kind]))))
            if kernel.is_ready(NARROWEST * _count_blocks(sizes[kind]) * samples * self.steps):
                assignments.append((kernel, members[is_of_kind]))
                is_left &= ~is_of_kind
        if is_left.any():
            assignments.append((self._variants[-1], members[is_left]))
        return assignments

    def _find_own_kernel(self, effects: tuple[str, ...]) -> KernelVariant:
        """The kernel of the model with these effects, in the model's order."""
        effects = tuple(name for name in self.model.effects if name in effects)
        if effects not in self._own:
            self._own[effects] = KernelVariant(self.model, effects)
        return self._own[effects]

    def _find_active_runs(self, effect: Effect, values: Array) -> NDArray[np.bool_]:
        """The runs in which the effect is active: one of its parameters differs from its off value."""
        is_active = np.zeros(len(values), bool)
        for name, off in effect.off.items():
            column = values[:, self.names.index(name)] if name in self.names else self.model[name]
            is_active |= column != off
        return is_active


class KernelVariant:
    """The kernel of a model with some of its effects, for the runs in which the others are off."""

    def __init__(self, model: Model, effects: tuple[str, ...]) -> None:
        own = set(build_bare_model(model.plant).with_effects(effects).values)
        self.model = replace(model, effects=effects, values={n: v for n, v in model.values.items() if n in own})
        self._laws = model.kind.list_laws(effects)
        self._state: Array | None = None
        # parameters of all shipped effects: kernels with records of one type have most of their functions in common
        complete = self.model.with_effects(e.name for e in model.kind.list_effects() if _is_shipped(e))
        self._names, self._record = complete.list_names(), complete.build_record()
        # lanes of its blocks: a costly effect keeps the processor busy with one register, else a step is half waiting;
        # a model of few effects makes too few runs to be worth the seconds in which a second layout is compiled
        is_waiting = all(_is_cheap(model.find_effect(name)) for name in effects)
        makes_many = not effects or len(model.effects) > FEW
        self.widths = (NARROWEST, WIDEST) if is_waiting and makes_many else (NARROWEST,)

    def is_ready(self, steps: float) -> bool:
        """Whether the kernel can make so many steps of all lanes now: see `KernelUse.is_ready`."""
        def is_stored() -> bool:
            plan = plan_layout(self.model.effects, self.model.kind, self._record.dtype, self.widths[0])
            return any(find_code_folder(plan.loop, plan.names).rglob("*.nbc"))  # be it for this CPU or another

        return KERNEL_USE.is_ready(self.key, steps, is_stored, self.prepare)

    @property
    def key(self) -> Hashable:
        """What tells the kernel from others: one kernel makes the runs of models that differ in parameters alone."""
        return self.model.kind, self.model.effects, self._laws, self._record.dtype

    def prepare(self) -> None:
        """Load or compile the kernel by a run of no samples."""
        none = np.empty(0)
        for width in self.widths:
            shares = [Share(self, (), np.zeros((width, 0)), np.arange(width))]
            for run, buffer, rows in build_blocks(shares, width):
                out = np.empty((width + 1, len(self.model.kind.signals.outputs), 0))
                run(buffer, none, none, none, 0.0, 0.0, False, 1.0, 1, 0, 0, 0, 0, True, rows, out)

    def compile(self, width: int) -> Function:
        """The kernel with so many lanes."""
        return self._compile_layout(width)[1]

    def _compile_layout(self, width: int) -> tuple[Layout, Function]:
        return _compile_layout(self.model.effects, self._laws, self.model.kind, self._record.dtype, width)

    def fill_lanes(self, names: Sequence[str], values: Array) -> Array:
        """The numbers of a lane for each run, (numbers, m), whose named parameters are `values` (m, p)."""
        plan, _ = self._compile_layout(self.widths[0])
        if self._state is None:  # not sooner: it asks laws, which may be wrong
            self._state = self.model.build_flat_state()
        lanes = np.zeros((plan.numbers, len(values)))
        lanes[:len(self._state)] = self._state[:, None]
        lanes[plan.parameters:] = self._record.view(np.float64)[:, None]
        for column, name in enumerate(names):
            if name in self._names:
                lanes[plan.parameters + self._names.index(name)] = values[:, column]
        return lanes


def _count_blocks(runs: int) -> int:
    return -(-int(runs) // NARROWEST)


def list_kernel_variants(model: Model) -> list[KernelVariant]:
    """Kernels for the runs of a model, from few effects to all of them.

    An effect at its off value changes no bit, so a run can be made without it. A model with many effects has three
    kernels: without effects, with those whose laws are cheap, with all. They make 400, 200 and 70 million steps per
    second. Kernels with one or two costly effects follow where they save more time than they take to compile
    (`plant.kernel_use`).
    """
    if len(model.effects) <= FEW:
        return [KernelVariant(model, model.effects)]
    cheap = tuple(name for name in model.effects if _is_cheap(model.find_effect(name)))
    return [KernelVariant(model, effects) for effects in dict.fromkeys(((), cheap, model.effects))]


def compile_kernels(model: Model, progress: Callable[[str, float], None] = lambda stage, share: None) -> None:
    """Compile the kernels that runs of the model may need, or load them from the cache.

    `progress` is called with each stage and the share done.
    The first time this takes some 2 s without effects and 12 s with the whole catalogue, later half a second.
    """
    variants = list_kernel_variants(model)
    for done, variant in enumerate(variants):
        progress(f"compiling the plant with {count_nouns(len(variant.model.effects), 'effect')}, once",
                 done / len(variants))
        variant.prepare()
    progress("", 1.0)


def _is_shipped(effect: Effect) -> bool:
    return effect.function is not None and effect.function.__module__.startswith("plant.")


def _is_cheap(effect: Effect) -> bool:
    """Whether a law of ours neither divides nor calls elementary functions, nor changes the oil, which does both."""
    return effect.port not in ("supply", "viscosity") and _is_shipped(effect) and not is_costly(effect.function)


@cache
def _compile_layout(effects: tuple[str, ...], laws: tuple[Any, ...], kind: Plant, record: np.dtype[Any], width: int
                    ) -> tuple[Layout, Function]:
    # `laws` is part of the cache's key only: a user may load a changed file under the same effect names
    plan = plan_layout(effects, kind, record, width)
    return plan, compile_function(plan.loop, plan.names, record)


class Layout(NamedTuple):
    """The layout of a block's buffer for a plant with certain effects."""

    loop: Function  # `run_block` for so many lanes
    names: dict[str, Function]  # replace the placeholders below and the ports
    parameters: int  # the number of the first parameter, which follow each other as in `Model.names`
    numbers: int  # of a lane


class Drive(NamedTuple):
    """The drive: in this cycle, and the controller's answer for the next."""

    now: float = 0.0
    next: float = 0.0


# each of these stands for a model's own, which is put in its place: x_at(buffer, lane), keep_x(x, buffer, lane)
state_at = parameters_at = coefficients_at = loop_at = drive_at = raise_unbound
keep_state = keep_coefficients = keep_loop = keep_drive = raise_unbound


def plan_layout(effects: tuple[str, ...], kind: Plant, record: np.dtype[Any], width: int = WIDEST) -> Layout:
    """The layout for a plant with `effects` and parameters in a `record`, `width` lanes."""
    functions, place = kind.bind_functions(effects), 0
    p = build_bare_model(kind.key).with_effects(effects).build_record()[0]
    shapes = {"state": kind.build_start(effects), "loop": kind.build_control_memory(), "drive": Drive(),
              "coefficients": functions["compute_plant_coefficients"](p, 1.0)}
    for name, shape in shapes.items():
        functions[f"keep_{name}"], functions[f"{name}_at"], place = make_packers(shape, width, place)
    functions["parameters_at"] = ReadRecord(record, place, width)
    numbers = place + record.itemsize // np.dtype(float).itemsize
    return Layout(rebind_names(run_block, WIDTH=width), functions, place, numbers)


def run_block(a: Any, com: Any, load: Any, position: Any, anchor: float, slack: float, is_closed: bool, period: float,
              steps: int, first: int, stop: int, origin: int, later: int, begins: bool, rows: Any, out: Any) -> None:
    """Simulates a block of runs over the samples k = first..stop-1.

    Fills out[rows[lane], :, k - origin] = the readings at sample k, in closed loop the drive too.

    Args:
        a: the block's buffer: state at the start and parameters in place, the rest zero. Used up.
        com: (n,) demand in closed loop, else the measured drive: com[k - 1] acts from k to k + 1.
        load: (n,) external load.
        position: (n,) measured controlled signal; NaN where missing; or (0,).
        anchor: 1/s, how fast the plant is pulled to it.
        slack: how far it may be off before the plant is pulled.
        is_closed: with the model's own controller.
        period: of a cycle, s.
        steps: steps a cycle.
        first: the first sample.
        stop: the sample after the last one.
        origin: the sample of the first column of `out`.
        later: samples by which the time is later than k says.
        begins: lanes begin at rest at the first sample; else they go on from where the buffer left them.
        rows: (WIDTH,) where in `out` each lane goes.
        out: (m, outputs or columns, n), written.
    """
    h = period / steps
    if begins:
        for lane in range(WIDTH):
            begin_lane(a, lane, position[first:], steps, h)
    for k in range(first, stop):
        t, column = (k + later) * period, k - origin
        drive = com[k - 1] if k > first or not begins else 0.0
        for lane in range(WIDTH):
            y = sample_lane(a, lane, t)
            keep_sample(y, out, rows[lane], column, is_closed)
            if is_closed:
                keep_answer(control_lane(a, lane, t, com[k], y), out, rows[lane], column)
            else:
                keep_drive(Drive(drive, 0.0), a, lane)
        if len(position):
            for lane in range(WIDTH):
                s, m = state_at(a, lane)
                keep_state(pull_plant(s, m, anchor * period, position[k], slack, parameters_at(a, lane)), a, lane)
        for i in range(steps):
            # the loop that everything is for
            for lane in range(WIDTH):
                u = Input(drive_at(a, lane).now, load[k], 0.0, t + i * h, i * h, h)
                s, m = state_at(a, lane)
                keep_state(step_plant(s, m, u, parameters_at(a, lane), coefficients_at(a, lane)), a, lane)


def begin_lane(a: Any, lane: int, position: Any, steps: int, h: float) -> None:
    """Put one lane at rest where its sensor shows position[0], or as it is, and compute its coefficients.

    Its controller begins with what its law remembers at the start.
    """
    s, m = state_at(a, lane)
    p = parameters_at(a, lane)
    keep_coefficients(compute_plant_coefficients(p, h), a, lane)
    keep_loop(start_control(), a, lane)
    keep_state(rest_at_reading(s, m, position[0], p, steps) if len(position) else (show_start(s, m, p), m), a, lane)


def sample_lane(a: Any, lane: int, t: float) -> Any:
    """The readings of one lane at `t`, as `plant.solve.read_sensors` without noise."""
    s, m = state_at(a, lane)
    p = parameters_at(a, lane)
    y, m = read_controlled(measure_plant(s, p), s, m, 0.0, t, p)
    keep_state((s, m), a, lane)
    return y


def control_lane(a: Any, lane: int, t: float, com: float, y: Any) -> float:
    """The drive that one lane's controller answers to a demand and the readings; it acts a cycle later."""
    s, m = state_at(a, lane)
    p, d = parameters_at(a, lane), drive_at(a, lane)
    demand, m = take_demand(com, m, y[0], t, p)
    drive: float
    drive, c = control_plant(loop_at(a, lane), demand, y, p)
    keep_loop(c, a, lane)
    keep_state((s, m), a, lane)
    keep_drive(Drive(d.next, drive), a, lane)
    return drive
