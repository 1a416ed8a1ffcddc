"""The nominal test of a plant: the profile that it declares, or the main phase of preflight for the EHA's signals."""

import numpy as np

from plant.errors import InputError
from plant.plants import Plant
from plant.profile import build_profile, resample_on_cycles
from plant.segments import RATE, Array
from plant.signals import EHA
from rig.sequences.sequence import load_sequence


def load_nominal_test(kind: Plant, period: float) -> tuple[Array, Array | None, str]:
    """Demand and load of every cycle of `period` s, (n,) each, and the name of the test; a load of None is none.

    Raises:
        InputError: the plant declares no test.
    """
    if kind.profile:
        return build_profile(kind.profile, rate=1.0 / period).command, None, f"profile of {kind.name}"
    if kind.signals.names != EHA.names:
        raise InputError("--command", "", f"FILE with the columns t and {kind.signals.command.name}: {kind.name} "
                                          "declares no profile")
    try:
        return (*_sample_preflight(1.0 / period), "preflight")
    except InputError:  # its segments are not whole cycles of this period
        columns = _sample_preflight(RATE)
    t = np.arange(len(columns[0])) / RATE
    command, force = (resample_on_cycles(t, column, period) for column in columns)
    return command, force, "preflight"


def _sample_preflight(rate: float) -> tuple[Array, Array]:
    """Demand, m, and load, N, `rate` values a second. Raises InputError if its segments are not whole cycles."""
    sequence = load_sequence("preflight", rate)
    return sequence.main_profile().command, sequence.load_profile()
