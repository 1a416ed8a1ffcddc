"""The RMS grid's runs beside C with OpenMP, jax and ProgPy: the same cells, from the same current, in one process.

The work is a map of `fdi.diagnosis.rms_grid`: every cell over a whole preflight, drawn to the measured ram,
and its RMS error.
"""
from __future__ import annotations

import ctypes
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi.progress import Progress, ignore_progress
from plant import Model, simulate
from plant.lanes import Lanes
from plant.monitor import FAULTS, Cell, Monitor, cells
from rig.studies.benchmarks.many_runs import Rival
from rig.studies.benchmarks.peers import FLAGS, GET_GCC, Replay, built, gcc, missing
from rig.studies.benchmarks.stopwatch import durations

Array = NDArray[np.float64]
OURS = "ours, a thread a core"
REFERENCE = "the reference model, 10 steps a cycle"
SIDE, ANCHOR, SLIDING = 21, 20.0, 2.0 / 3.0  # cells a side; 1/s; as in the grid
OPENMP = (*FLAGS, "-fopenmp")
LOOSE = (*OPENMP, "-ffast-math", "-DWIDTH=32")  # which lets gcc take several exponentials at once
PIECE = 12  # cycles for a rival that is slower by orders of magnitude


class Work:
    """The cells, and what was measured: a preflight with both faults."""

    def __init__(self, command: Array) -> None:
        self.model = Model()
        run = simulate(self.model.replace({FAULTS[0]: 0.25, FAULTS[1]: 30.0, "spool.dynamic_friction": 20.0}), command)
        self.current, self.position = run.cor, run.xj
        sizes = np.meshgrid(np.linspace(0.0, 0.5, SIDE), np.linspace(0.0, 90.0, SIDE), indexing="ij")
        self.values = np.stack(sizes, -1).reshape(-1, 2)
        self.h = float(self.model["controller.period"])

    def cells(self, width: int = 1) -> Array:
        """(fields, m) cells, the last repeated up to a multiple of `width`."""
        made = cells(self.model, FAULTS, self.values, self.h, SLIDING)
        return np.ascontiguousarray(np.pad(made, ((0, 0), (0, -len(self.values) % width)), "edge"))


def grid(command: Array, progress: Progress = ignore_progress, rounds: int = 5) -> list[Rival]:
    """Runs of all cells over `command` (n,) m; speeds are cycles of a cell per second."""
    work = Work(command)
    with tempfile.TemporaryDirectory() as folder:
        progress("the RMS grid: compiling the rivals", 0.0)
        runs, skipped = _rivals(work, Path(folder))
        maps = {name: run().copy() for name, run in runs.items()}
        progress("the RMS grid", 0.0)
        seconds = durations(runs, rounds)
    cycles = work.values.size // 2 * len(command)
    found = [Rival(name, float(cycles / np.median(s)), float(np.median(s / seconds[OURS])),
                   float(np.abs(maps[name] - maps[OURS]).max()), "") for name, s in seconds.items()]
    note = "another model: what the monitor leaves out is the difference"
    found = [rival._replace(note=note) if rival.name == REFERENCE else rival for rival in found]
    return [*found, *skipped, _progpy(work, cycles / float(np.median(seconds[OURS])), progress)]


def _rivals(work: Work, folder: Path) -> tuple[dict[str, Replay], list[Rival]]:
    def ours(workers: int | None) -> Replay:
        monitor = Monitor(work.model, workers=workers, sliding=SLIDING)

        def reduced(runs: Array) -> Array:
            left = runs[:, 0].T - work.position[:, None]
            error: Array = np.sqrt(np.einsum("ij,ij->j", left, left) / len(left))
            return error

        return lambda: monitor.replay(work.values, work.current, work.position, ANCHOR, reduced=reduced)

    runs: dict[str, Replay] = {OURS: ours(None), "ours, one thread": ours(1)}
    skipped = []
    for i, (name, flags) in enumerate((("C, one thread", FLAGS), ("C, OpenMP", OPENMP),
                                       ("C, OpenMP, 32 cells side by side, -ffast-math", LOOSE))):
        if gcc():
            runs[name] = _in_c(work, flags, folder / f"{i}.so")
        else:
            skipped.append(Rival(name, None, None, None, f"skipped, there is no gcc; to get it: {GET_GCC}"))
    if why := missing("jax"):
        skipped.append(Rival("jax, vmap", None, None, None, f"skipped, {why}"))
    else:
        runs["jax, vmap"] = _in_jax(work)
    runs[REFERENCE] = _reference(work)
    return runs, skipped


def _reference(work: Work) -> Replay:
    lanes = Lanes(work.model, (*FAULTS, "spool.dynamic_friction"), 10)
    values = np.column_stack([work.values, SLIDING * work.values[:, 1]])
    none = np.zeros_like(work.current)
    return lambda: _rms(lanes.replay(values, work.current, none, work.position, ANCHOR)[..., 0], work)


def _rms(xj: Array, work: Work) -> Array:
    left = xj - work.position[:xj.shape[1]]
    error: Array = np.sqrt(np.einsum("ij,ij->i", left, left) / left.shape[1])
    return error


def _in_c(work: Work, flags: tuple[str, ...], target: Path) -> Replay:
    """`map_cells` of monitor.c."""
    function = built("monitor.c", flags, target).map_cells
    width = next((int(flag.split("=")[1]) for flag in flags if flag.startswith("-DWIDTH=")), 16)
    made, n, count = work.cells(width), len(work.current), len(work.values)
    out = np.empty(made.shape[1])
    pointers = [np.ctypeslib.as_ctypes(a.reshape(-1)) for a in (made, work.current, work.position, out)]

    def run() -> Array:
        numbers, current, position, rows = pointers
        function(numbers, ctypes.c_long(made.shape[1]), current, position, ctypes.c_double(ANCHOR * work.h),
                 ctypes.c_long(n), ctypes.c_double(work.h), rows)
        return out[:count]

    return run


