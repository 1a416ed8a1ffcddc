"""How finely a column was recorded: the steps that its values come in."""
from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.thresholds import ROUNDED_SHARE

Floats = NDArray[np.float64]

FEWEST_VALUES = 20  # distinct ones that show how finely a column was recorded


class Comb(NamedTuple):
    """All values of a column are multiples of one step."""

    step: float
    doubt: float  # of the step


def find_comb(x: Floats, finest: float = 0.0) -> Comb | None:
    """The comb of a column (n,), if it has one that is coarser than `finest`; NaN are left out."""
    levels = np.unique(x[~np.isnan(x)])
    if len(levels) < 8:
        return None
    gaps = np.diff(levels)
    rounding = 1e-12 * float(np.abs(levels).max())
    step = float(np.min(gaps[gaps > rounding], initial=np.inf))
    if not finest < step < np.inf:
        return None
    for _ in range(3):  # the smallest gap tells the step roughly, the whole range tells it exactly
        counts = np.rint((levels - levels[0]) / step)
        step = float((counts @ (levels - levels[0])) / max(counts @ counts, 1.0))
    off = np.abs(levels - levels[0] - step * np.rint((levels - levels[0]) / step))
    if off.max() > 0.02 * step:
        return None
    return Comb(step, 2.0 * float(off.max()) / max(float(np.ptp(counts)), 1.0) + 1e-6 * step)


def is_rounding_left(residual: Floats, step: float, resolution: float) -> bool:
    """Whether a residual (n,) is what rounding of an input to steps leaves: no more than half a step, and not less.

    Args:
        residual: of an answer that was computed from the rounded input; NaN are left out.
        step: of the input, in the unit of the answer.
        resolution: RMS of what else is rounded, in the same unit.
    """
    left = np.abs(residual[~np.isnan(residual)])
    if not left.size:
        return False
    inside = left <= 0.5 * step + 3.0 * resolution
    least = 0.3 * step / np.sqrt(12.0)  # an input that rests on one step leaves less than the usual 1
    return bool(inside.mean() >= ROUNDED_SHARE and np.sqrt(np.mean(left[inside] ** 2)) > max(least, 3.0 * resolution))


def measure_resolution(x: Floats) -> float:
    """The RMS step between the values that a column can hold, from the digits they are written with.

    A few values show none, 0.0: a demand of 5 mm has one digit and may be exact.
    """
    values = np.unique(x[~np.isnan(x)])
    if len(values) < FEWEST_VALUES:
        return 0.0
    values = values[:: max(1, len(values) // 400)]  # a few hundred show as many digits as all
    digits, places = 1, -30
    for value in values[values != 0.0].tolist():
        mantissa, _, exponent = f"{value:.11e}".partition("e")  # 12 digits: more is rounding of a float
        shown = mantissa.lstrip("-").replace(".", "").rstrip("0")
        digits, places = max(digits, len(shown)), max(places, len(shown) - 1 - int(exponent))
    size = np.floor(np.log10(np.maximum(np.abs(values), 1e-300)))
    steps = np.where(values == 0.0, 0.0, 10.0 ** (size - digits + 1))
    return float(np.sqrt(np.mean(np.maximum(steps, 10.0**-places) ** 2)))
