"""The effects that a model has already: a fit refines them beside the tolerances, a search does not look for them."""
from __future__ import annotations

from fdi.estimation.problem import FURTHEST, Free, tolerances, unknowns
from plant.effects import CATALOGUE, Effect
from plant.model import Model, offered

UNREPLAYED = ("command", "reading")  # ports that a replay from the measured current does not pass


def effects_of(model: Model) -> tuple[str, ...]:
    """Effects at work in a model; those of the reference model if no healthy unit could be so far off nominal."""
    return tuple(e.name for e in offered(model.plant)
                 if (_off_nominal(e, model) if e.base else e.name in model.effects and e.acts(model.values)))


def unknowns_of(model: Model) -> tuple[Free, ...]:
    """The parameters of these effects, to be fitted from the values they have; nothing else is known of them."""
    replayed = [CATALOGUE[name] for name in effects_of(model) if CATALOGUE[name].port not in UNREPLAYED]
    return tuple(u._replace(centre=model[u.name]) for e in replayed for u in unknowns(e, model))


def free_of(model: Model) -> tuple[Free, ...]:
    """All that is free in a model: tolerances, and the parameters of the effects that it has."""
    own = unknowns_of(model)
    taken = {u.name for u in own}
    return (*(f for f in tolerances(model) if f.name not in taken), *own)


def _off_nominal(e: Effect, model: Model) -> bool:
    usual = model.kind.nominal
    tolerance = model.kind.tolerance
    return any(abs(model[name] - usual[name]) > (FURTHEST * tolerance(name, q) + 1e-12) * abs(usual[name])
               for name, q in e.parameters.items())
