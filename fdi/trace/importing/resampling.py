"""Samples of a channel put on the rows of a trace: as recorded wherever that is possible, else between the samples."""
from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SLIP = 0.4  # of a row: two clocks that drift apart by less over the recording are the same
FOLDED_SHARE = 0.05  # of a signal's standard deviation; more above the rows' Nyquist frequency is filtered out first
HELD_SHARE = 0.95  # of the changes that lie in one phase: a signal that is held between them


class Samples(NamedTuple):
    """A channel, samples that are missing left out."""

    t: Floats  # s, growing
    x: Floats

    @property
    def period(self) -> float:
        """The usual time between two samples, s."""
        return float(np.percentile(np.diff(self.t), 50, method="lower"))

    @property
    def gaps(self) -> int:
        """Places where samples are missing."""
        return int((np.diff(self.t) > 1.5 * self.period).sum())


class Placed(NamedTuple):
    """A channel on the rows of a trace, NaN where there is none, and how it came there."""

    x: Floats
    how: str


def measure_period(samples: Samples, nominal: float) -> float:
    """The period of samples, s: `nominal` if the two do not drift apart over the recording, else to 9 digits."""
    steps = np.rint(np.diff(samples.t) / samples.period)
    rows = float(steps.sum())
    mean = float(samples.t[-1] - samples.t[0]) / rows
    ratio = max(1, round(nominal / mean)) if mean < nominal else 1
    if abs(mean * ratio / nominal - 1.0) * rows / ratio < SLIP:
        return nominal
    return round(mean * ratio, 9)


def find_hold(samples: Samples, ratio: int) -> int | None:
    """Which of so many samples brings a new value, 0 for the first; None if more than one does."""
    rows = np.rint((samples.t - samples.t[0]) / samples.period).astype(int)
    new = rows[1:][np.diff(samples.x) != 0.0]
    if len(new) < 10:
        return None
    counts = np.bincount(new % ratio, minlength=ratio)
    return int(counts.argmax()) if counts.max() > HELD_SHARE * len(new) else None


def place_samples(samples: Samples, rows: Floats, period: float, method: str, low_pass: bool | None,
                  cycle_part: str) -> Placed:
    """The channel at the times `rows` (n,), s, one a `period`.

    Args:
        samples: the channel.
        rows: times of the rows, s.
        period: s.
        method: auto, samples (never between two), interpolate or hold.
        low_pass: whether to filter before samples are left out; None: if more than FOLDED_SHARE would fold.
        cycle_part: where in its cycle a value that is held comes: "answer" after the row's time, "demand" before it,
            "" at it.
    """
    ratio = period / samples.period
    whole = round(ratio)
    slip = abs(ratio / whole - 1.0) * len(rows) if whole >= 1 else math.inf
    is_whole = whole >= 1 and slip < 0.5 * max(whole, 1) + 0.01 * len(rows)
    if method in ("auto", "samples") and whole == 1 and is_whole:
        placed = _place_each(samples, rows, period)
        if placed is not None:
            return placed
    if method in ("auto", "samples") and whole > 1 and is_whole:
        return _pick(samples, rows, period, whole, low_pass, cycle_part)
    if method == "samples":
        return _place_nearest(samples, rows, 0.5 * period)
    if method == "hold" or (method == "auto" and cycle_part and _is_stepwise(samples)):
        return _hold(samples, rows)
    filtered, note = samples, ""
    if ratio > 1.5 and low_pass is not False:
        filtered, note = _filter(samples, ratio), "low-pass filtered, "
    note += f"straight lines between samples {_format_ms(samples.period)} apart"
    return Placed(_interpolate(filtered, rows), note)


def _format_ms(seconds: float) -> str:
    return f"{1e3 * seconds:.4g} ms"


def _place_each(samples: Samples, rows: Floats, period: float) -> Placed | None:
    """Each sample on the row next to it, whatever its place in the cycle; None if two would share a row."""
    turns = np.exp(2j * np.pi * (samples.t - rows[0]) / period)
    phase = float(np.angle(turns.mean())) / (2 * np.pi) * period
    place = np.rint((samples.t - rows[0] - phase) / period).astype(int)
    if (np.diff(place) < 1).any():
        return None
    inside = (place >= 0) & (place < len(rows))
    out = np.full(len(rows), math.nan)
    out[place[inside]] = samples.x[inside]
    where = f", {1e3 * phase:+.2f} ms from the row" if abs(phase) > 0.05 * period else ""
    return Placed(out, f"as recorded{where}")


