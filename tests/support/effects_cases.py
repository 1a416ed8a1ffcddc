"""What the tests of effects share: plants that have the whole catalogue, so that one kernel serves all of them."""

from typing import Any

import numpy as np
from physics_cases import SILENT, SMOOTH

from plant import Actuator, Model
from plant.effects import CATALOGUE

LAWS = [name for name, entry in CATALOGUE.items() if not entry.base]
WHOLE = SILENT.with_effects(LAWS)  # nominal, no noise
QUIET_SPOOL = WHOLE.replace({"spool.static_friction": 0.0, "spool.dynamic_friction": 0.0})
EASY = SMOOTH.with_effects(LAWS)  # nor dry friction
H = 1e-5


def drive_plant(model: Model, current: np.ndarray, load: float = 0.0, **options: Any) -> tuple[Actuator, np.ndarray]:
    """The plant after the current (n,) A, one a cycle, and its rows XJ as sensed, P12, XS, XJ, XJ' at each sample."""
    plant, out = Actuator(model, **options), np.empty((len(current), 5))
    for k, amperes in enumerate(current):
        s = plant.state
        out[k] = *plant.sample(), s.jack_position, s.jack_speed
        plant.advance(float(amperes), load)
    return plant, out.T


def measure_spool(model: Model, current: float) -> float:
    """XS at which feedback and torque motor are in balance, m."""
    return model["torque_motor.gain"] * current / model["feedback_spring.stiffness"]


def measure_speed(model: Model, spool: float) -> float:
    """Speed of an unloaded ram at that opening, m/s."""
    return model["valve.flow_gain"] * spool / model["jack.area"]
