"""Recordings too long to be fitted whole: fits take the part that says most, and are judged on all of the recording.

A fit makes hundreds of replays. Thirty minutes of recording say little more than the best fifteen seconds of them, so
fits are made with an excerpt, the pieces that say most about what is unknown. What a fit leaves of all of the recording
is counted piece after piece, so that memory does not grow.

Which seconds are best is asked of the model: one replay of the whole recording with a few steps a cycle, and one more
for each unknown, side by side, tell how far each unknown moves each signal in each piece. Pieces are taken one after
the other, each time the one with which the determinant of the information matrix grows most (a D-optimal design: V. V.
Fedorov, "Theory of Optimal Experiments", 1972). One more piece is taken where the model fits worst: what is missing may
act there alone.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fdi.estimation.fit import (
    BLOCK,
    Fit,
    Problem,
    limit_dynamic_friction,
    list_tolerance_sizes,
    sum_blocks,
)
from fdi.estimation.mains import remove_mains
from fdi.progress import Progress, ignore_progress
from fdi.thresholds import ANCHOR_RATE, RESIDUAL_HELD_OUT
from fdi.trace import Flags, Floats, Trace
from plant import Lanes, Model, Part
from plant.lanes import TURN

LONGEST_WHOLE = 30.0  # s; a shorter recording is fitted whole: the best pieces of it are more than half of it
PIECE = 3.0  # s
PIECES = 3  # for information
LEAD_IN = 1.0  # s before a piece, in which a replay that is drawn to the measured position forgets how it began
SHORT_LEAD_IN = 3.0  # s; pieces that need a longer one are taken only where there are no others
INFORMATION_STEPS = 5  # a cycle: what matters is where an unknown acts, not how much exactly
LARGEST_SHIFT = 10.0  # floors: more is a single stop of the ram, made or missed
SENSOR_MEMORY = 2000  # rows after which a sensor has forgotten what it was shown


def is_long(trace: Trace) -> bool:
    """Whether a recording is longer than fits need."""
    return len(trace) * trace.period > LONGEST_WHOLE


def can_be_cut(trace: Trace, model: Model) -> bool:
    """Whether fits of a recording may be made with an excerpt: it is long, and no forces are computed from its rows."""
    return is_long(trace) and not _is_driven_by_pressures(trace, model)


def _is_driven_by_pressures(trace: Trace, model: Model) -> bool:
    """Whether the position is predicted from measured chamber pressures."""
    return trace.chambers is not None and model.kind.measured_pressures is not None


def replay_in_turns(lanes: Lanes, values: Floats, trace: Trace, rows: int = TURN, position: Floats | None = None
                    ) -> Iterator[tuple[int, Floats]]:
    """The outputs as the sensors of the trace show them, so many `rows` at a time: the first row, (m, k, outputs).

    Memory does not grow with the recording, unless the position is predicted from measured pressures.

    Args:
        lanes: runs of a model.
        values: (m, len(lanes.names)) their parameters, SI.
        trace: a prepared recording.
        rows: of a turn.
        position: (n,), to which the replay is drawn; default: as measured.
    """
    position = trace.anchor if position is None else position
    if _is_driven_by_pressures(trace, lanes.model):
        out = lanes.replay(values, trace.drive, trace.load, position, ANCHOR_RATE, trace.parts, trace.chambers,
                           trace.slack)
        whole = trace.pass_sensors(out)
        yield from ((first, whole[:, first:first + rows]) for first in range(0, len(trace), rows))
        return
    memory = np.empty((len(values), 0, len(trace.output_names)))  # what a filtering sensor remembers
    turns = lanes.replay_in_turns(values, trace.drive, trace.load, position, ANCHOR_RATE, rows, trace.slack)
    for first, out in turns:
        if not trace.sensors:
            yield first, out
            continue
        history = np.concatenate([memory, out], axis=1)
        yield first, trace.pass_sensors(history)[:, memory.shape[1]:]
        memory = history[:, -SENSOR_MEMORY:]


class Excerpt(NamedTuple):
    """Pieces of a recording as rows (first, stop), in order of time, without their lead-ins."""

    pieces: tuple[tuple[int, int], ...]

    def describe(self, trace: Trace) -> str:
        """In words, for the recording `trace` that it was chosen from."""
        times = [f"{trace.t[first]:.4g} to {trace.t[stop - 1] + trace.period:.4g} s" for first, stop in self.pieces]
        seconds = sum(stop - first for first, stop in self.pieces) * trace.period
        whole = len(trace) * trace.period
        return (f"fitted to {seconds:.3g} s of {whole:.4g} s, the part that says most about the "
                f"unknowns ({', '.join(times)}); judged on all of it")


def choose_excerpt(trace: Trace, model: Model, floor: Mapping[str, float], changes: Iterable[Mapping[str, float]] = (),
                   progress: Progress = ignore_progress) -> Excerpt:
    """The pieces of a prepared recording to fit.

    Args:
        trace: a prepared recording.
        model: with every effect that `changes` name, at off values, without sensor noise.
        floor: RMS noise of each output, SI.
        changes: parameters of what is unknown beside the tolerances, a mapping for each unknown.
        progress: called with the stage and the share done.
    """
    rows = round(PIECE / trace.period)
    starts = np.arange(0, len(trace) - rows + 1, rows)
    information, misfit, shares = _measure_information(trace, model, floor, list(changes), rows, len(starts),
                                                       progress)
    is_full = shares >= 0.5 * shares.max()  # of rows that come every few cycles, not every one is measured
    leads = np.array([first - _find_lead_in(trace, first) for first in starts.tolist()])
    is_near = leads <= SHORT_LEAD_IN / trace.period
    if (is_full & is_near).sum() > 2 * PIECES:
        is_full &= is_near
    pieces = _choose_pieces(information, is_full)
    rest = np.where(is_full, misfit, -np.inf)
    rest[pieces] = -np.inf
    if np.isfinite(rest).any():
        pieces.append(int(np.argmax(rest)))
    return make_excerpt((int(starts[k]), int(starts[k]) + rows) for k in pieces)


def make_excerpt(pieces: Iterable[tuple[int, int]]) -> Excerpt:
    """An excerpt of these rows; pieces that touch are joined."""
    spans: list[tuple[int, int]] = []
    for first, stop in sorted(set(pieces)):
        if spans and first <= spans[-1][1]:
            spans[-1] = (spans[-1][0], max(stop, spans[-1][1]))
        else:
            spans.append((first, stop))
    return Excerpt(tuple(spans))


def _measure_information(trace: Trace, model: Model, floor: Mapping[str, float], changes: Sequence[Mapping[str, float]],
                         rows: int, count: int, progress: Progress) -> tuple[Floats, Floats, Floats]:
    """Information of the unknowns in each piece (q, d, d), the model's squared misfit (q,), share measured (q,)."""
    tolerances = list_tolerance_sizes(model)
    names = list(dict.fromkeys([*tolerances, *(name for change in changes for name in change)]))
    base = np.array([model[name] for name in names])
    variants = [{name: model[name] + size} for name, size in tolerances.items()] + list(changes)
    table = np.array([base, *([change.get(n, v) for n, v in zip(names, base, strict=True)] for change in variants)])
    lanes = Lanes(model, names, INFORMATION_STEPS)
    scale = 1.0 / np.array([floor[name] for name in trace.outputs])
    information, misfit = np.zeros((count, len(variants), len(variants))), np.zeros(count)
    shares = np.zeros(count)
    turns = replay_in_turns(lanes, limit_dynamic_friction(names, table), trace, rows)
    for k, (first, out) in enumerate(turns):
        if k >= count:
            break
        progress("choosing the part to fit", k / count)
        measurements = trace.measurements[:, first:first + rows]
        is_measured = ~np.isnan(measurements)
        predictions = out.transpose(0, 2, 1)[:, trace.output_columns]
        shift = np.where(is_measured, (predictions[1:] - predictions[0]) * scale[:, None], 0.0)
        shift = np.clip(shift, -LARGEST_SHIFT, LARGEST_SHIFT)[:, :, ::2].reshape(len(variants), -1)
        information[k] = shift @ shift.T
        residuals = np.where(is_measured, (predictions[0] - measurements) * scale[:, None], 0.0)
        misfit[k] = float(np.minimum(residuals**2, LARGEST_SHIFT**2).sum()) / max(int(is_measured.sum()), 1)
        shares[k] = is_measured.mean()
    return information, misfit, shares


