"""One run of the plant from a measured current, without its controller: what a fit repeats with other parameters."""
from __future__ import annotations

from typing import Any

from plant.compile import Function
from plant.ports import at_position
from plant.solve import read_sensors, step_cycle
from plant.state import Input, Ports, State

NO_NOISE = (0.0, 0.0, 0.0, 0.0)  # no noise
SETTLING = 40  # cycles, three times, that the transducer rests where the ram starts


def _make_replacer(*paths: str) -> Function:
    """`(s, ...)`: `s` with the numbers at `paths` replaced. Written out, as compiled code knows no _replace."""
    ports = ", ".join(f"memory_{f}" if f"memory.{f}" in paths else f"s.memory.{f}" for f in Ports._fields)
    fields = [f"Ports({ports})" if f == "memory" else f if f in paths else f"s.{f}" for f in State._fields]
    made: dict[str, Any] = {"State": State, "Ports": Ports}
    names = ", ".join(path.replace(".", "_") for path in paths)
    exec(f"def replaced(s, {names}):\n    return State({', '.join(fields)})", made)
    return made["replaced"]


set_jack_position = _make_replacer("jack_position")
set_sensed_position = _make_replacer("sensed", "memory.position")
set_sample_memories = _make_replacer("memory.command", "memory.reading")


def initialise_sensed_position(s: State, p: Any) -> Any:
    """`s` with what its transducer shows before the first step."""
    u = Input(0.0, 0.0, 0.0, 0.0, 0.0, 1e-5)
    return set_sensed_position(s, at_position(s.jack_position, s.memory.position, s, u, p)[0], s.memory.position)


def rest_at_reading(s: State, x: float, p: Any, steps: int) -> Any:
    """`s` at rest where its transducer shows `x` m: a lag has caught up, an offset or a gain is made up for."""
    u = Input(0.0, 0.0, 0.0, 0.0, 0.0, p.controller.period / steps)
    sensed = 0.0
    for _ in range(3):
        s = set_jack_position(s, s.jack_position + (x - sensed))
        for _ in range(SETTLING * steps):
            sensed, m = at_position(s.jack_position, s.memory.position, s, u, p)
            s = set_sensed_position(s, sensed, m)
    return s


def replay_current(s: State, current: Any, load: Any, position: Any, anchor: float, record: Any, steps: int,
                   out: Any) -> None:
    """The plant driven by a measured current; fills out[k] = XJ as sensed, P12, XS at sample k, all without noise.

    Args:
        s: state at the start.
        current: (n,) A; current[k - 1] acts from k to k + 1, none before.
        load: (n,) N, external force against extension.
        position: (n,) m, measured; NaN where missing; or (0,): the run starts as `s` is.
        anchor: 1/s, how fast the ram is pulled to the measured position.
        record: (1,) parameters of the model.
        steps: steps a cycle.
        out: (n, 3), written.
    """
    p = record[0]
    s = rest_at_reading(s, position[0], p, steps) if len(position) else initialise_sensed_position(s, p)
    for k in range(len(current)):
        t = k * p.controller.period
        out[k, 0], out[k, 1], out[k, 2], m = read_sensors(s, s.memory.reading, NO_NOISE, t, p)
        s = set_sample_memories(s, s.memory.command, m)
        if len(position):
            moved = compute_pull(anchor * p.controller.period, position[k], s.sensed)
            s = set_jack_position(s, s.jack_position + moved)
        s = step_cycle(s, current[k - 1] if k else 0.0, load[k], 0.0, t, record, steps)


def compute_pull(share: float, measured: float, sensed: float) -> float:
    """How far the ram is moved to the measured position, m: not at all where none was measured."""
    return share * (measured - sensed) if measured == measured else 0.0
