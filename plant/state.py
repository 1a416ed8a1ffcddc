"""What every step gets: its inputs; and records that laws of effects remember, or exchange at their ports."""

from collections import namedtuple
from typing import Any, NamedTuple

Memory = Any  # of a port: 0.0 for none, else what its effects keep, nested tuples of floats


class Input(NamedTuple):
    """The inputs of the plant in one step."""

    drive: float = 0.0  # the controller's answer of the cycle before, held for this cycle
    load: float = 0.0  # held for this cycle
    noise: float = 0.0  # one standard normal number a cycle, for effects that are noise
    t: float = 0.0  # s, time at the start of the step
    phase: float = 0.0  # s, the part of t since the cycle began
    h: float = 1e-5  # s, length of the step


class Sampled(NamedTuple):
    """What the controller knows of the plant, for effects at the port `command`."""

    sensed: float = 0.0  # the controlled signal as it was read


# memory of a play: where something has been dragged to
Held = namedtuple("Held", "held", defaults=(0.0,))

# memory of a lag: how far it is behind, and its last input
Lag = namedtuple("Lag", "behind last", defaults=(0.0, 0.0))


class Line(NamedTuple):
    """A pressure that falls with the speed of the body it drives: p = offset - slope * v, within +-limit."""

    offset: float  # Pa
    slope: float  # Pa s/m
    limit: float  # Pa
    drive: float  # Pa, the part of the offset that the opening of the metering edges makes


class Drag(NamedTuple):
    """The resistance of a body: dry(static, dynamic) + damping * v + force."""

    force: float  # N
    damping: float  # N s/m
    static: float  # N
    dynamic: float  # N
