"""The model run on what was measured: from the current (the plant alone) and from the command alone (the whole loop).

A replay from the current keeps the phase of stick-slip and leaves the controller out of the question. Its position
adds up every bias for ever, so the ram is pulled to the measured position at ANCHOR_RATE; the drift without it is
reported as a speed. The solver is checked first: with steps half as long the replay must not move; and where a ram that
stops or goes on hangs on a thousandth of its friction, neither model nor solver can say which, so such windows are not
judged.

Could the residual be nothing but scatter from one unit to the next? `fit_scatter` takes two Gauss-Newton steps from the
model, each parameter tied to its value by its own tolerance, and judges by a replay and not by the linear forecast.
`rig explain` does the same with every effect beside it.
"""
from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.estimation.fit import Fit
from fdi.estimation.likelihood import Problem, limit_dynamic_friction
from fdi.estimation.long_recordings import choose_excerpt, cut_excerpt, is_long, replay_in_turns
from fdi.estimation.noise import WINDOW
from fdi.estimation.unknowns import WITHOUT_NOISE, list_tolerance_sizes
from fdi.thresholds import (
    ANCHOR_RATE,
    FRICTION_UNCERTAINTY,
    RESIDUAL_IS_SCATTER,
    SCATTER_LARGE_RESIDUAL,
    SCATTER_TOLERANCES,
    SOLVER_ERROR_SHARE,
    UNDECIDED_SMALLEST,
)
from fdi.trace.signals import OUTPUTS
from fdi.trace.trace import Trace, bridge_gaps, rms
from plant.lanes import Lanes
from plant.model import Model

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Columns = dict[str, Floats]  # by signal, (n,)

REPLAY_STEPS, FINEST_REPLAY_STEPS = 50, 800  # a cycle
FRICTIONS = ("jack.static_friction", "jack.dynamic_friction", "spool.static_friction", "spool.dynamic_friction")
SCATTER_DIFFERENCE = 0.3  # tolerances, of the differences that the Jacobian is made of
ALIKE = 20  # neighbouring samples that say the same thing


class Replay(NamedTuple):
    """A model's replay of one trace; columns (n,) by signal."""

    model: Columns  # XJ anchored, P12, XS
    residual: Columns  # measured less model, NaN where not measured
    steps: int  # a cycle
    solver_error: Mapping[str, float]  # RMS, by halving the step
    undecided: Flags  # rows that hang on a knife's edge
    blind: Mapping[str, float]  # RMS, elsewhere, by which the current that was not recorded may move a replay


def replay_lanes(lanes: Lanes, values: Floats, trace: Trace, current: Floats | None = None,
                 anchor: float = ANCHOR_RATE) -> Floats:
    """XJ, P12 and XS, (m, n, 3), of the plant driven by a current (default: the measured one), for each row of values.

    They are what the sensors of the trace show of the plant.

    The replay starts at the first measured position, or in the middle where that is not known.
    """
    position = trace.unlagged_position if has_known_start(trace) else None
    driven = trace.cor if current is None else current
    out = lanes.replay(values, driven, trace.load, position, anchor, trace.parts, trace.chambers)
    return trace.pass_sensors(out)


def replay_current(trace: Trace, model: Model, steps: int = REPLAY_STEPS, anchor: float = ANCHOR_RATE) -> Columns:
    """XJ, P12 and XS, (n,) each, of the plant driven by the measured current, without noise."""
    lanes = Lanes(model.replace(WITHOUT_NOISE), (), steps)
    out = replay_lanes(lanes, np.empty((1, 0)), trace, anchor=anchor)
    return {name: out[0, :, i] for i, name in enumerate(OUTPUTS)}


def measure_misfit(trace: Trace, model: Model) -> float:
    """How badly a replay fits the outputs of a prepared trace: the mean logarithm of their RMS residuals."""
    left = compute_residuals(trace, replay_current(trace, model, 20))
    return sum(math.log(rms(r)) for r in left.values()) / len(left)


def has_known_start(trace: Trace) -> bool:
    """Whether the first position is known; else the replay starts in the middle."""
    return not np.isnan(trace.xj[0])


