"""The last rounds of a fit: their covariance."""
from __future__ import annotations

import numpy as np
import pytest

from fdi.estimation.final_rounds import invert_hessian


@pytest.mark.parametrize("steep", [1e6, 1e15, 1e18])
def test_a_steep_slope_leaves_what_only_a_prior_holds_as_wide_as_the_prior(steep: float) -> None:
    """Two unknowns that make up for each other, each with a prior of one; a third one with an enormous slope."""
    slopes = np.array([[1e3, -1e3, 0.0], [0.0, 0.0, np.sqrt(steep)]])
    covariance = invert_hessian(slopes.T @ slopes + np.diag([1.0, 1.0, 0.0]))
    assert covariance[0, 0] == pytest.approx(0.5, rel=1e-3)  # both priors count along their common direction
    assert covariance[2, 2] == pytest.approx(1.0 / steep, rel=1e-3)


def test_a_direction_that_nothing_holds_gets_no_width() -> None:
    assert invert_hessian(np.diag([4.0, 0.0])).tolist() == [[0.25, 0.0], [0.0, 0.0]]
