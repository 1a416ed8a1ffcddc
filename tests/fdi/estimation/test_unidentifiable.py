"""Flat directions: which trial replays confirm them."""
from __future__ import annotations

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from fdi.estimation.unidentifiable import TRIED, TRIED_SHARES, confirm_flat

Floats = NDArray[np.float64]


class SteppedResiduals:
    """Residuals (m, 1, 2) that a second unknown moves, and that jump once the first one passes 0.005."""

    def compute_white_residuals(self, free: object, x: Floats) -> Floats:
        """Whitened residuals of scaled unknowns (m, 2)."""
        return np.stack([10.0 * (x[:, 0] > 0.005), 1e5 * x[:, 1]], axis=-1)[:, None, :]


def confirm(is_tried: NDArray[np.bool_]) -> list[bool]:
    """`confirm_flat` along both unknowns, with a misfit of one allowed."""
    trials = np.array([TRIED * share * np.eye(2) for share in TRIED_SHARES])
    problem = cast(Any, SteppedResiduals())
    return [bool(flat) for flat in confirm_flat(problem, (), np.zeros(2), trials, is_tried, 1.0)]


def test_a_jump_in_one_trial_does_not_hide_a_flat_direction() -> None:
    assert confirm(np.ones((4, 2), bool)) == [True, False]


def test_a_direction_whose_only_trials_jump_or_are_stopped_by_a_bound_is_not_confirmed() -> None:
    is_tried = np.zeros((4, 2), bool)
    assert confirm(is_tried) == [False, False]
    is_tried[0] = True  # the full length forwards, where the jump is
    assert confirm(is_tried) == [False, False]


def test_each_direction_may_have_its_own_limit() -> None:
    problem, trials = cast(Any, SteppedResiduals()), np.array([TRIED * share * np.eye(2) for share in TRIED_SHARES])
    limits = np.array([1.0, 2.1e6])
    assert confirm_flat(problem, (), np.zeros(2), trials, np.ones((4, 2), bool), limits).tolist() == [True, True]
    assert confirm_flat(problem, (), np.zeros(2), trials, np.ones((4, 2), bool), limits[::-1]).tolist() == [True, False]
