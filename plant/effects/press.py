"""Loads of test stands that are no mere force."""
from __future__ import annotations

from typing import Annotated, Any, NamedTuple

from plant.effects import effect
from plant.quantity import Quantity
from plant.state import Drag


class OneWayLoad(NamedTuple):
    """How much of the given load resists as a press does, and the travel over which it builds up."""

    share: Annotated[float, Quantity("1", low=0, high=2, typical="1")] = 0.0
    travel: Annotated[float, Quantity("m", low=1e-6, high=1, typical="0.1-10 mm")] = 5e-3


class Engaged(NamedTuple):
    """Where the press does not touch any more."""

    start: float = 0.0


@effect("jack_drag", OneWayLoad, law="FR only against extension, rising over the travel; it resists and never drives",
        symptoms="no P12 from the load but in extension", memory=Engaged, plant="ehs",
        starts=((0.5, 5e-3), (1.0, 1e-3), (1.0, 5e-3)), source="a press cylinder behind a relief valve")
def one_way_load(x: Drag, m: Engaged, s: Any, u: Any, p: Any) -> tuple[Drag, Engaged]:
    """A press yields at its load. As friction that acts one way: half of it a level, half of it a force."""
    g = p.one_way_load
    x0 = m.start if m.start > s.jack_position - g.travel else s.jack_position - g.travel
    x0 = x0 if x0 < s.jack_position else s.jack_position
    half = 0.5 * g.share * u.load * ((s.jack_position - x0) / g.travel)
    return Drag(x.force - g.share * u.load + half, x.damping, x.static + half, x.dynamic + half), Engaged(x0)
