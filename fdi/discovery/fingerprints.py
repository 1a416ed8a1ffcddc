"""Effects that leave their mark without noise: in the firmware's answer, and in the numbers of the position itself."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.thresholds import FINEST_COMB, FIRMWARE_DIFFERS
from fdi.trace.resolution import find_comb, is_rounding_left, measure_resolution
from fdi.trace.trace import Trace, hold_last
from plant.controller import compute_answers
from plant.effects import CATALOGUE
from plant.model import Model

Floats = NDArray[np.float64]

BUS_CURRENT, BUS_POSITION = 1e-8, 1e-7  # A, m: what one count on the bus is worth (docs/bus.md)
SIZES = 41  # trial values of a parameter, logarithmic, one decade beyond its starts on either side


class Fingerprint(NamedTuple):
    """An effect found without a doubt; `parameters` are (value, low, high) in SI units."""

    effect: str
    parameters: dict[str, tuple[float, float, float]]
    before: float  # residual without it, in units of its own resolution
    after: float  # with it


class Marks(NamedTuple):
    """What runs show without noise: effects of firmware and transducer, and how exactly Cor follows from XJ."""

    controller: float  # RMS of Cor against the model's firmware, over `resolution`; 0 where no firmware is known
    resolution: float  # A, RMS that rounding leaves of that difference
    prints: tuple[Fingerprint, ...]
    step: float = 0.0  # m, of the positions, where all are multiples of one; 0: they are not
    is_recorder: bool = False  # whether only the recording is rounded to that step, and the controller reads finer
    rivals: tuple[Fingerprint, ...] = ()  # effects of the firmware that explain its answer less well than the best one

    @property
    def rounding(self) -> float:
        """RMS of the positions' rounding, m."""
        return float(self.step / np.sqrt(12.0))

    @property
    def is_firmware_different(self) -> bool:
        """Whether Cor is another firmware's than the model's."""
        return self.controller > FIRMWARE_DIFFERS


def find_marks(model: Model, traces: Sequence[Trace]) -> Marks:
    """The marks in runs of one bench; the first tells how positions were rounded.

    A transducer with few bits is read by the controller as well, so Cor follows from the steps. Where Cor differs by
    what rounding leaves, the recorder has rounded what the controller knows better, and that is no effect of the bench.
    """
    comb = find_comb(traces[0].position, FINEST_COMB)
    step, prints = comb.step if comb else 0.0, list[Fingerprint]()
    resolution, is_recorder = measure_firmware_resolution(model, traces[0]), False
    if comb and model.kind.controller:
        left = model["controller.proportional_gain"] * step
        is_recorder = is_rounding_left(compute_firmware_residual(model, traces[0]), left, resolution)
        resolution = float(np.hypot(resolution, left / np.sqrt(12.0))) if is_recorder else resolution
    if comb and not is_recorder and "quantisation" not in model.effects:
        sizes = {"quantisation.lsb": (step, step - comb.doubt, step + comb.doubt)}
        prints.append(Fingerprint("quantisation", sizes, step / FINEST_COMB, 0.0))
    error, firmware = find_firmware_marks(model, traces, resolution)
    return Marks(error, resolution, (*prints, *firmware[:1]), step, is_recorder, tuple(firmware[1:]))


def measure_firmware_resolution(model: Model, trace: Trace) -> float:
    """How exactly the firmware's answer follows from what a trace holds, A rms: counts of com, XJ, Cor on the bus.

    Where the file holds Com or Cor with fewer digits, these.
    """
    gain = model["controller.proportional_gain"]
    steps = np.array([max(BUS_CURRENT, measure_resolution(trace.cor)), gain * BUS_POSITION,
                      gain * max(BUS_POSITION, measure_resolution(trace.com))])
    return float(np.sqrt((steps**2).sum() / 12.0))


def compute_firmware_residual(model: Model, trace: Trace) -> Floats:
    """Cor of the model's controller on the measured com and XJ, minus the measured Cor: (n,) A, NaN where missing."""
    firmware = tuple(e for e in model.effects if CATALOGUE[e].firmware)
    own = replace(model, effects=firmware)
    measured: Floats = np.where(trace.incomplete, np.nan, trace.cor)
    return compute_answers(own, trace.com, hold_last(trace.position)) - measured


def find_firmware_marks(model: Model, traces: Sequence[Trace], unit: float) -> tuple[float, list[Fingerprint]]:
    """RMS of Cor against the model's firmware over `unit` A, and the firmware effects that explain it, best first.

    Of a plant whose controller is not known, neither.
    """
    if not model.kind.controller:
        return 0.0, []
    before = _measure_rms(model, traces) / unit
    found = []
    if before > FIRMWARE_DIFFERS:
        for name, entry in CATALOGUE.items():
            if entry.firmware and name not in model.effects and len(entry.fitted) == 1:
                found.append(_fit_size(model, traces, name, before, unit))
    return before, sorted((f for f in found if f.after < 0.7 * before), key=lambda f: f.after)


def _measure_rms(model: Model, traces: Sequence[Trace]) -> float:
    return float(np.sqrt(np.mean([np.nanmean(compute_firmware_residual(model, r) ** 2) for r in traces])))


def _fit_size(model: Model, traces: Sequence[Trace], name: str, before: float, unit: float) -> Fingerprint:
    """The size of a firmware effect: a logarithmic search over all sizes, then closer and closer."""
    entry = CATALOGUE[name]
    parameter = entry.fitted[0]
    usual = [abs(s[parameter]) for s in entry.starts]
    low, high = np.log(min(usual) / 10.0), np.log(max(usual) * 10.0)
    ready = model.with_effects([name])

    def measure_error(size: float) -> float:
        return _measure_rms(ready.replace({parameter: float(np.exp(size))}), traces) / unit

    for _ in range(6):  # each time closer around the best size
        sizes = np.linspace(low, high, SIZES)
        errors = [measure_error(s) for s in sizes]
        k = int(np.argmin(errors))
        low, high = sizes[max(k - 1, 0)], sizes[min(k + 1, SIZES - 1)]
    value = float(np.exp(sizes[k]))
    return Fingerprint(name, {parameter: (value, float(np.exp(low)), float(np.exp(high)))}, before, errors[k])
