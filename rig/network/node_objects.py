"""Numbers and application objects of the three nodes, which the rig writes and the nodes obey."""
from __future__ import annotations

from typing import NamedTuple

from plant.model import Model

RIG, CONTROLLER, PLANT = 1, 2, 3  # node-IDs
NAMES = {RIG: "rig", CONTROLLER: "controller", PLANT: "plant"}
GAINS = 0x2110  # of the controller
SCENARIO, COUNTERS, CYCLE_RECORD = 0x2210, 0x2211, 0x2212  # of the plant


class Gains(NamedTuple):
    """Object 0x2110 sub 1..5: the fields of `plant.parameters.Controller`."""

    proportional_gain: float
    integral_gain: float
    derivative_gain: float
    current_limit: float
    period: float


def read_gains(model: Model) -> Gains:
    """What a model's [controller] says."""
    return Gains(*(model[f"controller.{field}"] for field in Gains._fields))
