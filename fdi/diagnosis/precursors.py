"""Precursors: single numbers of a response that a fault changes, each beside its scatter over healthy units.

The mean error on a slow ramp is the classic sign of friction, but it does not depend on friction while the plant slides
(docs/physics.md); the signal-to-noise ratios show which precursors are worth looking at. Each precursor is a mean over
the sections of its kind. Noise of the position decides none of them: peaks are taken from running medians, ranges are
between percentiles, and a reversal counts when it passes a quarter of the usual range.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fdi.thresholds import BAND_EVENT_SAMPLES, POSITION_MISSING_SHARE
from fdi.trace import (
    Flags,
    Floats,
    Section,
    Trace,
    compute_speed,
    fill_gaps,
    filter_median,
    find_sections,
    find_stretches,
    hold_last,
)

STEP_JUDGED_FROM = 0.004  # s; the command has to come through a cycle of the bus and the pilot stage
STEP_JUDGED_UNTIL = 0.1  # s after a step at least; later the EHA only sticks and slips, which ramps show better


def find_stays(beyond: Flags, lasting: int = BAND_EVENT_SAMPLES) -> list[tuple[int, int]]:
    """Where a flag (n,) is up for `lasting` rows in a row, until it is down for as many: first and last row of each.

    One or two samples are no event; a single sample back inside does not end one.
    """
    stays: list[tuple[int, int]] = []
    for first, stop in find_stretches(beyond).tolist():
        if stays and first - stays[-1][1] <= lasting:
            stays[-1] = (stays[-1][0], stop - 1)
        elif stop - first >= lasting:
            stays.append((first, stop - 1))
    return stays


def find_lasting_peak(x: Floats, lasting: int = BAND_EVENT_SAMPLES) -> Floats:
    """The highest level that x (.., n), time last, keeps for `lasting` rows in a row; NaN is below all levels."""
    windows = np.lib.stride_tricks.sliding_window_view(np.where(np.isnan(x), -np.inf, x), lasting, axis=-1)
    return np.asarray(windows.min(axis=-1).max(axis=-1))


def compute_half_range(error: Floats) -> Floats:
    """Half the range of a following error (.., n) m, time last, from its 1st to its 99th percentile."""
    low, high = np.nanpercentile(error, (1, 99), axis=-1)
    return np.asarray((high - low) / 2)


def select_ramp_rows(s: Section, period: float, settling: float = 0.2) -> slice:
    """The rows of a ramp that are judged: from `settling` s after its start, when the plant follows."""
    return slice(s.start + round(settling / period), s.stop)


def measure_ramp(x: Floats, com: Floats, s: Section, period: float) -> tuple[Floats, Floats]:
    """Following error, and speed beyond the demand's, of runs `x` (.., n) on a ramp of `com` (n,), in its direction."""
    rows, way = select_ramp_rows(s, period), np.sign(s.rate)
    return way * (com[rows] - x[..., rows]), way * compute_speed(x, 1.0 / period)[..., rows] - abs(s.rate)


class Meaning(NamedTuple):
    """What a precursor is called, its unit, and how many of them make one SI unit."""

    words: str
    unit: str
    scale: float


MEANINGS = {
    "overshoot": Meaning("first overshoot", "%", 1.0),
    "undershoot": Meaning("undershoot after the overshoot", "%", 1.0),
    "settling_time": Meaning("settling within 5 %", "ms", 1e3),
    "rest_error": Meaning("error at rest, RMS", "um", 1e6),
    "mean_ramp_error": Meaning("mean error on the ramp", "um", 1e6),
    "break_away": Meaning("error at break-away", "um", 1e6),
    "stick_slip_amplitude": Meaning("stick-slip amplitude", "um", 1e6),
    "stick_slip_frequency": Meaning("stick-slip frequency", "Hz", 1.0),
    "speed_ripple": Meaning("speed ripple, s.d.", "mm/s", 1e3),
    "tracking_error": Meaning("RMS error in motion", "um", 1e6),
}
OF_STEPS = ("overshoot", "undershoot", "settling_time")


