"""The numbers that a response is judged by since long before models: of many runs at once, from command and position.

Each is a mean over the sections of its kind. Noise of the position decides none of them: peaks are taken from means of
SMOOTH samples, ranges between percentiles, and a reversal counts when it passes a quarter of the usual range.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.envelope import HORIZON, judged_rows, speed, waver
from fdi.trace.sections import Section

Floats = NDArray[np.float64]

SMOOTH = 5  # samples
SETTLING_BAND = 0.05  # of the step
SURE = 0.05  # s, as long a response must stay within, as an oscillation passes through now and then
LEAST_STEP = 2e-4  # m, below which noise and friction are all that a step shows
RESTING = 0.25  # s after a step, from when on the ram should be at rest
STUCK = 0.3  # of the ramp's rate, slower than that the ram sticks
LONG = 0.5  # s of a ramp, that several slips take
FASTEST = 5e-3  # m/s, of a ramp slow enough to show friction


class Meaning(NamedTuple):
    """What a precursor is called, its unit, and how many of them make one SI unit."""

    words: str
    unit: str
    scale: float


MEANINGS = {
    "overshoot": Meaning("first overshoot", "%", 1.0),
    "undershoot": Meaning("swing back after it", "%", 1.0),
    "rise_time": Meaning("rise from 10 to 90 %", "ms", 1e3),
    "peak_time": Meaning("time of the first peak", "ms", 1e3),
    "settling_time": Meaning("settling within 5 %", "ms", 1e3),
    "rest_error": Meaning("error at rest, RMS", "um", 1e6),
    "mean_ramp_error": Meaning("mean error on the ramp", "um", 1e6),
    "ramp_asymmetry": Meaning("half the difference of ramps out and in", "um", 1e6),
    "break_away": Meaning("break-away resolution", "um", 1e6),
    "stick_slip_amplitude": Meaning("stick-slip amplitude", "um", 1e6),
    "stick_slip_frequency": Meaning("stick-slip frequency", "Hz", 1.0),
    "speed_ripple": Meaning("speed ripple, s.d.", "mm/s", 1e3),
    "slip_speed": Meaning("fastest slip", "mm/s", 1e3),
    "stuck_share": Meaning("share of the ramp at rest", "%", 100.0),
    "tracking_error": Meaning("RMS error in motion", "um", 1e6),
}
OF_STEPS = ("overshoot", "undershoot", "rise_time", "peak_time", "settling_time")


def features(com: Floats, x: Floats, period: float, parts: Sequence[Section]) -> dict[str, Floats]:
    """Precursors of runs `x` (m, n) m of a command (n,) m, by name as in MEANINGS, SI or %; (m,) each.

    Those of steps carry the step's size, as `overshoot_5mm`. What the command does not show is left out; NaN is what a
    run did not show: an oscillation that never settles.
    """
    out: dict[str, list[Floats]] = {}
    ramps: dict[float, list[Floats]] = {1.0: [], -1.0: []}
    for s in parts:
        rows = slice(s.start, s.stop)
        if s.kind == "step" and abs(s.last - s.first) >= LEAST_STEP:
            size = f"{1e3 * abs(s.last - s.first):.3g}mm"
            for word, values in _step(x[:, rows], s, period):
                out.setdefault(word if word == "rest_error" else f"{word}_{size}", []).append(values)
        elif slow(s, period):
            for word, values in _ramp(com, x, period, s):
                out.setdefault(word, []).append(values)
            ramps[float(np.sign(s.rate))].append(out["mean_ramp_error"][-1])
        elif s.kind == "dynamic":
            error = com[rows] - x[:, rows]
            out.setdefault("tracking_error", []).append(np.sqrt(np.nanmean(error**2, axis=1)))
    if ramps[1.0] and ramps[-1.0]:
        out["ramp_asymmetry"] = [(np.mean(ramps[1.0], axis=0) - np.mean(ramps[-1.0], axis=0)) / 2]
    order = {word: i for i, word in enumerate(MEANINGS)}
    return {word: np.mean(out[word], axis=0) for word in sorted(out, key=lambda w: (order[kind_of(w)], w))}


def slow(s: Section, period: float) -> bool:
    """Whether a section is a ramp that shows friction: slow, and long enough for several slips."""
    return s.kind == "ramp" and abs(s.rate) < FASTEST and s.stop - judged_rows(s, period).start > LONG / period


def kind_of(name: str) -> str:
    """The key into MEANINGS: a name without the step's size."""
    return name if name in MEANINGS else name.rpartition("_")[0]


