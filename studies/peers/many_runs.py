"""Many runs at once, beside C, jax and ProgPy: the same runs of the same equations, in one process."""

import ctypes
import tempfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.progress import Progress, ignore_progress
from plant import Lanes, Model, simulate
from plant.eha import compute_coefficients
from plant.lanes import STEPS
from rig.bench.benchmarks import FLAGS, SAME_ROUNDING, build_library, measure_median_duration
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


class Task(NamedTuple):
    """Runs of the bare model: `values` (m, len(names)) of the parameters `names`, over `current` and `load` (n,)."""

    model: Model
    names: tuple[str, ...]
    values: Array
    current: Array
    load: Array
    steps: int

    @property
    def parameters(self) -> dict[str, dict[str, Array]]:
        """Group to field to the values of the runs, (m,)."""
        run_values = dict(zip(self.names, self.values.T, strict=True))
        groups: dict[str, dict[str, Array]] = {}
        for name, value in self.model.values.items():
            group, _, field = name.partition(".")
            groups.setdefault(group, {})[field] = run_values.get(name, np.full(len(self.values), value))
        return groups

    @property
    def h(self) -> float:
        """Length of a step, s."""
        return float(self.model["controller.period"]) / self.steps


def make_c_replay(task: Task, function: str, flags: tuple[str, ...], target: Path) -> Replay:
    """A function of lanes.c: "replay_each" or "replay_lanes"."""
    library = build_library("lanes.c", flags, target, "studies.peers")
    records = np.repeat(task.model.build_record(), len(task.values))
    numbers = records.view(np.float64).reshape(len(records), -1)
    for column, name in enumerate(task.names):
        numbers[:, task.model.list_names().index(name)] = task.values[:, column]
    n = len(task.current)
    out = np.empty((len(records), 3, n))
    pointers = [np.ctypeslib.as_ctypes(a.reshape(-1)) for a in (numbers, task.current, task.load, out)]

    def run() -> Array:
        models, current, load, rows = pointers
        getattr(library, function)(models, len(records), current, load, ctypes.c_long(n), task.steps, rows)
        return out.transpose(0, 2, 1)

    return run


def make_jax_replay(task: Task) -> Replay:
    """jax: one run as two nested scans, compiled, vmap over the runs. Unrolling the steps is slower."""
    import jax

    jax.config.update("jax_enable_x64", True)
    h, numbers = task.h, jax.numpy

    def replay_run(parameters: Any, k: Any, current: Any, load: Any) -> Any:
        p = _make_namespaces(parameters)

        def cycle(s: Any, inputs: Any) -> Any:
            def forward(s: Any, _: None) -> tuple[Any, None]:
                return step_bare_model(numbers, s, inputs[0], inputs[1], p, k, h), None

            after, _ = jax.lax.scan(forward, s, None, task.steps)
            return after, numbers.stack([s[4], s[6], s[2]])

        return jax.lax.scan(cycle, (numbers.zeros(()),) * 7, (current, load))[1]

    replay_runs = jax.jit(jax.vmap(replay_run, (0, 0, None, None)))
    acting, k = np.r_[0.0, task.current[:-1]], _stack_coefficients(task)
    return lambda: np.asarray(replay_runs(task.parameters, k, acting, task.load))


def make_progpy_replay(task: Task) -> Replay:
    """NASA ProgPy: the step as a ProgPy model, vectorised over the runs, simulated by `simulate_to`."""
    period = float(task.model["controller.period"])
    plant, acting = _define_progpy_plant(task), np.r_[0.0, task.current[:-1]]

    def inputs(t: float, x: Any = None) -> Any:
        row = min(int(t / period), len(acting) - 1)
        return plant.InputContainer({"current": acting[row], "load": task.load[row]})

    # half a step early: ProgPy adds its steps up, and saves the first state past a time
    times = [(row - 0.5 / task.steps) * period for row in range(1, len(acting))]

    def run() -> Array:
        rows = plant.simulate_to(times[-1], inputs, dt=task.h, save_pts=times).outputs
        columns = [[np.ravel(rows[k][name]) for k in range(len(acting))] for name in plant.outputs]
        return np.array(columns).transpose(2, 1, 0)

    return run


def _define_progpy_plant(task: Task) -> Any:
    """The reference model without its controller."""
    p, k, h = _make_namespaces(task.parameters), _stack_coefficients(task), task.h
    start = {name: np.zeros(len(task.values)) for name in ("xf", "vf", "xs", "vs", "xj", "vj", "p12")}

    def advance(x: Any, u: Any) -> Any:
        return step_bare_model(np, [x[name] for name in start], u["current"], u["load"], p, k, h)

    return make_progpy_plant(start, ("current", "load"), ("xj", "p12", "xs"), advance)


def _stack_coefficients(task: Task) -> Any:
    """The coefficients of the step, (m,) each: `plant.eha` computes those of one run, and chooses by numbers."""
    runs = [compute_coefficients(_make_namespaces({group: {field: values[run] for field, values in fields.items()}
                                                   for group, fields in task.parameters.items()}), task.h)
            for run in range(len(task.values))]
    return type(runs[0])(*np.array(runs).T)


def _make_namespaces(groups: Mapping[str, Mapping[str, Any]]) -> Any:
    """The groups as objects with attributes, as `plant.eha` reads its parameters."""
    return SimpleNamespace(**{group: SimpleNamespace(**fields) for group, fields in groups.items()})


