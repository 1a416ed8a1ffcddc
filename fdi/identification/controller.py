"""The gain and the limit of a position controller, read off its recorded answers, which hold no noise."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fdi.trace.trace import Trace

GAIN, LIMIT = "controller.proportional_gain", "controller.current_limit"


class ControllerGains(NamedTuple):
    """The proportional law, answer = gain * error up to a limit, and how well it holds."""

    gain: float  # A/m
    limit: float | None  # A; None where the answer never stayed at its largest value
    exact: float  # share of the rows in which it holds

    @property
    def is_proportional(self) -> bool:
        """Whether this is the law: else the gains of the model are left alone."""
        return self.exact > 0.95

    @property
    def values(self) -> Mapping[str, float]:
        """Parameters of the model, SI; none if this is not the law."""
        if not self.is_proportional:
            return {}
        return {GAIN: self.gain} | ({} if self.limit is None else {LIMIT: self.limit})


def read_controller(runs: Sequence[Trace], tolerance: float = 1e-3, fewest_rows: int = 20) -> ControllerGains | None:
    """The law of the controller that was at work in some runs; None where its error or its answer is always zero.

    Args:
        runs: with Com, XJ and Cor.
        tolerance: of an answer, as a share of the largest one, up to which the law holds.
        fewest_rows: at the largest answer, from which on that is the limit.
    """
    error = np.concatenate([t.com - t.xj for t in runs])
    answer = np.concatenate([t.cor for t in runs])
    known = np.isfinite(error) & np.isfinite(answer)
    error, answer = error[known], answer[known]
    largest = float(np.abs(answer).max(initial=0.0))
    inside = (np.abs(answer) < 0.99 * largest) & (np.abs(error) > 0.0) & (np.abs(answer) > 0.0)
    if not inside.any():
        return None
    ratio = answer[inside] / error[inside]
    weight = np.abs(error[inside])
    order = np.argsort(ratio)
    middle = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())
    gain = float(ratio[order][middle])
    left = np.abs(answer - np.clip(gain * error, -largest, largest))
    at_limit = int((np.abs(answer) > (1.0 - 1e-9) * largest).sum())
    return ControllerGains(gain, largest if at_limit >= fewest_rows else None,
                           float((left <= tolerance * largest).mean()))
