"""Precursors: single numbers of a response that a fault changes, each beside its scatter over healthy units.

The mean error on a slow ramp is the classic sign of friction, but it does not depend on friction while the ram slides
(docs/physics.md); the signal-to-noise ratios show which precursors are worth looking at. Each precursor is a mean over
the sections of its kind. Noise of the position decides none of them: peaks are taken from running medians, ranges are
between percentiles, and a reversal counts when it passes a quarter of the usual range.
"""
from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.bands import (
    STEP_JUDGED_UNTIL,
    Bands,
    compute_half_range,
    compute_speed,
    read_columns,
    select_ramp_rows,
)
from fdi.diagnosis.faults import CLOGGING, FRICTION
from fdi.thresholds import POSITION_MISSING_SHARE
from fdi.trace.sections import Section, find_sections
from fdi.trace.trace import Trace

Floats = NDArray[np.float64]


class Meaning(NamedTuple):
    """What a precursor is called, its unit, and how many of them make one SI unit."""

    words: str
    unit: str
    scale: float


MEANINGS = {
    "overshoot": Meaning("first overshoot", "%", 1.0),
    "undershoot": Meaning("undershoot after the overshoot", "%", 1.0),
    "rise_time": Meaning("rise from 10 to 90 %", "ms", 1e3),
    "peak_time": Meaning("time of the first peak", "ms", 1e3),
    "settling_time": Meaning("settling within 5 %", "ms", 1e3),
    "rest_error": Meaning("error at rest, RMS", "um", 1e6),
    "mean_ramp_error": Meaning("mean error on the ramp", "um", 1e6),
    "ramp_asymmetry": Meaning("ramp error out less in, half", "um", 1e6),
    "break_away": Meaning("error at break-away", "um", 1e6),
    "stick_slip_amplitude": Meaning("stick-slip amplitude", "um", 1e6),
    "stick_slip_frequency": Meaning("stick-slip frequency", "Hz", 1.0),
    "speed_ripple": Meaning("speed ripple, s.d.", "mm/s", 1e3),
    "slip_speed": Meaning("fastest slip", "mm/s", 1e3),
    "stuck_share": Meaning("share of the ramp at rest", "%", 100.0),
    "tracking_error": Meaning("RMS error in motion", "um", 1e6),
}
OF_STEPS = ("overshoot", "undershoot", "rise_time", "peak_time", "settling_time")


class Precursor(NamedTuple):
    """One number, SI or %, NaN where the trace does not show it; the rest is NaN without bands."""

    value: float
    unit: str  # "m", "s", "m/s", "Hz", "%" or "1"
    words: str
    shown: str  # the value in the unit that people use
    healthy: float  # mean of healthy units
    noise: float  # standard deviation of healthy units
    clogging: float  # what Table 2's lesser clogging adds
    friction: float  # what its lesser friction adds

    @property
    def departure(self) -> float:
        """Distance from the healthy mean, in healthy standard deviations."""
        return (self.value - self.healthy) / self._scatter

    @property
    def clogging_ratio(self) -> float:
        """Signal to noise: what Kintas 0.25 adds, in healthy standard deviations."""
        return self.clogging / self._scatter

    @property
    def friction_ratio(self) -> float:
        """Signal to noise: what FSS 35 N adds, in healthy standard deviations."""
        return self.friction / self._scatter

    @property
    def _scatter(self) -> float:
        return self.noise if self.noise > 0.0 else math.nan


def measure_precursors(source: Trace, bands: Bands | None = None) -> dict[str, Precursor]:
    """The precursors of a trace by name; empty where too much of the position is missing."""
    com, xj, _, period, _ = read_columns(source)
    missing = np.isnan(xj)
    if missing.mean() > POSITION_MISSING_SHARE:
        return {}
    rows = np.arange(len(xj))
    whole = np.interp(rows, rows[~missing], xj[~missing])
    found = compute_features(com, whole[None], period, find_sections(com, period))
    known = bands.precursors if bands is not None else {}
    return {name: _make_precursor(name, float(values[0]), known.get(name, {})) for name, values in found.items()}


