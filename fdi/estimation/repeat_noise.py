"""Whether repeats of a run differ by noise alone, or by more: a repeat from another unit is no measure of the noise."""
from __future__ import annotations

from collections.abc import Mapping, Sequence

from fdi.estimation.noise import Floor, find_floors, sensor_floors
from fdi.estimation.replay import compute_residuals, replay_current
from fdi.thresholds import LOWER_BOUND_ERROR_RATIO, REPEAT_FLOOR_RATIO
from fdi.trace.signals import SIGNALS
from fdi.trace.trace import Trace
from plant.model import Model


def check_repeats(trace: Trace, repeats: Sequence[Trace], model: Model) -> str:
    """What `describe_doubtful_repeats` says of prepared repeats on the rows of a prepared trace.

    An error of the model is the same in all of them, so it does not matter here.
    """
    if not repeats:
        return ""
    first, *others = (compute_residuals(run, replay_current(run, model)) for run in (trace, *repeats))
    return describe_doubtful_repeats(find_floors(first, others, trace.period), sensor_floors(trace, model))


def describe_doubtful_repeats(floor: Mapping[str, Floor], noise: Mapping[str, Floor]) -> str:
    """What makes a noise floor from repeats larger than the sensors' own noise explains; empty if nothing does."""
    def limit(name: str) -> float:  # the data's own noise is a lower bound: coloured noise has less of it
        return REPEAT_FLOOR_RATIO * (LOWER_BOUND_ERROR_RATIO if noise[name].lower_bound else 1.0)

    above = [f"{SIGNALS[name].symbol} by {f.value / noise[name].value:.2g}" for name, f in floor.items()
             if f.source == "repeats" and f.value > limit(name) * noise[name].value]
    if not above:
        return ""
    return (f"the repeats differ by more than the noise of the sensors: {', '.join(above)} times. Use repeats of the "
            "same unit; if its sensors are so noisy, set sensors.*_noise of the model")
