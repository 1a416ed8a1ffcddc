"""Times of a recording's samples: a column in any unit, calendar times, a fixed rate, or a counter that wraps."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fdi.trace.importing.import_map import TimeBase
from fdi.trace.importing.units import convert_to_si
from plant.errors import InputError

Floats = NDArray[np.float64]


def compute_times(base: TimeBase, samples: int, column: Floats | None, where: object, field: str) -> Floats:
    """Times (s) of so many samples; `column` holds the values of the base's source.

    Raises:
        InputError: times that are missing, stand still or go backwards, and counts that are no whole numbers.
    """
    if column is None:
        assert base.rate is not None  # a base without source has a rate
        return np.arange(samples) / base.rate
    missing = np.isnan(column)
    if missing.any():
        raise InputError(where, field, f"a time in every row; row {int(missing.argmax()) + 1} has none")
    if base.bits is not None and base.rate is not None:
        return unwrap_counter(column, base.bits, where, field) / base.rate
    t = column - column[0] if base.unit is None else convert_to_si(column, base.unit)
    require_growth(t, where, field)
    return t


def unwrap_counter(counts: Floats, bits: int, where: object, field: str) -> Floats:
    """Counts since the first sample, of a counter that starts again at 2**bits.

    >>> unwrap_counter(np.array([254.0, 255.0, 0.0, 3.0]), 8, "x", "n").tolist()
    [0.0, 1.0, 2.0, 5.0]

    Raises:
        InputError: counts that are no whole numbers below 2**bits, or that repeat.
    """
    size = 2.0**bits
    bad = (counts != np.floor(counts)) | (counts < 0) | (counts >= size)
    if bad.any():
        row = int(bad.argmax())
        raise InputError(where, field, f"whole numbers from 0 to {size - 1:.0f} ({bits} bits); "
                                       f"row {row + 1} has {counts[row]:g}")
    steps = np.diff(counts) % size
    if (steps == 0).any():
        row = int((steps == 0).argmax()) + 2
        raise InputError(where, field, f"a counter that goes on in every row; row {row} repeats {counts[row - 1]:g}")
    return np.concatenate([[0.0], np.cumsum(steps)])


def require_growth(t: Floats, where: object, field: str) -> None:
    """Refuse times that do not grow.

    Raises:
        InputError: it names the row and both times.
    """
    grows = np.diff(t) > 0.0
    if not grows.all():
        row = int(np.argmin(grows)) + 1
        raise InputError(where, field, f"times that grow; row {row + 1} has {t[row]:.9g} s after {t[row - 1]:.9g} s "
                                       "(a counter that wraps needs bits and rate)")