def _make_precursor(name: str, value: float, known: Mapping[str, float]) -> Precursor:
    kind = MEANINGS[find_kind(name)]
    size = f", {name.rpartition('_')[2].replace('mm', ' mm')}" if find_kind(name) in OF_STEPS else ""
    si_unit = {"ms": "s", "um": "m", "mm/s": "m/s"}.get(kind.unit, kind.unit)
    numbers = (known.get(key, math.nan) for key in ("healthy", "noise", CLOGGING.name, FRICTION.name))
    return Precursor(value, si_unit, kind.words + size, format_precursor(value, name), *numbers)


def format_precursor(value: float, name: str) -> str:
    """A value of a precursor in the unit that people use.

    >>> format_precursor(1.912e-05, "break_away"), format_precursor(7.41, "overshoot_5mm")
    ('19.1 um', '7.41 %')
    """
    kind = MEANINGS[find_kind(name)]
    return f"{value * kind.scale:.3g} {kind.unit}" if math.isfinite(value) else "-"


def find_kind(name: str) -> str:
    """The key into MEANINGS: a precursor's name without the step's size."""
    return name if name in MEANINGS else name.rpartition("_")[0]


def compute_features(com: Floats, x: Floats, period: float, parts: Sequence[Section], least_step: float = 2e-4
                     ) -> dict[str, Floats]:
    """Values of all precursors for runs `x` (m, n) m of a command (n,) m, by name as in MEANINGS, SI or %; (m,) each.

    Precursors of steps carry the step's size in their name, such as overshoot_5mm; a step below `least_step` m shows
    little but noise and friction and is left out. Precursors that the command cannot show are missing; those that a run
    does not show (an oscillation that never settles) are NaN.
    """
    out: dict[str, list[Floats]] = {}
    ramps: dict[float, list[Floats]] = {1.0: [], -1.0: []}
    for s in parts:
        rows = slice(s.start, s.stop)
        if s.kind == "step" and abs(s.last - s.first) >= least_step:
            size = f"{1e3 * abs(s.last - s.first):.3g}mm"
            for word, values in _measure_step(x[:, rows], s, period):
                out.setdefault(word if word == "rest_error" else f"{word}_{size}", []).append(values)
        elif is_slow_ramp(s, period):
            for word, values in _measure_ramp(com, x, period, s):
                out.setdefault(word, []).append(values)
            ramps[float(np.sign(s.rate))].append(out["mean_ramp_error"][-1])
        elif s.kind == "dynamic":
            error = com[rows] - x[:, rows]
            out.setdefault("tracking_error", []).append(np.sqrt(np.nanmean(error**2, axis=1)))
    if ramps[1.0] and ramps[-1.0]:
        out["ramp_asymmetry"] = [(np.mean(ramps[1.0], axis=0) - np.mean(ramps[-1.0], axis=0)) / 2]
    order = {word: i for i, word in enumerate(MEANINGS)}
    return {word: np.mean(out[word], axis=0) for word in sorted(out, key=lambda w: (order[find_kind(w)], w))}


def is_slow_ramp(s: Section, period: float, fastest: float = 5e-3, lasting: float = 0.5) -> bool:
    """Whether a section is a ramp that shows friction: below `fastest` m/s, and several slips (`lasting` s) long."""
    if s.kind != "ramp" or abs(s.rate) >= fastest:
        return False
    return bool(s.stop - select_ramp_rows(s, period).start > lasting / period)


def _measure_step(x: Floats, s: Section, period: float, settling_band: float = 0.05, settled_for: float = 0.05,
                  at_rest_after: float = 0.25) -> Iterator[tuple[str, Floats]]:
    """Response of (m, rows) to one step.

    A run has settled once it stays within `settling_band` of the step for `settled_for` s, as an oscillation passes
    through the band now and then. `at_rest_after` s after the step the ram should be at rest.
    """
    y = (smooth_spikes(x) - s.first) / (s.last - s.first)  # as a fraction of the step
    rows, horizon = y.shape[1], min(y.shape[1], round(STEP_JUDGED_UNTIL / period))
    peak = np.argmax(y[:, :horizon], axis=1)
    yield "overshoot", 100 * (y[np.arange(len(y)), peak] - 1)
    later = np.arange(horizon) > peak[:, None]
    yield "undershoot", 100 * (1 - np.where(later, y[:, :horizon], np.inf).min(axis=1))
    yield "rise_time", period * (_find_crossing(y, 0.9) - _find_crossing(y, 0.1))
    yield "peak_time", period * _find_vertex(y, peak)
    outside = np.abs(y - 1) > settling_band
    last = rows - 1 - np.argmax(outside[:, ::-1], axis=1)
    needed = settled_for / period if rows > 2 * settled_for / period else 1
    is_settled = rows - 1 - last >= needed
    yield "settling_time", np.where(is_settled, (last + 1) * period, np.nan)
    resting = round(at_rest_after / period)
    if resting < rows:
        yield "rest_error", np.sqrt(np.nanmean((x[:, resting:] - s.last)**2, axis=1))