def step_bare_model(xp: Any, s: Any, current: Any, load: Any, p: Any, k: Any, h: float) -> tuple[Any, ...]:
    """`plant.eha.step_actuator` of the bare model on arrays of the library `xp`: XF, XF', XS, XS', XJ, XJ', P12."""
    xf, vf, xs, vs, xj, vj, _ = s
    torque = p.torque_motor.gain * current - p.flapper.stiffness * xf - p.feedback_spring.stiffness * (
        xs + 0.5 * h * vs)
    xf, vf = _travel(xp, xf, vf, k.flapper_keep * vf + k.flapper_push * torque, h, p.flapper.travel)
    dry = h * xp.where(vs == 0.0, p.spool.static_friction, p.spool.dynamic_friction)
    v = _slide(xp, vs, p.spool.mass * vs, k.spool_push, k.pilot_gain * xf, k.pilot_slope, k.pilot_limit, dry,
               k.spool_free, k.spool_coupled)
    xs, vs = _travel(xp, xs, vs, v, h, p.spool.travel)
    line = k.valve_gain * xs
    dry = h * xp.where(vj == 0.0, p.jack.static_friction, p.jack.dynamic_friction)
    v = _slide(xp, vj, p.jack.mass * vj - h * load, h * p.jack.area, line, k.valve_slope, k.valve_limit, dry,
               k.jack_free, k.jack_coupled)
    xj, vj = _travel(xp, xj, vj, v, h, p.jack.travel)
    return xf, vf, xs, vs, xj, vj, clip(xp, line - k.valve_slope * vj, k.valve_limit)


def _soften(xp: Any, x: Any, band: Any) -> Any:
    return x - clip(xp, x, band)


def _slide(xp: Any, v0: Any, impulse: Any, push: Any, line: Any, slope: Any, limit: Any, dry: Any, free: Any,
           coupled: Any) -> Any:
    v = _soften(xp, coupled * impulse + coupled * push * line, coupled * dry)
    linear_pressure = line - slope * v
    pressure = clip(xp, linear_pressure, limit)
    v = xp.where(pressure == linear_pressure, v, _soften(xp, impulse + push * pressure, dry) * free)
    return xp.minimum(xp.maximum(v, xp.where(v0 > 0.0, 0.0, -xp.inf)), xp.where(v0 < 0.0, 0.0, xp.inf))


def _travel(xp: Any, x0: Any, v0: Any, v: Any, h: float, limit: Any) -> tuple[Any, Any]:
    x = (x0 + 0.5 * h * v0) + 0.5 * h * v
    return clip(xp, x, limit), xp.where(xp.abs(x) <= limit, v, 0.0)


OURS = "ours, one thread"
NAMES = ("spool.static_friction", "jack.damping")


def compare_many_runs(command: Array, progress: Progress = ignore_progress, rounds: int = 7, runs: int = 64,
                      cycles: int = 5000) -> list[Rival]:
    """Runs of the bare model with different friction and drag, from the current of a run over `command` (n,) m."""
    task = _make_task(command, runs, cycles)
    with tempfile.TemporaryDirectory() as folder:
        progress("many runs at once: compiling the rivals", 0.0)
        replays, skipped_rivals = make_replays(_list_makers(task, Path(folder)))
        progress("many runs at once", 0.0)
        race = race_rivals(replays, OURS, runs * cycles * task.steps, rounds, _compare_positions)
    progress("many runs at once: ProgPy", 0.0)
    return [*race.rivals, *skipped_rivals, _measure_progpy(task, race)]


def _make_task(command: Array, runs: int, cycles: int, first: int = 500) -> Task:
    """Runs that begin at cycle `first`, where the first step of the preflight begins."""
    model = Model()
    current = simulate(model, command).cor[first:first + cycles].copy()
    spread = np.random.default_rng(0).uniform([5.0, 1.0], [50.0, 2.0], (runs, 2))
    return Task(model, NAMES, spread * [1.0, model[NAMES[1]]], current, np.zeros(cycles), STEPS)


def _list_makers(task: Task, folder: Path) -> dict[str, Maker]:
    """What makes each rival, by name."""
    in_c = {"C, one run after the other": ("replay_each", FLAGS), "C, 16 runs side by side": ("replay_lanes", FLAGS),
            "C, 64 runs side by side": ("replay_lanes", (*FLAGS, "-DWIDTH=64")),
            "C, 16 runs, -ffp-contract=off": ("replay_lanes", SAME_ROUNDING)}
    return {OURS: ("", partial(_make_own_replay, task, 1)),
            "ours, a thread a core": ("", partial(_make_own_replay, task, None)),
            **{name: (explain_missing_gcc(), partial(make_c_replay, task, function, flags, folder / f"{number}.so"))
               for number, (name, (function, flags)) in enumerate(in_c.items())},
            "jax, vmap": (explain_missing("jax"), partial(make_jax_replay, task))}


def _make_own_replay(task: Task, workers: int | None) -> Replay:
    lanes = Lanes(task.model, task.names, task.steps, workers)
    return lambda: lanes.replay(task.values, task.current, task.load)


def _compare_positions(rows: Array, reference: Array) -> float:
    return float(np.abs(rows - reference)[..., 0].max())


def _measure_progpy(task: Task, race: Race, cycles: int = 5) -> Rival:
    """ProgPy on the first `cycles` cycles alone, because it is slower by orders of magnitude."""
    name = "ProgPy, vectorised"
    if reason := explain_missing("progpy"):
        return skip_rival(name, reason)
    replay = make_progpy_replay(task._replace(current=task.current[:cycles], load=task.load[:cycles]))
    rows, seconds = replay(), measure_median_duration(replay, 3)
    speed = len(task.values) * (cycles - 1) * task.steps / seconds  # the last row is a state, not a cycle
    return Rival(name, speed, race.speed / speed, _compare_positions(rows, race.reference[:, :cycles]),
                 f"measured on {cycles - 1} cycles")
