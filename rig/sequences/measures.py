"""Measures of sampled signals: overshoot, settling time, phase lag and so on, each a single number.

Signals have shape (n,), SI, one sample per cycle. Position carries some 2 um rms of sensor noise; where one sample
could decide (a peak, the last sample outside a band) a centred moving median of MEDIAN samples goes first. It keeps
steps and ramps as they are, lowers a peak of angular frequency w by (w * 1 ms)^2 / 2 of its curve (0.7 % at 120 rad/s),
and leaves 1.1 um rms of the noise.
"""
from __future__ import annotations

import numpy as np

from plant.segments import RATE, Array

MEDIAN_SAMPLES = 5  # samples
SPEED_SPAN = 20  # cycles between the two samples of a speed: 2 um rms of position noise become 0.14 mm/s rms


class NotMeasurable(Exception):
    """A measure does not exist for a signal; the message says why."""


def bridge_gaps(signal: Array, name: str, allowed: float) -> Array:
    """The signal with missing samples (NaN) on straight lines; NotMeasurable if more than a fraction `allowed` are."""
    missing = ~np.isfinite(signal)
    count = int(missing.sum())
    if count == len(signal):
        raise NotMeasurable(f"{name} was not measured")
    if count > allowed * len(signal):
        raise NotMeasurable(f"{count} of {len(signal)} samples of {name} are missing")
    if not count:
        return signal
    rows = np.arange(len(signal))
    return np.interp(rows, rows[~missing], signal[~missing])


def filter_median(signal: Array) -> Array:
    """Centred moving median of MEDIAN samples, the ends repeated."""
    half = MEDIAN_SAMPLES // 2
    padded = np.pad(signal, half, mode="edge")
    filtered: Array = np.median(np.lib.stride_tricks.sliding_window_view(padded, MEDIAN_SAMPLES), axis=1)
    return filtered


def compute_speed(position: Array) -> Array:
    """Central difference over SPEED_SPAN cycles, one-sided at the ends, m/s."""
    rows = np.arange(len(position))
    ahead, behind = np.minimum(rows + SPEED_SPAN // 2, len(rows) - 1), np.maximum(rows - SPEED_SPAN // 2, 0)
    if len(rows) < 2:
        raise NotMeasurable("one sample has no speed")
    difference: Array = (position[ahead] - position[behind]) * RATE / (ahead - behind)
    return difference


def measure_step_size(com: Array, before: float, smallest: float = 20e-6) -> float:
    """What a step section asks for; NotMeasurable if it has no step at its start or moves on later.

    `smallest`: m; ten times the noise.
    """
    size = float(com[-1] - before)
    if abs(size) < smallest or np.abs(com - com[-1]).max() > 1e-9:
        raise NotMeasurable("the command does not step here and then hold")
    return size


def measure_overshoot(position: Array, com: Array, before: float) -> float:
    """How far the highest point is beyond the target, % of the step; 0 if it never gets there."""
    size = measure_step_size(com, before)
    return max(0.0, 100 * float(((filter_median(position) - com[-1]) / size).max()))


def measure_settling_time(position: Array, com: Array, before: float, band: float) -> float:
    """Time until the position stays within +-band % of the step around the target, s."""
    size = measure_step_size(com, before)
    outside = np.flatnonzero(np.abs(filter_median(position) - com[-1]) > abs(size) * band / 100)
    if not len(outside):
        return 0.0
    if outside[-1] == len(position) - 1:
        raise NotMeasurable(f"still outside +-{band:g} % at the end of the window")
    return float(outside[-1] + 1) / RATE


def measure_rise_time(position: Array, com: Array, before: float) -> float:
    """Time from 10 % to 90 % of the step, s, interpolated between samples."""
    size = measure_step_size(com, before)
    done = (filter_median(position) - before) / size

    def find_time(level: float) -> float:
        beyond = np.flatnonzero(done >= level)
        if not len(beyond):
            raise NotMeasurable(f"{100 * level:g} % of the step was never reached")
        k = int(beyond[0])
        return k - (done[k] - level) / (done[k] - done[k - 1]) if k else 0.0

    return float(find_time(0.9) - find_time(0.1)) / RATE


def measure_ramp_error(error: Array, com: Array) -> float:
    """Mean lag behind a ramp, m, positive when the ram is behind whichever way it goes (docs/physics.md)."""
    if com[-1] == com[0]:
        raise NotMeasurable("the command does not move here")
    return float(error.mean() * np.sign(com[-1] - com[0]))


def measure_break_away(error: Array) -> float:
    """Position error that builds up before the spool lets go, m: half the band that stick-slip draws on a slow ramp.

    docs/physics.md: FSS KF / (GPF1 ASV GM GAP). The band is taken from the 1st to the 99th percentile of the
    filtered error, so that noise and single outliers do not widen it; a triangle loses 2 % by that. The mean (ramp
    error) drops out.
    """
    low, high = np.percentile(filter_median(error), (1, 99))
    return float(high - low) / 2


def measure_response(signal: Array, com: Array, frequency: float) -> complex:
    """Signal over command as a complex number at `frequency`, Hz: least-squares sine, cosine and mean of both."""
    if len(com) < RATE / frequency:
        raise NotMeasurable(f"the window is shorter than one period of {frequency:g} Hz")
    phase = 2 * np.pi * frequency * np.arange(len(com)) / RATE
    basis = np.column_stack((np.sin(phase), np.cos(phase), np.ones(len(com))))
    (sine, cosine, _), *_ = np.linalg.lstsq(basis, np.column_stack((com, signal)), rcond=None)
    asked, given = complex(sine[0], cosine[0]), complex(sine[1], cosine[1])
    if abs(asked) < 1e-9:
        raise NotMeasurable(f"the command has no {frequency:g} Hz here")
    return given / asked


def find_crossing(signal: Array, above: float | None, below: float | None) -> float:
    """Time of the first of three samples in a row above or below a level, s from the signal's start."""
    beyond = np.zeros(len(signal), bool)
    if above is not None:
        beyond |= signal > above
    if below is not None:
        beyond |= signal < below
    in_a_row = np.flatnonzero(beyond[:-2] & beyond[1:-1] & beyond[2:])
    if not len(in_a_row):
        raise NotMeasurable("the level was never passed")
    return float(in_a_row[0]) / RATE
