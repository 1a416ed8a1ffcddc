"""The signals of a recording of the EHA: column name, symbol and unit of each; and which of them a replay predicts."""
from __future__ import annotations

from collections.abc import Mapping

from plant.signals import EHA, Signal

SIGNALS: Mapping[str, Signal] = {signal.name: signal for signal in EHA}
OUTPUTS = tuple(signal.name for signal in EHA.outputs)  # what a replay predicts, in the order of its columns