def _measure_ramp(com: Floats, x: Floats, period: float, s: Section, stuck_below: float = 0.3
                  ) -> Iterator[tuple[str, Floats]]:
    """Response to a slow ramp; the ram sticks while it is slower than `stuck_below` of the ramp's rate."""
    rows = select_ramp_rows(s, period)
    error = np.sign(s.rate) * (com[rows] - x[:, rows])
    velocity = np.sign(s.rate) * compute_speed(x[:, s.start:s.stop], period)[:, rows.start - s.start:]
    yield "mean_ramp_error", np.nanmean(error, axis=1)
    half = compute_half_range(error)
    yield "break_away", half
    amplitude, frequency = _measure_oscillation(smooth_spikes(error), half, period)
    yield "stick_slip_amplitude", amplitude
    yield "stick_slip_frequency", frequency
    yield "speed_ripple", np.nanstd(velocity, axis=1)
    yield "slip_speed", np.nanpercentile(velocity, 99.5, axis=1)
    yield "stuck_share", np.nanmean(velocity < stuck_below * abs(s.rate), axis=1)


def _measure_oscillation(error: Floats, half: Floats, period: float) -> tuple[Floats, Floats]:
    """Amplitude, m (RMS about the mean times sqrt 2), and frequency, Hz (turns with a hysteresis of `half`/2)."""
    centred = error - np.nanmean(error, axis=1, keepdims=True)
    side = np.where(np.abs(centred) > half[:, None] / 2, np.sign(centred), 0.0)
    last = np.maximum.accumulate(np.where(side != 0.0, np.arange(side.shape[1]), 0), axis=1)
    latest_side = np.take_along_axis(side, last, axis=1)
    turns = ((latest_side[:, 1:] * latest_side[:, :-1]) < 0).sum(axis=1) / 2
    return np.sqrt(2 * np.nanmean(centred**2, axis=1)), turns / (side.shape[1] * period)


def smooth_spikes(x: Floats, samples: int = 5) -> Floats:
    """Running median over `samples`, the ends repeated: (m, n) in and out; a single spike leaves no trace."""
    half = samples // 2
    padded = np.pad(x, ((0, 0), (half, half)), mode="edge")
    out: Floats = np.median(np.lib.stride_tricks.sliding_window_view(padded, samples, axis=1), axis=2)
    return out


def _find_crossing(y: Floats, level: float) -> Floats:
    """Row, between samples, at which each run first passes a level; NaN if it never does."""
    beyond = y >= level
    k = np.argmax(beyond, axis=1)
    before = np.maximum(k - 1, 0)
    lines = np.arange(len(y))
    low, high = y[lines, before], y[lines, k]
    with np.errstate(divide="ignore", invalid="ignore"):
        part = np.where(high > low, (level - low) / (high - low), 0.0)
    return np.where(beyond.any(axis=1), before + part, np.nan)


def _find_vertex(y: Floats, peak: NDArray[np.int64]) -> Floats:
    """Row of each run's peak between samples: of the parabola through the five samples around it, by least squares."""
    k = np.clip(peak, 2, y.shape[1] - 3)
    near = y[np.arange(len(y))[:, None], k[:, None] + np.arange(-2, 3)]
    slope = near @ np.array([-2.0, -1.0, 0.0, 1.0, 2.0]) / 10
    bend = near @ np.array([2.0, -1.0, -2.0, -1.0, 2.0]) / 7
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = np.where(bend < 0, -slope / bend, 0.0)
    row: Floats = k + np.clip(shift, -2.0, 2.0)
    return row