def _choose_pieces(information: Floats, is_full: Flags) -> list[int]:
    """The pieces that together say most, the first first."""
    alike = 20.0  # neighbouring samples that say the same thing
    total, pieces = np.eye(information.shape[1]), list[int]()
    for _ in range(min(PIECES, int(is_full.sum()))):
        gains = np.where(is_full, np.linalg.slogdet(total + information / alike)[1], -np.inf)
        gains[pieces] = -np.inf
        pieces.append(int(np.argmax(gains)))
        total = total + information[pieces[-1]] / alike
    return pieces


def cut_excerpt(trace: Trace, excerpt: Excerpt) -> Trace:
    """The pieces of a prepared recording one after the other, each with a lead-in that is not compared with anything.

    A piece keeps its times. Rows that the recording does not have, as of a shorter repeat, are left out.
    """
    ranges, parts, rows = list[tuple[int, int, int]](), [], 0
    for first, stop in excerpt.pieces:
        begin, stop = max(_find_lead_in(trace, first), ranges[-1][2] if ranges else 0), min(stop, len(trace))
        measured_rows = np.flatnonzero(~np.isnan(trace.controlled[begin:stop]))
        if not len(measured_rows):
            continue
        begin += int(measured_rows[0])  # a replay starts where the ram was seen
        ranges.append((begin, max(first, begin), stop))
        parts.append(Part(rows, rows + stop - begin, begin - rows))
        rows += stop - begin
    places = np.concatenate([np.arange(begin, stop) for begin, _, stop in ranges])
    is_lead_in = np.concatenate([np.arange(begin, stop) < first if begin else np.zeros(stop, bool)
                                 for begin, first, stop in ranges])
    return trace.take_rows(places, usable=trace.usable[places] & ~is_lead_in,
                           incomplete=trace.incomplete[places] | is_lead_in, parts=tuple(parts))


