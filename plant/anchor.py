"""How a simulated run is tied to a measured position: it starts where the transducer shows it, and is pulled there."""
from __future__ import annotations

from typing import Any

from plant.compile import Function
from plant.ports import at_position, shift_position_memory
from plant.state import Input, Ports, State


def _make_replacer(*paths: str) -> Function:
    """`(s, ...)`: `s` with the numbers at `paths` replaced. Written out, as compiled code knows no _replace."""
    ports = ", ".join(f"memory_{f}" if f"memory.{f}" in paths else f"s.memory.{f}" for f in Ports._fields)
    fields = [f"Ports({ports})" if f == "memory" else f if f in paths else f"s.{f}" for f in State._fields]
    made: dict[str, Any] = {"State": State, "Ports": Ports}
    names = ", ".join(path.replace(".", "_") for path in paths)
    exec(f"def replaced(s, {names}):\n    return State({', '.join(fields)})", made)
    return made["replaced"]


set_jack_position = _make_replacer("jack_position")
set_moved_ram = _make_replacer("jack_position", "memory.position")
set_sensed_position = _make_replacer("sensed", "memory.position")
set_sample_memories = _make_replacer("memory.command", "memory.reading")


def initialise_sensed_position(s: State, p: Any) -> Any:
    """`s` with what its transducer shows before the first step."""
    u = Input(0.0, 0.0, 0.0, 0.0, 0.0, 1e-5)
    return set_sensed_position(s, at_position(s.jack_position, s.memory.position, s, u, p)[0], s.memory.position)


def rest_at_reading(s: State, x: float, p: Any, steps: int) -> Any:
    """`s` at rest where its transducer shows `x` m: a lag has caught up, an offset or a gain is made up for.

    Three times the ram is moved by what the transducer is off, and rests for 40 cycles of `steps` steps.
    """
    u = Input(0.0, 0.0, 0.0, 0.0, 0.0, p.controller.period / steps)
    sensed = 0.0
    for _ in range(3):
        s = set_jack_position(s, s.jack_position + (x - sensed))
        for _ in range(40 * steps):
            sensed, m = at_position(s.jack_position, s.memory.position, s, u, p)
            s = set_sensed_position(s, sensed, m)
    return s


def pull_ram(s: State, share: float, measured: float) -> State:
    """`s` with the ram moved by this share of the way to the measured position, m; as it is where none was measured.

    Positions that the transducer remembers move along. Else the noise of the measurement would push the ram through the
    play of a rod end, and the play would seem 1 um smaller than it is.
    """
    moved = share * (measured - s.sensed) if measured == measured else 0.0
    now: State = set_moved_ram(s, s.jack_position + moved, shift_position_memory(s.memory.position, moved))
    return now
