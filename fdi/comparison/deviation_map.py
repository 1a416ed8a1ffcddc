"""How large a residual is by speed and by amplitude of the motion."""
from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from fdi.trace.trace import Trace

Floats = NDArray[np.float64]

SPEEDS = (0.0, 1e-3, 3e-3, 10e-3, 30e-3, 100e-3, 300e-3, np.inf)  # m/s, edges of the cells; noise alone is 0.14 mm/s
AMPLITUDES = (0.0, 0.03e-3, 0.1e-3, 0.3e-3, 1e-3, 3e-3, 10e-3, 30e-3, np.inf)  # m


class DeviationMap(NamedTuple):
    """Error over noise floor of each signal in cells of speed and amplitude; NaN where there are too few rows.

    `speeds` (m + 1,) m/s and `amplitudes` (n + 1,) m are the edges of the cells that hold rows; each array of `ratio`
    has shape (n, m), and so has `rows`.
    """

    speeds: Floats
    amplitudes: Floats
    ratio: Mapping[str, Floats]
    rows: NDArray[np.int64]


def map_deviation(trace: Trace, residual: Mapping[str, Floats], floor: Mapping[str, float],
                  fewest: int = 30) -> DeviationMap | None:
    """RMS residual over floor by speed and amplitude of the ram; None if no cell has `fewest` rows.

    Args:
        trace: gives the motion. The speed is that over 20 rows; the amplitude is half the range of the position within
            0.25 s before and after.
        residual: (n,) of each signal, NaN where it is not judged.
        floor: noise floor of each signal, > 0, in the unit of its residual.
        fewest: rows that a cell needs.
    """
    position = _fill(trace.xj)
    speed = np.abs(position[np.minimum(np.arange(len(position)) + 10, len(position) - 1)]
                   - position[np.maximum(np.arange(len(position)) - 10, 0)]) / (20 * trace.period)
    width = 2 * round(0.25 / trace.period) + 1
    amplitude = 0.5 * (maximum_filter1d(position, width) - minimum_filter1d(position, width))
    cells = (np.digitize(amplitude, AMPLITUDES) - 1) * (len(SPEEDS) - 1) + np.digitize(speed, SPEEDS) - 1
    shape, size = (len(AMPLITUDES) - 1, len(SPEEDS) - 1), (len(AMPLITUDES) - 1) * (len(SPEEDS) - 1)
    judged = ~np.all([np.isnan(r) for r in residual.values()], axis=0)
    rows = np.bincount(cells[judged], minlength=size).reshape(shape)
    enough = rows >= fewest
    if not enough.any():
        return None
    ratio = {}
    for name, r in residual.items():
        known = ~np.isnan(r)
        count = np.bincount(cells[known], minlength=size).reshape(shape)
        square = np.bincount(cells[known], r[known] ** 2, minlength=size).reshape(shape)
        ratio[name] = np.where(enough & (count > 0), np.sqrt(square / np.maximum(count, 1)) / floor[name], np.nan)
    down, across = (slice(np.flatnonzero(enough.any(axis))[0], np.flatnonzero(enough.any(axis))[-1] + 1)
                    for axis in (1, 0))
    return DeviationMap(np.array(SPEEDS[across.start:across.stop + 1]),
                        np.array(AMPLITUDES[down.start:down.stop + 1]),
                        {name: r[down, across] for name, r in ratio.items()}, rows[down, across])


def _fill(position: Floats) -> Floats:
    known = np.flatnonzero(~np.isnan(position))
    filled: Floats = np.interp(np.arange(len(position)), known, position[known])
    return filled
