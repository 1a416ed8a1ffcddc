"""Model against measurement: how large the error is beside what noise explains, where, when, and in which block."""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fdi.comparison.residuals import (
    Place,
    ResidualTests,
    combine_residuals,
    describe_motion,
    examine_residuals,
    find_condition,
    locate_error,
)
from fdi.estimation.noise import (
    Floor,
    describe_doubtful_repeats,
    find_floors,
    floor_from_data,
    sensor_floors,
    simulate_reading_noise,
)
from fdi.estimation.replay import (
    BRIDGED_ROWS,
    Columns,
    Repeat,
    Replay,
    Scatter,
    align_columns,
    compute_residuals,
    differentiate,
    extend_flags,
    find_repeat,
    fit_scatter,
    match_period,
    measure_drift,
    measure_misfit,
    prepare_trace,
    replay_command,
    replay_current,
    replay_with_checked_steps,
)
from fdi.progress import Progress, ignore_progress
from fdi.thresholds import (
    BLOCK_ERROR_RATIO,
    BLOCK_EXCESS_LEAST,
    CONTROLLER_ERROR_RATIO,
    CONTROLLER_LAG_RATIO,
    FINEST_COMB,
    LAG_MISFIT_RATIO,
    LOWER_BOUND_ERROR_RATIO,
    NOISY_SENSOR_RATIO,
    REPEAT_DIFFERENCE_RATIO,
    SECTION_ERROR_SD,
    SHAPE_TIE_GAIN,
    SIGNAL_ERROR_RATIO,
    SOLVER_HIDES_RATIO,
    SPOOL_FITS_RATIO,
    UNDECIDED_SHARE,
)
from fdi.trace.sensor_dynamics import find_comb, is_rounding_left, measure_resolution
from fdi.trace.signals import SIGNALS
from fdi.trace.trace import Flags, Floats, Trace, bridge_gaps, hold_last, rms, shift_rows
from plant.controller import compute_answers
from plant.forced import compute_flow_balance, compute_force_balance
from plant.model import Model

SPAN = 0.02  # s; the flow is compared over the ram's way in it: longer adds up noise of XS, shorter shows that of XJ
MEAN = 0.011  # s, over which the direction of motion is told
SURE = 5.0  # standard deviations of the speed that tell a moving ram
LOOSE = 2e-3  # m/s; the speed of the sensed position must show the direction too
PLAYS = (2e-5, 6e-5, 1.5e-4)  # m, hysteresis of any shape as a sum of plays
FEWEST_FORCE_ROWS = 400  # with known forces; fewer are the ends of steps, where speed is hardest to tell
OWN = {"way": 5e-7, "force": 8e3}  # m, Pa: what straight lines between the samples leave of a perfect model
LAGS = range(-8, 21)  # cycles that Com or XJ may be late in the file


class Balance(NamedTuple):
    """The jack's two residuals and what they were made of, columns (n,)."""

    way: Floats  # m, XJ sensed less XJ from the flow, gained over SPAN; NaN where it cannot be told
    force: Floats  # Pa, P12 less what the motion takes; NaN unless the ram surely moves, and without P12
    gain: float  # by which the ram moves further than the flow says, as a fraction
    speed: Floats  # m/s, from the flow
    position: Floats  # m, as the flow adds it up