def replay_with_checked_steps(trace: Trace, model: Model, floor: Mapping[str, float]) -> Replay:
    """The replay from the current, with the step that the floor of each signal (SI units) asks for."""
    coarse, undecided, blind = _replay_with_other_frictions(trace, model, floor)
    checked = trace
    if is_long(trace):
        checked = cut_excerpt(trace, choose_excerpt(trace, model.replace(WITHOUT_NOISE), floor))
    steps, error = _choose_steps(checked, model, floor, undecided if checked is trace else ~checked.usable)
    if checked is trace or steps > 2 * REPLAY_STEPS:  # else the replay that is there will do
        coarse = replay_current(trace, model, steps)
    else:
        steps = REPLAY_STEPS
    return Replay(coarse, compute_residuals(trace, coarse), steps, error, undecided, blind)


def _replay_with_other_frictions(trace: Trace, model: Model, floor: Mapping[str, float]
                                 ) -> tuple[Columns, Flags, dict[str, float]]:
    """The replay, the rows that hang on a knife's edge, and by how much a guessed current moves it elsewhere, RMS."""
    values = vary_frictions(model)
    lanes = Lanes(model.replace(WITHOUT_NOISE), list_frictions(model), REPLAY_STEPS)
    position = trace.unlagged_position if has_known_start(trace) else None
    turns = [replay_in_turns(lanes, values, trace, position, ANCHOR_RATE)]
    turns += [replay_in_turns(lanes, values[:1], replace(trace, cor=current), position, ANCHOR_RATE)
              for current in guess_current(trace)]
    found = np.empty((len(OUTPUTS), len(trace)))
    undecided = np.zeros(len(trace), bool)
    power, count = np.zeros(len(OUTPUTS)), 0
    for (first, own), *others in zip(*turns, strict=True):
        runs = np.concatenate([own, *(other for _, other in others)])
        rows = slice(first, first + runs.shape[1])
        found[:, rows] = runs[0].T
        for i, name in enumerate(OUTPUTS):
            if name in floor:
                moved = np.abs(runs[1:, :, i] - runs[:1, :, i])
                large = find_large_windows(moved, max(floor[name], UNDECIDED_SMALLEST[name]))
                undecided[rows] |= large & ~np.isnan(trace.mask_unusable(name)[rows])
        guessed = (runs[len(values):] - runs[:1])[:, ~undecided[rows]]
        power, count = power + (guessed**2).sum(axis=(0, 1)), count + guessed.shape[0] * guessed.shape[1]
    blind = {name: math.sqrt(float(power[i]) / count) if count else 0.0 for i, name in enumerate(OUTPUTS)}
    return {name: found[i] for i, name in enumerate(OUTPUTS)}, undecided, blind


def _choose_steps(trace: Trace, model: Model, floor: Mapping[str, float], undecided: Flags
                  ) -> tuple[int, dict[str, float]]:
    """The steps a cycle that the floors ask for, and what half as many change, RMS."""
    coarse, steps = replay_current(trace, model), REPLAY_STEPS
    judged = ~undecided
    while True:
        fine, steps = replay_current(trace, model, 2 * steps), 2 * steps
        error = {name: rms((fine[name] - coarse[name])[judged]) for name in OUTPUTS if name in floor}
        if all(error[name] <= SOLVER_ERROR_SHARE * floor[name] for name in error) or steps >= FINEST_REPLAY_STEPS:
            return steps, error
        coarse = fine


def guess_current(trace: Trace) -> list[Floats]:
    """The current with what its filled rows may have been instead; none if every row was recorded.

    The fill misses a row by as much as it would miss every other recorded row around: that error, with random signs.
    """
    if not trace.filled.any():
        return []
    there = np.flatnonzero(~trace.filled)
    odd = there[1::2]
    thinned = trace.cor.copy()
    thinned[trace.filled], thinned[odd] = np.nan, np.nan
    again, lost = bridge_gaps(thinned, len(trace))
    error = np.where(lost, 0.0, trace.cor - again)
    near = odd[np.clip(np.searchsorted(odd, np.arange(len(trace))), 0, len(odd) - 1)]
    signs = np.random.default_rng(0).choice([-1.0, 1.0], len(trace))
    return [trace.cor + np.where(trace.filled, sign * signs * error[near], 0.0) for sign in (1.0, -1.0)]


