"""What the residual itself tells: is it noise, does it follow an input, does it depend on what the ram does.

As in MATLAB's `resid` and Box and Jenkins: autocorrelation, cross-correlation with the inputs, cumulative periodogram
with Bartlett's band, and the mean of the residual by speed, position, pressure and direction. Coloured sensor noise is
no fault of a model: where repeats show its colour, residuals are whitened by it before they are called coloured.
"""
from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import kolmogi, ndtri

from fdi.comparison.localisation import Motion
from fdi.estimation.noise import solve_yule_walker
from fdi.estimation.replay import Columns
from fdi.thresholds import RESIDUAL_TEST_CONFIDENCE
from fdi.trace.trace import Trace

Floats = NDArray[np.float64]

REACH = 100  # lags, of the autocorrelation
AFTER, BEFORE = 60, 20  # lags, of the residual after and before the input
BINS = 15
OWN = {("xj", "Cor"), ("p12", "P12")}  # a signal's own noise or error is in these; that they go together says nothing
WHITENING_ORDER = 40  # of the filter that makes noise white: two periods of 50 Hz hum at 1 kHz
WILD = 5.0  # standard deviations; what is larger is an event and has no say in a colour
WHITE = np.ones(1)  # the filter of what is white already
SHAPES = ("proportional to", "steps with the sign of", "even in")


class Follows(NamedTuple):
    """The largest cross-correlation of the residual with one input, both made white by the input's own colour."""

    input: str
    correlation: float
    lag: float  # s, the residual is behind the input
    bound: float  # what chance reaches in 1 % of all cases
    lags: Floats  # s
    curve: Floats


class Depends(NamedTuple):
    """Means of the residual over bins of one quantity."""

    on: str  # "speed", "position", "P12", "acceleration"
    share: float  # of the residual's mean square, that the means hold
    shape: str  # one of SHAPES, or ""
    size: float  # largest mean, residual's unit
    centres: Floats
    means: Floats
    half: Floats  # half width of the means' 95 % interval


class ResidualTests(NamedTuple):
    """One signal's residual."""

    memory: float  # s, until the autocorrelation has fallen below 1/e
    noise_memory: float  # s, that of the noise, where repeats show it; else one sample
    correlation: Floats  # autocorrelation at lags 0.. of the whitened residual
    band: float  # its 99 % band
    frequencies: Floats  # Hz
    power: Floats  # cumulative periodogram of the whitened residual, 0..1
    departs: float  # its largest distance from that of white noise
    allowed: float  # Bartlett's 95 % band
    half_power: float  # Hz; half of the residual's power lies below
    follows: tuple[Follows, ...]
    depends: tuple[Depends, ...]  # the largest share first


def examine_residuals(trace: Trace, residual: Columns, repeats: Mapping[str, Floats], m: Motion
                      ) -> dict[str, ResidualTests]:
    """Each signal's residual (n,); `repeats`: the difference to a repeat's residual over sqrt 2, where there is one."""
    inputs = {"Cor": trace.cor, "Com": trace.com} | ({"load": trace.load} if np.ptp(trace.load) > 0.0 else {})
    colours = {name: fit_whitener(np.diff(u)) for name, u in inputs.items() if np.ptp(u) > 0.0}
    quantities = {"speed": m.v, "position": m.x, "P12": m.p12, "acceleration": m.a}
    found = {}
    for name, r in residual.items():
        foreign = {u: (inputs[u], by) for u, by in colours.items() if (name, u) not in OWN}
        others = {q: x for q, x in quantities.items() if (name, q) not in OWN}
        found[name] = _examine_signal(trace, r, repeats.get(name), foreign, others)
    return found


