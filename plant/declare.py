"""All names that a plant file imports: `from plant.declare import ...` (docs/plants.md shows a whole file)."""
from typing import Annotated, Any, NamedTuple

from plant.friction import clip, play, soften, solve_sliding, solve_velocity
from plant.pid import Loop, control_by_pid
from plant.plants import Fault, Plant, base_effect, effect, port
from plant.quantity import Quantity
from plant.segments import Chirp, Hold, Multisine, Points, Ramp, Sine, Step
from plant.signals import Signal

__all__ = ["Annotated", "Any", "Chirp", "Fault", "Hold", "Loop", "Multisine", "NamedTuple", "Plant", "Points",
           "Quantity", "Ramp", "Signal", "Sine", "Step", "base_effect", "clip", "control_by_pid", "effect", "play",
           "port", "soften", "solve_sliding", "solve_velocity"]
