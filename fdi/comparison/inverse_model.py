"""The error of the drive: what a model turned round does not explain of the drive that a measured motion took.

Defined as the users of the EMPS benchmark do (A. Janot, M. Gautier, M. Brunot, "Data Set and Reference Models of EMPS",
2019): the controlled signal through a Butterworth filter of fourth order, forwards and backwards, rates by central
differences, both drives decimated by ten; 100 |u - u_model| / |u|. At 1 kHz the filter ends at 100 Hz.
"""
from __future__ import annotations

import numpy as np

from fdi.trace.trace import Trace
from plant.inverse import compute_needed_drive
from plant.model import Model

CUT_OFF = 0.2  # of half the rate of rows
DECIMATION = 10
TRANSIENT = 20  # rows at either end, of the filter's transient


def measure_drive_error(trace: Trace, model: Model) -> float | None:
    """Share of the drive, 0 to 1, that the inverse model leaves; None where the plant declares none or it cannot tell.

    Drive k - 1 acts from row k to k + 1.
    """
    rows = len(trace) - 2 * TRANSIENT
    if model.kind.inverse is None or rows < 50 * DECIMATION or np.isnan(trace.controlled).any():
        return None
    from scipy.signal import butter, decimate, filtfilt  # late: it takes longer to import than all else of a comparison

    x = filtfilt(*butter(4, CUT_OFF), trace.controlled)
    v = np.gradient(x, trace.period)
    motion = np.column_stack([x, v, np.gradient(v, trace.period)])
    needed = compute_needed_drive(model, motion, trace.load)[TRANSIENT:-TRANSIENT]
    acting = np.concatenate([trace.drive[:1], trace.drive[:-1]])[TRANSIENT:-TRANSIENT]
    kept = np.convolve(~trace.usable[TRANSIENT:-TRANSIENT], np.ones(DECIMATION), "same")[::DECIMATION] < 0.5
    u, left = (decimate(column, DECIMATION, zero_phase=True)[kept] for column in (acting, acting - needed))
    size = float(np.linalg.norm(u))
    return float(np.linalg.norm(left)) / size if size else None
