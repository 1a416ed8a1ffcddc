"""The last rounds of a fit: their covariance, and what they replay."""
from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from fdi.estimation.fit import DAMPINGS, Fit
from fdi.estimation.likelihood import Free
from fdi.estimation.unidentifiable import finish_fit, invert_hessian
from fdi.trace.trace import Floats


class CurvedProblem:
    """Residuals (m, 1, 200) that curve with three unknowns, none of which the data leave open; counts its replays."""

    model = SimpleNamespace(plant="curve")

    def __init__(self) -> None:
        self.slopes = np.random.default_rng(0).standard_normal((3, 200))
        self.replays: list[int] = []  # number of rows in each

    def compute_residuals(self, free: object, x: Floats) -> Floats:
        """Residuals of scaled unknowns (m, 3)."""
        self.replays.append(len(x))
        return (np.expm1(x) @ self.slopes - 0.5 * self.slopes.sum(axis=0))[:, None, :]

    def whiten_residuals(self, residuals: Floats) -> Floats:
        """The residuals are white."""
        return residuals

    def compute_white_residuals(self, free: object, x: Floats) -> Floats:
        """Residuals of scaled unknowns (m, 3)."""
        return self.compute_residuals(free, x)


def begin_fit() -> Fit:
    """A fit at zero whose residuals and cost are not yet known."""
    free = tuple(Free(name, 0.0, 1.0, 1.0, -9.0, 9.0, 0.1) for name in "abc")
    return Fit(free, np.zeros(3), np.inf, np.inf, 0.01 * np.eye(3), np.empty((1, 0)), np.empty((1, 0)),
               np.empty((3, 1, 0)))


def test_no_round_replays_a_point_whose_residuals_are_known() -> None:
    problem = CurvedProblem()
    found = finish_fit(cast(Any, problem), begin_fit(), rounds=2)
    assert problem.replays == [1, 3, len(DAMPINGS), 3, len(DAMPINGS)]  # the start; in a round differences and trials
    assert found.residuals == pytest.approx(problem.compute_residuals(found.free, found.x[None])[0])
    assert found.x == pytest.approx(np.log(1.5), abs=0.02)


def test_differences_of_coarser_steps_have_their_own_point() -> None:
    fine, coarse = CurvedProblem(), CurvedProblem()
    finish_fit(cast(Any, fine), begin_fit(), rounds=2, slopes=cast(Any, coarse))
    assert fine.replays == [1, len(DAMPINGS), len(DAMPINGS)] and coarse.replays == [4, 4]


@pytest.mark.parametrize("steep", [1e6, 1e15, 1e18])
def test_a_steep_slope_leaves_what_only_a_prior_holds_as_wide_as_the_prior(steep: float) -> None:
    """Two unknowns that make up for each other, each with a prior of one; a third one with an enormous slope."""
    slopes = np.array([[1e3, -1e3, 0.0], [0.0, 0.0, np.sqrt(steep)]])
    covariance = invert_hessian(slopes.T @ slopes + np.diag([1.0, 1.0, 0.0]))
    assert covariance[0, 0] == pytest.approx(0.5, rel=1e-3)  # both priors count along their common direction
    assert covariance[2, 2] == pytest.approx(1.0 / steep, rel=1e-3)


def test_a_direction_that_nothing_holds_gets_no_width() -> None:
    assert invert_hessian(np.diag([4.0, 0.0])).tolist() == [[0.25, 0.0], [0.0, 0.0]]
