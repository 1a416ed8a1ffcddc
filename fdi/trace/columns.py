"""One column of a recording: missing samples filled, rows shifted. Columns have shape (n,); NaN is a missing sample."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


def hold_last(x: Floats) -> Floats:
    """`x` with each missing sample replaced by the last one before it; 0 before the first sample.

    >>> hold_last(np.array([np.nan, 1.0, np.nan, 2.0])).tolist()
    [0.0, 1.0, 1.0, 2.0]
    """
    last = np.maximum.accumulate(np.where(np.isnan(x), 0, np.arange(len(x))))
    filled: Floats = np.nan_to_num(x[last])
    return filled


def hold_next(x: Floats) -> Floats:
    """`x` with each missing sample replaced by the first one after it; 0 after the last sample."""
    return hold_last(x[::-1])[::-1]


def shift_rows(x: Floats, rows: int) -> Floats:
    """`x` delayed by so many rows (negative: advanced); the end values are repeated.

    >>> shift_rows(np.arange(4), 1).tolist(), shift_rows(np.arange(4), -1).tolist()
    ([0, 0, 1, 2], [1, 2, 3, 3])
    """
    return x[np.clip(np.arange(len(x)) - rows, 0, len(x) - 1)]


def bridge_gaps(x: Floats, longest: int) -> tuple[Floats, Flags]:
    """Fill gaps of up to `longest` samples with cubics through the two samples on either side.

    Longer gaps, and one at the start, hold the last sample and are flagged in the second result. Straight lines replace
    the cubics at the ends and where the samples beside a gap are far apart.
    """
    missing = np.isnan(x)
    rows = np.arange(len(x))
    there = rows[~missing]
    filled = np.interp(rows, there, x[there])
    edges = np.flatnonzero(np.diff(missing, prepend=False, append=False)).reshape(-1, 2)
    flagged = np.zeros(len(x), bool)
    for first, stop in edges:
        if stop - first > longest or first == 0:
            flagged[first:stop] = True
    gaps = rows[missing & ~flagged]
    after = np.searchsorted(there, gaps)
    inner = (after >= 2) & (after < len(there) - 1)
    gaps, near = gaps[inner], there[after[inner][:, None] + np.arange(-2, 2)]
    narrow = near[:, 3] - near[:, 0] <= longest + 5
    filled[gaps[narrow]] = _interpolate_cubic(near[narrow], x[near[narrow]], gaps[narrow])
    return np.where(flagged, hold_last(x), filled), flagged


def rms(x: Floats) -> float:
    """Root mean square of the samples that are there; NaN if there are none."""
    there = x[~np.isnan(x)]
    return float(np.sqrt(np.mean(there**2))) if len(there) else float("nan")


def _interpolate_cubic(at: NDArray[np.int64], values: Floats, wanted: NDArray[np.int64]) -> Floats:
    """Lagrange's cubics through `values` (m, 4) at rows `at` (m, 4), evaluated at rows `wanted` (m,)."""
    out = np.zeros(len(wanted))
    for i in range(4):
        others = [j for j in range(4) if j != i]
        parts = (wanted[:, None] - at[:, others]) / (at[:, [i]] - at[:, others])
        out += values[:, i] * parts.prod(axis=1)
    return out
