"""Statistics against known answers: noise floors, and shares with their exact intervals."""

import math

import numpy as np
import pytest
from noisy_traces import LEVELS, sample_noise
from scipy.stats import binomtest

from fdi.estimation import floor_from_data, measure_share
from fdi.estimation.binomial import clopper_pearson_interval
from fdi.estimation.noise import find_hum_lines, floor_from_repeats

ROWS = 13_500


def pair(seed: int, colour: str, rows: int = ROWS) -> tuple[np.ndarray, np.ndarray]:
    first, second = (sample_noise(2 * seed + number, rows, colour)[:, 0] / LEVELS[0] for number in (0, 1))
    return first, second


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


@pytest.mark.parametrize(("colour", "rows", "scatter"), [
    ("white", ROWS, 0.012), ("white", 2000, 0.03), ("hum", ROWS, 0.025), ("hum", 2000, 0.07)])
def test_a_perfect_model_has_ratio_one(colour: str, rows: int, scatter: float) -> None:
    pairs = [pair(seed, colour, rows) for seed in range(30)]
    ratios = [rms(r) / floor_from_repeats(r, [repeat]).value for r, repeat in pairs]
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.025)
    assert np.std(ratios) < scatter and max(ratios) < 1.02 + 4 * scatter


@pytest.mark.parametrize("colour", ["white", "hum"])
def test_what_the_model_lacks_in_both_runs_is_no_noise(colour: str) -> None:
    r, repeat = pair(0, colour)
    model_error = 20 * np.sin(np.arange(ROWS) / 300)
    assert floor_from_repeats(r + model_error, [repeat + model_error]).value == pytest.approx(1.0, abs=0.06)


@pytest.mark.parametrize(("part", "least"), [(0.3, 0.02), (0.6, 0.05), (0.8, 0.1)])
def test_stick_slip_that_comes_at_other_times_is_no_noise(part: float, least: float) -> None:
    """Errors that differ between the runs, ten times the noise, in 30 to 80 % of the windows."""
    floors = []
    for seed in range(8):
        r, repeat = pair(seed, "white")
        rng = np.random.default_rng(seed)
        events = np.repeat(np.where(rng.random(ROWS // 100) < part, rng.exponential(10, ROWS // 100), 0.0), 100)
        slips = events * np.tanh(np.cumsum(rng.standard_normal(ROWS)) / 20)
        floors.append(floor_from_repeats(r + slips, [repeat - slips]))
    assert np.mean([f.value for f in floors]) == pytest.approx(1.0, abs=least)
    assert floors[0].difference > 3.0 and floors[0].share < 1.05 - 0.6 * part  # told apart from the noise


def test_hum_of_one_phase_is_found_and_counted() -> None:
    """It is in both runs alike, so their difference does not hold it."""
    k = np.arange(ROWS)
    r, repeat = pair(3, "white")
    hum = 0.8 * np.sin(2 * np.pi * 0.05 * k + 1.0)
    floor = floor_from_repeats(r + hum, [repeat + hum])
    assert floor.hum == pytest.approx(0.8 / np.sqrt(2), rel=0.1)
    assert floor.value == pytest.approx(np.hypot(1.0, 0.8 / np.sqrt(2)), rel=0.03)
    fast = r + 0.3 * np.sin(2 * np.pi * 0.4 * k)
    none, one, more = ([f for f, _ in find_hum_lines(runs, 1e-3)]
                       for runs in ([r, repeat], [r + hum, repeat + hum], [fast, fast]))
    assert (none, one) == ([], [50.0]) and 400.0 in more


def test_second_differences_are_a_lower_bound() -> None:
    slow = 1e3 * np.sin(np.arange(ROWS) / 200)
    white, coloured = (sample_noise(5, ROWS, colour)[:, 0] / LEVELS[0] for colour in ("white", "hum"))
    assert floor_from_data(white + slow).value == pytest.approx(1.0, abs=0.05)
    assert floor_from_data(coloured + slow).value < 0.6
    assert floor_from_data(white + 3.0 * np.sin(np.arange(ROWS) * 2.0)).value < 1.2, "a line of 318 Hz is no noise"
    assert floor_from_data(white).lower_bound and floor_from_data(np.array([1.0, 2.0])).value == 0.0


@pytest.mark.parametrize("confidence", [0.95, 0.99])
@pytest.mark.parametrize(("good", "of"), [(0, 10), (10, 10), (7, 33), (198, 200)])
def test_intervals_are_those_of_clopper_and_pearson(good: int, of: int, confidence: float) -> None:
    exact = binomtest(good, of).proportion_ci(confidence, method="exact")
    assert clopper_pearson_interval(good, of, confidence) == pytest.approx((exact.low, exact.high), abs=1e-9)
    share, nothing = measure_share(good, of), measure_share(0, 0)
    assert share == (good, of, *clopper_pearson_interval(good, of, 0.95)) and share.value == good / of
    assert nothing == (0, 0, 0.0, 1.0) and math.isnan(nothing.value)
