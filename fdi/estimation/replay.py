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

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from fdi.estimation.fit import (
    Fit,
    Problem,
    compute_typical_rms,
    limit_dynamic_friction,
    list_tolerance_sizes,
    silence_sensors,
)
from fdi.estimation.long_recordings import choose_excerpt, cut_excerpt, is_long, replay_in_turns
from fdi.estimation.noise import WINDOW, Floor, find_sensor_level, sensor_floors
from fdi.thresholds import (
    ANCHOR_RATE,
    FINEST_COMB,
    FRICTION_UNCERTAINTY,
    HELD_OUT_UNDECIDED_SHARE,
    RESIDUAL_HELD_OUT,
    RESIDUAL_IS_NOISE,
    RESIDUAL_IS_SCATTER,
    SAME_COMMAND_POSITION,
    SCATTER_LARGE_RESIDUAL,
    SCATTER_TOLERANCES,
    SOLVER_ERROR_SHARE,
)
from fdi.trace import Flags, Floats, Trace, bridge_gaps, fill_gaps, find_comb, hold_last, hold_next, rms
from plant import EHA, MODULES, InputError, Lanes, Model, compute_answers, find_divergence, require, rest_controller

Columns = dict[str, Floats]  # by signal, (n,)

REPLAY_STEPS, FINEST_REPLAY_STEPS = 50, 800  # a cycle
SCATTER_DIFFERENCE = 0.3  # tolerances, of the differences that the Jacobian is made of
MEMORY = 4.0 / ANCHOR_RATE  # s, until an anchored replay is back on the recording
NEAR_NOISE = 2.0  # floors, in the better half of a run: else physics is missing, and no stop matters
START_ROWS = 50  # in which the controller's answers tell what it remembered before
ALIKE = 20  # neighbouring samples that say the same thing


class Replay(NamedTuple):
    """A model's replay of one trace; columns (n,) by signal."""

    model: Columns  # the plant's outputs, the controlled one anchored
    residual: Columns  # measured less model, NaN where not measured
    steps: int  # a cycle
    solver_error: Mapping[str, float]  # RMS, by halving the step
    undecided: Flags  # rows that hang on a knife's edge
    blind: Mapping[str, float]  # RMS, elsewhere, by which the drive that was not recorded may move a replay


def replay_lanes(lanes: Lanes, values: Floats, trace: Trace, anchor: float = ANCHOR_RATE) -> Floats:
    """The outputs, (m, n, outputs), of the plant driven by the measured current, for each of values.

    They are what the sensors of the trace show of the plant. The replay starts at the first measured position.
    """
    out = lanes.replay(values, trace.drive, trace.load, trace.anchor, anchor, trace.parts, trace.chambers, trace.slack)
    return trace.pass_sensors(out)


def replay_current(trace: Trace, model: Model, steps: int = REPLAY_STEPS, anchor: float = ANCHOR_RATE) -> Columns:
    """The outputs, (n,) each, of the plant driven by the measured current, without noise."""
    out = replay_lanes(Lanes(silence_sensors(model), (), steps), np.empty((1, 0)), trace, anchor=anchor)[0]
    return dict(zip(trace.output_names, out.T, strict=True))


def require_finite_replay(trace: Trace, model: Model) -> None:
    """Refuse a model that diverges with the measured current of a prepared trace: what is no number is no error either.

    Raises:
        InputError: such a model.
    """
    diverged = find_divergence(model, replay_current(trace, model, max(REPLAY_STEPS, model.steps)))
    require(not diverged, model.name, "",
            f"a plant that stays finite; with the measured {trace.declared.drive.name}, {diverged}")


def measure_misfit(trace: Trace, model: Model) -> float:
    """How badly a replay fits the outputs of a prepared trace: the mean logarithm of their RMS residuals."""
    residuals = compute_residuals(trace, replay_current(trace, model, 20))
    return sum(math.log(rms(r)) for r in residuals.values()) / len(residuals)


def replay_with_checked_steps(trace: Trace, model: Model, floor: Mapping[str, float]) -> Replay:
    """The replay from the current, with the step that the floor of each signal (SI units) asks for."""
    coarse, undecided, blind = _replay_with_other_frictions(trace, model, floor)
    part = trace
    if is_long(trace):
        part = cut_excerpt(trace, choose_excerpt(trace, silence_sensors(model), floor))
    steps, error = _choose_steps(part, model, floor, undecided if part is trace else ~part.usable)
    if steps > (REPLAY_STEPS if part is trace else 2 * REPLAY_STEPS):  # else the replay that is there will do
        coarse = replay_current(trace, model, steps)
    else:
        steps = REPLAY_STEPS
    residuals = compute_residuals(trace, coarse)
    if model.kind.correct is not None:
        undecided = extend_until_noise(undecided, np.array([residuals[s] / floor[s] for s in residuals if s in floor]))
    return Replay(coarse, residuals, steps, error, undecided, blind)


def _replay_with_other_frictions(trace: Trace, model: Model, floor: Mapping[str, float]
                                 ) -> tuple[Columns, Flags, dict[str, float]]:
    """The replay, the rows that hang on a knife's edge, and by how much a guessed current moves it elsewhere, RMS."""
    names = list(filter(is_friction, model.values))
    if not names and model.kind.foreign is None:
        names = list(list_tolerance_sizes(model))
    values = vary_frictions(names, model.values)
    lanes = Lanes(silence_sensors(model), names, REPLAY_STEPS)
    turns = [replay_in_turns(lanes, values, trace)]
    currents = guess_current(trace)
    turns += [replay_in_turns(lanes, values[:1], trace.with_inputs(drive=current)) for current in currents]
    turns += [replay_in_turns(lanes, values[:1], trace, position=trace.anchor + shift)
              for noise in guess_anchor_noise(trace, model, floor) for shift in (noise, -noise)]
    outputs = trace.declared.outputs
    columns = np.empty((len(outputs), len(trace)))
    undecided = np.zeros(len(trace), bool)
    power, count = np.zeros(len(outputs)), 0
    for (first, runs), *other_turns in zip(*turns, strict=True):
        rows = slice(first, first + runs.shape[1])
        columns[:, rows] = runs[0].T
        input_changes = [other - runs[:1] for _, other in other_turns]
        changes = np.concatenate([compare_neighbours(names, runs), *input_changes])
        for i, signal in enumerate(outputs):
            if signal.name in floor:
                change_power = measure_window_power(changes[:, :, i]).max(axis=0, initial=0.0)
                undecided[rows] |= ((change_power > max(floor[signal.name], signal.slight) ** 2)
                                    & ~np.isnan(trace.mask_unusable(signal.name)[rows]))
        current_changes = np.concatenate([runs[:0], *input_changes[:len(currents)]])[:, ~undecided[rows]]
        power, count = (power + (current_changes**2).sum(axis=(0, 1)),
                        count + current_changes.shape[0] * current_changes.shape[1])
    blind = {name: math.sqrt(float(power[i]) / count) if count else 0.0 for i, name in enumerate(trace.output_names)}
    return {name: columns[i] for i, name in enumerate(trace.output_names)}, undecided, blind