def _in_jax(work: Work) -> Replay:
    """jax: one cell as a scan over the cycles, compiled, vmap over the cells."""
    import jax

    jax.config.update("jax_enable_x64", True)
    numbers = jax.numpy

    def one(cell: Any, current: Any, position: Any) -> Any:
        def cycle(s: Any, held: Any) -> Any:
            xs, xj, v, sliding = s
            drawn = xj + ANCHOR * work.h * (held[1] - xj)
            return step(numbers, (xs, drawn, v, sliding), held[0], work.h, cell), xj

        zero = numbers.zeros(())
        xj = jax.lax.scan(cycle, (zero, position[0], zero, zero), (current, position))[1]
        return numbers.sqrt(numbers.mean((xj - position) ** 2))

    compiled = jax.jit(jax.vmap(one, (0, None, None)))
    made, acting = Cell(*work.cells()), np.r_[0.0, work.current[:-1]]
    return lambda: np.asarray(compiled(made, acting, work.position))


def _progpy(work: Work, our_speed: float, progress: Progress) -> Rival:
    """NASA ProgPy, vectorised over the cells, on a short piece, as it is so much slower."""
    if why := missing("progpy"):
        return Rival("ProgPy, vectorised", None, None, None, f"skipped, {why}")
    progress("the RMS grid: ProgPy", 0.0)
    plant, acting = _progpy_plant(work), np.r_[0.0, work.current[:-1]]

    def inputs(t: float, x: Any = None) -> Any:
        row = max(int(t / work.h - 0.5), 0)  # it asks for the end of the cycle, where ours takes the start
        return plant.InputContainer({"current": acting[row], "measured": work.position[row]})

    times = [(row - 0.5) * work.h for row in range(1, PIECE + 1)]  # half a cycle early: it takes the next state
    run = partial(plant.simulate_to, times[-1], inputs, dt=work.h, save_pts=times)
    rows = np.array([np.ravel(row["xj"]) for row in run().outputs])
    monitor = Monitor(work.model, sliding=SLIDING)
    ours = _rms(monitor.replay(work.values, work.current[:PIECE], work.position[:PIECE], ANCHOR)[:, 0], work)
    speed = len(work.values) * PIECE / float(np.median(durations({"": run}, 3)[""]))
    apart = float(np.abs(_rms(rows[:PIECE].T, work) - ours).max())
    return Rival("ProgPy, vectorised", speed, our_speed / speed, apart, f"measured on {PIECE} cycles")


def _progpy_plant(work: Work) -> Any:
    from progpy import PrognosticsModel

    cell, names = Cell(*work.cells()), ["xs", "xj", "v", "sliding"]

    class Plant(PrognosticsModel):  # type: ignore[misc]
        """The monitor without its controller."""

        is_vectorized = True
        inputs, states, outputs = ["current", "measured"], names, ["xj"]
        events: list[str] = []  # noqa: RUF012  (the library's own way)

        def initialize(self, u: Any = None, z: Any = None) -> Any:
            at = {name: np.zeros(len(work.values)) for name in names}
            return self.StateContainer(at | {"xj": np.full(len(work.values), work.position[0])})

        def next_state(self, x: Any, u: Any, dt: float) -> Any:
            drawn = x["xj"] + ANCHOR * work.h * (u["measured"] - x["xj"])
            after = step(np, (x["xs"], drawn, x["v"], x["sliding"]), u["current"], work.h, cell)
            return self.StateContainer(dict(zip(names, after, strict=True)))

        def output(self, x: Any) -> Any:
            return self.OutputContainer({"xj": x["xj"]})

    return Plant(process_noise=0, measurement_noise=0)


def step(xp: Any, s: Any, current: Any, h: float, c: Any) -> tuple[Any, ...]:
    """`plant.monitor.step` on arrays of the library `xp`: XS, XJ, XJ', which way the spool slides."""
    xs, xj, v0, sliding = s
    tilt = c.tilt * current - c.back * xs
    asked = tilt - _clip(xp, tilt, c.slide)
    asked = xp.where((asked * sliding > 0.0) | (xp.abs(tilt) > c.dead), asked, 0.0)
    begin = _clip(xp, asked, c.most)
    wait = xp.minimum(xp.abs(asked - begin) * c.wait, h)
    end = begin * xp.exp(c.rate * (wait - h))
    line, curve, left = c.speed * begin * wait, (begin - end) * c.unback, h - wait
    spool = _clip(xp, xs + line + curve, c.spool_travel)
    area = line * (0.5 * wait + left) + (begin * left - (begin - end) * c.unrate) * c.unback
    total = _clip(xp, h * xs + area, h * c.spool_travel)
    before = xs - c.lag * c.speed * begin
    free = c.follow * (spool - c.lag * c.speed * end) + (v0 - c.follow * before) * c.fade
    v = xp.minimum(xp.maximum(free, c.coast * v0 - c.push), c.coast * v0 + c.push)
    x = xj + xp.where(v == free, c.follow * total - c.lag * (v - v0), 0.5 * h * (v0 + v))
    return spool, _clip(xp, x, c.jack_travel), xp.where(xp.abs(x) <= c.jack_travel, v, 0.0), xp.sign(asked)


def _clip(xp: Any, x: Any, limit: Any) -> Any:
    return xp.maximum(xp.minimum(x, limit), -limit)