def compute_residuals(trace: Trace, model: Columns) -> Columns:
    """Measured less model, of the chosen signals."""
    return {name: trace.mask_unusable(name) - model[name] for name in trace.outputs}


def list_frictions(model: Model) -> tuple[str, ...]:
    """The friction levels that the model's plant has."""
    return tuple(name for name in FRICTIONS if name in model.values)


def vary_frictions(model: Model) -> Floats:
    """(m, frictions) values: the model's, and each level a little higher and lower; dynamic stays below static."""
    names = list_frictions(model)
    base = np.array([model[name] for name in names])
    shifts = FRICTION_UNCERTAINTY * np.eye(len(names))
    values = np.concatenate([base[None], base * (1 + shifts), base * (1 - shifts)])
    return limit_dynamic_friction(names, values)


def find_large_windows(moved: Floats, floor: float, window: int = WINDOW) -> Flags:
    """Rows of windows in which one of the runs (m, n) is moved by more than the floor, RMS."""
    n = moved.shape[1]
    starts = np.arange(0, n, window)
    sizes = np.diff(np.append(starts, n))
    power = np.add.reduceat(moved**2, starts, axis=1).max(axis=0) / sizes
    out: Flags = np.repeat(power > floor**2, sizes)
    return out


def find_undecided_rows(problem: Problem, fit: Fit, floor: Mapping[str, float]) -> Flags:
    """Rows of the problem's run, (n,), in windows that a friction level off by `FRICTION_UNCERTAINTY` changes.

    On soft oil a slow ramp is a chain of slips, and the time of each follows from the one before. A replay at the true
    values drifts out of phase within a second, however fine its steps are, and is then wrong by the height of the
    slips.

    Args:
        problem: with the run and its solver steps.
        fit: the values to replay.
        floor: of each signal, SI; smaller changes do not count.
    """
    frictions = list_frictions(problem.model)
    names = [f.name for f in fit.free]
    names += [name for name in frictions if name not in names]
    values = {**problem.model.values, **fit.values}
    base = np.array([values[name] for name in names])
    moved = [base.copy() for _ in range(2 * len(frictions))]
    for k, name in enumerate(frictions):
        at = names.index(name)
        moved[2 * k][at] *= 1.0 + FRICTION_UNCERTAINTY
        moved[2 * k + 1][at] *= 1.0 - FRICTION_UNCERTAINTY
    runs = problem.predict_outputs(names, limit_dynamic_friction(names, np.array([base, *moved])))
    changes = np.abs(runs[1:] - runs[0])
    undecided = np.zeros(runs.shape[2], bool)
    for i, signal in enumerate(problem.trace.outputs):
        large = find_large_windows(changes[:, i], max(floor[signal], UNDECIDED_SMALLEST[signal]))
        undecided |= large & ~np.isnan(problem.trace.measurements[i])
    return undecided


def measure_drift(trace: Trace, model: Model, steps: int = REPLAY_STEPS) -> tuple[float, float]:
    """Of a replay without anchor: RMS of the residual of XJ, m, and the speed at which it departs, m/s."""
    free = trace.mask_unusable("xj") - replay_current(trace, model, steps, 0.0)["xj"]
    there = ~np.isnan(free)
    t = trace.t[there] - trace.t[there].mean()
    return rms(free), float(np.sum(t * free[there]) / np.sum(t**2))


def replay_command(trace: Trace, model: Model, steps: int = REPLAY_STEPS) -> Columns:
    """Residuals, measured less model, of the chosen signals and `cor` in a run from the command alone, no noise."""
    rest_time = 1.0  # s at the first demand, before a closed-loop replay begins
    before = round(rest_time / trace.period)
    com = np.concatenate([np.full(before, trace.com[0]), trace.com])
    load = np.concatenate([np.full(before, trace.load[0]), trace.load])
    lanes = Lanes(model.replace(WITHOUT_NOISE), (), steps)
    out = lanes.closed_loop(np.empty((1, 0)), com, load)[0]
    shown = trace.pass_sensors(out[:, [0, 2, 3]])[before:]
    whole = {"cor": out[before:, 1]} | {name: shown[:, i] for i, name in enumerate(OUTPUTS)}
    left = {name: trace.mask_unusable(name) - whole[name] for name in trace.outputs}
    return left | {"cor": trace.mask_unusable("cor") - whole["cor"]}


