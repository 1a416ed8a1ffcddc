"""Model against measurement: how large the error is beside what noise explains, where, when, and in which block."""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fdi.comparison import blocks
from fdi.comparison.blocks import ControllerBlock
from fdi.comparison.residuals import (
    Motion,
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
    sensor_floors,
    simulate_reading_noise,
)
from fdi.estimation.replay import (
    Columns,
    Repeat,
    Replay,
    Scatter,
    align_columns,
    compute_residuals,
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
    CONTROLLER_ERROR_RATIO,
    LAG_MISFIT_RATIO,
    LOWER_BOUND_ERROR_RATIO,
    REPEAT_DIFFERENCE_RATIO,
    SECTION_ERROR_SD,
    SIGNAL_ERROR_RATIO,
    SOLVER_HIDES_RATIO,
    SPOOL_FITS_RATIO,
    UNDECIDED_SHARE,
)
from fdi.trace.signals import SIGNALS
from fdi.trace.trace import Floats, Trace, rms
from plant.model import Model

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
    motion: Motion
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
    trace, found = _align_delays(trace, model, blocks.compare_controller(trace, model))
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
                      tuple(sections), when, free, speed, scattered, diagnoses, replay, m, closed, len(others),
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
    j = blocks.Jack()
    # the balances of flow and force take the measured signals as the true ones
    if model.plant == BALANCED and {"p12", "xs"} & set(trace.outputs) and not trace.filtered:
        j = blocks.judge_jack(trace, model, run, pairs, level)
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