def _choose_steps(trace: Trace, model: Model, floor: Mapping[str, float], undecided: Flags
                  ) -> tuple[int, dict[str, float]]:
    """The steps a cycle that the floors ask for, and what half as many change, RMS; NaN for an FMU, which has its own.
    """
    if model.kind.foreign is not None:
        return REPLAY_STEPS, dict.fromkeys(trace.output_names, math.nan)
    coarse, steps = replay_current(trace, model), REPLAY_STEPS
    while True:
        fine, steps = replay_current(trace, model, 2 * steps), 2 * steps
        error = {name: rms((fine[name] - coarse[name])[~undecided]) for name in trace.output_names if name in floor}
        if all(error[name] <= SOLVER_ERROR_SHARE * floor[name] for name in error) or steps >= FINEST_REPLAY_STEPS:
            return steps, error
        coarse = fine


def guess_current(trace: Trace) -> list[Floats]:
    """The current with what its filled rows may have been instead; none if every row was recorded.

    The fill misses a row by as much as it would miss every other recorded row around: that error, with random signs.
    """
    if not trace.filled.any():
        return []
    odd = np.flatnonzero(~trace.filled)[1::2]
    sparse_drive = trace.drive.copy()
    sparse_drive[trace.filled], sparse_drive[odd] = np.nan, np.nan
    fill, is_unknown = bridge_gaps(sparse_drive, len(trace))
    error = np.where(is_unknown, 0.0, trace.drive - fill)
    nearest = odd[np.clip(np.searchsorted(odd, np.arange(len(trace))), 0, len(odd) - 1)]
    signs = np.random.default_rng(0).choice([-1.0, 1.0], len(trace))
    return [trace.drive + np.where(trace.filled, sign * signs * error[nearest], 0.0) for sign in (1.0, -1.0)]


def guess_anchor_noise(trace: Trace, model: Model, floor: Mapping[str, float]) -> list[Floats]:
    """Noise, (n,), that the controlled signal may have had instead; none where it only moves the replay along.

    A plant with an observer of its own takes it for a speed, and so for a force. What hangs on that is undecided.
    """
    rounding = trace.slack / math.sqrt(3.0)  # RMS; within it the observer does nothing
    size = math.sqrt(max(floor.get(trace.declared.controlled.name, 0.0) ** 2 - rounding**2, 0.0))
    if model.kind.correct is None or not size:
        return []
    return [size * np.random.default_rng(0).standard_normal(len(trace))]


def compute_residuals(trace: Trace, model: Columns) -> Columns:
    """Measured less model, of the chosen signals."""
    return {name: trace.mask_unusable(name) - model[name] for name in trace.outputs}


def is_friction(name: str) -> bool:
    """Whether a parameter is a level of dry friction, by its name."""
    return name.endswith("friction")


def vary_frictions(names: Sequence[str], values: Mapping[str, float]) -> Floats:
    """Rows (1 + 2 m, p) of the named parameters: as they are, each of m friction levels higher, each of them lower.

    Where none is called a friction, as in a plant that calls it Coulomb's force, each of the parameters is varied.
    """
    base = np.array([values[name] for name in names])
    frictions = list(map(is_friction, names))
    shifts = FRICTION_UNCERTAINTY * np.eye(len(names))[frictions if any(frictions) else slice(None)]
    return limit_dynamic_friction(names, np.concatenate([base[None], base * (1 + shifts), base * (1 - shifts)]))