def fit_whitener(x: Floats) -> Floats:
    """The filter, (p + 1,), that makes x (n,) white: its autoregressive model by Yule and Walker. WHITE if it rests.

    The order is fixed, as an input is to be whitened and not described.
    """
    x = np.nan_to_num(x)
    level = float(np.median(np.abs(x))) / 0.6745
    if level == 0.0:
        return WHITE
    x = np.clip(x, -WILD * level, WILD * level)
    covariance = correlate(x, x, 0, WHITENING_ORDER) / len(x)
    covariance[0] *= 1 + 1e-9  # a pure sine has no inverse
    weights = solve_yule_walker(covariance, by_elimination=True)
    out: Floats = np.concatenate([WHITE, -weights])
    return out


def apply_whitener(x: Floats, by: Floats) -> Floats:
    """x (n,) through the filter of a colour; NaN counts as 0."""
    out: Floats = np.convolve(np.nan_to_num(x), by)[:len(x)]
    return out


def _examine_signal(trace: Trace, residual: Floats, difference: Floats | None,
                    inputs: Mapping[str, tuple[Floats, Floats]], quantities: Mapping[str, Floats]) -> ResidualTests:
    r = np.nan_to_num(residual)
    e = apply_whitener(r, fit_whitener(difference) if difference is not None else WHITE)
    own = autocorrelate(e)
    band = float(ndtri(0.5 + RESIDUAL_TEST_CONFIDENCE / 2)) / math.sqrt(len(e))
    frequencies, power, departs, allowed = cumulate_periodogram(e, trace.period)
    _, plain, _, _ = cumulate_periodogram(r, trace.period)
    half = float(frequencies[min(int(np.searchsorted(plain, 0.5)), len(frequencies) - 1)])
    quiet = autocorrelate(np.nan_to_num(difference)) if difference is not None else np.eye(1, REACH + 1)[0]
    follows = tuple(correlate_with_input(name, u, by, r, trace.period) for name, (u, by) in inputs.items())
    found = [bin_residual(name, q, residual) for name, q in quantities.items()]
    depends = sorted((d for d in found if d is not None), key=lambda d: -d.share)
    memory, noise_memory = (_measure_memory(x) * trace.period for x in (autocorrelate(r), quiet))
    return ResidualTests(memory, noise_memory, own, band, frequencies, power, departs, allowed, half, follows,
                         tuple(depends))


def autocorrelate(x: Floats) -> Floats:
    """At lags 0..REACH, of a residual that would be zero: its mean is not taken off."""
    whole = correlate(x, x, 0, REACH)
    out: Floats = whole / whole[0] if whole[0] > 0.0 else np.eye(1, len(whole))[0]
    return out


def correlate(x: Floats, y: Floats, first: int, last: int) -> Floats:
    """Sums of x_{k + lag} y_k for lags first..last, by FFT; x and y (n,).

    With numpy: scipy.signal has the same and takes 1 s to import, a third of the time that the whole command has.
    """
    n = len(x) + len(y)
    whole = np.fft.irfft(np.fft.rfft(x, n) * np.conj(np.fft.rfft(y, n)), n)
    out: Floats = whole[np.arange(first, last + 1) % n]
    return out


def _measure_memory(correlation: Floats) -> int:
    """The lag at which it first is below 1/e."""
    below = np.flatnonzero(correlation < 1 / math.e)
    return int(below[0]) if len(below) else len(correlation)


