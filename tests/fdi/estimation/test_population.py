"""A search by a population on a rough misfit with a known lowest place."""
from __future__ import annotations

import numpy as np
import pytest

from fdi.estimation.fit import evolve_population

LOWEST = np.array([0.4, -1.2, 2.0, 0.0, -0.7, 1.1])
TURN = np.linalg.qr(np.random.default_rng(3).standard_normal((6, 6)))[0]
SCALES = np.array([1.0, 3.0, 10.0, 30.0, 100.0, 300.0])


def measure_costs(x: np.ndarray) -> np.ndarray:
    """A narrow valley across the axes, with ridges 40 high in it: at a far place slopes show the ridges alone."""
    along = (x - LOWEST) @ TURN * SCALES
    costs: np.ndarray = (along**2).sum(axis=1) + 20.0 * (1.0 - np.cos(5.0 * along)).sum(axis=1) / 6.0
    return costs


def search(seed: int, low: float = -5.0, high: float = 5.0) -> tuple[np.ndarray, float]:
    begin = np.zeros(6)
    found = evolve_population(measure_costs, begin, np.eye(6), np.full(6, low), np.full(6, high), 200, seed)
    return found.x, found.cost


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_lowest_place_of_a_rough_valley_is_found(seed: int) -> None:
    x, cost = search(seed)
    assert cost < 10.0 < 0.01 * measure_costs(np.zeros((1, 6)))[0]
    assert cost == pytest.approx(measure_costs(x[None])[0])
    assert np.abs((x - LOWEST) @ TURN * SCALES).max() < 3.0


def test_trials_stay_within_the_bounds() -> None:
    x, _ = search(0, -1.0, 1.0)
    assert np.abs(x).max() <= 1.0 and (np.abs(x) == 1.0).any()


def test_same_seed_gives_the_same_answer() -> None:
    first, again = search(5), search(5)
    assert (first[0] == again[0]).all() and first[1] == again[1]
