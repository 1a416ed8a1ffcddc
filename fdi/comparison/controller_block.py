"""The controller's block: Cor against what the firmware of the model answers to the recorded Com and XJ.

Nothing in it is noise, so the two agree to the last digit of the file or bus, or the firmware is another one. First of
all it shows whether the columns belong to the same cycle.
"""
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.trace.columns import hold_last, shift_rows
from fdi.trace.trace import Trace
from plant.effects import at
from plant.model import Model, kernel

Floats = NDArray[np.float64]

FLOAT32 = 1e-7  # of the current limit: a firmware may calculate in single precision
LAGS = range(-8, 21)  # cycles that Com or XJ may be late in the file
BETTER = 0.1  # of the misfit at no lag, that a lag has to leave for being believed
DISAGREES = 3.0  # times the resolution; rounding alone does not reach that


class ControllerBlock(NamedTuple):
    """The controller's block."""

    residual: Floats  # (n,) A, Cor less what the model answers; NaN where it cannot be told
    error: float  # A, RMS
    floor: float  # A, RMS of the rounding in file or bus
    com_lag: int = 0  # cycles: Cor_k answers Com of cycle k - com_lag
    xj_lag: int = 0
    gain: float = math.nan  # A/m, as the answers show it
    limit: float = math.inf  # A, of the model's current

    @property
    def ratio(self) -> float:
        """Error over floor."""
        return self.error / self.floor


def compare_controller(trace: Trace, model: Model) -> ControllerBlock:
    """Compare; where it does not fit, look for the cycles that Com and XJ are late. NaN where firmware is unknown."""
    if not model.kind.controller:
        return ControllerBlock(np.full(len(trace), np.nan), math.nan, math.nan, limit=model["controller.current_limit"])
    found = _compared(trace, model, 0, 0)
    if found.ratio <= DISAGREES:
        return found
    com, xj, gain = find_lags(trace, model["controller.current_limit"])
    found = found._replace(gain=gain)
    if (com, xj) == (0, 0):
        return found
    late = _compared(trace, model, com, xj)
    return late._replace(gain=gain) if late.error < BETTER * found.error else found


def _compared(trace: Trace, model: Model, com: int, xj: int) -> ControllerBlock:
    limit = model["controller.current_limit"]
    sensed = shift_rows(trace.xj, xj)
    answers = run_firmware(model, shift_rows(trace.com, com), hold_last(sensed))
    residual = trace.cor - answers
    unknown = np.isnan(sensed) | ~trace.usable
    unknown[1:] |= unknown[:-1].copy()  # a derivative looks back by one
    if model["controller.integral_gain"] != 0.0 and unknown.any():
        unknown[int(np.argmax(unknown)):] = True  # what the integral did in a gap is not known
    unknown[:max(0, com, xj)] = True
    unknown[len(unknown) + min(0, com, xj):] = True
    residual[unknown] = np.nan
    gain = abs(model["controller.proportional_gain"]) + abs(model["controller.derivative_gain"]) / trace.period
    cor, xj_step, com_step = (measure_resolution(column) for column in (trace.cor, trace.xj, trace.com))
    floor = max(float(np.hypot.reduce([cor, gain * xj_step, gain * com_step])) / math.sqrt(12.0), FLOAT32 * limit)
    error = float(np.sqrt(np.nanmean(residual**2))) if not unknown.all() else math.nan
    return ControllerBlock(residual, error, floor, com, xj, limit=limit)


def run_firmware(model: Model, com: Floats, xj: Floats) -> Floats:
    """What the model's controller answers, (n,) A, to a demand (n,) m and a sensed position (n,) m."""
    out = np.empty(len(com))
    memory = at("command", model.effects)[1]
    kernel("firmware", model.effects)(memory, com, xj, model.record(), out)
    return out


def measure_resolution(x: Floats) -> float:
    """The RMS step between the values that a column can hold, from the digits they are written with."""
    values = np.unique(x[~np.isnan(x)])
    values = values[:: max(1, len(values) // 400)]  # a few hundred show as many digits as all
    digits, places = 1, -30
    for value in values[values != 0.0].tolist():
        mantissa, _, exponent = f"{value:.11e}".partition("e")  # 12 digits: more is rounding of a float
        shown = mantissa.lstrip("-").replace(".", "").rstrip("0")
        digits, places = max(digits, len(shown)), max(places, len(shown) - 1 - int(exponent))
    size = np.floor(np.log10(np.maximum(np.abs(values), 1e-300)))
    steps = np.where(values == 0.0, 0.0, 10.0 ** (size - digits + 1))
    return float(np.sqrt(np.mean(np.maximum(steps, 10.0**-places) ** 2)))


def find_lags(trace: Trace, limit: float) -> tuple[int, int, float]:
    """Trace that Com and XJ are late in Cor = g (Com - XJ), the two that fit best; and the gain g, A/m."""
    inside = trace.usable & (np.abs(trace.cor) < 0.98 * min(limit, float(np.abs(trace.cor).max())))
    inside[:max(LAGS)], inside[min(LAGS):] = False, False
    xj = hold_last(trace.xj)
    columns = [shift_rows(x, lag)[inside] for x in (trace.com, xj) for lag in LAGS]
    whole = np.column_stack([*columns, trace.cor[inside]])
    gram = np.einsum("ki,kj->ij", whole, whole)
    n, target = len(LAGS), gram[-1, -1]
    best = (math.inf, 0, 0, math.nan)
    for a in range(n):
        for b in range(n):
            pick = [a, n + b]
            left, right = gram[np.ix_(pick, pick)], gram[pick, -1]
            gains = np.linalg.lstsq(left, right, rcond=None)[0]
            misfit = float(target - gains @ right)
            nearer = abs(LAGS[a]) + abs(LAGS[b])
            if misfit < best[0] * (1 - 1e-9) - 1e-30 * nearer:
                best = (misfit, LAGS[a], LAGS[b], float(gains[0]))
    return best[1], best[2], best[3]