def compare_neighbours(names: Sequence[str], runs: Floats) -> Floats:
    """What a level of friction a little off changes, (m, ..), of runs (1 + 2 m, ..) at `vary_frictions`.

    What another parameter changes smoothly is nothing undecided: it is the same both ways, and taken out. A quarter of
    the rest is left, which no rounding of the readings makes as large as their noise.
    """
    base, higher, lower = np.split(runs, [1, 1 + len(runs) // 2])
    if any(map(is_friction, names)):
        return np.concatenate([higher, lower]) - base
    return 0.25 * (higher + lower - 2.0 * base)


def measure_window_power(x: Floats, window: int = WINDOW) -> Floats:
    """Mean square of each row's window in signals (m, n): (m, n)."""
    starts = np.arange(0, x.shape[1], window)
    sizes = np.diff(np.append(starts, x.shape[1]))
    return np.repeat(np.add.reduceat(x**2, starts, axis=1) / sizes, sizes, axis=1)


def find_undecided_rows(problem: Problem, fit: Fit, floor: Mapping[str, float]) -> Flags:
    """Rows of the problem's run, (n,), in windows that a friction level off by `FRICTION_UNCERTAINTY` changes.

    Where no parameter is called a friction, in windows that any parameter so far off does not change smoothly.

    On soft oil a slow ramp is a chain of slips, and the time of each follows from the one before. A replay at the true
    values drifts out of phase within a second, however fine its steps are, and is then wrong by the height of the
    slips.

    Args:
        problem: with the run and its solver steps.
        fit: the values to replay.
        floor: of each signal, SI; smaller changes do not count.
    """
    values = {**problem.model.values, **problem.list_values(fit.free, fit.x)}
    names = list(dict.fromkeys([*(f.name for f in fit.free), *filter(is_friction, values)]))
    variants = vary_frictions(names, values)
    runs = problem.predict_outputs(names, variants)
    changes = [compare_neighbours(names, runs)]
    name = problem.trace.declared.controlled.name
    for sign in (1.0, -1.0):
        noisy_traces = [run.with_columns({name: run.controlled + sign * noise})
                        for run in (problem.trace, *problem.also)
                        for noise in guess_anchor_noise(run, problem.model, floor)]
        if noisy_traces:
            noisy_problem = replace(problem, trace=noisy_traces[0], also=tuple(noisy_traces[1:]))
            changes.append(noisy_problem.predict_outputs(names, variants[:1]) - runs[:1])
    all_changes = np.concatenate(changes)
    power = measure_window_power(all_changes.reshape(-1, all_changes.shape[2])).reshape(all_changes.shape)
    least = np.array([[max(floor[s], problem.trace.declared.find(s).slight)] for s in problem.trace.outputs])
    is_large = power.max(axis=0, initial=0.0) > least**2
    return np.asarray((is_large & ~np.isnan(problem.trace.measurements)).any(axis=0))


def find_rest_rows(position: Floats, period: float, noise: float, window: float = 0.05,
                   memory: float = MEMORY) -> Flags:
    """Rows, (n,), in which the controlled signal rests, and those in which a replay still remembers that.

    Args:
        position: the signal, (n,) SI, NaN where it was not measured.
        period: s, of its rows.
        noise: RMS of its sensor, SI.
        window: s, the shortest rest; the reversal of a motion is none.
        memory: s, until an anchored replay is back on the recording.
    """
    rows = 2 * round(0.5 * window / period) + 1
    range_of_noise = 8.0  # RMS, hardly ever exceeded by so few samples of normal noise
    x = hold_next(hold_last(position))
    rests = (maximum_filter1d(x, rows) - minimum_filter1d(x, rows) <= range_of_noise * noise) & ~np.isnan(position)
    return extend_flags(maximum_filter1d(rests.astype(np.int8), rows) > 0, round(memory / period))


def leave_out_rest(trace: Trace, model: Model, memory: float = MEMORY) -> Trace:
    """A prepared run of a plant that is replayed by an observer, without the rows that hang on its stops.

    At rest dry friction has any value up to its static level: whether a replay stays or slips hangs on less than a
    sensor shows, and one that slips alone is off by many times the noise. Speed and friction of a motion are certain.
    Without an observer, or where fewer than `FEWEST_ROWS` would remain, the run is as it is: steps that are held for
    seconds rest most of the time. A note says how much is not compared. `memory`: as for `find_rest_rows`.
    """
    if model.kind.correct is None:
        return trace
    noise = find_sensor_level(trace, trace.declared.controlled, model)
    is_moving = trace.usable & ~find_rest_rows(trace.controlled, trace.period, noise, memory=memory)
    rest_time = float((trace.usable & ~is_moving).sum()) * trace.period
    if rest_time == 0.0 or is_moving.sum() < FEWEST_ROWS:
        return trace
    return trace.with_columns({}, usable=is_moving).with_notes(
        f"{rest_time:.1f} s at rest are not compared: friction has any value there")


def leave_out_rows(trace: Trace, rows: Flags) -> Trace:
    """A prepared run without some of its rows, (n,).

    As it is where there are none to leave out, or where more than `HELD_OUT_UNDECIDED_SHARE` would be.
    """
    usable = trace.usable & ~rows
    share = float(usable.sum() / trace.usable.sum())
    return trace if share == 1.0 or share < 1.0 - HELD_OUT_UNDECIDED_SHARE else trace.with_columns({}, usable=usable)


def find_unpredictable_rows(problem: Problem, fit: Fit, floor: Mapping[str, float]) -> Flags:
    """Rows of the first run, (n,), that hang on a stop, and those after them until only noise is left again.

    A replay that has missed a stop goes on beside the measurement, as its neighbours do, so these do not show it.
    None where more than `HELD_OUT_UNDECIDED_SHARE` of the run hangs on stops, or half of it is not near noise.
    """
    names, residuals = problem.trace.outputs, fit.residuals[:, :len(problem.trace)]
    levels = np.array([[floor[s]] for s in names])
    no_rows = np.zeros(residuals.shape[1], bool)
    if (compute_typical_rms(residuals[:, problem.trace.usable], 0.5) > NEAR_NOISE * levels[:, 0]).any():
        return no_rows
    alone, reach = replace(problem, also=()), None
    undecided = find_undecided_rows(alone, fit, floor) | ~problem.trace.usable
    if problem.model.kind.correct is not None and any(map(is_friction, problem.model.values)):
        frictions = {name: x for name, x in problem.model.values.items() if is_friction(name)}
        values = frictions | problem.list_values(fit.free, fit.x)
        rows = np.array([[x * keep if is_friction(n) else x for n, x in values.items()] for keep in (1.0, 0.0)])
        reach = np.diff(alone.predict_outputs(list(values), rows), axis=0)[0] / levels
    undecided = extend_until_noise(undecided, residuals / levels, reach)
    return undecided if undecided.mean() <= HELD_OUT_UNDECIDED_SHARE else no_rows


def extend_until_noise(undecided: Flags, ratios: Floats, reach: Floats | None = None) -> Flags:
    """The undecided rows, and the windows after them in which residuals over their floors, (s, n), are not noise.

    `reach`, (s, n), is what all friction of the plant does, over the floors. A replay that slides where the plant
    sticks, or the reverse, is off by no more: a larger residual is physics that is missing, and ends the extension.
    """
    extended = undecided.copy()
    power = measure_window_power(np.nan_to_num(ratios))
    is_off: Flags = power.max(axis=0) > RESIDUAL_HELD_OUT**2
    if reach is not None:
        is_off &= (power <= np.maximum(measure_window_power(reach), RESIDUAL_HELD_OUT**2)).all(axis=0)
    for first in range(WINDOW, len(extended), WINDOW):
        extended[first:first + WINDOW] |= extended[first - 1] & is_off[first:first + WINDOW]
    return extended


def measure_decided_errors(problem: Problem, fit: Fit, floor: Mapping[str, float]) -> dict[str, float]:
    """RMS residuals of the first run, SI; where that is more than noise, of the typical rows that hang on no stop.

    A repeat stops elsewhere, so it tells a stop that was missed from physics; without one, only this does.
    """
    names, residuals = problem.trace.outputs, fit.residuals[:, :len(problem.trace)]
    errors = dict(zip(names, map(rms, residuals), strict=True))
    if any(errors[s] > RESIDUAL_IS_NOISE * floor[s] for s in names):
        undecided = find_unpredictable_rows(problem, fit, floor)
        if undecided.any():
            decided_residuals = residuals[:, ~undecided & problem.trace.usable]
            return dict(zip(names, compute_typical_rms(decided_residuals).tolist(), strict=True))
    return errors


def measure_drift(trace: Trace, model: Model, steps: int = REPLAY_STEPS) -> tuple[float, float]:
    """Of a replay without anchor: RMS of the residual of the controlled signal, SI, and its rate of departure, SI/s."""
    name = trace.declared.controlled.name
    run, rate = trace, 0.0
    if not trace.usable[0]:  # in motion: drawn to the measured one until it is judged
        is_anchored = np.arange(len(trace)) <= int(np.argmax(trace.usable))
        run, rate = trace.with_columns({name: np.where(is_anchored, trace.unlagged, np.nan)}), ANCHOR_RATE
    residual = trace.mask_unusable(name) - replay_current(run, model, steps, rate)[name]
    is_measured = ~np.isnan(residual)
    t = trace.t[is_measured] - trace.t[is_measured].mean()
    return rms(residual), float(np.sum(t * residual[is_measured]) / np.sum(t**2))


def replay_command(trace: Trace, model: Model, steps: int = REPLAY_STEPS) -> Columns:
    """Residuals, measured less model, of the chosen signals and the drive in a run from the command alone, no noise."""
    rest_rows = round(1.0 / trace.period)  # a second at the first demand, before a closed-loop replay begins
    command, load = (np.pad(x, (rest_rows, 0), "edge") for x in (trace.command, trace.load))
    lanes = Lanes(silence_sensors(model), (), steps)
    out = lanes.closed_loop(np.empty((1, 0)), command, load)[0]
    drive = trace.declared.drive.name
    place = trace.declared.columns.index(trace.declared.drive)
    outputs = trace.pass_sensors(np.delete(out, place, axis=-1))[rest_rows:]
    columns = {name: outputs[:, i] for i, name in enumerate(trace.output_names)} | {drive: out[rest_rows:, place]}
    return {name: trace.mask_unusable(name) - columns[name] for name in (*trace.outputs, drive)}


def answer_readings(model: Model, trace: Trace, command: Floats, controlled: Floats) -> Floats:
    """The drive that the model's controller answers to a command and a controlled signal without gaps, (n,) each.

    The other readings are those of the trace; NaN where the law needs one that was not measured.
    """
    other_readings = [trace.column(name) for name in trace.output_names[1:]]
    low, high = (_answer_from_the_middle(model, trace, command, np.column_stack(
        [controlled, *(np.full(len(x), guess) if np.isnan(x).all() else hold_last(x) for x in other_readings)]))
        for guess in (-1e9, 1e9))  # so far apart that a limit of the drive does not make them alike
    return np.where(low == high, low, np.nan)


def _answer_from_the_middle(model: Model, trace: Trace, command: Floats, readings: Floats) -> Floats:
    """The same from all outputs, (n, outputs), where a recording may begin while the law remembers what came before.

    What it then remembers is that with which it answers as the measured controller does in the first rows, if there it
    is ten times nearer than from rest: another law has other answers later on.
    """
    answers, first = compute_answers(model, command, readings), slice(0, START_ROWS)
    if not has_controller_memory(model) or trace.incomplete[first].any():
        return answers

    def miss(memory: Floats) -> Floats:
        return trace.drive[first] - compute_answers(model, command[first], readings[first], memory)

    rest, from_rest = rest_controller(model), trace.drive[first] - answers[first]
    slopes = np.array([from_rest - miss(rest + 1e-6 * unit) for unit in np.eye(len(rest))]).T / 1e-6
    memory = rest + np.linalg.lstsq(slopes, from_rest, rcond=None)[0]
    if not rms(miss(memory)) < 0.1 * rms(from_rest):
        return answers
    return compute_answers(model, command, readings, memory)


def find_controller_gain(model: Model, period: float) -> tuple[float, float]:
    """Drive for each unit of the controlled signal, and for each unit by which it changes within a cycle; no sign.

    Those of the PID law are parameters; another law is asked for its answer to a small change.
    """
    if "controller.proportional_gain" in model.values:
        return abs(model["controller.proportional_gain"]), abs(model["controller.derivative_gain"]) / period
    size = 1e-6 * (model.kind.signals.command.largest if math.isfinite(model.kind.signals.command.largest) else 1.0)
    readings = np.zeros((50, len(model.kind.signals.outputs)))
    readings[20:, 0] = size
    answers = compute_answers(model, np.zeros(50), readings)
    steady = abs(float(answers[21] - answers[19])) / size
    return steady, max(abs(float(answers[20] - answers[19])) / size - steady, 0.0)


def has_controller_memory(model: Model) -> bool:
    """Whether the controller's answer may hang on readings of long ago: by an integral, or in a way not known."""
    is_unknown = getattr(model.kind, "control_memory", None) is not None
    return model.values.get("controller.integral_gain", float(is_unknown)) != 0.0


def differentiate(x: Floats, size: int, order: int) -> Floats:
    """First or second derivative of x (n,) per sample, of the parabola through `size` samples (Savitzky and Golay)."""
    k = np.arange(size) - size // 2
    weights = np.linalg.pinv(np.vander(k.astype(float), 3, increasing=True))[order] * order
    return np.correlate(np.pad(x, size // 2, "edge"), weights, "valid")


class Scatter(NamedTuple):
    """What a refit within the tolerances makes of the error."""

    error: dict[str, float]  # by signal, SI unit
    ratio: dict[str, float]  # over the floor
    moved: dict[str, float]  # parameter "group.field" to its change in tolerances
    enough: bool  # within reach of the floor


def fit_scatter(trace: Trace, model: Model, floor: Mapping[str, float]) -> Scatter:
    """Refit the tolerances to a trace; `floor` of each chosen signal in its SI unit."""
    tolerances = list_tolerance_sizes(model)
    base = np.array([model[name] for name in tolerances])
    size = np.array(list(tolerances.values()))
    scatter_steps = 20  # a cycle; coarse, because only the size of the residual matters here
    lanes = Lanes(silence_sensors(model), list(tolerances), scatter_steps)
    scale = np.array([floor[name] for name in trace.outputs])[:, None]

    def compute_scaled_residuals(x: Floats) -> Floats:
        """Residuals (m, signals * n) in floors, for changes x (m, parameters) in tolerances."""
        values = limit_dynamic_friction(list(tolerances), base + x * size)
        out = replay_lanes(lanes, values, trace).transpose(0, 2, 1)[:, trace.output_columns]
        residuals: Floats = np.nan_to_num((trace.measurements - out) / scale)
        return residuals.reshape(len(x), -1)

    whole = trace
    if is_long(whole):
        trace = cut_excerpt(whole, choose_excerpt(whole, silence_sensors(model), floor))
    x = np.zeros(len(base))
    residual = compute_scaled_residuals(x[None])[0]
    for _ in range(2):
        slope = (compute_scaled_residuals(x + SCATTER_DIFFERENCE * np.eye(len(base))) - residual) / SCATTER_DIFFERENCE
        weight = 1.0 / np.sqrt(1.0 + (residual / SCATTER_LARGE_RESIDUAL) ** 2)
        normal = np.einsum("ik,jk,k->ij", slope, slope, weight, optimize=False) / ALIKE + np.eye(len(base))
        step = np.linalg.solve(normal, -np.einsum("ik,k->i", slope, weight * residual) / ALIKE - x)
        trials = np.clip(x + np.array([1.0, 0.5, 0.2])[:, None] * step, -SCATTER_TOLERANCES, SCATTER_TOLERANCES)
        trial_residuals = compute_scaled_residuals(trials)
        large = SCATTER_LARGE_RESIDUAL
        costs = 2 * large**2 * (np.sqrt(1 + (trial_residuals / large) ** 2) - 1).sum(axis=1) / ALIKE
        best = int(np.argmin(costs + (trials**2).sum(axis=1)))
        x, residual = trials[best], trial_residuals[best]
    if whole is not trace:
        trace = whole
        residual = compute_scaled_residuals(x[None])[0]
    rows = residual.reshape(len(scale), -1)
    ratio = {name: rms(np.where(np.isnan(y), np.nan, r))
             for name, r, y in zip(trace.outputs, rows, trace.measurements, strict=True)}
    error = {name: ratio[name] * floor[name] for name in ratio}
    changes = dict(sorted(zip(tolerances, x.tolist(), strict=True), key=lambda item: -abs(item[1])))
    return Scatter(error, ratio, changes, max(ratio.values()) < RESIDUAL_IS_SCATTER)


FEWEST_ROWS = 200  # of a recording; fewer cannot tell anything
PERIODS = (1e-4, 0.1)  # s, shortest and longest of a controller: the bounds of `controller.period`
SAME_PERIOD = 0.01  # of a period: two periods that differ by less are the same
BRIDGED_ROWS = 5  # of missing current that are interpolated; longer gaps are left out
STILL = 5e-5  # m; a ram that moves further than that moves every sensor
LIMIT_TIMES = {"command": 5.0, "output": 3.0, "drive": 20.0}  # by role: more times its limit is another unit
LARGEST_TIMES = 2.0  # more times the largest demand or load that the plant declares is another unit
FOLLOWED = (1 / 300, 30.0)  # of the demand, by a controlled signal in its own unit; a jammed one hardly follows
QUICKER_MISFIT = 0.8  # of the model's own cycle, below which rows are taken as those of a controller that is slower
ALIKE_SHARE = 0.8  # of the power of the controlled signal, from which on it follows the demand


def prepare_trace(trace: Trace, model: Model, outputs: Sequence[str] | None = None, source: object = "trace") -> Trace:
    """The recording on the controller's cycles, as replays and fits use it.

    Where the rows can be read in more than one way, the way is taken in which a replay follows the quick changes best.

    Args:
        trace: the recording; needs command, controlled signal and drive.
        model: its plant says what a signal can be, its controller how long a cycle is.
        outputs: signals that replays are compared with; default: all of the plant's outputs that were measured.
        source: the recording's name in error messages.

    Raises:
        InputError: a recording that cannot be replayed.
    """
    ways = read_cycles(trace, model, outputs, source)
    if len(ways) == 1:
        return ways[0]
    floors = sensor_floors(ways[0], model)
    own, other = (_measure_quick_misfit(way, model, floors) for way in reversed(ways))
    return ways[0] if other < QUICKER_MISFIT * own else ways[1]


def _measure_quick_misfit(trace: Trace, model: Model, floors: Mapping[str, Floor]) -> float:
    """RMS of what a replay misses of the changes from row to row, over that of noise, in the signal that it fits best.

    A bias, a leak or a load that the model lacks is nearly the same in two rows; a current that acts too late is not.
    """
    residuals = compute_residuals(trace, replay_current(trace, match_period(model, trace), 20))
    return min(rms(np.diff(r[~np.isnan(r)])) / max(floors[name].value, 1e-300) for name, r in residuals.items())


def hold_inputs(trace: Trace, outputs: Sequence[str] | None = None, source: object = "trace") -> Trace:
    """The recording with missing inputs held at their last value, all rows usable, and no check of units or sensors.

    For recordings of other plants, whose ranges are not known.

    Raises:
        InputError: too few rows, no command, controlled signal or drive, or a chosen signal that was not measured.
    """
    return trace.with_inputs(hold_last(trace.command), hold_last(trace.drive), hold_last(trace.load),
                             incomplete=_find_incomplete(trace), outputs=_choose_outputs(trace, outputs, source),
                             slack=_find_slack(trace))


def simulate_trace(lanes: Lanes, values: Floats, command: Floats, load: Floats, outputs: Sequence[str]) -> Trace:
    """A run in closed loop as a recording without noise, of which these outputs are compared.

    Args:
        lanes: runs of a model.
        values: (len(lanes.names),) their parameters, SI.
        command: (n,) demand.
        load: (n,) external load.
        outputs: names.
    """
    d = lanes.model.kind.signals
    out = lanes.closed_loop(values[None], command, load)[0]
    columns = {d.command.name: command, **{s.name: x for s, x in zip(d.columns, out.T, strict=True)},
               **({d.load.name: load} if d.load else {})}
    trace = Trace.from_columns(columns, lanes.model["controller.period"], {}, d)
    return trace.with_inputs(outputs=tuple(name for name in trace.output_names if name in outputs),
                             slack=_find_slack(trace))


def match_period(model: Model, trace: Trace, tolerance: float = 0.0) -> Model:
    """The model with the recording's period as its controller's; the model itself within a relative `tolerance`.

    Raises:
        InputError: a period that no controller has.
    """
    model_period = model["controller.period"]
    if model_period == trace.period or abs(model_period / trace.period - 1.0) < tolerance:
        return model
    shortest, longest = PERIODS
    require(shortest <= trace.period <= longest, "trace", "t", f"one row a controller cycle, {1e3 * shortest:g} to "
            f"{1e3 * longest:g} ms apart; these rows are {1e3 * trace.period:.4g} ms apart")
    return replace(model, values={**model.values, "controller.period": trace.period})


def read_cycles(trace: Trace, model: Model, outputs: Sequence[str] | None = None, source: object = "trace"
                ) -> list[Trace]:
    """The prepared recording; several where its rows can be read in more than one way.

    Rows every 2 ms can come from a controller that is that slow, or be every other cycle of one at 1 ms.

    Raises:
        InputError: a recording that cannot be replayed.
    """
    outputs = _choose_outputs(trace, outputs, source)
    _check_signals(trace, model, outputs, source)
    if trace.declared.names != EHA.names:  # an EHA, which has followed its drive for hundreds of rows, begins with main
        trace = trace.join_lead()
    rows = _take_rows(trace, outputs).with_notes(*_list_offsets(trace, model, outputs))
    ratio = trace.period / model["controller.period"]
    rows_in_cycle, cycles_in_row = round(1 / ratio), round(ratio)
    ms = 1e3 * trace.period
    if abs(ratio - 1) < SAME_PERIOD:
        return [_fill_inputs(rows, trace, source)]
    if rows_in_cycle > 1 and abs(1 / ratio / rows_in_cycle - 1) < SAME_PERIOD:
        phase = _find_new_current(rows.drive, rows_in_cycle)
        if phase is not None:
            few = slice(phase, None, rows_in_cycle)
            cycles = rows.take_rows(few, incomplete=np.isnan(rows.controlled[few]), period=rows_in_cycle * rows.period)
            require(len(cycles) >= FEWEST_ROWS, source, "t", f"at least {FEWEST_ROWS} cycles, not {len(cycles)}")
            for name in (trace.declared.controlled.name, *outputs):
                require(not np.isnan(cycles.column(name)).all(), source, name, "readings in the rows in which "
                        f"{trace.declared.drive.symbol} is new, every {rows_in_cycle}; there are none")
            note = f"rows every {ms:g} ms, current new every {rows_in_cycle}: one row a cycle is used"
            return [_fill_inputs(cycles.with_notes(note), trace, source)]
    ways = [rows.with_notes(f"the model's cycle of {1e3 * model['controller.period']:g} ms is taken as the trace's, "
                            f"{ms:g} ms")]
    if 1 < cycles_in_row <= 20 and abs(ratio / cycles_in_row - 1) < SAME_PERIOD:
        note = f"rows every {ms:g} ms are taken as one cycle in {cycles_in_row}; the current between is interpolated"
        ways.append(_spread_rows(rows, cycles_in_row).with_notes(note))
    return [_fill_inputs(way, trace, source) for way in ways]


def _choose_outputs(trace: Trace, outputs: Sequence[str] | None, source: object) -> tuple[str, ...]:
    declared = trace.declared
    for name in declared.required:
        require(name in trace.signals, source, name, "a measured column: a replay starts from "
                f"{declared.drive.symbol}, {declared.command.symbol} and {declared.controlled.symbol}")
    require(len(trace) >= FEWEST_ROWS, source, "t", f"at least {FEWEST_ROWS} rows, not {len(trace)}")
    measured_names = [name for name in trace.output_names if name in trace.signals]
    for name in outputs or ():
        require(name in trace.output_names, "--signals", name, f"some of {','.join(trace.output_names)}")
        require(name in measured_names, source, name, f"a measured signal; this trace has {', '.join(measured_names)}")
    return tuple(name for name in measured_names if not outputs or name in outputs)


def _check_signals(trace: Trace, model: Model, outputs: Sequence[str], source: object) -> None:
    """Refuse another plant's recordings, other units and dead sensors."""
    declared = trace.declared
    plant = trace.provenance.get("plant", "")
    phrase = (f"{plant}, whose rig recorded this" if plant else
              f"a plant with the signals {', '.join(declared.names)}")
    require((plant not in MODULES or plant == model.plant)
            and declared.names == model.kind.signals.names, source, "--model", f"{phrase}, not {model.plant}")
    require(trace.period <= 50 * model["controller.period"], source, "t",
            f"times in s, one row a cycle; the rows are {trace.period:g} s apart")
    for signal in declared[1:]:
        largest = float(np.nanmax(sizes := np.abs(trace.column(signal.name)), initial=0.0))
        if largest > LIMIT_TIMES.get(signal.role, math.inf) * model.values.get(signal.limit, math.inf):
            raise InputError(source, signal.name, f"values in {signal.unit}; the largest, {largest:g} at "
                             f"t = {trace.t[np.nanargmax(sizes)]:g} s, is {largest / model[signal.limit]:.0f} times "
                             f"{signal.limit}, which {np.sum(sizes > model[signal.limit])} of {len(sizes)} rows exceed")
        require(largest <= LARGEST_TIMES * signal.largest, source, signal.name, f"values in {signal.unit}, of which "
                f"the plant declares {signal.largest:g} as the largest; here it is {largest:g}")
    moves = float(np.nanmax(trace.command) - np.nanmin(trace.command)) > STILL * trace.scale
    drive, controlled = declared.drive.name, declared.controlled.name
    for name in (drive, *outputs):
        values, signal = trace.column(name), declared.find(name)
        lowest, highest = float(np.nanmin(values)), float(np.nanmax(values))
        if lowest == highest and (moves or name == controlled):
            without = ",".join(other for other in outputs if other != name) or controlled
            hint = "" if name in (drive, controlled) else f" (--signals {without} leaves it out)"
            raise InputError(source, name, f"a signal that changes; it is {lowest:g} throughout{hint}")
        require(not moves or highest - lowest >= signal.faint, source, name,
                f"values in {signal.unit}; the largest is {highest:g}")
    is_known = ~np.isnan(trace.command + trace.controlled)
    if moves and declared.command.unit == declared.controlled.unit and is_known.sum() > 1:
        (power, covariance), (_, answer) = np.cov(trace.command[is_known], trace.controlled[is_known])
        require(covariance**2 <= ALIKE_SHARE * power * answer
                or FOLLOWED[0] * power < abs(covariance) < FOLLOWED[1] * power, source, controlled,
                f"values in {declared.controlled.unit}; it moves {covariance / power:.3g} times as far as "
                f"{declared.command.name}")


def _list_offsets(trace: Trace, model: Model, outputs: Sequence[str]) -> list[str]:
    """Notes on positions beyond the end stops by more than noise: no fault leaves them."""
    return [f"{signal.symbol} reaches {reached:.3g} {signal.unit} where {signal.limit} is {model[signal.limit]:g} "
            f"{signal.unit}: does the map of rig import leave an offset in it, or is this another actuator?"
            for signal in map(trace.declared.find, outputs) if signal.limit in model.values
            and (reached := float(np.nanmax(np.abs(trace.column(signal.name))))) > 1.05 * model[signal.limit]]


def _take_rows(trace: Trace, outputs: Sequence[str]) -> Trace:
    """The recording row by row, nothing filled yet; of the outputs only those chosen, and the controlled one."""
    grid = trace.t[0] + trace.period * np.arange(len(trace))
    jitter = float(np.abs(trace.t - grid).max())
    if jitter > 0.1 * trace.period:
        trace = trace.with_notes(
            f"times are up to {1e3 * jitter:.2g} ms off an even grid; each row is taken as one cycle")
    nothing = np.full(len(trace), np.nan)
    # the controller's block and the anchor of a replay need the controlled signal, chosen or not
    unused_columns = {name: nothing for name in trace.output_names[1:] if name not in outputs}
    return trace.with_columns(unused_columns, filled=np.zeros(len(trace), bool), incomplete=_find_incomplete(trace),
                              outputs=tuple(outputs))


def _find_incomplete(trace: Trace) -> Flags:
    """Rows in which command, controlled signal or drive was not recorded.

    Where rows are resampled or moved onto those of another run, only the rows without the controlled signal count as
    incomplete: command and drive are then those that were filled in.
    """
    return np.isnan(trace.command) | np.isnan(trace.controlled) | np.isnan(trace.drive)


def _find_new_current(cor: Floats, rows: int) -> int | None:
    """Which of so many rows brings a new current, 0 for the first; None if more than one does."""
    new = np.flatnonzero(np.diff(cor) != 0.0) + 1
    counts = np.bincount(new % rows, minlength=rows)
    return int(counts.argmax()) if len(new) and counts.max() > 0.95 * len(new) else None


def _spread_rows(trace: Trace, cycles: int) -> Trace:
    """Each row as one of so many cycles, nothing recorded in the others."""
    n = (len(trace) - 1) * cycles + 1
    period = trace.period / cycles
    is_between = np.arange(n) % cycles > 0
    columns = {name: np.where(is_between, np.nan, np.repeat(x, cycles)[:n]) for name, x in trace.columns.items()}
    return replace(trace, columns=columns, t=np.round(trace.t[0] + period * np.arange(n), 9), period=period,
                   phase=np.repeat(trace.phase, cycles)[:n], usable=np.repeat(trace.usable, cycles)[:n],
                   filled=np.zeros(n, bool),
                   incomplete=np.isnan(columns[trace.declared.controlled.name]))


def _fill_inputs(rows: Trace, trace: Trace, source: object, recovery: float = 0.3, abrupt: float = 0.1) -> Trace:
    """Command, drive and load without gaps; rows flagged that no replay can be compared with.

    Args:
        rows: the recording on the controller's cycles.
        trace: as it was recorded.
        source: its name in error messages.
        recovery: s after a gap, until an anchored replay is back on the recording.
        abrupt: share of the largest current; a gap across which the current changes by more cannot be filled.
    """
    drive, is_unknown = bridge_gaps(rows.drive, max(BRIDGED_ROWS, round(trace.period / rows.period)))
    is_missing = np.isnan(rows.drive)
    change = np.abs(hold_next(rows.drive) - hold_last(rows.drive))
    is_unknown |= is_missing & (change > abrupt * np.nanmax(np.abs(rows.drive)))
    usable = rows.usable & ~extend_flags(is_unknown, max(round(recovery / rows.period) - 1, 0))
    notes = []
    missing_rows = int(np.isnan(trace.drive).sum())
    if missing_rows:
        notes.append(f"the current is missing in {missing_rows} of {len(trace)} rows; "
                     f"{(~usable).sum() * rows.period:.2g} s of the trace could not be replayed")
    notes += [f"{name} is missing for {seconds:.1f} s: it is not compared there" for name in rows.outputs if (
        seconds := float(bridge_gaps(rows.column(name), round(recovery / rows.period))[1].sum()) * rows.period)]
    for name in rows.outputs:
        mover = rows.command if name == rows.declared.controlled.name else rows.controlled
        is_frozen = _find_frozen(rows.column(name), mover, rows.scale)
        if is_frozen.any():
            first = float(rows.t[int(np.argmax(is_frozen))])
            seconds = float(is_frozen.sum()) * rows.period
            notes.append(f"{name} is frozen for {seconds:.2f} s, first at {first:.2f} s: left out there")
            usable &= ~is_frozen
    d, start = rows.declared, round(recovery / rows.period)
    is_at_work = (abs(float(drive[:10].mean())) > abrupt * float(np.abs(drive).max())
                  and usable[start:].sum() >= FEWEST_ROWS)  # a short recording at rest may have such a drive as well
    if is_at_work or _starts_in_motion(rows):  # a replay begins at rest, without drive
        what = f"{d.drive.phrase} is at work" if is_at_work else f"{d.controlled.phrase} already moves"
        notes.append(f"the {what} in the first row: the first {start * rows.period:g} s are not judged")
        usable[:start] = False
    require(usable.sum() >= FEWEST_ROWS, source, rows.declared.drive.name,
            f"at least {FEWEST_ROWS} rows that can be replayed, not {int(usable.sum())}")
    return rows.with_inputs(_fill_demand(rows.command, 2e-4 * rows.scale), drive, hold_last(rows.load),
                            usable=usable, filled=is_missing, notes=(*rows.notes, *notes), slack=_find_slack(trace))


def _find_slack(trace: Trace) -> float:
    """Half the step of which all values of the controlled signal are multiples; 0 where there is no coarse one."""
    comb = find_comb(trace.controlled, FINEST_COMB)
    return 0.5 * comb.step if comb else 0.0


def _fill_demand(com: Floats, step: float) -> Floats:
    """Com where it is missing: on straight lines, but held before a change by more than `step`: a step."""
    before, behind = hold_last(com), hold_next(com)
    return np.where(np.isnan(com) & (np.abs(behind - before) > step), before, fill_gaps(com))


def extend_flags(flags: Flags, rows: int) -> Flags:
    """The flagged rows, and so many after each."""
    total = np.concatenate([np.zeros(rows + 1, int), np.cumsum(flags)])
    return total[rows + 1:] > total[:-rows - 1]


def _find_frozen(x: Floats, mover: Floats, scale: float, longest: int = 200, least_way: float = 1e-3, jump: float = 5.0
                 ) -> Flags:
    """Rows in which `x` repeats one value while `mover` goes on, and then jumps, or never changes again.

    A ram at rest under a coarse converter also repeats its value, but goes on by the converter's steps.

    Args:
        x: the signal.
        mover: moves it if it is alive.
        scale: of the mover, as of `Trace.scale`.
        longest: equal rows that a live signal may have.
        least_way: how far the mover goes on, times the scale, for a signal that never changes again.
        jump: steps, in usual ones, that a signal makes when it comes back.
    """
    is_frozen = np.zeros(len(x), bool)
    steps = np.abs(np.diff(x))
    usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    starts = np.flatnonzero(np.concatenate([[True], np.diff(x) != 0.0]))
    for first, stop in zip(starts, [*starts[1:], len(x)], strict=True):
        if stop - first < longest or np.isnan(mover[first:stop]).all():
            continue
        way = float(np.nanmax(mover[first:stop]) - np.nanmin(mover[first:stop]))
        if stop == len(x):
            is_frozen[first:stop] = way > least_way * scale
        else:
            is_frozen[first:stop] = way > STILL * scale and steps[stop - 1] > jump * usual
    return is_frozen


def _starts_in_motion(trace: Trace, rows: int = 16, fast: float = 2e-3) -> bool:
    """Whether the plant moves faster than `fast` m/s, times the scale, in the first row: replays start at rest.

    The speed is that of a parabola through the first `rows` positions. Beside a smaller one than five times the
    standard deviation that its residual, the noise, gives it, the plant may as well be at rest.
    """
    first = trace.controlled[:rows]
    if len(first) < rows or np.isnan(first).any():
        return False
    powers = np.vander(np.arange(float(rows)), 3, increasing=True)
    parabola = np.linalg.pinv(powers)
    noise = float(np.linalg.norm(first - powers @ (parabola @ first)))
    certain = 5.0 * noise / math.sqrt(rows - 3) * float(np.linalg.norm(parabola[1]))
    return abs(float(parabola[1] @ first)) > max(fast * trace.scale * trace.period, certain)


def find_repeat(first: Trace, trace: Trace, model: Model, number: int) -> Trace:
    """A repeat of the prepared run `first`, prepared too and on its rows, which are found by the command.

    Args:
        first: the prepared run.
        trace: the repeat as it was recorded.
        model: as for `first`.
        number: of the repeat, for error messages.

    Raises:
        InputError: another command, other cycles, no signal in common, or the same samples.
    """
    source = f"--repeat {trace.provenance.get('source', number)}"
    outputs = [name for name in first.outputs if name in trace.signals]
    require(outputs, source, ", ".join(first.outputs), "a signal that the trace has too")
    ways = [way for way in read_cycles(trace, model, outputs, source)
            if abs(way.period / first.period - 1.0) < SAME_PERIOD]
    require(ways, source, "t", f"rows as in the trace it repeats; they are {1e3 * trace.period:g} ms apart")
    repeat = ways[0]
    late, command = _find_first_move(first) - _find_first_move(repeat), first.declared.command
    delays = [each for each in (0, late) if has_same_command(first, repeat, each)]
    off = np.abs(_align_repeat(repeat, late, len(first)).command - first.command)
    require(delays, source, command.name, "the command of the trace it repeats; another command is no repeat: "
            f"{np.mean(off > SAME_COMMAND_POSITION * first.scale):.0%} of the rows differ, by {off.max():.2g} "
            f"{command.unit} at {first.t[off.argmax()]:g} s (or its rows were imported at other times)")
    aligned_repeat = _align_repeat(repeat, delays[0], len(first))
    require(any(np.nansum(np.abs(aligned_repeat.column(name) - first.column(name))) > 0.0 for name in outputs),
            source, "", "the same command run again; every sample of this one is that of the trace itself")
    return aligned_repeat


def _find_first_move(trace: Trace) -> int:
    return int(np.argmax(np.abs(trace.command - trace.command[0]) > SAME_COMMAND_POSITION * trace.scale))


def has_same_command(one: Trace, other: Trace, late: int = 0, overlap: float = 0.5, same_share: float = 0.98) -> bool:
    """Whether the other's command, `late` rows later, is that of the one in nearly all of the common rows.

    It is not if these are less than `overlap` of the one.
    """
    a, b = one.command, other.command
    first, last = max(0, late), min(len(a), len(b) + late)
    if last - first < overlap * len(a):
        return False
    is_same = np.abs(a[first:last] - b[first - late:last - late]) <= SAME_COMMAND_POSITION * one.scale
    return bool(np.mean(is_same) >= same_share)


def _align_repeat(trace: Trace, late: int, rows: int) -> Trace:
    """A repeat on the `rows` of the first run, its own being so many rows `late`.

    Before its own first row the ram rests, and nothing was measured.
    """
    if late == 0 and len(trace) == rows:
        return trace
    repeat_rows = np.arange(rows) - late
    place = np.clip(repeat_rows, 0, len(trace) - 1)
    usable = (repeat_rows == place) & trace.usable[place]
    return trace.take_rows(place, usable=usable, incomplete=np.isnan(trace.controlled[place]) | ~usable)
