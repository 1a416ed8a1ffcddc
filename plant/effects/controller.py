"""Effects in the firmware: they show in its answer against what it was told and what it sensed, without any noise."""

from collections import namedtuple
from typing import Any

from plant.effects import Quantity, clip, effect


@effect("command", {  # By what fraction the loop's gain is higher where the ram is to retract; negative: lower.
    "retraction": Quantity("1", low=-1, high=10, typical="-0.5 to 0.5"),
}, law="error (1 + retraction) where Com < XJ", symptoms="another following error out and back at the same speed",
    starts=(-0.3, 0.3), searched_in=("ehs",), source="firmware that makes up for unequal areas")
def asymmetric_gain(x: float, s: Any, u: Any, p: Any) -> float:
    """The firmware's gain depends on the direction of the error."""
    error = x - s.sensed
    return x + (p.asymmetric_gain.retraction * error if error < 0.0 else 0.0)


# the demand as the loop had it last; 0 begun before the first one, which is taken as it is
Followed = namedtuple("Followed", "demand begun", defaults=(0.0, 0.0))


@effect("command", {  # The fastest demand that the firmware follows.
    "rate": Quantity("m/s", low=0, high=1e6, typical="0.05-0.3 m/s; 0: no limit"),
}, law="|Com'| <= rate, before the error is formed", symptoms="only when the command is fast", memory=Followed,
    starts=(0.3, 0.12, 0.05), source="ramp generators of position controllers")
def command_rate_limit(x: float, m: Followed, s: Any, u: Any, p: Any) -> tuple[float, Followed]:
    """The firmware follows a fast demand at its own rate."""
    rate = p.command_rate_limit.rate
    free = m.begun == 0.0 or rate == 0.0
    limited = m.demand + clip(x - m.demand, rate * u.h)
    x = x if free else limited
    return x, Followed(x, 1.0)
