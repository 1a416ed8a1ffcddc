"""The law of a position controller, identified from what it was told, what it sensed and what it answered."""

import numpy as np
import pytest
from places import SHARED

from studies.servo_ledger import fit_directional_gains

DATA = SHARED / "data" / "electrohydrostatic_rig_raw"


@pytest.mark.parametrize("delay", [0, 3])
def test_it_finds_gains_and_delay_exactly(delay: int) -> None:
    rng = np.random.default_rng(1)
    error = rng.integers(-100, 100, 5000).astype(float)
    side = np.roll(np.sign(error), delay)
    answer = np.where(side > 0.0, 10.0, 7.0) * np.roll(error, delay)
    error, answer, side = error[:-delay or None], answer[:-delay or None], side[:-delay or None]
    found = fit_directional_gains(error[delay:], answer[delay:], side[delay:])
    assert (found.out, found.back, found.delay) == pytest.approx((10.0, 7.0, delay))
    assert found.residual == pytest.approx(0.0, abs=1e-9) and found.exact == 1.0
    assert found.asymmetry == pytest.approx(-0.3)


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no measurements at {DATA.name}: they belong to others")
def test_the_servos_firmware() -> None:
    """10 out and 7 back, without delay, and nearly without anything left."""
    columns = np.loadtxt(DATA / "exp_data_2_2.csv.gz", delimiter=";", skiprows=61, usecols=(9, 13, 14, 16))
    answer, demand, position, valve = columns.T
    found = fit_directional_gains(demand - position, answer, valve)
    assert (found.out, found.back) == pytest.approx((10.0, 7.0), abs=0.05)
    assert found.delay == 0 and found.residual < 0.01 * found.answer