def differentiate(x: Floats, size: int, order: int) -> Floats:
    """First or second derivative of x (n,) per sample, of the parabola through `size` samples (Savitzky and Golay)."""
    k = np.arange(size) - size // 2
    weights = np.linalg.pinv(np.vander(k.astype(float), 3, increasing=True))[order] * order
    out: Floats = np.correlate(np.pad(x, size // 2, "edge"), weights, "valid")
    return out


class Scatter(NamedTuple):
    """What a refit within the tolerances makes of the error."""

    error: dict[str, float]  # by signal, SI unit
    ratio: dict[str, float]  # over the floor
    moved: dict[str, float]  # parameter "group.field" to its change in tolerances
    enough: bool  # within reach of the floor


def fit_scatter(trace: Trace, model: Model, floor: Mapping[str, float]) -> Scatter:
    """Refit the tolerances to a trace; `floor` of each chosen signal in its SI unit."""
    known = list_tolerance_sizes(model)
    base = np.array([model[name] for name in known])
    size = np.array(list(known.values()))
    scatter_steps = 20  # a cycle; coarse, because only the size of the residual matters here
    lanes = Lanes(model.replace(WITHOUT_NOISE), list(known), scatter_steps)
    scale = np.array([floor[name] for name in trace.outputs])[:, None]

    def compute_scaled_residuals(x: Floats) -> Floats:
        """Residuals (m, signals * n) in floors, for changes x (m, parameters) in tolerances."""
        values = limit_dynamic_friction(list(known), base + x * size)
        out = replay_lanes(lanes, values, trace).transpose(0, 2, 1)[:, trace.output_columns]
        left: Floats = np.nan_to_num((trace.measurements - out) / scale)
        return left.reshape(len(x), -1)

    whole = trace
    if is_long(whole):
        trace = cut_excerpt(whole, choose_excerpt(whole, model.replace(WITHOUT_NOISE), floor))
    x = np.zeros(len(base))
    now = compute_scaled_residuals(x[None])[0]
    for _ in range(2):
        slope = (compute_scaled_residuals(x + SCATTER_DIFFERENCE * np.eye(len(base))) - now) / SCATTER_DIFFERENCE
        weight = 1.0 / np.sqrt(1.0 + (now / SCATTER_LARGE_RESIDUAL) ** 2)
        normal = np.einsum("ik,jk,k->ij", slope, slope, weight, optimize=False) / ALIKE + np.eye(len(base))
        step = np.linalg.solve(normal, -np.einsum("ik,k->i", slope, weight * now) / ALIKE - x)
        tried = np.clip(x + np.array([1.0, 0.5, 0.2])[:, None] * step, -SCATTER_TOLERANCES, SCATTER_TOLERANCES)
        found = compute_scaled_residuals(tried)
        large = SCATTER_LARGE_RESIDUAL
        costs = 2 * large**2 * (np.sqrt(1 + (found / large) ** 2) - 1).sum(axis=1) / ALIKE
        best = int(np.argmin(costs + (tried**2).sum(axis=1)))
        x, now = tried[best], found[best]
    if whole is not trace:
        trace, now = whole, _replay_scaled(lanes, limit_dynamic_friction(list(known), base + x * size), whole, scale)
    rows = now.reshape(len(scale), -1)
    ratio = {name: rms(np.where(np.isnan(y), np.nan, r))
             for name, r, y in zip(trace.outputs, rows, trace.measurements, strict=True)}
    error = {name: ratio[name] * floor[name] for name in ratio}
    moved = dict(sorted(zip(known, x.tolist(), strict=True), key=lambda item: -abs(item[1])))
    return Scatter(error, ratio, moved, max(ratio.values()) < RESIDUAL_IS_SCATTER)


def _replay_scaled(lanes: Lanes, values: Floats, trace: Trace, scale: Floats) -> Floats:
    """Residuals (signals, n) of one run in floors."""
    out = replay_lanes(lanes, values[None], trace)[0].T[trace.output_columns]
    left: Floats = np.nan_to_num((trace.measurements - out) / scale)
    return left