def _find_lead_in(trace: Trace, first: int, wide: float = 0.5, longest: float = 20.0) -> int:
    """The row at which the lead-in of a piece begins: so far back that the valve has moved widely by the `first` row.

    A spool that friction holds remembers where it came to rest until the next wide movement. The current must have
    gone through the `wide` part of its usual range, within the `longest` time, s.
    """
    usual = float(np.subtract(*np.percentile(trace.drive[::10], (99.0, 1.0))))
    step = round(LEAD_IN / trace.period)
    begin = first
    while begin > 0 and (first - begin) * trace.period < longest:
        begin = max(begin - step, 0)
        if float(np.ptp(trace.drive[begin:first])) >= wide * usual:
            return max(begin - step, 0) if first - begin < 2 * step else begin
    return begin


@dataclass(frozen=True, eq=False)
class Judgement:
    """What one model leaves of a whole recording."""

    outputs: tuple[str, ...]
    blocks: Floats  # (s, b) sums of squared residuals over blocks, SI
    count: Floats  # (s, b) measured samples in each

    @property
    def errors(self) -> dict[str, float]:
        """RMS residual of each signal, SI."""
        return {name: float(np.sqrt(squares.sum() / max(n.sum(), 1.0)))
                for name, squares, n in zip(self.outputs, self.blocks, self.count, strict=True)}

    def holds(self, floor: Mapping[str, float]) -> bool:
        """Whether only noise is left in the typical block, as on a held-out run."""
        return all(x <= RESIDUAL_HELD_OUT for x in self.typical_ratio(floor).values())

    def typical_ratio(self, floor: Mapping[str, float], share: float = 0.85) -> dict[str, float]:
        """RMS residual over the floor, without the worst blocks: a stop that is made or missed by a hair is luck."""
        ratios = {}
        for name, squares, n in zip(self.outputs, self.blocks, self.count, strict=True):
            is_full = n > 0.5 * n.max()
            means = np.sort(squares[is_full] / n[is_full])
            typical_means = means[:max(1, round(share * len(means)))]
            ratios[name] = float(np.sqrt(typical_means.mean())) / floor[name] if len(typical_means) else 0.0
        return ratios

    def find_worst_piece(self, floor: Mapping[str, float], rows: int, apart: Sequence[tuple[int, int]]
                         ) -> tuple[int, int] | None:
        """The piece of so many `rows` with the largest typical ratio, but for the pieces `apart`; None: none left."""
        size = rows // BLOCK
        scale = np.array([floor[name] for name in self.outputs])[:, None] ** 2
        with np.errstate(invalid="ignore", divide="ignore"):
            is_full = self.count > 0.5 * self.count.max(axis=-1, keepdims=True)
            ratio = np.where(is_full, self.blocks / self.count / scale, np.nan)
        pieces = ratio[:, :ratio.shape[1] // size * size].reshape(len(self.outputs), -1, size)
        typical = np.nan_to_num(np.median(pieces, axis=-1), nan=0.0).max(axis=0)
        for first, stop in apart:
            typical[first // rows:-(-stop // rows)] = 0.0
        k = int(np.argmax(typical)) if len(typical) else 0
        return (k * rows, (k + 1) * rows) if len(typical) and typical[k] > RESIDUAL_HELD_OUT**2 else None


def judge_on_all(problem: Problem, fits: Sequence[Fit], trace: Trace, steps: int) -> list[Judgement]:
    """What each fit leaves of a whole recording `trace`, replayed with `steps` a cycle, side by side."""
    names = list(dict.fromkeys(f.name for fit in fits for f in fit.free))
    fit_values = [dict(zip((f.name for f in fit.free), problem.convert_unknowns(fit.free, fit.x[None])[0], strict=True))
                  for fit in fits]
    values = np.array([[parameters.get(name, problem.model[name]) for name in names] for parameters in fit_values])
    lanes = Lanes(problem.model, names, steps)
    squares, counts = [], []
    turns = replay_in_turns(lanes, limit_dynamic_friction(names, values), trace)
    for first, out in turns:
        measurements = trace.measurements[:, first:first + out.shape[1]]
        residuals = np.ascontiguousarray(out.transpose(0, 2, 1)[:, trace.output_columns] - measurements)
        if measurements.shape[1] > BLOCK:
            remove_mains(residuals, 0, measurements.shape[1], trace.period, np.full(len(measurements), np.inf))
        squares.append(sum_blocks(np.nan_to_num(residuals)))
        counts.append(sum_blocks((~np.isnan(measurements)).astype(float)))
    blocks, count = np.concatenate(squares, axis=-1), np.concatenate(counts, axis=-1)
    return [Judgement(trace.outputs, sums, count) for sums in blocks]