class Precursor(NamedTuple):
    """One number, SI or %, NaN where the trace does not show it; the rest is NaN without bands."""

    value: float
    unit: str  # "m", "s", "m/s", "Hz", "%" or "1"
    words: str
    shown: str  # the value in the unit that people use
    healthy: float  # mean of healthy units
    noise: float  # standard deviation of healthy units
    adds: Mapping[str, float]  # by fault: what one at MidBand adds

    @property
    def departure(self) -> float:
        """Distance from the healthy mean, in healthy standard deviations."""
        return (self.value - self.healthy) / self._scatter

    def compute_ratio(self, fault: str) -> float:
        """Signal to noise: what that fault at MidBand adds, in healthy standard deviations; NaN where not known."""
        return self.adds.get(fault, math.nan) / self._scatter

    @property
    def _scatter(self) -> float:
        return self.noise if self.noise > 0.0 else math.nan


def measure_precursors(source: Trace, band_precursors: Mapping[str, Mapping[str, float]] | None = None
                       ) -> dict[str, Precursor]:
    """The precursors of a trace by name; empty where too much of the position is missing.

    Args:
        source: the trace.
        band_precursors: `Bands.precursors`: of healthy units and by fault.
    """
    com, xj, period = hold_last(source.command), source.mask_unusable(source.declared.controlled.name), source.period
    if np.isnan(xj).mean() > POSITION_MISSING_SHARE:
        return {}
    unit, scale = source.declared.controlled.unit, source.scale
    features = compute_features(com, fill_gaps(xj)[None], period, find_sections(com, period, scale), unit, scale)
    return {name: _make_precursor(name, float(values[0]), unit, (band_precursors or {}).get(name, {}))
            for name, values in features.items()}


def _make_precursor(name: str, value: float, unit: str, numbers: Mapping[str, float]) -> Precursor:
    kind, of_size = MEANINGS[find_kind(name)], _choose_size_unit(unit)[0]
    size = f", {name.rpartition('_')[2].removesuffix(of_size)} {of_size}" if find_kind(name) in OF_STEPS else ""
    si_unit = {"ms": "s", "um": unit, "mm/s": f"{unit}/s"}.get(kind.unit, kind.unit)
    adds = {fault: by for fault, by in numbers.items() if fault not in ("healthy", "noise")}
    return Precursor(value, si_unit, kind.words + size, format_precursor(value, name, si_unit),
                     numbers.get("healthy", math.nan), numbers.get("noise", math.nan), adds)


def format_precursor(value: float, name: str, si_unit: str = "m") -> str:
    """A value of a precursor in the unit that people use; `si_unit` is its own, of a signal other than a position.

    >>> format_precursor(1.912e-05, "break_away"), format_precursor(7.41, "overshoot_5mm")
    ('19.1 um', '7.41 %')
    >>> format_precursor(1.8e-4, "rest_error", "rad")
    '0.00018 rad'
    """
    _, unit, scale = MEANINGS[find_kind(name)]
    if unit in ("um", "mm/s") and si_unit not in ("m", "m/s"):
        unit, scale = si_unit, 1.0
    return f"{value * scale:.3g} {unit}" if math.isfinite(value) else "-"


def _choose_size_unit(unit: str) -> tuple[str, float]:
    """The unit of the size of a step, and how many of them make one `unit`."""
    return ("mm", 1e3) if unit == "m" else (unit, 1.0)


def find_kind(name: str) -> str:
    """The key into MEANINGS: a precursor's name without the step's size."""
    return name if name in MEANINGS else name.rpartition("_")[0]


def compute_features(com: Floats, x: Floats, period: float, parts: Sequence[Section], unit: str = "m",
                     scale: float = 1.0, least_step: float = 2e-4) -> dict[str, Floats]:
    """Values of all precursors for runs `x` (m, n) of a command (n,) in `unit`, by name as in MEANINGS, (m,) each.

    Precursors of steps carry the step's size in their name, such as overshoot_5mm; a step below `least_step`, by the
    `scale` of `Trace.scale`, shows little but noise and friction and is left out. Precursors that the command cannot
    show are missing; those that a run does not show (an oscillation that never settles) are NaN.
    """
    out: dict[str, list[Floats]] = {}
    for s in parts:
        rows = slice(s.start, s.stop)
        if s.kind == "step" and abs(s.last - s.first) >= least_step * scale:
            of_size, factor = _choose_size_unit(unit)
            size = f"{factor * abs(s.last - s.first):.3g}{of_size}"
            for word, values in measure_step(x[:, rows], s, period).items():
                out.setdefault(word if word == "rest_error" else f"{word}_{size}", []).append(values)
        elif is_slow_ramp(s, period, scale):
            for word, values in _measure_ramp_response(com, x, period, s).items():
                out.setdefault(word, []).append(values)
        elif s.kind == "dynamic":
            out.setdefault("tracking_error", []).append(np.sqrt(np.nanmean((com[rows] - x[:, rows])**2, axis=1)))
    order = {word: i for i, word in enumerate(MEANINGS)}
    return {word: np.mean(out[word], axis=0) for word in sorted(out, key=lambda w: (order[find_kind(w)], w))}


