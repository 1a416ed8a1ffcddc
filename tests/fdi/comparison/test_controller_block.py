"""The controller's block: equal to the last digit, or told what is different; and columns that are out of step."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from noisy_traces import record_healthy

from fdi.comparison.blocks import compare_controller, find_lags
from fdi.estimation.replay import read_cycles
from fdi.thresholds import CONTROLLER_ERROR_RATIO
from fdi.trace.trace import Trace, shift_rows
from plant import Model, simulate

MODEL = Model()


@pytest.fixture(scope="module")
def c() -> Trace:
    return read_cycles(record_healthy(), MODEL)[0]


def test_the_same_firmware_agrees_to_the_last_digit(c: Trace) -> None:
    found = compare_controller(c, MODEL)
    assert found.error < 1e-15 and found.ratio <= 1.0 and (found.com_lag, found.xj_lag) == (0, 0)


@pytest.mark.parametrize("digits", [6, 9])
def test_rounding_in_a_file_is_no_disagreement(c: Trace, digits: int) -> None:
    def rounded(x: np.ndarray) -> np.ndarray:
        return np.array([float(f"{v:.{digits - 1}e}") for v in x.tolist()])

    found = compare_controller(replace(c, cor=rounded(c.cor), xj=rounded(c.xj)), MODEL)
    assert found.ratio < CONTROLLER_ERROR_RATIO


def test_rounding_on_the_bus_is_no_disagreement(c: Trace) -> None:
    """The firmware sees what the bus carries, and its answer is rounded to 1e-8 A."""
    xj = np.round(c.xj / 1e-7) * 1e-7
    cor = np.round(np.clip(3.8 * (c.com - xj), -8e-3, 8e-3) / 1e-8) * 1e-8
    found = compare_controller(replace(c, xj=xj, cor=cor), MODEL)
    assert found.ratio < 1.2


@pytest.mark.parametrize("changes", [
    {"controller.proportional_gain": 3.7}, {"controller.current_limit": 7e-3}, {"controller.derivative_gain": 1e-4},
    {"controller.integral_gain": 0.5}, {"command_rate_limit.rate": 0.1}])
def test_another_firmware_is_told(changes: dict[str, float]) -> None:
    model = MODEL.replace(changes)
    run = simulate(model, record_healthy().com, seed=1, steps=20)
    c = replace(read_cycles(record_healthy(), MODEL)[0], com=run.com, xj=run.xj, cor=run.cor)
    found = compare_controller(c, MODEL)
    assert found.ratio > 100 and (found.com_lag, found.xj_lag) == (0, 0)
    assert compare_controller(c, model).ratio <= 1.0
    if "controller.proportional_gain" in changes:
        assert found.gain == pytest.approx(3.7, rel=1e-6)


@pytest.mark.parametrize(("com", "xj"), [(3, 0), (-2, 0), (0, 2), (2, 2)])
def test_columns_that_are_late(c: Trace, com: int, xj: int) -> None:
    """`com` cycles before row k is what Cor_k answers, the file having it earlier than it should."""
    found = compare_controller(replace(c, com=shift_rows(c.com, -com), xj=shift_rows(c.xj, -xj)), MODEL)
    assert (found.com_lag, found.xj_lag) == (com, xj) and found.ratio <= 1.0
    assert find_lags(c, 8e-3)[:2] == (0, 0)


def test_a_recorder_that_rounds_positions_is_no_error_of_the_controller(c: Trace) -> None:
    step = 7.3e-6
    rounded = replace(c, xj=step * np.round(c.xj / step))
    found = compare_controller(rounded, MODEL)
    assert 0.5 < found.ratio < CONTROLLER_ERROR_RATIO
    other = MODEL.replace({"controller.proportional_gain": 1.1 * MODEL["controller.proportional_gain"]})
    assert compare_controller(rounded, other).ratio > CONTROLLER_ERROR_RATIO


def test_missing_samples_are_not_judged(c: Trace) -> None:
    xj = c.xj.copy()
    xj[100:103] = np.nan
    found = compare_controller(replace(c, xj=xj), MODEL)
    assert np.isnan(found.residual[100:104]).all() and found.ratio <= 1.0 and not np.isnan(found.residual[104])
