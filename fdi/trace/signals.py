"""The signals of a recording: column name, symbol and unit of each; and which of them a replay predicts."""
from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple


class Signal(NamedTuple):
    """A measured or commanded quantity of the actuator."""

    name: str  # of its column
    symbol: str  # as the paper and all figures have it
    unit: str  # SI
    quantity: str
    noise: str = ""  # parameter of a model that holds its sensor's noise


SIGNALS: Mapping[str, Signal] = {signal.name: signal for signal in (
    Signal("t", "t", "s", "time"),
    Signal("com", "Com", "m", "position demand"),
    Signal("xj", "XJ", "m", "sensed ram position", "sensors.position_noise"),
    Signal("cor", "Cor", "A", "current command of the servovalve"),
    Signal("p12", "P12", "Pa", "pressure difference across the jack", "sensors.pressure_noise"),
    Signal("xs", "XS", "m", "spool position", "sensors.spool_noise"),
    Signal("load", "load", "N", "external force on the ram"),
)}
OUTPUTS = ("xj", "p12", "xs")  # what a replay predicts, in the order of its columns