def compute_balance(trace: Trace, model: Model, replayed: Columns) -> Balance:
    """Flow and force of the jack from measured XS and P12; an XS that was not measured is the replay's."""
    chosen = {name: getattr(trace, name) if name in trace.outputs else replayed[name] for name in ("p12", "xs")}
    (p12, lost), (xs, missing) = (bridge_gaps(chosen[name], BRIDGED_ROWS) for name in ("p12", "xs"))
    xj = bridge_gaps(trace.xj, BRIDGED_ROWS)[0]
    seen = differentiate(xj, max(5, round(MEAN / trace.period) | 1), 1) / trace.period
    bad = lost | missing | ~trace.usable
    if "p12" not in trace.outputs:  # not the replay's, which hangs on the valve, but what motion takes where it is sure
        error = _compute_force_residual(trace, model, p12, xj, seen)
        p12, bad = p12 - np.nan_to_num(error), bad | np.isnan(error)
    saturated_share = 0.98  # of the supply pressure: the edges' law says nothing about the speed there
    bad |= np.abs(p12) > saturated_share * model["supply.pressure"]
    sensed, speed = compute_flow_balance(model, xs, p12, float(xj[0]))
    lag = count_span_rows(trace.period)
    way = difference_over(trace.xj - sensed, lag)
    way[extend_flags(bad, lag)] = np.nan
    dx = difference_over(xj, lag)
    there = ~np.isnan(way) & ~np.isnan(dx)
    power = float(np.sum(dx[there] ** 2))
    gain = float(np.sum(dx[there] * way[there])) / power if power > 0.0 else 0.0
    # without a measured spool the flow is the servovalve's, and the forces take their speed from the position
    known = speed * (1 + max(-0.2, min(gain, 0.2))) if "xs" in trace.outputs else seen
    force = np.full(len(trace), np.nan)
    if "p12" in trace.outputs:
        force = _compute_force_residual(trace, model, p12, xj, known)
    force[bad] = np.nan
    return Balance(way, force, gain, speed, sensed)


def count_span_rows(period: float) -> int:
    """SPAN in rows."""
    return max(1, round(SPAN / period))


def difference_over(x: Floats, rows: int) -> Floats:
    """x less what it was so many rows before; NaN at the start."""
    out = np.full(len(x), np.nan)
    out[rows:] = x[rows:] - x[:-rows]
    return out


def _compute_force_residual(trace: Trace, model: Model, p12: Floats, xj: Floats, speed: Floats) -> Floats:
    takes, _, dynamic = compute_force_balance(model, xj, speed, p12, trace.load)
    size = max(1, round(MEAN / trace.period)) | 1
    kernel = np.ones(size) / size
    mean = np.convolve(speed, kernel, "same")
    noise = float(np.median(np.abs(np.diff(speed, 2)))) / 0.6745 / math.sqrt(6.0 * size)
    seen = np.convolve(np.gradient(xj, trace.period), kernel, "same")
    direction = np.where(mean > SURE * noise, 1.0, np.where(mean < -SURE * noise, -1.0, 0.0))
    direction[(np.abs(seen) > LOOSE) & (np.sign(seen) != direction)] = 0.0
    turned = extend_flags(np.diff(direction, prepend=direction[0]) != 0.0, size)
    turned |= np.roll(turned, -size) | ~_find_resolved(speed, trace.period)
    pushed = np.abs(np.diff(trace.load, prepend=trace.load[0])) > OWN["force"] * model["jack.area"]
    turned |= extend_flags(pushed, size)  # a step of the known load: the speed changes within a sample
    out: Floats = p12 - (takes + direction * dynamic) / model["jack.area"]
    return np.where((direction == 0.0) | turned, np.nan, out)


def _find_resolved(speed: Floats, period: float) -> Flags:
    """Where the change of speed is the same over two and over four samples: there is no jerk between them."""
    near, wide = np.gradient(speed, period), np.zeros(len(speed))
    wide[2:-2] = (speed[4:] - speed[:-4]) / (4 * period)
    apart = np.abs(near - wide)
    most_apart = 4.0  # standard deviations by which accelerations over two and four samples may differ
    return apart <= most_apart * float(np.median(apart)) / 0.6745


