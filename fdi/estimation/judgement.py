"""What fitted models leave of all of a recording, and where: piece after piece, so that memory does not grow."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fdi.estimation.driven import replay_in_turns
from fdi.estimation.fit import Fit
from fdi.estimation.likelihood import BLOCK, Problem, limit_dynamic_friction, remove_mains, sum_blocks
from fdi.thresholds import RESIDUAL_HELD_OUT
from fdi.trace.trace import Trace
from plant.lanes import Lanes

Floats = NDArray[np.float64]

TURN = 20_000  # rows


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
        found = {}
        for name, squares, n in zip(self.outputs, self.blocks, self.count, strict=True):
            full = n > 0.5 * BLOCK
            means = np.sort(squares[full] / n[full])
            kept = means[:max(1, round(share * len(means)))]
            found[name] = float(np.sqrt(kept.mean())) / floor[name] if len(kept) else 0.0
        return found

    def find_worst_piece(self, floor: Mapping[str, float], rows: int, apart: Sequence[tuple[int, int]]
                         ) -> tuple[int, int] | None:
        """The piece of so many `rows` with the largest typical ratio, but for the pieces `apart`; None: none left."""
        size = rows // BLOCK
        scale = np.array([floor[name] for name in self.outputs])[:, None] ** 2
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.where(self.count > 0.5 * BLOCK, self.blocks / self.count / scale, np.nan)
        pieces = ratio[:, :ratio.shape[1] // size * size].reshape(len(self.outputs), -1, size)
        typical = np.nan_to_num(np.median(pieces, axis=-1), nan=0.0).max(axis=0)
        for first, stop in apart:
            typical[first // rows:-(-stop // rows)] = 0.0
        k = int(np.argmax(typical)) if len(typical) else 0
        return (k * rows, (k + 1) * rows) if len(typical) and typical[k] > RESIDUAL_HELD_OUT**2 else None


def judge_on_all(problem: Problem, fits: Sequence[Fit], trace: Trace, steps: int) -> list[Judgement]:
    """What each fit leaves of a whole recording `trace`, replayed with `steps` a cycle, side by side."""
    names = list(dict.fromkeys(f.name for fit in fits for f in fit.free))
    found = [dict(zip((f.name for f in fit.free), problem.convert_unknowns(fit.free, fit.x[None])[0], strict=True))
             for fit in fits]
    values = np.array([[own.get(name, problem.model[name]) for name in names] for own in found])
    lanes = Lanes(problem.model, names, steps)
    period, outputs = trace.period, trace.output_columns
    squares, counts = [], []
    turns = replay_in_turns(lanes, limit_dynamic_friction(names, values), trace, trace.position, problem.anchor, TURN)
    for first, out in turns:
        seen = trace.measurements[:, first:first + TURN]
        left = out.transpose(0, 2, 1)[:, outputs] - seen
        if seen.shape[1] > BLOCK:
            left = remove_mains(left, period)
        squares.append(sum_blocks(np.nan_to_num(left)))
        counts.append(sum_blocks((~np.isnan(seen)).astype(float)))
    blocks, count = np.concatenate(squares, axis=-1), np.concatenate(counts, axis=-1)
    return [Judgement(trace.outputs, own, count) for own in blocks]
