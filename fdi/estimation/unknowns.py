"""What a fit may change: the tolerances of a unit, the parameters of effects, and what is known of them beforehand."""
from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from fdi.estimation.likelihood import Free
from fdi.thresholds import HEALTHY_TOLERANCES
from fdi.trace.trace import Floats
from plant.effects import CATALOGUE, Effect
from plant.model import Model, find_quantity, list_offered_effects, list_searched_effects

UNREPLAYED = ("command", "reading")  # ports that a replay from the measured current does not pass
WITHOUT_NOISE = {f"sensors.{quantity}_noise": 0.0 for quantity in ("position", "pressure", "spool")}


def list_relative_tolerances(model: Model, names: Iterable[str]) -> dict[str, float]:
    """Of the named parameters those that differ from one healthy unit to the next, with one tolerance as a fraction."""
    found = {name: model.kind.find_tolerance(name, find_quantity(name, plant=model.plant)) for name in names}
    return {name: tolerance for name, tolerance in found.items() if tolerance > 0.0}


def list_tolerance_sizes(model: Model) -> dict[str, float]:
    """The parameters that differ from one healthy unit to the next, with one tolerance in SI units."""
    found = list_relative_tolerances(model, model.list_names())
    sizes = {name: tolerance * abs(model[name]) for name, tolerance in found.items()}
    return {name: size for name, size in sizes.items() if size > 0.0}


def list_tolerance_unknowns(model: Model) -> tuple[Free, ...]:
    """The parameters with a tolerance as unknowns of a fit, each with its tolerance as prior.

    The tolerance is a fraction of the nominal value, so that it does not depend on the model's own.
    """
    usual = model.nominal
    free = []
    for name, tolerance in list_relative_tolerances(model, model.values).items():
        value, q = model.values[name], find_quantity(name, plant=model.plant)
        scale = tolerance * (abs(usual.get(name, value)) or 1.0)
        low, high = value - HEALTHY_TOLERANCES * scale, value + HEALTHY_TOLERANCES * scale
        free.append(Free(name, value, scale, 1.0, max(q.low, q.above, low), min(q.high, q.below, high), 0.3))
    return tuple(free)


def list_effect_unknowns(effect: Effect, model: Model, turning: float = 2e-3) -> tuple[Free, ...]:
    """The parameters of an effect as unknowns of a fit, without prior: only their possible range is known.

    `turning`, Hz, is the first difference of a frequency: a small part of a turn over a test.
    """
    usual, free = model.nominal, []
    for name in effect.fitted:
        q, off = effect.parameters[name], effect.off.get(name, usual.get(name, 0.0))
        sizes = sorted(abs(start[name] - off) for start in effect.starts)
        scale = sizes[len(sizes) // 2] or 1.0
        step = turning / scale if q.unit == "Hz" else 0.05
        free.append(Free(name, off, scale, np.inf, max(q.low, q.above), min(q.high, q.below), step))
    return tuple(free)


def name_sine(effect: str) -> tuple[str, str, str] | None:
    """Names of the amplitude, the frequency and the phase of an effect that has them."""
    entry = CATALOGUE[effect]
    named = {entry.parameters[n].unit: n for n in entry.fitted}
    size = next((n for n in entry.fitted if entry.parameters[n].unit not in ("Hz", "rad")), None)
    if size is None or not {"Hz", "rad"} <= set(named) or not entry.starts:
        return None
    return size, named["Hz"], named["rad"]


def turn_amplitudes_positive(free: Sequence[Free], x: Floats) -> Floats:
    """Scaled unknowns, (p,), of the same sines with amplitudes that are not negative and phases within half a turn."""
    x, place = x.copy(), {f.name: k for k, f in enumerate(free)}
    for sine in map(name_sine, CATALOGUE):
        if sine is None or sine[0] not in place:
            continue
        size, angle = place[sine[0]], place[sine[2]]
        amplitude, phase = (free[k].centre + free[k].scale * x[k] for k in (size, angle))
        phase += np.pi * (amplitude < 0.0)
        x[size] = (abs(amplitude) - free[size].centre) / free[size].scale
        x[angle] = ((phase + np.pi) % (2.0 * np.pi) - np.pi - free[angle].centre) / free[angle].scale
    return x


def list_active_effects(model: Model) -> tuple[str, ...]:
    """Effects at work in a model; those of the reference model if no healthy unit could be so far off nominal."""
    return tuple(e.name for e in list_offered_effects(model.plant)
                 if (_is_off_nominal(e, model) if e.base else e.name in model.effects and e.is_active(model.values)))


def list_active_unknowns(model: Model) -> tuple[Free, ...]:
    """The parameters of the active effects as unknowns of a fit, from their present values and without prior."""
    replayed = [CATALOGUE[name] for name in list_active_effects(model) if CATALOGUE[name].port not in UNREPLAYED]
    return tuple(u._replace(centre=model[u.name]) for e in replayed for u in list_effect_unknowns(e, model))


def list_all_unknowns(model: Model) -> tuple[Free, ...]:
    """All that is free in a model: tolerances, and the parameters of the effects that it has."""
    own = list_active_unknowns(model)
    taken = {u.name for u in own}
    return (*(f for f in list_tolerance_unknowns(model) if f.name not in taken), *own)


def _is_off_nominal(e: Effect, model: Model) -> bool:
    usual = model.nominal
    tolerance = model.kind.find_tolerance
    return any(abs(model[name] - usual[name]) > (HEALTHY_TOLERANCES * tolerance(name, q) + 1e-12) * abs(usual[name])
               for name, q in e.parameters.items())


def complete_model(model: Model) -> Model:
    """The model without sensor noise and with all effects that are searched in its plant, at their off values."""
    return silence_readings(model.with_effects(e.name for e in list_searched_effects(model.plant) if not e.disturbance))


def silence_readings(model: Model) -> Model:
    """The model without sensor noise and rounding: these are what fits allow for."""
    readings = [CATALOGUE[name] for name in model.effects if CATALOGUE[name].port == "reading"]
    return model.replace(WITHOUT_NOISE | {name: value for e in readings for name, value in e.off.items()})
