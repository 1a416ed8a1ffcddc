"""The cycle of a run: the plant takes the same steps of 10 us whatever it is."""

import numpy as np
import pytest

from plant import Actuator, Model, simulate
from plant.run import Columns
from plant.segments import Array

QUIET = Model().replace({f"sensors.{name}_noise": 0.0 for name in ("position", "pressure", "spool")})
CYCLES = (0.5e-3, 2e-3, 5e-3, 10e-3)


def play(period: float, current: Array, load: Array) -> list[tuple[float, float, float]]:
    """The readings at the start of each cycle of the plant alone."""
    plant, readings = Actuator(QUIET.replace({"controller.period": period})), []
    for amount, force in zip(current.tolist(), load.tolist(), strict=True):
        readings.append(plant.sample())
        plant.advance(amount, force)
    return readings


@pytest.mark.parametrize("period", CYCLES)
def test_a_current_moves_the_plant_as_the_same_current_held_on_the_usual_cycle(period: float) -> None:
    longer, shorter = max(period, 1e-3), min(period, 1e-3)
    every, rng = round(longer / shorter), np.random.default_rng(1)
    current, load = rng.uniform(-5e-3, 5e-3, 40), rng.uniform(-5e3, 5e3, 40)
    slow = play(longer, current, load)
    fast = play(shorter, np.repeat(current, every), np.repeat(load, every))
    assert slow == fast[::every]


def simulate_ramp(period: float) -> Columns:
    """The closed loop on a smooth command, every 10 ms."""
    t = np.arange(round(0.6 / period)) * period
    gain = 0.25 * QUIET["controller.proportional_gain"]  # with all of it the loop is unstable at 10 ms
    model = QUIET.replace({"controller.period": period, "controller.proportional_gain": gain})
    run = simulate(model, 1e-3 * np.sin(2 * np.pi * 2.0 * t))
    return Columns(*(column[::round(10e-3 / period)] for column in run))


def test_the_closed_loop_differs_by_its_sampling_alone() -> None:
    """The delay of one cycle and a half grows with the cycle, and so does the difference to a fast controller."""
    usual, errors = simulate_ramp(1e-3), []
    for period in CYCLES:
        slow = simulate_ramp(period)
        np.testing.assert_allclose(slow.com, usual.com, atol=1e-15)
        errors.append(float(np.abs(slow.xj - usual.xj).max()))
    assert errors[0] < errors[1] < errors[2] < errors[3] < 0.1e-3, errors
