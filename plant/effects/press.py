"""Loads of test stands that are no mere force."""

from typing import Annotated, Any, NamedTuple

from plant.effects import effect
from plant.quantity import Quantity
from plant.state import Drag


class OneWayLoad(NamedTuple):
    """How much of the given load resists as a press does, the way until it touches, and that until it is all there."""

    share: Annotated[float, Quantity("1", low=0, high=2, typical="1")] = 0.0
    slack: Annotated[float, Quantity("m", low=0, high=1, typical="0-5 mm")] = 0.0
    travel: Annotated[float, Quantity("m", low=1e-6, high=1, typical="0.1-10 mm")] = 5e-3


class Dragged(NamedTuple):
    """Where the press was left behind."""

    start: float = 0.0


@effect("jack_drag", OneWayLoad, law="FR, against extension only, after a slack and over a travel; it never drives",
        symptoms="no P12 from the load but in extension", memory=Dragged, plant="ehs",
        starts=((0.5, 0.0, 5e-3), (1.0, 0.0, 1e-3), (1.0, 1e-3, 4e-3)), source="a press cylinder and its relief valve")
def one_way_load(x: Drag, m: Dragged, s: Any, u: Any, p: Any) -> tuple[Drag, Dragged]:
    """A press yields at its load. As friction that acts one way: half of it a level, half of it a force."""
    g = p.one_way_load
    whole = s.jack_position - (g.slack + g.travel)
    x0 = m.start if m.start > whole else whole
    x0 = x0 if x0 < s.jack_position else s.jack_position
    pressed = s.jack_position - x0 - g.slack
    half = 0.5 * g.share * u.load * ((pressed if pressed > 0.0 else 0.0) / g.travel)
    return Drag(x.force + half, x.damping, x.static + half, x.dynamic + half), Dragged(x0)
