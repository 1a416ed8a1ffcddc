"""The cycle of a run: the plant takes the same steps of 10 us whatever it is."""

import numpy as np
import pytest

from plant import Actuator, Model
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