def _step(x: Floats, s: Section, period: float) -> Iterator[tuple[str, Floats]]:
    """Response of (m, rows) to one step, as a fraction of it."""
    y = (smooth(x) - s.first) / (s.last - s.first)
    rows, horizon = y.shape[1], min(y.shape[1], round(HORIZON / period))
    peak = np.argmax(y[:, :horizon], axis=1)
    yield "overshoot", 100 * (y[np.arange(len(y)), peak] - 1)
    later = np.arange(horizon) > peak[:, None]
    yield "undershoot", 100 * (1 - np.where(later, y[:, :horizon], np.inf).min(axis=1))
    yield "rise_time", period * (_reached(y, 0.9) - _reached(y, 0.1))
    yield "peak_time", period * _vertex(y, peak)
    outside = np.abs(y - 1) > SETTLING_BAND
    last = rows - 1 - np.argmax(outside[:, ::-1], axis=1)
    settled = rows - 1 - last >= (SURE / period if rows > 2 * SURE / period else 1)
    yield "settling_time", np.where(settled, (last + 1) * period, np.nan)
    if (resting := round(RESTING / period)) < rows:
        yield "rest_error", np.sqrt(np.nanmean((x[:, resting:] - s.last)**2, axis=1))


def _ramp(com: Floats, x: Floats, period: float, s: Section) -> Iterator[tuple[str, Floats]]:
    rows = judged_rows(s, period)
    error = np.sign(s.rate) * (com[rows] - x[:, rows])
    velocity = np.sign(s.rate) * speed(x[:, s.start:s.stop], period)[:, rows.start - s.start:]
    yield "mean_ramp_error", np.nanmean(error, axis=1)
    half = waver(error)
    yield "break_away", half
    amplitude, frequency = _oscillation(smooth(error), half, period)
    yield "stick_slip_amplitude", amplitude
    yield "stick_slip_frequency", frequency
    yield "speed_ripple", np.nanstd(velocity, axis=1)
    yield "slip_speed", np.nanpercentile(velocity, 99.5, axis=1)
    yield "stuck_share", np.nanmean(velocity < STUCK * abs(s.rate), axis=1)


def _oscillation(error: Floats, half: Floats, period: float) -> tuple[Floats, Floats]:
    """RMS of the error about its mean times sqrt 2, m; and its turns a second, with a hysteresis of `half`/2."""
    centred = error - np.nanmean(error, axis=1, keepdims=True)
    side = np.where(np.abs(centred) > half[:, None] / 2, np.sign(centred), 0.0)
    last = np.maximum.accumulate(np.where(side != 0.0, np.arange(side.shape[1]), 0), axis=1)
    held = np.take_along_axis(side, last, axis=1)
    turns = ((held[:, 1:] * held[:, :-1]) < 0).sum(axis=1) / 2
    return np.sqrt(2 * np.nanmean(centred**2, axis=1)), turns / (side.shape[1] * period)


def smooth(x: Floats) -> Floats:
    """Centred median of SMOOTH samples, the ends repeated: (m, n) in and out; a single spike leaves no trace."""
    half = SMOOTH // 2
    padded = np.pad(x, ((0, 0), (half, half)), mode="edge")
    out: Floats = np.median(np.lib.stride_tricks.sliding_window_view(padded, SMOOTH, axis=1), axis=2)
    return out


def _reached(y: Floats, level: float) -> Floats:
    """Row, between samples, at which each run first passes a level; NaN if it never does."""
    beyond = y >= level
    k = np.argmax(beyond, axis=1)
    before = np.maximum(k - 1, 0)
    lines = np.arange(len(y))
    low, high = y[lines, before], y[lines, k]
    with np.errstate(divide="ignore", invalid="ignore"):
        part = np.where(high > low, (level - low) / (high - low), 0.0)
    return np.where(beyond.any(axis=1), before + part, np.nan)


def _vertex(y: Floats, peak: NDArray[np.int64]) -> Floats:
    """Row of each run's peak between samples: of the parabola through the five samples around it, by least squares."""
    k = np.clip(peak, 2, y.shape[1] - 3)
    near = y[np.arange(len(y))[:, None], k[:, None] + np.arange(-2, 3)]
    slope = near @ np.array([-2.0, -1.0, 0.0, 1.0, 2.0]) / 10
    bend = near @ np.array([2.0, -1.0, -2.0, -1.0, 2.0]) / 7
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = np.where(bend < 0, -slope / bend, 0.0)
    row: Floats = k + np.clip(shift, -2.0, 2.0)
    return row
