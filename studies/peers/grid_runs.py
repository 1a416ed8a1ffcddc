"""The RMS grid's runs beside C with OpenMP, jax and ProgPy: the same cells, from the same current, in one process.

The work is one map of `fdi.diagnosis.rms_grid`: every cell over a whole preflight, drawn to the measured ram, and its
RMS error.
"""

import ctypes
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi.progress import Progress, ignore_progress
from plant import FAULTS, Lanes, Model, Monitor, simulate
from plant.monitor import Cell, compute_cells
from rig.bench.benchmarks import FLAGS, build_library, measure_median_duration
from studies.peers.rivals import (
    Maker,
    Race,
    Replay,
    Rival,
    clip,
    explain_missing,
    explain_missing_gcc,
    make_progpy_plant,
    make_replays,
    race_rivals,
    skip_rival,
)

Array = NDArray[np.float64]
OURS = "ours, a thread a core"
REFERENCE = "the reference model, 10 steps a cycle"
ANCHOR, SLIDING = 20.0, 2.0 / 3.0  # 1/s, dynamic over static friction; as in the grid
OPENMP = (*FLAGS, "-fopenmp")
LOOSE = (*OPENMP, "-ffast-math", "-DWIDTH=32")  # lets gcc compute several exponentials at once


class Work:
    """The cells of the grid, `side` by `side`, and the measured run: a preflight with both faults."""

    def __init__(self, command: Array, side: int = 21) -> None:
        self.model = Model()
        run = simulate(self.model.replace({FAULTS[0]: 0.25, FAULTS[1]: 30.0, "spool.dynamic_friction": 20.0}), command)
        self.current, self.position = run.cor, run.xj
        sizes = np.meshgrid(np.linspace(0.0, 0.5, side), np.linspace(0.0, 90.0, side), indexing="ij")
        self.values = np.stack(sizes, -1).reshape(-1, 2)
        self.h = float(self.model["controller.period"])

    def cells(self, width: int = 1) -> Array:
        """(fields, m) cells; the last one is repeated up to a multiple of `width`."""
        columns = compute_cells(self.model, FAULTS, self.values, self.h, SLIDING)
        return np.ascontiguousarray(np.pad(columns, ((0, 0), (0, -len(self.values) % width)), "edge"))


def compare_grid_runs(command: Array, progress: Progress = ignore_progress, rounds: int = 5) -> list[Rival]:
    """Runs of all cells over `command` (n,) m; speeds are cycles of a cell per second."""
    work = Work(command)
    with tempfile.TemporaryDirectory() as folder:
        progress("the RMS grid: compiling the rivals", 0.0)
        replays, skipped_rivals = make_replays(_list_makers(work, Path(folder)))
        progress("the RMS grid", 0.0)
        race = race_rivals(replays, OURS, len(work.values) * len(command), rounds, _compare_maps)
    note = "another model: what the monitor leaves out is the difference"
    rivals = [rival._replace(note=note) if rival.name == REFERENCE else rival for rival in race.rivals]
    progress("the RMS grid: ProgPy", 0.0)
    return [*rivals, *skipped_rivals, _measure_progpy(work, race)]


def _compare_maps(errors: Array, reference: Array) -> float:
    return float(np.abs(errors - reference).max())


def _list_makers(work: Work, folder: Path) -> dict[str, Maker]:
    """What makes each rival, by name."""
    in_c = {"C, one thread": FLAGS, "C, OpenMP": OPENMP, "C, OpenMP, 32 cells side by side, -ffast-math": LOOSE}
    return {OURS: ("", partial(_make_own_replay, work, None)),
            "ours, one thread": ("", partial(_make_own_replay, work, 1)),
            **{name: (explain_missing_gcc(), partial(_make_c_replay, work, flags, folder / f"{number}.so"))
               for number, (name, flags) in enumerate(in_c.items())},
            "jax, vmap": (explain_missing("jax"), partial(_make_jax_replay, work)),
            REFERENCE: ("", partial(_make_reference_replay, work))}


def _make_own_replay(work: Work, workers: int | None) -> Replay:
    monitor = Monitor(work.model, workers=workers, sliding=SLIDING)

    def reduce_to_rms(runs: Array) -> Array:
        error = runs[:, 0].T - work.position[:, None]
        return np.asarray(np.sqrt(np.einsum("ij,ij->j", error, error) / len(error)))

    return lambda: monitor.replay(work.values, work.current, work.position, ANCHOR, reduced=reduce_to_rms)


def _make_reference_replay(work: Work) -> Replay:
    lanes = Lanes(work.model, (*FAULTS, "spool.dynamic_friction"), 10)
    values = np.column_stack([work.values, SLIDING * work.values[:, 1]])
    load = np.zeros_like(work.current)
    return lambda: _measure_rms(lanes.replay(values, work.current, load, work.position, ANCHOR)[..., 0], work)


def _measure_rms(xj: Array, work: Work) -> Array:
    """RMS error of positions (m, n) against the measured ones, (m,) m."""
    error = xj - work.position[:xj.shape[1]]
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", error, error) / error.shape[1]))


