"""The noise of measured signals: its floor in a residual, its level, its colour, and the filter that makes it white.

Two runs of one command have the model's error in common and the noise not, so rms(r_est - r_repeat)/sqrt 2 is the
noise, whatever its colour. Only where the model is wrong does it take in more: stick-slip comes a little earlier in one
run than in the other, and then the model's error differs too. So the floor is built from below: short windows of the
difference, the quietest first, and on upward as long as they are as large as the quiet ones let expect. Hum that has
the same phase in every run (the mains start the test, or the test waits for them) is in the difference no more;
its lines are measured in the quiet windows of each run and added.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_toeplitz
from scipy.special import gammainc, gammaincinv, ndtri

from fdi.thresholds import (
    ANCHOR_RATE,
    CALM_BLOCK_RATIO,
    HUM_LINE_RATIO,
    LOWER_BOUND_ERROR_RATIO,
    NOISE_COEFFICIENT_GAIN,
    NOISE_WINDOW_CONFIDENCE,
    NOISIER_THAN_MODEL,
    REPEAT_FLOOR_RATIO,
)
from fdi.trace import Flags, Floats, Trace, rms
from plant import Function, Input, Model, Signal, Signals, compile_function
from plant.effects import combine_laws

WINDOW = 100  # samples; shorter than stick-slip events are apart, longer than two periods of hum
QUIET = 0.2  # the part of all windows that the first guess rests on
LAGS = 40  # samples, of the noise's autocorrelation
MAINS = (50.0, 60.0, 400.0)  # Hz, and what is an odd or even multiple of them below half the sampling rate
NEIGHBOURS = (-7.0, -5.0, -3.0, 3.0, 5.0, 7.0)  # Hz beside a line: how large it would look without hum
SWEEP = 4000  # positions


class Floor(NamedTuple):
    """RMS that the noise alone leaves of a residual, in the residual's unit, and how it is known."""

    value: float
    source: str  # "repeats", "model" (its sensors.* noise), "data" (its second differences), "none"
    lower_bound: bool = False  # True: the noise is at least that large
    share: float = 1.0  # of the windows, those that hold noise alone
    difference: float = float("nan")  # rms(r - r_repeat)/sqrt 2 over all rows: noise, and what did not repeat
    hum: float = 0.0  # RMS of the mains' lines within `value`
    freedom: float = 1.0  # independent samples in one, of the noise's square: 1 for white noise, less for coloured


def find_floors(residual: Mapping[str, Floats], repeats: Sequence[Mapping[str, Floats]],
                period: float = 1e-3, least: Mapping[str, float] | None = None) -> dict[str, Floor]:
    """The floor of each signal from the residuals (n,) of the same model on repeats of one command.

    Rows correspond; NaN is a missing sample. Signals that no repeat has are left out. Lengths may differ at the end.
    `least`, in the residual's unit, is a floor that no measured one is below, as where repeats are rounded alike.
    """
    signal_repeats = {name: [repeat[name] for repeat in repeats if name in repeat] for name in residual}
    return {name: floor_from_repeats(residual[name], runs, period, (least or {}).get(name, 0.0))
            for name, runs in signal_repeats.items() if runs}


def floor_from_repeats(residual: Floats, repeats: Sequence[Floats], period: float = 1e-3, least: float = 0.0) -> Floor:
    """The floor of one signal from its residuals (n,), (m,).. under one model."""
    n = min(len(residual), *(len(r) for r in repeats))
    runs = [residual[:n], *(r[:n] for r in repeats)]
    pairs = [(a - b) / np.sqrt(2.0) for a, b in combinations(runs, 2)]
    difference = rms(np.concatenate(pairs))
    lines = find_hum_lines(runs, period)
    steady = [_remove_lines(r, lines, period) for r in runs]
    level, share, freedom = measure_quiet_level([(a - b) / np.sqrt(2.0) for a, b in combinations(steady, 2)])
    hum = float(np.sqrt(sum(power for _, power in lines)))
    return Floor(max(float(np.hypot(level, hum)), least), "repeats", False, share, difference, hum, freedom)


