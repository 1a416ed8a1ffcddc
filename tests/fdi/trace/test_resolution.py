"""How finely a column was recorded: its digits, its comb, and what rounding leaves of an answer."""
from __future__ import annotations

import numpy as np
import pytest

from fdi.trace.sensor_dynamics import find_comb, is_rounding_left, measure_resolution


def test_resolution_of_a_column() -> None:
    rng = np.random.default_rng(0)
    assert measure_resolution(np.round(rng.standard_normal(1000), 3)) == pytest.approx(1e-3, rel=0.01)
    assert measure_resolution(np.round(rng.standard_normal(1000) * 1e5) * 1e-8) == pytest.approx(1e-8, rel=0.01)
    six = np.array([float(f"{x:.5e}") for x in rng.uniform(1, 9, 1000)])
    assert measure_resolution(six) == pytest.approx(1e-5, rel=0.01)
    assert measure_resolution(rng.standard_normal(1000)) < 1e-10
    assert measure_resolution(np.tile([5e-3, -5e-3], 500)) == 0.0


def test_a_comb_is_found_to_a_part_in_ten_thousand() -> None:
    x = np.random.default_rng(1).standard_normal(3000)
    found = find_comb(0.073 * np.round(x / 0.073))
    assert found is not None and found.step == pytest.approx(0.073, rel=1e-4)
    assert find_comb(x) is None and find_comb(np.round(x / 0.073) * 0.073, finest=0.1) is None
    assert find_comb(np.array([0.0, 1.0, np.nan])) is None


def test_rounding_leaves_half_a_step_at_most_and_not_much_less() -> None:
    rng = np.random.default_rng(2)
    left = rng.uniform(-0.5, 0.5, 5000)
    assert is_rounding_left(left, 1.0, 0.01)
    assert not is_rounding_left(3.0 * left, 1.0, 0.01)  # another firmware
    assert not is_rounding_left(0.01 * left, 1.0, 0.01)  # the steps themselves went in
    assert not is_rounding_left(np.full(3, np.nan), 1.0, 0.01)