def cumulate_periodogram(x: Floats, period: float) -> tuple[Floats, Floats, float, float]:
    """Frequencies, cumulative periodogram 0..1, its largest distance from the straight line, and Bartlett's 95 % band.

    Box and Jenkins: for white noise the distance is that of Kolmogorov and Smirnov for as many samples as frequencies.
    """
    frequencies = np.arange(1, len(x) // 2) / (len(x) * period)
    power: Floats = np.abs(np.fft.rfft(x)[1:len(x) // 2]) ** 2
    total = power.sum()
    added = np.cumsum(power) / total if total > 0.0 else np.linspace(0, 1, len(power))
    line = np.arange(1, len(added) + 1) / len(added)
    allowed = float(kolmogi(0.05)) / math.sqrt(len(added))
    return frequencies, added, float(np.abs(added - line).max()), allowed


def correlate_with_input(name: str, u: Floats, by: Floats, residual: Floats, period: float) -> Follows:
    """Cross-correlation with an input (n,); both are filtered `by` the colour of its steps to make them white."""
    steps, left = (apply_whitener(np.diff(x), by) for x in (u, residual))
    # a jump of the command would stand for the whole test
    steps, left = (np.clip(x, -WILD * x.std(), WILD * x.std()) for x in (steps, left))
    size = math.sqrt(float(np.sum(left**2)) * float(np.sum(steps**2))) or 1.0
    curve: Floats = correlate(left, steps, -BEFORE, AFTER) / size
    lags: Floats = np.linspace(-BEFORE * period, AFTER * period, AFTER + BEFORE + 1)
    peak = BEFORE + 1 + int(np.abs(curve[BEFORE + 1:]).argmax())  # what comes before its cause is feedback
    # Bartlett: what is left of both colours widens the band. Of all lags the largest is taken: they share the 1 %
    wider = 1.0 + 2.0 * float(np.sum(autocorrelate(left)[1:] * autocorrelate(steps)[1:]))
    bound = float(ndtri(1 - (1 - RESIDUAL_TEST_CONFIDENCE) / 2 / AFTER)) * math.sqrt(max(wider, 1.0) / len(steps))
    return Follows(name, float(curve[peak]), float(lags[peak]), bound, lags, curve)


def bin_residual(name: str, quantity: Floats, residual: Floats) -> Depends | None:
    """Means of the residual (n,) over BINS of the quantity (n,) with as many samples in each; None for too few."""
    there = ~np.isnan(quantity) & ~np.isnan(residual)
    q, r = quantity[there], residual[there]
    edges = np.unique(np.quantile(q, np.linspace(0, 1, BINS + 1))) if len(q) else np.empty(0)
    power = float(np.mean(r**2)) if len(r) else 0.0
    if len(edges) < 5 or power == 0.0:
        return None
    where = np.clip(np.searchsorted(edges, q, side="right") - 1, 0, len(edges) - 2)
    count = np.maximum(np.bincount(where, minlength=len(edges) - 1), 1)
    means = np.bincount(where, r, len(edges) - 1) / count
    centres = np.bincount(where, q, len(edges) - 1) / count
    spread = np.sqrt(np.maximum(np.bincount(where, r**2, len(edges) - 1) / count - means**2, 0.0))
    own = autocorrelate(r - means[where])
    first = int(np.argmax(own < 0.05)) or len(own)
    thin = 1.0 + 2.0 * float(own[1:first].sum())  # neighbours say the same: as many samples count as one
    half = float(ndtri(0.975)) * spread * np.sqrt(thin / count)
    chance = float(np.sum(spread**2 * thin) / len(r))  # what the means would hold by chance
    share = max(0.0, float(np.average(means**2, weights=count)) - chance) / power
    largest = float(means[np.abs(means).argmax()])
    return Depends(name, share, name_shape(centres, means, count), largest, centres, means, half)


def name_shape(x: Floats, means: Floats, count: Floats) -> str:
    """Which of SHAPES holds most of the means, if it holds nearly all."""
    scale = float(np.abs(x).max()) or 1.0
    weights = np.sqrt(count)
    total = float(((means * weights) ** 2).sum())
    best = (0.8, "")
    for word, f in zip(SHAPES, (x / scale, np.tanh(20 * x / scale), np.abs(x) / scale), strict=True):
        columns = np.column_stack([f, np.ones(len(x))] if word == SHAPES[2] else [f]) * weights[:, None]
        left = means * weights - columns @ np.linalg.lstsq(columns, means * weights, rcond=None)[0]
        held = 1.0 - float(left @ left) / total if total > 0.0 else 0.0
        if held > best[0] + 0.02:
            best = (held, word)
    return best[1]
