"""The state of the plant, its inputs, and the ports where effects act."""
from __future__ import annotations

from typing import Any, NamedTuple

from plant.quantity import Ampere, Metre, MetrePerSecond, Newton, One, Pascal, Second

Memory = Any  # the memory of a port: 0.0 for none, else what its effects keep, nested tuples of floats


class Ports(NamedTuple):
    """The ports of the signal path, where effects act; each field holds the memories of the effects there.

    An effect gets the signal of its port, in the unit below, and returns it changed.
    """

    command: Memory = 0.0  # m, demand as the firmware takes it; once a cycle, in the controller
    current: Memory = 0.0  # A, in the torque motor's coil
    supply: Memory = 0.0  # 1, supply pressure over nominal r; PSR and GPF follow with r, GQF and GQ with sqrt r
    viscosity: Memory = 0.0  # 1, viscosity of the oil over nominal; CJ, BF and 1/CLK follow
    nozzle: Memory = 0.0  # m, flapper displacement as the nozzles feel it
    feedback: Memory = 0.0  # m, spool displacement as the feedback spring feels it
    spool_force: Memory = 0.0  # N, extra force on the spool, positive as XS
    metering: Memory = 0.0  # m, spool displacement as the metering edges feel it
    valve: Memory = 0.0  # Line, P12 against the ram's speed
    load: Memory = 0.0  # N, external force FR on the ram, positive against extension
    jack_drag: Memory = 0.0  # Drag, all that resists the ram in the jack
    position: Memory = 0.0  # m, ram position as its transducer feels it
    reading: Memory = 0.0  # m, XJ with its noise as it is sent; once a cycle


UNITS = Ports("m", "A", "1", "1", "m", "m", "N", "m", "Pa, Pa s/m", "N", "N, N s/m", "m", "m")


class State(NamedTuple):
    """The plant at one instant; all zero is the centred actuator at rest."""

    flapper_position: Metre = 0.0  # XF, at the nozzles
    flapper_speed: MetrePerSecond = 0.0
    spool_position: Metre = 0.0  # XS
    spool_speed: MetrePerSecond = 0.0
    jack_position: Metre = 0.0  # XJ
    jack_speed: MetrePerSecond = 0.0
    pressure: Pascal = 0.0  # P12, across the piston
    sensed: Metre = 0.0  # XJ as its transducer shows it, without noise
    memory: Ports = Ports()


class Input(NamedTuple):
    """The inputs of the plant in one step."""

    current: Ampere = 0.0  # Cor of the cycle before, held for this cycle
    load: Newton = 0.0  # FR, held for this cycle
    noise: One = 0.0  # one standard normal number a cycle, for effects that are noise
    t: Second = 0.0  # time at the start of the step
    phase: Second = 0.0  # the part of t since the cycle began
    h: Second = 1e-5  # length of the step


class Line(NamedTuple):
    """A pressure that falls with the speed of the body it drives: p = offset - slope * v, within +-limit."""

    offset: Pascal
    slope: float  # Pa s/m
    limit: Pascal
    drive: Pascal  # the part of the offset that the opening of the metering edges makes


class Drag(NamedTuple):
    """The resistance of a body: dry(static, dynamic) + damping * v + force."""

    force: Newton
    damping: float  # N s/m
    static: Newton
    dynamic: Newton