def is_slow_ramp(s: Section, period: float, scale: float = 1.0, fastest: float = 5e-3, lasting: float = 0.5) -> bool:
    """Whether a section is a ramp that shows friction: below `fastest` m/s by the `scale` of `Trace.scale`, and several
    slips (`lasting` s) long.
    """
    return (s.kind == "ramp" and abs(s.rate) < fastest * scale
            and bool(s.stop - select_ramp_rows(s, period).start > lasting / period))


def measure_step(x: Floats, s: Section, period: float, settling_band: float = 0.05, settled_for: float = 0.05,
                 at_rest_after: float = 0.25) -> dict[str, Floats]:
    """Response of (m, rows) to one step, by precursor.

    A run has settled once it stays within `settling_band` of the step for `settled_for` s, as an oscillation passes
    through the band now and then. `at_rest_after` s after the step it should be at rest.
    """
    y = (filter_median(x, 1.0 / period) - s.first) / (s.last - s.first)  # as a fraction of the step
    rows, horizon = y.shape[1], min(y.shape[1], round(STEP_JUDGED_UNTIL / period))
    if np.median(y[:, :horizon].max(axis=1)) < 0.9:  # a slow plant
        horizon = rows
    peak = np.argmax(y[:, :horizon], axis=1)
    lowest = np.where(np.arange(horizon) > peak[:, None], y[:, :horizon], np.inf).min(axis=1)
    is_outside = np.abs(y - 1) > settling_band
    last = rows - 1 - np.argmax(is_outside[:, ::-1], axis=1)
    least_rows = settled_for / period if rows > 2 * settled_for / period else 1
    is_settled = rows - 1 - last >= least_rows
    response = {"overshoot": 100 * (y[np.arange(len(y)), peak] - 1),
                "undershoot": np.where(np.isfinite(lowest), 100 * (1 - lowest), np.nan),
                "settling_time": np.where(is_settled, (last + 1) * period, np.nan)}
    if (rest_row := round(at_rest_after / period)) < rows:
        response["rest_error"] = np.sqrt(np.nanmean((x[:, rest_row:] - s.last)**2, axis=1))
    return response


def _measure_ramp_response(com: Floats, x: Floats, period: float, s: Section) -> dict[str, Floats]:
    """Response of (m, n) to a slow ramp, on which the plant sticks and slips, by precursor."""
    rows = select_ramp_rows(s, period)
    error = np.sign(s.rate) * (com[rows] - x[:, rows])
    half = compute_half_range(error)
    amplitude, frequency = _measure_oscillation(filter_median(error, 1.0 / period), half, period)
    return {"mean_ramp_error": np.nanmean(error, axis=1), "break_away": half, "stick_slip_amplitude": amplitude,
            "stick_slip_frequency": frequency,
            "speed_ripple": np.nanstd(compute_speed(x, 1.0 / period)[:, rows], axis=1)}


def _measure_oscillation(error: Floats, half: Floats, period: float) -> tuple[Floats, Floats]:
    """Amplitude, m (RMS about the mean times sqrt 2), and frequency, Hz (turns with a hysteresis of `half`/2)."""
    centred = error - np.nanmean(error, axis=1, keepdims=True)
    side = np.where(np.abs(centred) > half[:, None] / 2, np.sign(centred), 0.0)
    last = np.maximum.accumulate(np.where(side != 0.0, np.arange(side.shape[1]), 0), axis=1)
    latest_side = np.take_along_axis(side, last, axis=1)
    turns = ((latest_side[:, 1:] * latest_side[:, :-1]) < 0).sum(axis=1) / 2
    return np.sqrt(2 * np.nanmean(centred**2, axis=1)), turns / (side.shape[1] * period)
