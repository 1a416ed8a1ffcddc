"""Effects that leave their mark without noise: in the firmware's answer, and in the numbers of the position itself."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.trace.trace import Trace, hold_last
from plant.controller import compute_answers
from plant.effects import CATALOGUE
from plant.model import Model

Floats = NDArray[np.float64]

BUS_CURRENT, BUS_POSITION = 1e-8, 1e-7  # A, m: what one count on the bus is worth (docs/bus.md)
FINEST_COMB = 2.5e-7  # m; a coarser grid of positions is none of the bus
SIZES = 41  # trial values of a parameter, logarithmic, one decade beyond its starts on either side


class Fingerprint(NamedTuple):
    """An effect found without a doubt; `parameters` are (value, low, high) in SI units."""

    effect: str
    parameters: dict[str, tuple[float, float, float]]
    before: float  # residual without it, in units of its own resolution
    after: float  # with it


def measure_firmware_resolution(model: Model) -> float:
    """How exactly the firmware's answer follows from what a trace holds, A rms: counts of com, XJ, Cor on the bus."""
    counts = np.array([BUS_CURRENT, *(2 * [model["controller.proportional_gain"] * BUS_POSITION])])
    return float(np.sqrt((counts**2).sum() / 12.0))


def compute_firmware_residual(model: Model, trace: Trace) -> Floats:
    """Cor of the model's controller on the measured com and XJ, minus the measured Cor: (n,) A, NaN where missing."""
    firmware = tuple(e for e in model.effects if CATALOGUE[e].firmware)
    own = replace(model, effects=firmware)
    measured: Floats = np.where(trace.incomplete, np.nan, trace.cor)
    return compute_answers(own, trace.com, hold_last(trace.position)) - measured


def find_firmware_marks(model: Model, traces: Sequence[Trace]) -> tuple[float, list[Fingerprint]]:
    """RMS of Cor against the model's firmware in units of its resolution, and the firmware effects that explain it.

    Of a plant whose controller is not known, neither.
    """
    if not model.kind.controller:
        return 0.0, []
    unit = measure_firmware_resolution(model)
    before = _measure_rms(model, traces) / unit
    found = []
    if before > 3.0:
        for name, entry in CATALOGUE.items():
            if entry.firmware and name not in model.effects and len(entry.fitted) == 1:
                found.append(_fit_size(model, traces, name, before))
    return before, sorted((f for f in found if f.after < 0.7 * before), key=lambda f: f.after)


def _measure_rms(model: Model, traces: Sequence[Trace]) -> float:
    return float(np.sqrt(np.mean([np.nanmean(compute_firmware_residual(model, r) ** 2) for r in traces])))


def _fit_size(model: Model, traces: Sequence[Trace], name: str, before: float) -> Fingerprint:
    """The size of a firmware effect: a logarithmic search over all sizes, then closer and closer."""
    entry = CATALOGUE[name]
    parameter = entry.fitted[0]
    usual = [abs(s[parameter]) for s in entry.starts]
    low, high = np.log(min(usual) / 10.0), np.log(max(usual) * 10.0)
    unit, ready = measure_firmware_resolution(model), model.with_effects([name])

    def measure_error(size: float) -> float:
        return _measure_rms(ready.replace({parameter: float(np.exp(size))}), traces) / unit

    for _ in range(6):  # each time closer around the best size
        sizes = np.linspace(low, high, SIZES)
        errors = [measure_error(s) for s in sizes]
        k = int(np.argmin(errors))
        low, high = sizes[max(k - 1, 0)], sizes[min(k + 1, SIZES - 1)]
    value = float(np.exp(sizes[k]))
    return Fingerprint(name, {parameter: (value, float(np.exp(low)), float(np.exp(high)))}, before, errors[k])


def find_quantisation(trace: Trace) -> Fingerprint | None:
    """A transducer with few bits: every sensed position is a multiple of one step."""
    x = trace.position[~np.isnan(trace.position)]
    levels = np.unique(x)
    if len(levels) < 8 or "quantisation" not in CATALOGUE:
        return None
    gaps = np.diff(levels)
    step = float(np.min(gaps[gaps > 1e-12], initial=np.inf))
    if not FINEST_COMB < step < np.inf:
        return None
    for _ in range(3):  # the smallest gap tells the step roughly, the whole range tells it exactly
        counts = np.rint((levels - levels[0]) / step)
        step = float((counts @ (levels - levels[0])) / max(counts @ counts, 1.0))
    off = np.abs(levels - levels[0] - step * np.rint((levels - levels[0]) / step))
    if off.max() > 0.02 * step:
        return None
    doubt = 2.0 * float(off.max()) / max(float(np.ptp(counts)), 1.0) + 1e-6 * step
    sizes = {"quantisation.lsb": (step, step - doubt, step + doubt)}
    return Fingerprint("quantisation", sizes, step / FINEST_COMB, 0.0)