def share_error(trace: Trace, b: Balance, xs: Floats, p12: Floats, floor: float, is_noisy: bool
                ) -> tuple[float, float]:
    """Ratios of flow and sensor to the floor, m: the one at fault carries all, the other what it alone explains.

    At fault is whichever error describes `b.way` better; xs m, p12 Pa, (n,), as in the balance. `is_noisy`: the sensed
    position changes from sample to sample by more than its noise, as no flow can make it.

    The descriptions are least-squares fits of a few shapes of each kind. None of them is made of the sensed position,
    whose noise is in the residual itself.
    """
    lag, x = count_span_rows(trace.period), b.position
    rates = [np.concatenate([[0.0], np.cumsum(r)[:-1]]) * trace.period for r in _list_rate_shapes(xs, p12)]
    places = [x, b.speed, p12, *(apply_play(x, width) for width in PLAYS)]
    there = ~np.isnan(b.way)
    columns = [difference_over(s, lag)[there] for s in (*rates, *places)]
    error, (rate, place, gain, both) = _measure_remainders(b.way[there], columns, len(rates))
    effective = int(there.sum()) / lag

    def measure_evidence(one: float, other: float) -> float:
        """Twice the log likelihood by which `one` describes worse than `other`."""
        return effective * math.log(max(one, 1e-3 * floor) ** 2 / max(other, 1e-3 * floor) ** 2)

    whole = error / floor
    gain_suffices = measure_evidence(gain, both) < SHAPE_TIE_GAIN + len(columns)
    is_tie = gain_suffices or abs(measure_evidence(rate, place)) < SHAPE_TIE_GAIN
    if whole**2 - 1.0 < BLOCK_EXCESS_LEAST or (is_tie and not is_noisy):
        return whole, whole
    if not is_tie and rate < place:
        return whole, math.sqrt(1.0 + max(0.0, rate**2 - both**2) / floor**2)
    return math.sqrt(1.0 + max(0.0, place**2 - both**2) / floor**2), whole


def _measure_remainders(y: Floats, columns: list[Floats], first: int
                        ) -> tuple[float, tuple[float, float, float, float]]:
    """RMS of y, and of what the `first` columns, the others, the first of the others, and all of them leave of it."""
    every = [*columns, y]
    size = np.sqrt([np.mean(c**2) for c in every])
    scale, gram = np.where(size > 0.0, size, 1.0), np.zeros((len(every), len(every)))
    rows = 100_000  # at a time
    for k in range(0, len(y), rows):
        z = np.column_stack([c[k:k + rows] for c in every]) / scale
        # not z.T @ z, here and elsewhere: the threads of BLAS wait for a busy core, and 1 ms becomes 0.9 s
        gram += np.einsum("ki,kj->ij", z, z) / len(y)

    def measure_remainder(pick: slice) -> float:
        inverse = np.linalg.pinv(gram[pick, pick], rcond=1e-9, hermitian=True)
        part = gram[pick, -1]
        return float(size[-1]) * math.sqrt(max(0.0, 1.0 - float(part @ inverse @ part)))

    parts = slice(0, first), slice(first, -1), slice(first, first + 1), slice(0, -1)
    return float(size[-1]), tuple(measure_remainder(part) for part in parts)  # type: ignore[return-value]


def _list_rate_shapes(xs: Floats, p12: Floats) -> list[Floats]:
    """Errors of speed that a valve or a jack can make, as functions of opening and pressure, each of order one."""
    x, p = xs / 1e-4, p12 / 1e6
    edge, narrow, held = np.tanh(xs / 2e-5), np.tanh(xs / 5e-6), np.tanh(p / 0.3)
    return [np.ones(len(x)), x, np.abs(x), p, np.abs(p), x * p, x * np.abs(x), np.abs(x) * p, x * x * p,
            x * np.abs(p), x * p * p, edge, narrow, held, edge * np.abs(p)]


def apply_play(x: Floats, width: float) -> Floats:
    """x behind a play of that width, m: the elementary hysteresis."""
    out, held, half = [], float(x[0]), 0.5 * width
    for value in x.tolist():
        held = min(max(held, value - half), value + half)
        out.append(held)
    return np.array(out)


