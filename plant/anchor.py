"""How a simulated run is tied to a measured signal: it starts where the sensor shows it, and is pulled there."""

from typing import Any

from plant.friction import soften
from plant.kernels import correct_plant, measure_plant, move_plant, sense_plant, shift_memories
from plant.state import Input, Memory


def show_start(s: Any, m: Memory, p: Any) -> Any:
    """The state with what its sensors show before the first step; memories stay as they are."""
    return sense_plant(s, m, Input(0.0, 0.0, 0.0, 0.0, 0.0, 1e-5), p)[0]


def rest_at_reading(s: Any, m: Memory, x: float, p: Any, steps: int) -> tuple[Any, Memory]:
    """The plant at rest where its controlled signal shows `x`: a lag has caught up, an offset or gain is made up for.

    Three times the plant is moved by what the sensor is off, and rests for 40 cycles of `steps` steps.
    """
    u = Input(0.0, 0.0, 0.0, 0.0, 0.0, p.controller.period / steps)
    shown = 0.0
    for _ in range(3):
        s = move_plant(s, x - shown, p)
        for _ in range(40 * steps):
            s, m = sense_plant(s, m, u, p)
        shown = measure_plant(s, p)[0]
    return s, m


def pull_plant(s: Any, m: Memory, share: float, measured: float, slack: float, p: Any) -> tuple[Any, Memory]:
    """The plant moved by this share of the way to the measured signal; as it is where none was measured.

    Positions that a sensor remembers move along. Else the noise of the measurement would push a ram through the play of
    its rod end, and the play would seem 1 um smaller than it is.

    The measured signal of a coarse sensor says no more than that the true one is within `slack` of it, half a step. An
    observer that took the rounding for motion would add it to every speed, the same in each repeat of a run.
    """
    moved = share * soften(measured - measure_plant(s, p)[0], slack) if measured == measured else 0.0
    return correct_plant(s, moved, p), shift_memories(m, moved)