def _pick(samples: Samples, rows: Floats, period: float, ratio: int, low_pass: bool | None, cycle_part: str) -> Placed:
    """Every so many samples; those of a held signal where its new value is."""
    held = find_hold(samples, ratio)
    how = f"every {_format_ordinal(ratio)} sample"
    if held is not None:
        own = (samples.t[0] + held * samples.period - rows[0]) % period
        own = 0.0 if own > period - 0.25 * samples.period else own
        shift = 0.0
        if cycle_part == "answer":
            shift = own
        elif cycle_part == "demand" and own:
            shift = own - period
        return Placed(_place_nearest(samples, rows + shift, 0.6 * samples.period).x,
                      f"{how}; the signal is held for {ratio}")
    if low_pass is None:
        low_pass = not cycle_part and _measure_folded_share(samples, ratio) > FOLDED_SHARE
    if low_pass:
        samples, how = _filter(samples, ratio), f"low-pass filtered, {how}"
    return Placed(_place_nearest(samples, rows, 0.6 * samples.period).x, how)


def _format_ordinal(n: int) -> str:
    return f"{n}{ {1: 'st', 2: 'nd', 3: 'rd'}.get(n if n < 20 else n % 10, 'th')}"


def _place_nearest(samples: Samples, rows: Floats, reach: float) -> Placed:
    """The sample nearest to each row, if it is within `reach`, s."""
    after = np.clip(np.searchsorted(samples.t, rows), 1, len(samples.t) - 1)
    nearest = np.where(rows - samples.t[after - 1] <= samples.t[after] - rows, after - 1, after)
    apart = np.abs(samples.t[nearest] - rows)
    return Placed(np.where(apart <= reach, samples.x[nearest], math.nan), "nearest sample")


def _is_stepwise(samples: Samples) -> bool:
    """Whether most samples repeat the one before."""
    return len(samples.x) > 10 and float(np.mean(np.diff(samples.x) == 0.0)) > 0.5


def _hold(samples: Samples, rows: Floats) -> Placed:
    before = np.searchsorted(samples.t, rows + 1e-9, side="right") - 1
    x = samples.x[np.clip(before, 0, None)]
    late = rows - samples.t[np.clip(before, 0, None)] > 1.5 * samples.period
    return Placed(np.where((before < 0) | late, math.nan, x), f"last sample, {_format_ms(samples.period)} apart")


def _interpolate(samples: Samples, rows: Floats) -> Floats:
    """Straight lines between samples; NaN in gaps and outside."""
    after = np.searchsorted(samples.t, rows)
    left, right = np.clip(after - 1, 0, len(samples.t) - 1), np.clip(after, 0, len(samples.t) - 1)
    lost = (samples.t[right] - samples.t[left] > 1.5 * samples.period)
    exact = samples.t[right] == rows
    lost |= (rows < samples.t[0] - 1e-9) | (rows > samples.t[-1] + 1e-9)
    return np.where(lost & ~exact, math.nan, np.interp(rows, samples.t, samples.x))


def _design_low_pass(ratio: float) -> Floats:
    """Symmetric low-pass of unit gain: -6 dB at 0.8 of the rows' Nyquist frequency, Hamming window."""
    half = round(8 * ratio)
    k = np.arange(-half, half + 1)
    taps = np.sinc(0.8 * k / ratio) * np.hamming(2 * half + 1)
    out: Floats = taps / taps.sum()
    return out


def _filter(samples: Samples, ratio: float) -> Samples:
    """The channel without what lies above the rows' Nyquist frequency, not shifted in time; each piece for itself."""
    taps = _design_low_pass(ratio)
    half = len(taps) // 2
    edges = [0, *(np.flatnonzero(np.diff(samples.t) > 1.5 * samples.period) + 1).tolist(), len(samples.t)]
    pieces = []
    for first, stop in pairwise(edges):
        pieces.append(np.convolve(np.pad(samples.x[first:stop], half, "edge"), taps, "valid"))
    return Samples(samples.t, np.concatenate(pieces))


def _measure_folded_share(samples: Samples, ratio: int) -> float:
    """RMS of what lies above the rows' Nyquist frequency, over the signal's standard deviation."""
    part = Samples(samples.t[:200_000], samples.x[:200_000])
    spread = float(part.x.std())
    return float(np.std(part.x - _filter(part, ratio).x)) / spread if spread > 0.0 else 0.0