class Jack(NamedTuple):
    """Ratios to their floors of the parts that flow and force decide; None where they cannot be told."""

    flow: float | None = None
    force: float | None = None
    sensor: float | None = None
    gain: float | None = None  # by which the ram moves further than the flow says, as a fraction


def judge_jack(trace: Trace, model: Model, run: Columns, repeats: Sequence[tuple[Trace, int, Columns]],
               level: Mapping[str, float]) -> Jack:
    """The jack and the sensor of a trace; repeats with their shift in rows, `run` and theirs the replays they go with.

    Nothing is told where too few rows hang together.

    The floor comes from the repeats, as everywhere; without them the noise `level` of each signal, SI, is put in once
    more, and what that changes is what noise does.
    """
    b = compute_balance(trace, model, run)
    found = {"way": b.way, "force": b.force}
    if repeats:
        others = [(late, compute_balance(other, model, theirs)) for other, late, theirs in repeats]
        pairs = [align_columns({"way": o.way, "force": o.force}, late, len(trace)) for late, o in others]
        floor = {name: f.value for name, f in find_floors(found, pairs, trace.period).items()}
    else:
        again = compute_balance(add_noise(trace, level), model, run)
        floor = {"way": rms(again.way - b.way), "force": rms(again.force - b.force)}
    floor = {name: math.hypot(value, OWN[name]) for name, value in floor.items()}
    known = {name: getattr(trace, name) if name in trace.outputs else run[name] for name in ("xs", "p12")}
    xs, p12 = (bridge_gaps(column, BRIDGED_ROWS)[0] for column in known.values())
    if (~np.isnan(b.way)).sum() < FEWEST_FORCE_ROWS or not floor.get("way", 0.0) > 0.0:
        return Jack()
    is_noisy = ("xj" in level
                and floor_from_data(trace.mask_unusable("xj")).value > NOISY_SENSOR_RATIO * level["xj"])
    flow, sensor = share_error(trace, b, xs, p12, floor["way"], is_noisy)
    flow = flow if "xs" in trace.outputs else max(flow, sensor)
    most_missing = 0.2  # of the rows; where more are missing, accelerations are guesses
    is_enough = (~np.isnan(b.force)).sum() >= FEWEST_FORCE_ROWS and trace.filled.mean() < most_missing
    is_told = is_enough and floor.get("force", 0.0) > 0.0
    return Jack(flow, rms(b.force) / floor["force"] if is_told else None, sensor, b.gain)


def add_noise(trace: Trace, level: Mapping[str, float]) -> Trace:
    """The trace with noise of each signal's level added, always the same."""
    rng = np.random.default_rng(0)
    noisy = {name: trace.column(name) + size * rng.standard_normal(len(trace)) for name, size in level.items()}
    return replace(trace, **noisy)  # type: ignore[arg-type]


class ControllerBlock(NamedTuple):
    """The controller's block."""

    residual: Floats  # (n,) A, Cor less what the model answers; NaN where it cannot be told
    error: float  # A, RMS
    floor: float  # A, RMS of the rounding in file or bus
    com_lag: int = 0  # cycles: Cor_k answers Com of cycle k - com_lag
    xj_lag: int = 0
    gain: float = math.nan  # A/m, as the answers show it
    limit: float = math.inf  # A, of the model's current

    @property
    def ratio(self) -> float:
        """Error over floor."""
        return self.error / self.floor


def compare_controller(trace: Trace, model: Model) -> ControllerBlock:
    """Compare; where it does not fit, look for the cycles that Com and XJ are late. NaN where firmware is unknown."""
    if not model.kind.controller:
        return ControllerBlock(np.full(len(trace), np.nan), math.nan, math.nan, limit=model["controller.current_limit"])
    found = _compare_at_lags(trace, model, 0, 0)
    if found.ratio <= CONTROLLER_ERROR_RATIO:
        return found
    com, xj, gain = find_lags(trace, model["controller.current_limit"])
    found = found._replace(gain=gain)
    if (com, xj) == (0, 0):
        return found
    late = _compare_at_lags(trace, model, com, xj)
    return late._replace(gain=gain) if late.error < CONTROLLER_LAG_RATIO * found.error else found


