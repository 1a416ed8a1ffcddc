"""Effects of the position transducer, in the order of its signal path."""
from __future__ import annotations

from typing import Annotated, Any, NamedTuple

from plant.effects import effect
from plant.quantity import Quantity


class SensorLag(NamedTuple):
    """First-order lag."""

    time: Annotated[float, Quantity("s", low=0, high=0.1, typical="0.3-3 ms")] = 0.0


class Lag(NamedTuple):
    """What a lag remembers: how far it is behind, and its last input."""

    behind: float = 0.0
    last: float = 0.0


@effect("position", SensorLag, law="tau XS' + XS = XJ", symptoms="roll-off in the sensed position", memory=Lag)
def sensor_lag(x: float, m: Lag, s: Any, u: Any, p: Any) -> tuple[float, Lag]:
    """Demodulator and anti-alias filter of the LVDT (trapezoidal rule on the part that lags, exact at tau = 0)."""
    two = 2.0 * p.sensor_lag.time
    behind = ((two - u.h) * m.behind - two * (x - m.last)) / (two + u.h)
    return x + behind, Lag(behind, x)


class SensorOffset(NamedTuple):
    """Zero error of the transducer."""

    offset: Annotated[float, Quantity("m", low=-1, high=1, typical="10-200 um")] = 0.0


@effect("position", SensorOffset, law="XJ = XJ + offset", symptoms="unobservable in closed loop except at end stops")
def sensor_offset(x: float, s: Any, u: Any, p: Any) -> float:
    """The transducer's zero is not the ram's; behind the lag, which would else begin a run by catching up with it."""
    return x + p.sensor_offset.offset