def _make_c_replay(work: Work, flags: tuple[str, ...], target: Path) -> Replay:
    """The function `map_cells` of monitor.c."""
    function = build_library("monitor.c", flags, target, "studies.peers").map_cells
    width = next((int(flag.split("=")[1]) for flag in flags if flag.startswith("-DWIDTH=")), 16)
    columns, n, count = work.cells(width), len(work.current), len(work.values)
    out = np.empty(columns.shape[1])
    pointers = [np.ctypeslib.as_ctypes(a.reshape(-1)) for a in (columns, work.current, work.position, out)]

    def run() -> Array:
        numbers, current, position, rows = pointers
        function(numbers, ctypes.c_long(columns.shape[1]), current, position, ctypes.c_double(ANCHOR * work.h),
                 ctypes.c_long(n), ctypes.c_double(work.h), rows)
        return out[:count]

    return run


def _make_jax_replay(work: Work) -> Replay:
    """jax: one cell as a scan over the cycles, compiled, vmap over the cells."""
    import jax

    jax.config.update("jax_enable_x64", True)
    numbers = jax.numpy

    def measure_cell(cell: Any, current: Any, position: Any) -> Any:
        def cycle(s: Any, inputs: Any) -> Any:
            xs, xj, v, sliding = s
            anchored_xj = xj + ANCHOR * work.h * (inputs[1] - xj)
            return step_monitor(numbers, (xs, anchored_xj, v, sliding), inputs[0], work.h, cell), xj

        zero = numbers.zeros(())
        xj = jax.lax.scan(cycle, (zero, position[0], zero, zero), (current, position))[1]
        return numbers.sqrt(numbers.mean((xj - position) ** 2))

    measure_cells = jax.jit(jax.vmap(measure_cell, (0, None, None)))
    cell_columns, acting = Cell(*work.cells()), np.r_[0.0, work.current[:-1]]
    return lambda: np.asarray(measure_cells(cell_columns, acting, work.position))


def _measure_progpy(work: Work, race: Race, cycles: int = 12) -> Rival:
    """NASA ProgPy, vectorised over the cells, on `cycles` cycles alone: it is slower by orders of magnitude."""
    name = "ProgPy, vectorised"
    if reason := explain_missing("progpy"):
        return skip_rival(name, reason)
    plant, acting = _define_progpy_plant(work), np.r_[0.0, work.current[:-1]]

    def inputs(t: float, x: Any = None) -> Any:
        row = max(int(t / work.h - 0.5), 0)  # ProgPy asks for the end of the cycle, the monitor takes the start
        return plant.InputContainer({"current": acting[row], "measured": work.position[row]})

    times = [(row - 0.5) * work.h for row in range(1, cycles + 1)]  # half a cycle early: it saves the next state
    run = partial(plant.simulate_to, times[-1], inputs, dt=work.h, save_pts=times)
    rows = np.array([np.ravel(row["xj"]) for row in run().outputs])
    monitor = Monitor(work.model, sliding=SLIDING)
    own = monitor.replay(work.values, work.current[:cycles], work.position[:cycles], ANCHOR)[:, 0]
    difference = _compare_maps(_measure_rms(rows[:cycles].T, work), _measure_rms(own, work))
    speed = len(work.values) * cycles / measure_median_duration(run, 3)
    return Rival(name, speed, race.speed / speed, difference, f"measured on {cycles} cycles")


def _define_progpy_plant(work: Work) -> Any:
    """The monitor without its controller."""
    cell = Cell(*work.cells())
    start = {name: np.zeros(len(work.values)) for name in ("xs", "xj", "v", "sliding")}
    start["xj"] += work.position[0]

    def advance(x: Any, u: Any) -> Any:
        anchored_xj = x["xj"] + ANCHOR * work.h * (u["measured"] - x["xj"])
        return step_monitor(np, (x["xs"], anchored_xj, x["v"], x["sliding"]), u["current"], work.h, cell)

    return make_progpy_plant(start, ("current", "measured"), ("xj",), advance)


def step_monitor(xp: Any, s: Any, current: Any, h: float, c: Any) -> tuple[Any, ...]:
    """`plant.monitor.step_monitor` on arrays of the library `xp`: XS, XJ, XJ', which way the spool slides."""
    xs, xj, v0, sliding = s
    tilt = c.tilt * current - c.back * xs
    net_tilt = tilt - clip(xp, tilt, c.slide)
    net_tilt = xp.where((net_tilt * sliding > 0.0) | (xp.abs(tilt) > c.dead), net_tilt, 0.0)
    begin = clip(xp, net_tilt, c.most)
    wait = xp.minimum(xp.abs(net_tilt - begin) * c.wait, h)
    end = begin * xp.exp(c.rate * (wait - h))
    line, curve, time_left = c.speed * begin * wait, (begin - end) * c.unback, h - wait
    spool = clip(xp, xs + line + curve, c.spool_travel)
    area = line * (0.5 * wait + time_left) + (begin * time_left - (begin - end) * c.unrate) * c.unback
    total = clip(xp, h * xs + area, h * c.spool_travel)
    before = xs - c.lag * c.speed * begin
    free = c.follow * (spool - c.lag * c.speed * end) + (v0 - c.follow * before) * c.fade
    v = xp.minimum(xp.maximum(free, c.coast * v0 - c.push), c.coast * v0 + c.push)
    x = xj + xp.where(v == free, c.follow * total - c.lag * (v - v0), 0.5 * h * (v0 + v))
    return spool, clip(xp, x, c.jack_travel), xp.where(xp.abs(x) <= c.jack_travel, v, 0.0), xp.sign(net_tilt)
