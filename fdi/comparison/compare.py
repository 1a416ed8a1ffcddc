"""Model against measurement: how large the error is beside what noise explains, where, when, and in which block."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fdi.comparison.jack import judge_blocks
from fdi.comparison.residuals import (
    Place,
    ResidualTests,
    combine_residuals,
    describe_motion,
    examine_residuals,
    find_condition,
    locate_error,
)
from fdi.estimation import (
    Columns,
    Floor,
    Replay,
    Scatter,
    answer_readings,
    compute_residuals,
    describe_doubtful_repeats,
    extend_until_noise,
    find_controller_gain,
    find_floors,
    find_repeat,
    fit_scatter,
    has_controller_memory,
    leave_out_rest,
    list_tolerance_sizes,
    match_period,
    measure_drift,
    measure_misfit,
    measure_window_power,
    prepare_trace,
    replay_command,
    replay_current,
    replay_with_checked_steps,
    require_finite_replay,
    sensor_floors,
)
from fdi.progress import Progress, ignore_progress
from fdi.thresholds import (
    BLOCK_ERROR_RATIO,
    CONTROLLER_ERROR_RATIO,
    CONTROLLER_LAG_RATIO,
    FINEST_COMB,
    LAG_MISFIT_RATIO,
    LOWER_BOUND_ERROR_RATIO,
    OFF_ALONE_SHARE,
    REPEAT_DIFFERENCE_RATIO,
    REPEAT_FLOOR_RATIO,
    RUN_FITS,
    RUN_IS_OFF,
    SECTION_ERROR_SD,
    SIGNAL_ERROR_RATIO,
    SOLVER_HIDES_RATIO,
    UNDECIDED_SHARE,
)
from fdi.trace import Flags, Floats, Trace, find_comb, hold_last, is_rounding_left, measure_resolution, rms, shift_rows
from plant import InputError, Model, Signal, compute_needed_drive, count_nouns

CUT_OFF = 0.2  # of half the rate of rows
DECIMATION = 10
TRANSIENT = 20  # rows at either end, of the filter's transient


def measure_drive_error(trace: Trace, model: Model) -> float | None:
    """Share of the drive, 0 to 1, that the inverse model leaves; None where the plant declares none or it cannot tell.

    Defined as the users of the EMPS benchmark do (A. Janot, M. Gautier, M. Brunot, "Data Set and Reference Models of
    EMPS", 2019): the controlled signal through a Butterworth filter of fourth order, forwards and backwards, rates by
    central differences, both drives decimated by ten; |u - u_model| / |u|. At 1 kHz the filter ends at 100 Hz. Drive
    k - 1 acts from row k to k + 1.
    """
    rows = len(trace) - 2 * TRANSIENT
    if model.kind.inverse is None or rows < 50 * DECIMATION or np.isnan(trace.controlled).any():
        return None
    from scipy.signal import butter, decimate, filtfilt  # late: it takes longer to import than all else of a comparison

    x = filtfilt(*butter(4, CUT_OFF), trace.controlled)
    v = np.gradient(x, trace.period)
    motion = np.column_stack([x, v, np.gradient(v, trace.period)])
    needed_drive = compute_needed_drive(model, motion, trace.load)[TRANSIENT:-TRANSIENT]
    drive = np.concatenate([trace.drive[:1], trace.drive[:-1]])[TRANSIENT:-TRANSIENT]
    is_kept = np.convolve(~trace.usable[TRANSIENT:-TRANSIENT], np.ones(DECIMATION), "same")[::DECIMATION] < 0.5
    u, residual = (decimate(column, DECIMATION, zero_phase=True)[is_kept] for column in (drive, drive - needed_drive))
    size = float(np.linalg.norm(u))
    return float(np.linalg.norm(residual)) / size if size else None


LAGS = range(-8, 21)  # cycles that command or controlled signal may be late in the file


class ControllerBlock(NamedTuple):
    """The controller's block."""

    error: float  # RMS of the drive less what the model answers, in its unit
    floor: float  # RMS of the rounding in file or bus
    com_lag: int = 0  # cycles: drive k answers the command of cycle k - com_lag
    xj_lag: int = 0  # and the controlled signal of cycle k - xj_lag
    gain: float = math.nan  # drive for each unit of the controlled signal, as the answers show it
    gains: Mapping[str, float] | None = None  # of the model's law, with which it would answer so
    limit: float = math.inf  # of the model's drive

    @property
    def ratio(self) -> float:
        """Error over floor."""
        return self.error / self.floor


def compare_controller(trace: Trace, model: Model) -> ControllerBlock:
    """Compare; where it does not fit, look for the cycles that columns are late. NaN where firmware is unknown."""
    limit = model.values.get(model.kind.signals.drive.limit, math.inf)
    if not model.kind.controller:
        return ControllerBlock(math.nan, math.nan, limit=limit)
    answer = _compare_at_lags(trace, model, limit, 0, 0)
    if not answer.ratio > CONTROLLER_ERROR_RATIO:  # or it cannot be told
        return answer
    com, xj, gain = find_lags(trace, limit)
    answer = answer._replace(gain=gain)
    with suppress(InputError):  # a law of the user's own may not take what fits
        answer = answer._replace(gains=fit_gains(trace, model, answer))
    late_answer = _compare_at_lags(trace, model, limit, com, xj)
    return late_answer._replace(gain=gain) if late_answer.error < CONTROLLER_LAG_RATIO * answer.error else answer


def fit_gains(trace: Trace, model: Model, answer: ControllerBlock) -> dict[str, float]:
    """The gains that differ where the model's law with other gains answers as recorded, by name; {} where none does.

    Raises:
        InputError: gains that the model may not have.
    """
    names = [name for name in model.values if name.startswith("controller.") and name.endswith("_gain")]
    fitted, small = model, 1e-6  # far from the drive's limit a gain acts linearly
    for _ in range(10 if names else 0):
        residual = _compute_residual(trace, fitted, 0, 0)
        slopes = np.array([residual - _compute_residual(trace, fitted.replace({name: fitted[name] + small}), 0, 0)
                           for name in names]) / small
        rows = np.isfinite(residual + slopes.sum(axis=0)) & (np.abs(trace.drive) < 0.98 * answer.limit)
        step = np.linalg.lstsq(slopes[:, rows].T, residual[rows], rcond=None)[0]
        fitted = fitted.replace({name: max(0.0, fitted[name] + float(x)) for name, x in zip(names, step, strict=True)})
    gains = {name: fitted[name] for name, slope in zip(names, slopes if names else (), strict=True)
             if abs(fitted[name] - model[name]) * rms(slope[rows]) > CONTROLLER_ERROR_RATIO * answer.floor}
    corrected_answer = _compare_at_lags(trace, model.replace(gains), answer.limit, 0, 0)
    return gains if corrected_answer.ratio <= CONTROLLER_ERROR_RATIO else {}


def _compute_residual(trace: Trace, model: Model, com: int, xj: int) -> Floats:
    """The drive less the model's answer to command and controlled signal of so many cycles before; NaN: unknown."""
    sensed = shift_rows(trace.controlled, xj)
    residual = trace.drive - answer_readings(model, trace, shift_rows(trace.command, com), hold_last(sensed))
    unknown = np.isnan(sensed) | np.isnan(residual) | ~trace.usable
    unknown[1:] |= unknown[:-1].copy()  # a derivative looks back by one
    if has_controller_memory(model) and unknown.any():
        unknown[int(np.argmax(unknown)):] = True  # what the integral did in a gap is not known
    unknown[:max(0, com, xj)] = True
    unknown[len(unknown) + min(0, com, xj):] = True
    residual[unknown] = np.nan
    return residual


def _compare_at_lags(trace: Trace, model: Model, limit: float, com: int, xj: int) -> ControllerBlock:
    residual = _compute_residual(trace, model, com, xj)
    gain = sum(find_controller_gain(model, trace.period))
    cor, xj_step, com_step = (measure_resolution(trace.column(s.name), s.unit) for s in (
        trace.declared.drive, trace.declared.controlled, trace.declared.command))
    largest = limit if math.isfinite(limit) else float(np.nanmax(np.abs(trace.drive)))
    rounding = float(np.hypot.reduce([cor, gain * xj_step, gain * com_step])) / math.sqrt(12.0)
    floor = max(rounding, 1e-7 * largest)  # a firmware may calculate in single precision
    comb = find_comb(trace.controlled, FINEST_COMB)
    if comb and is_rounding_left(residual, gain * comb.step, floor):
        # the controller reads the signal finer than the recording holds it
        floor = math.hypot(floor, gain * comb.step / math.sqrt(12.0))
    return ControllerBlock(rms(residual), floor, com, xj, limit=limit)


def find_lags(trace: Trace, limit: float, most_rows: int = 60_000) -> tuple[int, int, float]:
    """Cycles that command and controlled signal are late in drive = g (command - controlled), and the gain g.

    0, 0 and NaN where the drive does not show them.
    """
    inside = trace.usable & (np.abs(trace.drive) < 0.98 * min(limit, float(np.abs(trace.drive).max())))
    inside[:max(LAGS)], inside[min(LAGS):] = False, False
    sensed = hold_last(trace.controlled)
    rows = np.flatnonzero(inside)
    rows = rows[::max(1, len(rows) // most_rows)]
    if not trace.drive[rows].any():  # always at its limit, or 0
        return 0, 0, math.nan
    columns = [x[rows - lag] for x in (trace.command, sensed) for lag in LAGS]
    whole = np.column_stack([*columns, trace.drive[rows]])
    gram = np.einsum("ki,kj->ij", whole, whole)
    n, target = len(LAGS), gram[-1, -1]
    best = (math.inf, 0, 0, math.nan)
    for a in range(n):
        for b in range(n):
            pick = [a, n + b]
            left, right = gram[np.ix_(pick, pick)], gram[pick, -1]
            gains = np.linalg.lstsq(left, right, rcond=None)[0]
            misfit = float(target - gains @ right)
            if misfit < best[0] * (1 - 1e-9) - 1e-30 * (abs(LAGS[a]) + abs(LAGS[b])):
                best = (misfit, LAGS[a], LAGS[b], float(gains[0]))
    return best[1], best[2], best[3]


STAGES = 7


@dataclass(frozen=True)
class SignalError:
    """One signal's error, SI units."""

    signal: Signal
    error: float  # RMS of the replay from measured inputs; the controlled one: drawn to the measured one at 20 1/s
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
    free_error: float  # RMS of the controlled signal in a replay without anchor
    drift: float  # a second, at which that replay departs
    drive_error: float | None  # share of the drive that the measured motion does not need; None: not asked for
    scatter: Scatter | None  # None: nothing to explain
    diagnoses: Mapping[str, ResidualTests]
    replay: Replay
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
    trace, answer = _align_delays(trace, model, compare_controller(trace, model))
    trace = leave_out_rest(trace, model)
    repeats = [find_repeat(trace, other, model, number) for number, other in enumerate(repeats, 1)]
    progress("solver", 1 / STAGES)
    require_finite_replay(trace, model)
    noise = sensor_floors(trace, model)
    replay = replay_with_checked_steps(trace, model, {name: f.value for name, f in noise.items()})
    noise = sensor_floors(trace, model, replay.residual)
    progress("repeats", 2 / STAGES)
    runs = [(other, replay_current(other, model, replay.steps)) for other in repeats]
    repeat_residuals = [compute_residuals(other, run) for other, run in runs]
    # without repeats, the floor holds what a current that was not recorded leaves open
    widened = {name: f._replace(value=math.hypot(f.value, replay.blind[name])) for name, f in noise.items()}
    # an effect on readings rounds all repeats alike
    is_rounded = any(model.find_effect(name).port == "reading" for name in model.effects)
    least = {s.name: noise[s.name].value if is_rounded and s == trace.declared.controlled else s.finest
             for s in map(trace.declared.find, noise)}
    floor = widened | find_floors(replay.residual, repeat_residuals, trace.period, least)
    off_alone = find_rows_off_alone(replay.residual, repeat_residuals, floor)
    replay = replay._replace(undecided=replay.undecided | off_alone)
    undecided_share = float(replay.undecided[trace.usable].mean())  # of the rows that a replay is judged on
    left_out = replay.undecided & (undecided_share <= UNDECIDED_SHARE)
    residual = {name: np.where(left_out, np.nan, r) for name, r in replay.residual.items()}
    floor |= find_floors(residual, repeat_residuals, trace.period, least)  # repeats part there, too
    progress("closed loop", 3 / STAGES)
    loop_residual, (free_error, drift) = replay_command(trace, model), measure_drift(trace, model)
    table = {name: _measure_signal(trace.declared.find(name), r, floor[name], noise[name], loop_residual[name], replay)
             for name, r in residual.items()}
    doubtful = describe_doubtful_repeats(floor, widened, trace.declared)
    if not doubtful and off_alone[trace.usable].mean() > OFF_ALONE_SHARE:
        doubtful = (f"this run is off for {off_alone.sum() * trace.period:.1f} s in which a repeat is at the noise "
                    "floor: the two differ, and no model explains both")
    progress("blocks", 4 / STAGES)
    ratios, parts = _judge_blocks(trace, model, replay.model, runs, table, answer, noise)
    progress("where", 5 / STAGES)
    m = describe_motion(trace, replay.model)
    z2 = combine_residuals(residual, {name: f.value for name, f in floor.items()})
    sections, condition = locate_error(trace, z2, m, answer.limit), find_condition(z2, m, answer.limit)
    verdict, reason = _decide_verdict(table, sections, ratios, replay, undecided_share, trace.period, doubtful)
    diagnoses = examine_residuals(trace, residual, {name: (replay.residual[name] - r) / math.sqrt(2.0)
                                     for name, r in (repeat_residuals[0] if repeat_residuals else {}).items()}, m)
    progress("tolerances", 6 / STAGES)
    is_plant_wrong = verdict == "MODEL_INCOMPLETE" and any(s.ratio > s.limit for s in table.values())
    floors = {name: s.floor.value for name, s in table.items()}
    scatter = fit_scatter(trace, model, floors) if is_plant_wrong and list_tolerance_sizes(model) else None
    progress("done", 1.0)
    return Comparison(source, model, trace, verdict, reason, table, answer, ratios, parts,
                      _list_blocks_above(ratios, table), tuple(sections), condition, free_error, drift,
                      measure_drive_error(trace, model), scatter, diagnoses, replay, len(repeats),
                      (*trace.notes, *([doubtful] if doubtful and verdict != "CANNOT_TELL" else []),
                       *_list_notes(floor, left_out, replay, trace, off_alone)))


def find_rows_off_alone(residual: Columns, repeats: Sequence[Columns], floor: Mapping[str, Floor]) -> Flags:
    """Rows, (n,), in which the run is off and a repeat is at the floor: it made a stop, or missed one, by a hair.

    A model that lacks physics is off in every run. Where a repeat has no data, nothing is known about it.
    """
    if not repeats:
        return np.zeros(len(next(iter(residual.values()))), bool)

    rows = min(len(next(iter(columns.values()))) for columns in (residual, *repeats))

    def measure_known_power(other: Columns) -> Floats:
        x = np.array([other.get(name, np.full(rows, np.nan))[:rows] / floor[name].value for name in residual])
        share = measure_window_power((~np.isnan(x)).astype(float))
        power = measure_window_power(np.nan_to_num(x)) / np.maximum(share, 1.0 / rows)
        usual = np.median(share, axis=1, keepdims=True)  # a signal may be sampled in few rows
        return np.where(share > 0.5 * usual, power, np.inf)

    scaled_residual = np.nan_to_num(np.array([values / floor[name].value for name, values in residual.items()]))
    best = np.min([measure_known_power(other).max(axis=0) for other in repeats], axis=0)
    is_off = extend_until_noise(measure_window_power(scaled_residual).max(axis=0) > RUN_IS_OFF, scaled_residual)
    is_off[:rows] &= best <= RUN_FITS
    is_off[rows:] = False
    return is_off


def _measure_signal(signal: Signal, residual: Floats, floor: Floor, noise: Floor, loop_residual: Floats,
                    replay: Replay) -> SignalError:
    samples = int((~np.isnan(residual)).sum())
    ratio_spread = 1.0 / math.sqrt(max(1.0, samples * floor.freedom))  # of two RMS values of so many samples each
    return SignalError(signal, rms(residual), floor, noise.value, rms(loop_residual), replay.solver_error[signal.name],
                       SIGNAL_ERROR_RATIO + 3 * ratio_spread)


def _align_delays(trace: Trace, model: Model, answer: ControllerBlock) -> tuple[Trace, ControllerBlock]:
    """Columns that are cycles late in the file, set right; a firmware that answers late stays as it is."""
    com, xj = answer.com_lag, answer.xj_lag
    drive, sensed = trace.declared.drive.symbol, trace.declared.controlled.symbol
    notes = []
    if xj:
        aligned_trace = trace.with_inputs(drive=shift_rows(trace.drive, -xj))
        if measure_misfit(aligned_trace, model) < measure_misfit(trace, model) + math.log(LAG_MISFIT_RATIO):
            trace, com = aligned_trace, com - xj
            notes.append(f"{drive} stands {_describe_cycles(xj)} than the other columns: moved into step")
        else:
            notes.append(f"{drive} fits the {sensed} {_describe_cycles(-xj)}: the firmware answers late, "
                         f"or {sensed} is delayed on its way")
    if com:
        trace = trace.with_inputs(command=shift_rows(trace.command, com))
        command = trace.declared.command.symbol
        notes.append(f"{command} stands {_describe_cycles(-com)} than the rest of the trace: moved into step")
    return trace.with_notes(*notes), answer


def _describe_cycles(n: int) -> str:
    return f"{count_nouns(abs(n), 'cycle')} {'later' if n > 0 else 'earlier'}"


def _judge_blocks(trace: Trace, model: Model, run: Columns, repeats: Sequence[tuple[Trace, Columns]],
                  table: Mapping[str, SignalError], answer: ControllerBlock,
                  noise: Mapping[str, Floor]) -> tuple[dict[str, float | None], dict[str, float | None]]:
    """Ratios of the blocks, None where nothing measured can tell, and the parts of those that have some.

    A plant that declares no balances is one block, as wrong as its worst signal; its sensors cannot be told from it.
    """
    signal = {name: s.ratio for name, s in table.items()}
    ratios = {"controller": answer.ratio if math.isfinite(answer.error) else None}
    if not model.kind.balances:
        return ratios | {"plant": max(signal.values()), "sensors": None}, dict.fromkeys(("flow", "force", "gain"))
    block_ratios, parts = judge_blocks(trace, model, run, repeats, signal, noise)
    return ratios | block_ratios, parts


def _list_blocks_above(ratios: Mapping[str, float | None], table: Mapping[str, SignalError]) -> tuple[str, ...]:
    limits = {"controller": CONTROLLER_ERROR_RATIO, "plant": max((s.limit for s in table.values()), default=math.inf)}
    over = [(ratio, name) for name, ratio in ratios.items()
            if ratio is not None and ratio > limits.get(name, BLOCK_ERROR_RATIO)]
    return tuple(name for _, name in sorted(over, reverse=True))


def _decide_verdict(table: Mapping[str, SignalError], sections: Sequence[Place], ratios: Mapping[str, float | None],
                    replay: Replay, undecided_share: float, period: float, doubtful: str) -> tuple[str, str]:
    """The verdict, and why it cannot tell; `doubtful` says why the repeats are no measure of the noise."""
    if coarse := [s.signal.name for s in table.values() if s.solver_error > SOLVER_HIDES_RATIO * s.floor.value]:
        return "CANNOT_TELL", f"the solver's own error in {', '.join(coarse)} is as large as the floor"
    above = [s for s in table.values() if s.ratio > s.limit]
    least = min((s.floor.freedom for s in table.values()), default=1.0)

    # what a drive that was not recorded leaves open is no noise: it gathers in the fast sections, and hides errors
    is_open_alike = all(replay.blind[name] < 0.5 * s.floor.value for name, s in table.items())
    local = [p for p in sections if is_open_alike and p.ratio > SIGNAL_ERROR_RATIO + SECTION_ERROR_SD / math.sqrt(
        max(1.0, 2 * least * (p.t1 - p.t0) / period))]
    is_hidden = not is_open_alike and any(
        s.error > s.limit * s.sensor_noise
        and s.floor.value > (REPEAT_FLOOR_RATIO if s.floor.source == "repeats" else 1.0) * s.sensor_noise
        for s in table.values())
    open_doubt = "rows of the current were not recorded, and the error may be what they leave open"
    if not (above or local or _list_blocks_above(ratios, table)):
        apart = _list_apart((s.signal, s.floor) for s in table.values())
        if apart and not doubtful:
            doubtful = (f"the model fits this trace but not its repeat: they differ by more than noise "
                        f"({apart} noise floors). Use repeats of the same unit")
        doubtful = doubtful or (open_doubt if is_hidden else "")
        return ("CANNOT_TELL", doubtful) if doubtful else ("WITHIN_FLOOR", "")
    doubt = ""
    if any(s.floor.lower_bound for s in table.values()):
        doubt = "without a repeat the floor is only a lower bound, and the error is not far above it"
    elif not is_open_alike:
        doubt = open_doubt
    elif undecided_share > UNDECIDED_SHARE:
        doubt = f"{100 * undecided_share:.0f} % of the trace {_describe_cause(replay)}"
    is_sure = any(s.ratio > LOWER_BOUND_ERROR_RATIO or (is_open_alike and undecided_share <= UNDECIDED_SHARE
                                                        and not s.floor.lower_bound) for s in above)
    is_open = doubt and not is_sure and (ratios["controller"] or 0.0) <= CONTROLLER_ERROR_RATIO
    return ("CANNOT_TELL", doubt) if is_open else ("MODEL_INCOMPLETE", "")


def _list_notes(floor: Mapping[str, Floor], left_out: Flags, replay: Replay, trace: Trace, off_alone: Flags
                ) -> Iterator[str]:
    """What a reader must know about the floor and about rows left out."""
    yield from (f"{name} of the model passes the sensor of the trace: "
                f"{sensor.describe(trace.period, trace.units[name])}"
                for name, sensor in trace.sensors.items() if name in trace.outputs)
    if trace.filtered:
        yield f"flow and force are not balanced: {', '.join(trace.filtered)} is filtered by its sensor"
    if apart := _list_apart((trace.declared.find(name), f) for name, f in floor.items()):
        yield f"the error differs between the repeats, as with stick-slip: {apart} noise floors"
    if left_out.any():
        seconds, alone = (float(rows.sum()) * trace.period for rows in (left_out & ~off_alone, off_alone))
        if seconds:
            yield (f"{seconds:.1f} s are not judged: whether the {trace.declared.controlled.phrase} stops "
                   f"{_describe_cause(replay)}")
        if alone:
            yield f"{alone:.1f} s are not judged: this run is off there, and a repeat is at the noise floor"


def _list_apart(floors: Iterable[tuple[Signal, Floor]]) -> str:
    """The signals in which the repeats differ by more than the floor, and by how much; "" for none."""
    return ", ".join(f"{signal.symbol} by {floor.difference / floor.value:.2g}" for signal, floor in floors
                     if floor.source == "repeats" and floor.difference > REPEAT_DIFFERENCE_RATIO * floor.value)


def _describe_cause(replay: Replay) -> str:
    guessed = " or on current that was not recorded" if any(replay.blind.values()) else ""
    return f"hangs there on less than 0.1 % of a friction level{guessed}"