def floor_from_data(signal: Floats) -> Floor:
    """A lower bound from one signal's own second differences, (n,): noise that is not white has less in them."""
    second = np.diff(signal, 2)
    if np.isnan(second).all():
        return Floor(0.0, "none", True)
    # the median, scaled to a standard deviation, does not see the few samples in which the signal itself bends
    spread = float(np.nanmedian(np.abs(second))) / float(ndtri(0.75))
    white_difference = 6.0  # variance of the second difference of white noise, over its own
    return Floor(float(min(spread / np.sqrt(white_difference), _measure_spectrum(second))), "data", True)


def _measure_spectrum(second: Floats) -> float:
    """RMS of white noise from the upper half of the spectrum of its second differences, (n,); inf if they are too few.

    The median over frequencies does not see a line or a resonance, which second differences themselves take for noise.
    """
    frequencies = np.arange(WINDOW // 4, WINDOW // 2)  # periods in a window
    taper = np.hanning(WINDOW)
    pieces = _cut_windows(second, WINDOW)
    pieces = pieces[~np.isnan(pieces).any(axis=1)]
    if not len(pieces):
        return float("inf")
    power = np.abs(np.fft.rfft(pieces * taper)[:, frequencies]) ** 2 / np.sum(taper**2)
    power /= (2.0 * np.sin(np.pi * frequencies / WINDOW)) ** 4  # gain of the second difference
    return float(np.sqrt(np.median(power) / np.log(2.0)))  # power is distributed exponentially


def sensor_floors(trace: Trace, model: Model, residual: Mapping[str, Floats] | None = None) -> dict[str, Floor]:
    """The floors without repeats: the model's sensor noise, or the data's own where that is more or none is given.

    What a replay takes over of the controlled signal's noise is in them: see `compute_anchor_noise`. A signal moves
    from row to row where the controller answers noisy readings; the `residual`, (n,) each, of a replay has less of it.
    """
    floors = {}
    anchor_noise = compute_anchor_noise(trace, model)
    for name in trace.outputs:
        signal, own = trace.declared.find(name), [trace.mask_unusable(name), *([residual[name]] if residual else [])]
        data_floor = min((f for f in map(floor_from_data, own) if f.value > 0.0), default=floor_from_data(own[0]))
        level = (simulate_reading_noise(model, trace.controlled) if signal == trace.declared.controlled else
                 model.values.get(signal.noise, 0.0))
        share = 1.0
        if name in trace.sensors:
            level = trace.sensors[name].measure_noise(level)
            share = trace.sensors[name].count_independent(trace.period)
        floor = Floor(level, "model") if level > 0.0 and data_floor.value < NOISIER_THAN_MODEL * level else data_floor
        value = float(np.hypot(max(floor.value, signal.finest), anchor_noise.get(name, 0.0)))
        floors[name] = floor._replace(value=value, freedom=share)
    return floors


def find_sensor_level(trace: Trace, signal: Signal, model: Model) -> float:
    """RMS of a sensor's white noise: the model's, or that of the data where that is more or the plant declares none.

    And what a replay takes over of the controlled signal's noise.
    """
    level, own = model.values.get(signal.noise, 0.0), floor_from_data(trace.mask_unusable(signal.name)).value
    if not signal.noise:
        level = max(own, signal.finest) or 1.0
    elif own > NOISIER_THAN_MODEL * level:
        level = own
    if signal == trace.declared.controlled:
        return level
    return float(np.hypot(level, compute_anchor_noise(trace, model).get(signal.name, 0.0)))


def compute_anchor_noise(trace: Trace, model: Model) -> dict[str, float]:
    """RMS by output that the noise of the controlled signal makes of the others in a replay that is drawn to it.

    It moves whatever moves along, such as the angle of a motor beside the position of its load: white noise through a
    filter of the first order. A plant with an observer of its own is not looked at.
    """
    kind, controlled = model.kind, trace.declared.controlled
    if kind.foreign is not None or kind.correct is not None:
        return {}
    level = find_sensor_level(trace, controlled, model)
    pull = ANCHOR_RATE * model["controller.period"]
    start, p = model.build_start()[0], model.build_record()[0]
    outputs, shifted_outputs = kind.measure(start, p), kind.measure(kind.move(start, level, p), p)
    filter_gain = np.sqrt(pull / (2.0 - pull))
    return {signal.name: float(abs(after - before) * filter_gain) for signal, before, after
            in zip(trace.declared.outputs, outputs, shifted_outputs, strict=True) if signal != controlled}


def simulate_reading_noise(model: Model, controlled: Floats) -> float:
    """RMS of what noise and the effects on a reading (rounding, say) make of a signal within the range of `controlled`.

    A sweep through it, as neither is in a replay.
    """
    level = model.values.get(model.kind.signals.controlled.noise, 0.0)
    law, memory = combine_laws("reading", [model.find_effect(name) for name in model.effects])
    if not any(model.find_effect(name).port == "reading" for name in model.effects):
        return level
    noise = level * np.random.default_rng(0).standard_normal(SWEEP)
    true = np.linspace(float(np.nanmin(controlled)), float(np.nanmax(controlled)), SWEEP)
    s, p, out = model.build_start()[0], model.build_record()[0], np.empty(SWEEP)
    for k, x in enumerate((true + noise).tolist()):
        u = Input(0.0, 0.0, 0.0, k * model["controller.period"], 0.0, model["controller.period"])
        out[k], memory = law(x, memory, s, u, p)
    return rms(out - true)


def describe_doubtful_repeats(floor: Mapping[str, Floor], noise: Mapping[str, Floor], signals: Signals) -> str:
    """What makes a noise floor from repeats larger than the sensors' own noise explains; empty if nothing does."""
    # the data's own noise is a lower bound: coloured noise has less of it
    limits = {name: REPEAT_FLOOR_RATIO * (LOWER_BOUND_ERROR_RATIO if own.lower_bound else 1.0) * own.value
              for name, own in noise.items()}
    above = [f"{signals.find(name).symbol} by {f.value / noise[name].value:.2g}" for name, f in floor.items()
             if f.source == "repeats" and f.value > limits[name]]
    if not above:
        return ""
    return (f"the repeats differ by more than the noise of the sensors: {', '.join(above)} times. Use repeats of the "
            "same unit; if its sensors are so noisy, set sensors.*_noise of the model")


def measure_quiet_level(noise: Sequence[Floats], window: int = WINDOW) -> tuple[float, float, float]:
    """Standard deviation of stationary noise, (n,) each, in which at times something larger happens.

    Also the share of windows that were taken for noise, and their degrees of freedom per sample. A window's mean square
    is chi-squared with as many degrees of freedom as the noise's autocorrelation leaves it; that says what the quietest
    windows are to be divided by, and which windows are too large to belong.
    """
    pieces = np.concatenate([_cut_windows(x, window) for x in noise])
    pieces = pieces[np.isnan(pieces).mean(axis=1) < 0.5]
    if not len(pieces):
        x = np.concatenate(list(noise))
        return (float(np.sqrt(np.nanmean(x**2))), 1.0, 1.0) if len(x) and not np.isnan(x).all() else (0.0, 0.0, 1.0)
    power = np.nanmean(pieces**2, axis=1)
    order = np.argsort(power)
    quiet_rows = order[:max(1, round(QUIET * len(order)))]
    level, freedom = float(np.quantile(power, QUIET)), float(window)
    for _ in range(30):
        freedom = _measure_freedom(pieces[quiet_rows])
        if not len(quiet_rows) or level == 0.0:
            break
        if len(quiet_rows) == max(1, round(QUIET * len(order))):
            level = float(np.quantile(power, QUIET)) / _mean_square(QUIET, freedom)
        limit = _mean_square(NOISE_WINDOW_CONFIDENCE, freedom)
        new_rows = np.flatnonzero(power <= limit * level)
        # mean of the windows below the limit
        below = float(gammainc(freedom / 2 + 1, freedom * limit / 2)) / NOISE_WINDOW_CONFIDENCE
        if len(new_rows) == 0 or np.array_equal(new_rows, quiet_rows):
            break
        quiet_rows, level = new_rows, float(power[new_rows].mean()) / below
    return float(np.sqrt(level)), len(quiet_rows) / len(power), freedom / window


def _mean_square(part: float, freedom: float) -> float:
    """The mean square that this part of all windows stays below: chi-squared over its degrees of freedom."""
    return 2.0 * float(gammaincinv(freedom / 2, part)) / freedom


def _cut_windows(x: Floats, window: int) -> Floats:
    return x[:len(x) // window * window].reshape(-1, window)


def measure_freedom(x: Floats) -> float:
    """Independent samples in one of x, (n,), as to its mean square: 1 for white noise, less for what keeps its sign."""
    pieces = _cut_windows(x, WINDOW)
    return _measure_freedom(pieces) / pieces.shape[1] if len(pieces) else 1.0


def _measure_freedom(pieces: Floats) -> float:
    """Degrees of freedom of a window's mean square: samples over the sum of the squared autocorrelation."""
    x = np.nan_to_num(pieces)
    size = pieces.shape[1]
    power = float((x**2).sum())
    if power == 0.0:
        return float(size)
    lags = min(LAGS, size - 1)
    rho = np.array([float((x[:, k:] * x[:, :size - k]).sum()) / power for k in range(1, lags + 1)])
    fade = 1.0 - np.arange(1, lags + 1) / size
    alike = float((fade * np.maximum(rho**2 - 1.0 / x.size, 0.0)).sum())
    return max(1.0, float(size) / (1.0 + 2.0 * alike))


def find_hum_lines(runs: Sequence[Floats], period: float) -> list[tuple[float, float]]:
    """(Hz, mean square) of the mains' lines that stand out in the quiet half of the windows of the runs (n,)."""
    mains = sorted({f * k for f in MAINS for k in range(1, 5) if f * k < 0.45 / period})
    grid = np.array([[f, *(f + d for d in NEIGHBOURS)] for f in mains])
    power = np.zeros(grid.shape)
    fewest_hum_windows = 10  # fewer give no spectrum to compare lines in
    for r in runs:
        loud = np.mean(_cut_windows(r, WINDOW) ** 2, axis=1)
        if np.isfinite(loud).sum() < fewest_hum_windows or not grid.size:
            return []
        rows = loud <= np.nanquantile(loud, 0.5)
        power += np.abs(_fit_phasors(r, rows, grid.ravel(), period).reshape(grid.shape)) ** 2 / 2.0 / len(runs)
    line, beside = power[:, 0], power[:, 1:].mean(axis=1)
    return [(f, float(a - b)) for f, a, b in zip(mains, line, beside, strict=True) if a > HUM_LINE_RATIO * b > 0.0]


def _fit_phasors(x: Floats, rows: Flags, frequencies: Floats, period: float) -> NDArray[np.complex128]:
    """Amplitude and phase of sines in the chosen windows of x, which are freed of their mean and slope first."""
    t = np.arange(WINDOW) - (WINDOW - 1) / 2
    pieces = _cut_windows(x, WINDOW)
    windows = np.flatnonzero(rows[:len(pieces)] & ~np.isnan(pieces).any(axis=1))
    if not len(windows):
        return np.zeros(len(frequencies), complex)
    level = pieces[windows] - pieces[windows].mean(axis=1, keepdims=True)
    level = level - np.outer(np.einsum("ij,j->i", level, t) / np.sum(t**2), t)
    turn = -2j * np.pi * period * frequencies
    inside = np.einsum("ij,jk->ik", level, np.exp(np.outer(np.arange(WINDOW), turn)))
    return np.asarray(2.0 / WINDOW * (inside * np.exp(np.outer(windows * WINDOW, turn))).mean(axis=0))


def _remove_lines(x: Floats, lines: Sequence[tuple[float, float]], period: float) -> Floats:
    """x without the lines as they stand in it."""
    if not lines:
        return x
    frequencies = np.array([f for f, _ in lines])
    rows = np.ones(len(x) // WINDOW, bool)
    wave = np.exp(2j * np.pi * period * np.outer(np.arange(len(x)), frequencies))
    return np.asarray(x - np.einsum("ij,j->i", wave, _fit_phasors(x, rows, frequencies, period)).real)


class Noise(NamedTuple):
    """Noise of one signal: standard deviation, and the autoregressive model of its colour."""

    level: float  # SI unit of the signal
    filter: Floats  # (p + 1,) coefficients, first 1: e_k = sum_i filter_i r_{k-i} is white
    innovation: float  # standard deviation of e

    def whiten_signal(self, residuals: Floats, signal: int, white: Floats) -> None:
        """Fill one signal of `white` (m, s, n) with that of the residuals (m, s, n), as white noise of variance 1.

        NaN (nothing measured) gives 0.
        """
        _compile_filter()(residuals, signal, self.filter / self.innovation, white)


@cache
def _compile_filter() -> Function:
    return compile_function(filter_signal)


def filter_signal(x: Floats, signal: int, weights: Floats, out: Floats) -> None:
    """Fill `out` (m, s, n) of a signal with weighted sums of each value of `x` (m, s, n) and those before it.

    Where one of them is missing, they are 0. Compiled, as the residuals of every trial of a fit pass it: SciPy's
    lfilter takes five times as long.
    """
    n, tile = x.shape[2], 1024  # a tile stays in the fastest cache for all weights
    for run in range(len(x)):
        for first in range(0, n, tile):
            sums = out[run, signal, first:first + tile]
            sums[:] = 0.0
            for i in range(len(weights)):
                begin = max(i - first, 0)
                samples = x[run, signal, first + begin - i:n]
                if weights[i] != 0.0:  # a signal sampled in few rows has none between them
                    for t in range(len(sums) - begin):
                        sums[begin + t] += weights[i] * samples[t]
            for t in range(len(sums)):
                sums[t] = sums[t] if sums[t] == sums[t] else 0.0


def white_noise(level: float) -> Noise:
    """White noise of a known standard deviation."""
    return Noise(level, np.ones(1), level)


def measure_level(difference: Floats, block: int = WINDOW) -> float:
    """Standard deviation of noise, (n,), in which now and then something else happens: the median block's."""
    blocks = _cut_windows(difference, block)
    if not len(blocks):
        return float(np.nanstd(difference))
    has_value = ~np.isnan(blocks)
    with np.errstate(invalid="ignore", divide="ignore"):  # a block may have no value at all
        variance = np.nansum(blocks**2, axis=1) / has_value.sum(axis=1)
    mean_over_median = 1.0 / 0.993  # mean over median of the variance of BLOCK normal samples
    return float(np.sqrt(np.nanmedian(variance) * mean_over_median))


def fit_noise(residual: Floats, order: int = 40) -> Noise:
    """The autoregressive model of noise, (n,), that its length supports (Yule-Walker; Akaike's choice of order)."""
    rows = np.flatnonzero(~np.isnan(residual))
    x = residual[rows]
    sigma = measure_level(x)
    if sigma == 0.0:
        return white_noise(float(np.finfo(float).tiny))
    size = WINDOW * (len(x) // WINDOW) or len(x)
    blocks = x[:size].reshape(-1, min(WINDOW, size))
    calm = blocks[(blocks**2).mean(axis=1) <= CALM_BLOCK_RATIO * sigma**2]  # the others hold a stop that came later
    n = calm.size
    pairs = [np.einsum("ij,ij->", calm[:, k:], calm[:, :calm.shape[1] - k]) for k in range(order + 1)]
    covariance = np.array(pairs) / n
    covariance *= sigma**2 / covariance[0]
    best, cost = white_noise(float(np.sqrt(covariance[0]))), 0.0
    stride = int(np.median(np.diff(rows))) if len(rows) > 1 else 1  # of a signal that is sampled in few rows
    for p in range(1, order + 1):
        a = solve_toeplitz(covariance[:p], covariance[1:p + 1])  # the equations of Yule and Walker
        variance = covariance[0] - a @ covariance[1:p + 1]
        gain = n * np.log(covariance[0] / variance) - NOISE_COEFFICIENT_GAIN * p
        if gain > cost:
            whitener = np.zeros(p * stride + 1)
            whitener[::stride] = [1.0, *-a]
            best, cost = Noise(float(np.sqrt(covariance[0])), whitener, float(np.sqrt(variance))), gain
    return best