def _compare_at_lags(trace: Trace, model: Model, com: int, xj: int) -> ControllerBlock:
    limit = model["controller.current_limit"]
    sensed = shift_rows(trace.xj, xj)
    answers = compute_answers(model, shift_rows(trace.com, com), hold_last(sensed))
    residual = trace.cor - answers
    unknown = np.isnan(sensed) | ~trace.usable
    unknown[1:] |= unknown[:-1].copy()  # a derivative looks back by one
    if model["controller.integral_gain"] != 0.0 and unknown.any():
        unknown[int(np.argmax(unknown)):] = True  # what the integral did in a gap is not known
    unknown[:max(0, com, xj)] = True
    unknown[len(unknown) + min(0, com, xj):] = True
    residual[unknown] = np.nan
    gain = abs(model["controller.proportional_gain"]) + abs(model["controller.derivative_gain"]) / trace.period
    cor, xj_step, com_step = (measure_resolution(column) for column in (trace.cor, trace.xj, trace.com))
    single_precision = 1e-7  # of the current limit: a firmware may calculate in single precision
    rounding = float(np.hypot.reduce([cor, gain * xj_step, gain * com_step])) / math.sqrt(12.0)
    floor = max(rounding, single_precision * limit)
    comb = find_comb(trace.xj, FINEST_COMB)
    if comb and is_rounding_left(residual, gain * comb.step, floor):
        # the controller reads XJ finer than the recording holds it
        floor = math.hypot(floor, gain * comb.step / math.sqrt(12.0))
    error = float(np.sqrt(np.nanmean(residual**2))) if not unknown.all() else math.nan
    return ControllerBlock(residual, error, floor, com, xj, limit=limit)


