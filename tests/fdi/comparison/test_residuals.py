"""Where an error is: sections, conditions, speed, and what a residual goes with, with errors put there."""

import re

import numpy as np
import pytest
from noisy_traces import LEVELS, record_healthy, sample_noise

from fdi.comparison.residuals import (
    WHITE,
    Motion,
    bin_residual,
    correlate_with_input,
    describe_motion,
    examine_residuals,
    find_condition,
    locate_error,
    map_deviation,
    name_shape,
)
from fdi.estimation.replay import read_cycles
from fdi.trace.trace import Trace
from plant import Model

LIMIT = 8e-3


@pytest.fixture(scope="module")
def c() -> Trace:
    return read_cycles(record_healthy(), Model())[0]


@pytest.fixture(scope="module")
def m(c: Trace) -> Motion:
    return describe_motion(c, {"xj": c.xj, "p12": c.p12, "xs": c.xs})


def squares(seed: int, rows: int, extra: np.ndarray) -> np.ndarray:
    return sample_noise(seed, rows)[:, 0] ** 2 / LEVELS[0] ** 2 + extra


@pytest.mark.parametrize(("chosen", "words"), [
    (lambda c, m: np.abs(m.v) > 0.05, "ram faster than 50 mm/s"),
    (lambda c, m: m.reversed_for < 0.02, "within 20 ms after a reversal"),
    (lambda c, m: np.abs(m.others["p12"]) > 1e6, r"\|P12\| above 10 bar"),
    (lambda c, m: np.abs(m.x) > 2e-3, "ram further than 2 mm from the middle"),
    (lambda c, m: np.abs(c.cor) > 0.99 * LIMIT, "current at its limit"),
    (lambda c, m: m.v > 5e-4, "ram extends"),
])
def test_the_condition_is_named(c: Trace, m: Motion, chosen: object, words: str) -> None:
    rows = chosen(c, m)  # type: ignore[operator]
    z2 = squares(1, len(c), np.where(rows, 30.0, 0.0))
    said = find_condition(z2, m, LIMIT)
    assert said.startswith(("100 %", "99 %")) and re.search(words, said), said


def test_noise_and_what_is_everywhere_have_no_condition(c: Trace, m: Motion) -> None:
    nothing = np.zeros(len(c))
    for z2 in (squares(2, len(c), nothing), squares(2, len(c), nothing + 9.0), nothing + np.nan):
        assert find_condition(z2, m, LIMIT) == ""


def test_sections_with_their_shares(c: Trace, m: Motion) -> None:
    z2 = squares(3, len(c), np.where((c.t >= 4.0) & (c.t < 6.0), 50.0, 0.0))
    found = locate_error(c, z2, m, LIMIT)
    worst = found[0]
    assert sum(p.share for p in found) == pytest.approx(1.0, abs=0.01)
    assert worst.section == "ramp at 0.5 mm/s" and (worst.t0, worst.t1) == pytest.approx((4.0, 6.0), abs=2e-3)
    assert worst.share > 0.85 and worst.ratio == pytest.approx(7.1, abs=0.3)
    assert {"motion within 3 mm", "step to 5 mm"} <= {p.section for p in found}


def test_white_noise_stays_within_its_bands(c: Trace, m: Motion) -> None:
    found = [examine_residuals(c, {"xj": sample_noise(seed, len(c))[:, 0]}, {}, m)["xj"]
             for seed in range(100, 120)]  # not that of the trace, whose noise is in its own XJ
    assert sum(d.departs > d.allowed for d in found) <= 4  # 5 %
    assert sum(any(abs(f.correlation) > f.bound for f in d.follows) for d in found) <= 3  # 1 % of two
    assert not any(d.depends and d.depends[0].share > 0.02 for d in found)


def test_coloured_noise_is_white_when_a_repeat_shows_its_colour(c: Trace, m: Motion) -> None:
    r, repeat = (sample_noise(seed, len(c), "hum")[:, 0] for seed in (1, 2))
    alone = examine_residuals(c, {"xj": r}, {}, m)["xj"]
    d = examine_residuals(c, {"xj": r}, {"xj": (r - repeat) / np.sqrt(2)}, m)["xj"]
    assert alone.departs > 5 * alone.allowed and d.departs < 3 * d.allowed
    assert d.memory == pytest.approx(d.noise_memory, abs=1.5e-3)


@pytest.mark.parametrize("lag", [1, 7, 30])
def test_what_follows_an_input_is_found_with_its_lag(c: Trace, lag: int) -> None:
    u = np.random.default_rng(0).standard_normal(len(c)).cumsum()
    left = 0.5 * np.roll(u, lag) + np.random.default_rng(1).standard_normal(len(c))
    found = correlate_with_input("Cor", u, WHITE, left, 1e-3)
    assert found.lag == pytest.approx(lag * 1e-3) and found.correlation > 4 * found.bound
    alone = correlate_with_input("Cor", u, WHITE, left - 0.5 * np.roll(u, lag), 1e-3)
    assert abs(alone.correlation) < 1.5 * alone.bound


@pytest.mark.parametrize(("law", "word"), [
    (lambda v: 0.3 * v / 0.05, "proportional to"), (np.sign, "steps with the sign of"),
    (lambda v: np.abs(v) / 0.05, "even in")])
def test_dependence_on_speed_and_its_shape(m: Motion, law: object, word: str) -> None:
    rng = np.random.default_rng(0)
    v = rng.uniform(-0.1, 0.1, 13_500)
    left = law(v) + 0.1 * rng.standard_normal(len(v))  # type: ignore[operator]
    found = bin_residual("speed", v, left)
    assert found is not None and found.shape == word and found.share > 0.8
    inside = np.abs(found.means - law(found.centres)) < 4 * found.half + 0.05  # type: ignore[operator]
    assert inside.mean() > 0.8
    assert bin_residual("speed", np.zeros(100), left[:100]) is None
    assert name_shape(np.array([-1.0, 0.0, 1.0]), np.array([1.0, -2.0, 1.5]), np.ones(3)) != "proportional to"


def make_trace(amplitude: float, frequency: float, rows: int = 4000) -> Trace:
    t = np.arange(rows) / 1000
    xj = amplitude * np.sin(2 * np.pi * frequency * t)
    return Trace.from_columns({"com": xj, "xj": xj, "cor": 0 * t}, 1e-3, {})


def test_the_error_of_a_fast_motion_stands_in_its_cell() -> None:
    slow, fast = make_trace(0.2e-3, 2.0), make_trace(2e-3, 4.0)
    trace = Trace.from_columns({name: np.concatenate([slow.column(name), fast.column(name)])
                                for name in ("com", "xj", "cor")}, 1e-3, {})
    residual = np.where(np.arange(8000) < 4000, 1e-6, 7e-6)
    found = map_deviation(trace, {"xj": residual}, {"xj": 1e-6})
    assert found is not None
    rows = found.amplitudes.searchsorted([0.2e-3, 2e-3]) - 1
    assert np.nanmax(found.ratio["xj"][rows[0], :1]) == pytest.approx(1.0, abs=0.01)
    column = int(found.speeds.searchsorted(45e-3)) - 1
    assert found.ratio["xj"][rows[1], column] == pytest.approx(7.0)
    assert found.ratio["xj"].shape == (len(found.amplitudes) - 1, len(found.speeds) - 1)