def find_lags(trace: Trace, limit: float, most_rows: int = 60_000) -> tuple[int, int, float]:
    """Trace that Com and XJ are late in Cor = g (Com - XJ), the two that fit best; and the gain g, A/m."""
    inside = trace.usable & (np.abs(trace.cor) < 0.98 * min(limit, float(np.abs(trace.cor).max())))
    inside[:max(LAGS)], inside[min(LAGS):] = False, False
    xj = hold_last(trace.xj)
    rows = np.flatnonzero(inside)
    rows = rows[::max(1, len(rows) // most_rows)]
    columns = [x[rows - lag] for x in (trace.com, xj) for lag in LAGS]
    whole = np.column_stack([*columns, trace.cor[rows]])
    gram = np.einsum("ki,kj->ij", whole, whole)
    n, target = len(LAGS), gram[-1, -1]
    best = (math.inf, 0, 0, math.nan)
    for a in range(n):
        for b in range(n):
            pick = [a, n + b]
            left, right = gram[np.ix_(pick, pick)], gram[pick, -1]
            gains = np.linalg.lstsq(left, right, rcond=None)[0]
            misfit = float(target - gains @ right)
            nearer = abs(LAGS[a]) + abs(LAGS[b])
            if misfit < best[0] * (1 - 1e-9) - 1e-30 * nearer:
                best = (misfit, LAGS[a], LAGS[b], float(gains[0]))
    return best[1], best[2], best[3]


BALANCED = "eha"  # the plant whose metering edges and ram the balances of `plant.forced` are
STAGES = 7


@dataclass(frozen=True)
class SignalError:
    """One signal's error, SI units."""

    name: str
    unit: str
    error: float  # RMS of the replay from measured inputs; XJ: drawn to the measured position at 20 1/s
    floor: Floor
    sensor_noise: float  # RMS of the model's sensor noise alone, or of the data's own where that is more
    closed_loop_error: float  # RMS of the replay from the command alone
    solver_error: float
    limit: float  # the ratio up to which the error is noise

    @property
    def ratio(self) -> float:
        """Error over floor; 1 for a perfect model."""
        if self.floor.value > 0.0:
            return self.error / self.floor.value
        return math.inf if self.error else 1.0


@dataclass(frozen=True, eq=False)
class Comparison:
    """A model held against a trace; what `rig compare` tells."""

    source: str
    model: Model
    trace: Trace  # prepared for replay
    verdict: str  # WITHIN_FLOOR, MODEL_INCOMPLETE, CANNOT_TELL
    reason: str  # why it cannot tell, or ""
    signals: Mapping[str, SignalError]
    answer: ControllerBlock
    blocks: Mapping[str, float | None]
    parts: Mapping[str, float | None]  # the jack's: "flow", "force"; and "gain", its speed over the model's less 1
    named: tuple[str, ...]  # blocks that disagree, the worst first
    where: tuple[Place, ...]
    condition: str  # of the whole trace
    free_error: float  # m, RMS of XJ in a replay without anchor
    drift: float  # m/s, at which that replay departs
    scatter: Scatter | None  # None: nothing to explain
    diagnoses: Mapping[str, ResidualTests]
    replay: Replay
    closed: Columns  # residuals of the replay from the command alone, (n,)
    repeats: int
    notes: tuple[str, ...]


def compare(trace: Trace, model: Model, repeats: Sequence[Trace] = (), signals: Sequence[str] | None = None,
            progress: Progress = ignore_progress, source: str = "trace") -> Comparison:
    """Replay a trace and judge what is left.

    Raises:
        InputError: a trace, a repeat or a signal that cannot be used, in one line.
    """
    progress("reading", 0.0)
    trace = prepare_trace(trace, model, signals, source)
    model = match_period(model, trace)
    trace, found = _align_delays(trace, model, compare_controller(trace, model))
    others = [find_repeat(trace, other, model, number) for number, other in enumerate(repeats, 1)]
    progress("solver", 1 / STAGES)
    noise = sensor_floors(trace, model)
    replay = replay_with_checked_steps(trace, model, {name: f.value for name, f in noise.items()})
    progress("repeats", 2 / STAGES)
    runs = [(other, replay_current(other.trace, model, replay.steps)) for other in others]
    theirs = [align_columns(compute_residuals(other.trace, run), other.late, len(trace)) for other, run in runs]
    # without repeats, the floor holds what a current that was not recorded leaves open
    widened = {name: f._replace(value=math.hypot(f.value, replay.blind[name])) for name, f in noise.items()}
    floor = widened | find_floors(replay.residual, theirs, trace.period)
    left_out = replay.undecided & (replay.undecided.mean() <= UNDECIDED_SHARE)
    judged = {name: np.where(left_out, np.nan, r) for name, r in replay.residual.items()}
    progress("closed loop", 3 / STAGES)
    closed, (free, speed) = replay_command(trace, model), measure_drift(trace, model)
    table = {name: _measure_signal(name, r, floor[name], noise[name], closed[name], replay)
             for name, r in judged.items()}
    doubtful = describe_doubtful_repeats(floor, noise)
    progress("blocks", 4 / STAGES)
    ratios, parts = _judge_blocks(trace, model, replay.model, runs, table, found, noise)
    progress("where", 5 / STAGES)
    m = describe_motion(trace, replay.model)
    z2 = combine_residuals(judged, {name: f.value for name, f in floor.items()})
    sections, when = locate_error(trace, z2, m, found.limit), find_condition(z2, m, found.limit)
    verdict, reason = _decide_verdict(table, sections, ratios, replay, trace.period, doubtful)
    diagnoses = examine_residuals(trace, judged, {name: (replay.residual[name] - r) / math.sqrt(2.0)
                                     for name, r in (theirs[0] if theirs else {}).items()}, m)
    progress("tolerances", 6 / STAGES)
    plant = verdict == "MODEL_INCOMPLETE" and any(s.ratio > s.limit for s in table.values())
    scattered = fit_scatter(trace, model, {name: s.floor.value for name, s in table.items()}) if plant else None
    progress("done", 1.0)
    return Comparison(source, model, trace, verdict, reason, table, found, ratios, parts, _list_blocks_above(ratios),
                      tuple(sections), when, free, speed, scattered, diagnoses, replay, closed, len(others),
                      (*trace.notes, *([doubtful] if doubtful and verdict != "CANNOT_TELL" else []),
                       *_list_notes(floor, replay, trace)))


def _measure_signal(name: str, residual: Floats, floor: Floor, noise: Floor, closed: Floats,
                    replay: Replay) -> SignalError:
    samples = int((~np.isnan(residual)).sum())
    ratio_spread = 1.0 / math.sqrt(max(1.0, samples * floor.freedom))  # of two RMS values of so many samples each
    return SignalError(name, SIGNALS[name].unit, rms(residual), floor, noise.value, rms(closed),
                       replay.solver_error[name], SIGNAL_ERROR_RATIO + 3 * ratio_spread)


def _align_delays(trace: Trace, model: Model, found: ControllerBlock) -> tuple[Trace, ControllerBlock]:
    """Columns that are cycles late in the file, set right; a firmware that answers late stays as it is."""
    com, xj = found.com_lag, found.xj_lag
    notes = []
    if xj:
        moved = trace.with_delays(cor=-xj)
        if measure_misfit(moved, model) < measure_misfit(trace, model) + math.log(LAG_MISFIT_RATIO):
            trace, com = moved, com - xj
            notes.append(f"Cor stands {_describe_cycles(xj)} than the other columns: moved into step")
        else:
            notes.append(f"Cor fits the XJ {_describe_cycles(-xj)}: the firmware answers late, "
                         "or XJ is delayed on its way")
    if com:
        trace = trace.with_delays(com=com)
        notes.append(f"Com stands {_describe_cycles(-com)} than the rest of the trace: moved into step")
    return trace.with_notes(*notes), found


def _describe_cycles(n: int) -> str:
    cycles = "cycle" if abs(n) == 1 else "cycles"
    direction = "later" if n > 0 else "earlier"
    return f"{abs(n)} {cycles} {direction}"


def _judge_blocks(trace: Trace, model: Model, run: Columns, repeats: Sequence[tuple[Repeat, Columns]],
                  table: Mapping[str, SignalError], found: ControllerBlock,
                  noise: Mapping[str, Floor]) -> tuple[dict[str, float | None], dict[str, float | None]]:
    """Ratios of the blocks, None where nothing measured can tell, and the parts of the jack's.

    Where the spool is as the model says, an error of P12 in the replay is the jack's too: it sees standstill and
    reversals, which the balance of forces leaves out. Without a measured spool the servovalve is judged with its
    metering edges, as current to flow, and the jack by its forces alone; a sensor cannot be told from a valve then.
    """
    signal = {name: s.ratio for name, s in table.items()}
    pairs = [(other.trace, other.late, theirs) for other, theirs in repeats]
    level = {"xj": simulate_reading_noise(model, trace.xj)} | {name: f.value for name, f in noise.items()}
    j = Jack()
    # the balances of flow and force take the measured signals as the true ones
    if model.plant == BALANCED and {"p12", "xs"} & set(trace.outputs) and not trace.filtered:
        j = judge_jack(trace, model, run, pairs, level)
    parts = {"flow": j.flow, "force": j.force, "gain": j.gain}
    ratios = {"controller": found.ratio if model.kind.controller else None, "servovalve": j.flow, "jack": j.force,
              "sensor": None}
    if "xs" in trace.outputs:
        known = [x for x in (j.flow, j.force) if x is not None]
        if known and "p12" in signal and signal["xs"] < SPOOL_FITS_RATIO:
            known.append(signal["p12"])
        ratios |= {"servovalve": signal["xs"], "jack": max(known, default=None), "sensor": j.sensor}
    return ratios, parts


def _list_blocks_above(ratios: Mapping[str, float | None]) -> tuple[str, ...]:
    limits = {"controller": CONTROLLER_ERROR_RATIO}
    over = [(ratio, name) for name, ratio in ratios.items()
            if ratio is not None and ratio > limits.get(name, BLOCK_ERROR_RATIO)]
    return tuple(name for _, name in sorted(over, reverse=True))


def _decide_verdict(table: Mapping[str, SignalError], sections: Sequence[Place], ratios: Mapping[str, float | None],
                    replay: Replay, period: float, doubtful: str) -> tuple[str, str]:
    """The verdict, and why it cannot tell; `doubtful` says why the repeats are no measure of the noise."""
    coarse = [s.name for s in table.values() if s.solver_error > SOLVER_HIDES_RATIO * s.floor.value]
    if coarse:
        return "CANNOT_TELL", f"the solver's own error in {', '.join(coarse)} is as large as the floor"
    above = [s for s in table.values() if s.ratio > s.limit]
    least = min((s.floor.freedom for s in table.values()), default=1.0)

    local = [p for p in sections if p.ratio > SIGNAL_ERROR_RATIO + SECTION_ERROR_SD / math.sqrt(
        max(1.0, 2 * least * (p.t1 - p.t0) / period))]
    if not (above or local or _list_blocks_above(ratios)):
        apart = _list_signals_apart({name: s.floor for name, s in table.items()})
        if apart and not doubtful:
            doubtful = (f"the model fits this trace but not its repeat: they differ by more than noise "
                        f"({', '.join(apart)} noise floors). Use repeats of the same unit")
        return ("CANNOT_TELL", doubtful) if doubtful else ("WITHIN_FLOOR", "")
    edgy = float(replay.undecided.mean())
    doubt = ""
    if any(s.floor.lower_bound for s in table.values()):
        doubt = "without a repeat the floor is only a lower bound, and the error is not far above it"
    elif edgy > UNDECIDED_SHARE:
        doubt = f"{100 * edgy:.0f} % of the trace {_describe_cause(replay)}"
    sure = any(s.ratio > LOWER_BOUND_ERROR_RATIO or not (edgy > UNDECIDED_SHARE or s.floor.lower_bound)
               for s in above)
    if doubt and not sure and (ratios["controller"] or 0.0) <= CONTROLLER_ERROR_RATIO:
        return "CANNOT_TELL", doubt
    return "MODEL_INCOMPLETE", ""


def _list_notes(floor: Mapping[str, Floor], replay: Replay, trace: Trace) -> list[str]:
    """What a reader must know about the floor and about rows left out."""
    said = [f"{name} of the model passes the sensor of the trace: {sensor.describe(trace.period, SIGNALS[name].unit)}"
            for name, sensor in trace.sensors.items() if name in trace.outputs]
    if trace.filtered:
        said.append(f"flow and force are not balanced: {', '.join(trace.filtered)} is filtered by its sensor")
    if apart := _list_signals_apart(floor):
        said.append(f"the error differs between the repeats, as with stick-slip: {', '.join(apart)} noise floors")
    if replay.undecided.any() and replay.undecided.mean() <= UNDECIDED_SHARE:
        seconds = float(replay.undecided.sum()) * trace.period
        said.append(f"{seconds:.1f} s are not judged: whether the ram stops {_describe_cause(replay)}")
    return said


def _list_signals_apart(floor: Mapping[str, Floor]) -> list[str]:
    """The signals whose repeats differ by more than the floor, each with the ratio."""
    return [f"{SIGNALS[name].symbol} by {f.difference / f.value:.2g}" for name, f in floor.items()
            if f.source == "repeats" and f.difference > REPEAT_DIFFERENCE_RATIO * f.value]


def _describe_cause(replay: Replay) -> str:
    guessed = " or on current that was not recorded" if any(replay.blind.values()) else ""
    return f"hangs there on less than 0.1 % of a friction level{guessed}"
