"""The residual itself: where and under which condition it is large, whether it is noise, what it follows.

It is shared out over the sections of the command, and over conditions such as a speed, a pressure or a reversal.

The tests are those of MATLAB's `resid` and of Box and Jenkins: autocorrelation, cross-correlation with the inputs,
cumulative periodogram with Bartlett's band, and the mean of the residual by speed, position, pressure and direction.
Coloured sensor noise is no fault of a model: where repeats show its colour, residuals are whitened by it before they
are called coloured.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d
from scipy.special import kolmogi, ndtri

from fdi.estimation import Columns, differentiate
from fdi.thresholds import CONDITION_DENSITY, CONDITION_EXCESS_LEAST, CONDITION_SHARE, RESIDUAL_TEST_CONFIDENCE
from fdi.trace import Flags, Floats, Trace, describe_section, fill_gaps, hold_last
from plant import Signal, Signals

SMOOTH = 0.021  # s of measured position that a speed is taken from
REVERSES = 5e-4  # m/s in the other direction make a reversal; a ram at rest trembles by less
SPEEDS = (0.001, 0.003, 0.01, 0.02, 0.05, 0.1)  # m/s
RATES = (0.3, 1.0, 3.0)  # m/s2
PLACES = (0.5e-3, 1e-3, 2e-3, 5e-3, 10e-3, 20e-3)  # m
LEVELS = {"Pa": (5e5, 1e6, 2e6, 5e6, 1e7), "m": (5e-6, 20e-6, 50e-6, 2e-4)}  # of the other outputs, by unit
SHARES = (0.05, 0.1, 0.2, 0.5)  # of the largest value, for outputs in other units
DELAYS = (0.005, 0.02, 0.05, 0.1)  # s after a reversal
REACH = 100  # lags, of the autocorrelation
AFTER, BEFORE = 60, 20  # lags, of the residual after and before the input
BINS = 15
WILD = 5.0  # standard deviations; what is larger is an event and has no say in a colour
WHITE = np.ones(1)  # the filter of what is white already
SHAPES = ("proportional to", "steps with the sign of", "even in")


class Place(NamedTuple):
    """One section's part of the error."""

    section: str
    t0: float  # s
    t1: float
    share: float  # of the squared error of all signals, each over its floor
    ratio: float  # RMS over floor within the section
    condition: str  # where in it the error is, "" if it is everywhere


class Motion(NamedTuple):
    """What the plant does, (n,) each."""

    x: Floats  # the controlled signal
    v: Floats  # its speed
    a: Floats  # its acceleration
    others: Mapping[str, Floats]  # the other outputs, by name
    drive: Floats
    reversed_for: Floats  # s since the motion last reversed; inf before
    signals: Signals
    scale: float  # as of `Trace.scale`


def describe_motion(trace: Trace, model: Columns) -> Motion:
    """What the replay of the `model` does, whose noise is not in the residuals, and how long ago it last reversed."""
    controlled, *others = trace.declared.outputs
    x, reverses = model[controlled.name], REVERSES * trace.scale
    size = max(5, round(SMOOTH / trace.period) | 1)
    v = differentiate(x, size, 1) / trace.period
    a = differentiate(x, 2 * size + 1, 2) / trace.period**2
    sign = hold_last(np.where(np.abs(v) > reverses, np.sign(v), np.nan))
    is_turn = np.append(False, (np.diff(sign) != 0.0) & (sign[:-1] != 0.0))
    rows = np.arange(len(x))
    since = trace.period * np.asarray(rows - np.maximum.accumulate(np.where(is_turn, rows, -np.inf)), float)
    return Motion(x, v, a, {s.name: model[s.name] for s in others}, trace.drive, since, trace.declared, trace.scale)


def combine_residuals(residual: Columns, floor: Mapping[str, float]) -> Floats:
    """Squared error over squared floor, mean of the signals, (n,); 1 on average where only noise is left."""
    stack = np.array([(residual[name] / floor[name]) ** 2 for name in residual if floor.get(name, 0.0) > 0.0])
    has_value = ~np.isnan(stack)
    return np.where(has_value.any(axis=0), np.nansum(stack, axis=0) / np.maximum(has_value.sum(axis=0), 1), np.nan)


def locate_error(trace: Trace, z2: Floats, m: Motion, limit: float) -> list[Place]:
    """The sections of the command with their shares of `z2` (n,), the largest first; `limit` of the drive."""
    total = float(np.nansum(z2))
    out = []
    shortest = 0.05  # s; a section with fewer samples is not judged by itself
    for section in trace.sections():
        rows = slice(section.start, section.stop)
        inside = z2[rows]
        if total <= 0.0 or (~np.isnan(inside)).sum() * trace.period < shortest:
            continue
        is_in_section = np.zeros(len(z2), bool)
        is_in_section[rows] = True
        share = float(np.nansum(inside)) / total
        condition = find_condition(np.where(is_in_section, z2, np.nan), m, limit) if share > 0.03 else ""
        words = describe_section(section, float(np.abs(trace.command[rows]).max()), trace.declared.command.unit)
        t0, t1 = float(trace.t[section.start]), float(trace.t[section.stop - 1] + trace.period)
        out.append(Place(words, t0, t1, share, math.sqrt(float(np.nanmean(inside))), condition))
    return sorted(out, key=lambda place: -place.share)


def find_condition(z2: Floats, m: Motion, limit: float) -> str:
    """The condition under which the excess of `z2` (n,) over 1 is gathered, in words; "" if under none."""
    has_value = ~np.isnan(z2)
    excess = np.where(has_value, z2 - 1.0, 0.0)
    total, rows = float(excess.sum()), int(has_value.sum())
    if rows == 0 or total < CONDITION_EXCESS_LEAST * rows:
        return ""
    best, condition = 0.0, ""
    for words, flags in _list_conditions(m, limit):
        time = float((flags & has_value).sum()) / rows
        part = float(excess[flags].sum()) / total
        # the gain over spreading it evenly; a condition that holds nearly always or hardly ever gains little
        score = part - time
        if part >= CONDITION_SHARE and time > 0.0 and part / time >= CONDITION_DENSITY and score > best + 0.01:
            best, condition = score, f"{100 * min(part, 1.0):.0f} % of it in {100 * time:.2g} % of the time: {words}"
    return condition


def _list_conditions(m: Motion, limit: float) -> Sequence[tuple[str, Flags]]:
    speed, far, hard, by = np.abs(m.v), np.abs(m.x), np.abs(m.a), m.scale
    unit, ram, symbol = m.signals.controlled.unit, m.signals.controlled.phrase, m.signals.controlled.symbol
    return [
        *((f"{ram} faster than {_format_speed(s * by, unit)}", speed > s * by) for s in SPEEDS),
        *((f"{ram} slower than {_format_speed(s * by, unit)}", speed < s * by) for s in SPEEDS[:4]),
        *((f"{ram} further than {_format_place(x * by, unit)} from the middle", far > x * by) for x in PLACES),
        *((f"within {_format_place(x * by, unit)} of the middle", far < x * by) for x in PLACES[:3]),
        *((f"{ram} accelerates by more than {a * by:g} {unit}/s2", hard > a * by) for a in RATES),
        *((f"within {1e3 * d:g} ms after a reversal", m.reversed_for < d) for d in DELAYS),
        (f"{ram} extends", m.v > REVERSES * by), (f"{ram} retracts", m.v < -REVERSES * by),
        (f"{symbol} positive", m.x > PLACES[0] * by), (f"{symbol} negative", m.x < -PLACES[0] * by),
        (f"{m.signals.drive.phrase} at its limit", np.abs(m.drive) > 0.99 * limit),
        *(each for name, x in m.others.items() for each in _list_levels(m.signals.find(name), x))]


def _list_levels(signal: Signal, x: Floats) -> Sequence[tuple[str, Flags]]:
    """Conditions on an output other than the controlled one; a length is the way of a part from its null."""
    size, levels = np.abs(x), LEVELS.get(signal.unit) or [float(np.abs(x).max()) * share for share in SHARES]
    factor, unit = {"Pa": (1e-5, "bar"), "m": (1e6, "um")}.get(signal.unit, (1.0, signal.unit))
    if signal.unit == "m":
        return [*((f"{signal.phrase} within {factor * y:g} {unit} of its null", size < y) for y in levels),
                *((f"{signal.phrase} more than {factor * y:g} {unit} from its null", size > y) for y in levels)]
    return [*((f"|{signal.symbol}| above {factor * y:.3g} {unit}", size > y) for y in levels),
            (f"{signal.symbol} positive", x > levels[0]), (f"{signal.symbol} negative", x < -levels[0])]


def _format_place(x: float, unit: str) -> str:
    return f"{1e3 * x:g} mm" if unit == "m" else f"{x:g} {unit}"


def _format_speed(s: float, unit: str) -> str:
    return f"{1e3 * s:g} mm/s" if unit == "m" and s < 0.1 else f"{s:g} {unit}/s"


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

    on: str  # "speed", "position", "acceleration", or the symbol of an output
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
    d = trace.declared
    inputs = {d.drive.symbol: trace.drive, d.command.symbol: trace.command,
              **({d.load.symbol: trace.load} if d.load and np.ptp(trace.load) > 0.0 else {})}
    colours = {name: fit_whitener(np.diff(u)) for name, u in inputs.items() if np.ptp(u) > 0.0}
    levels = {s.symbol: m.others[s.name] for s in d.outputs[1:] if s.unit != d.controlled.unit}  # such as pressures
    quantities = {"speed": m.v, "position": m.x, **levels, "acceleration": m.a}
    # a signal's own noise or error is in these; that they go together says nothing
    own = {(s.name, s.symbol) for s in d.outputs} | {(d.controlled.name, d.drive.symbol)}
    return {name: _examine_signal(
        trace, r, repeats.get(name), {u: (inputs[u], by) for u, by in colours.items() if (name, u) not in own},
        {q: x for q, x in quantities.items() if (name, q) not in own}) for name, r in residual.items()}


def fit_whitener(x: Floats) -> Floats:
    """The filter, (p + 1,), that makes x (n,) white: its autoregressive model by Yule and Walker. WHITE if it rests.

    The order is fixed, as an input is to be whitened and not described.
    """
    x = np.nan_to_num(x)
    level = float(np.median(np.abs(x))) / 0.6745
    if level == 0.0:
        return WHITE
    x = np.clip(x, -WILD * level, WILD * level)
    whitening_order = 40  # of the filter that makes noise white: two periods of 50 Hz hum at 1 kHz
    covariance = correlate(x, x, 0, whitening_order) / len(x)
    covariance[0] *= 1 + 1e-9  # a pure sine has no inverse
    lags = np.arange(whitening_order)
    # by elimination: Levinson's recursion loses digits where the equations are nearly singular, as for a sine
    weights = np.linalg.solve(covariance[np.abs(lags[:, None] - lags)], covariance[1:])
    return np.concatenate([WHITE, -weights])


def apply_whitener(x: Floats, by: Floats) -> Floats:
    """x (n,) through the filter of a colour; NaN counts as 0."""
    return np.convolve(np.nan_to_num(x), by)[:len(x)]


def _examine_signal(trace: Trace, residual: Floats, difference: Floats | None,
                    inputs: Mapping[str, tuple[Floats, Floats]], quantities: Mapping[str, Floats]) -> ResidualTests:
    r = np.nan_to_num(residual)
    e = apply_whitener(r, fit_whitener(difference) if difference is not None else WHITE)
    correlation = autocorrelate(e)
    band = float(ndtri(0.5 + RESIDUAL_TEST_CONFIDENCE / 2)) / math.sqrt(len(e))
    frequencies, power, departs, bartlett_band = cumulate_periodogram(e, trace.period)
    _, plain, _, _ = cumulate_periodogram(r, trace.period)
    half_power = float(frequencies[min(int(np.searchsorted(plain, 0.5)), len(frequencies) - 1)])
    quiet = autocorrelate(np.nan_to_num(difference)) if difference is not None else np.eye(1, REACH + 1)[0]
    follows = tuple(correlate_with_input(name, u, by, r, trace.period) for name, (u, by) in inputs.items())
    candidates = [bin_residual(name, q, residual) for name, q in quantities.items()]
    depends = sorted((d for d in candidates if d is not None), key=lambda d: -d.share)
    # the lags at which they first are below 1/e
    memory, noise_memory = (int(np.argmax(np.append(x, 0.0) < 1 / math.e)) * trace.period
                            for x in (autocorrelate(r), quiet))
    return ResidualTests(memory, noise_memory, correlation, band, frequencies, power, departs, bartlett_band,
                         half_power, follows, tuple(depends))


def autocorrelate(x: Floats) -> Floats:
    """At lags 0..REACH, of a residual that would be zero: its mean is not taken off."""
    whole = correlate(x, x, 0, REACH)
    return np.asarray(whole / whole[0] if whole[0] > 0.0 else np.eye(1, len(whole))[0])


def correlate(x: Floats, y: Floats, first: int, last: int) -> Floats:
    """Sums of x_{k + lag} y_k for lags first..last, by FFT; x and y (n,).

    With numpy: scipy.signal has the same and takes 1 s to import, a third of the time that the whole command has.
    """
    piece = 1 << 17  # rows; the transform of a long recording would take its memory ten times
    padded = np.concatenate([np.zeros(-first), x, np.zeros(last)])
    sums = np.zeros(last - first + 1)
    for k in range(0, len(y), piece):
        sums += _correlate_piece(padded[k:k + piece + last - first], y[k:k + piece])[:len(sums)]
    return sums


def _correlate_piece(x: Floats, y: Floats) -> Floats:
    """Sums of x_{k + lag} y_k for the lags at which y does not reach beyond the end of x, from 0 on."""
    n = 1 << (len(x) - 1).bit_length()
    return np.asarray(np.fft.irfft(np.fft.rfft(x, n) * np.conj(np.fft.rfft(y, n)), n))


def cumulate_periodogram(x: Floats, period: float) -> tuple[Floats, Floats, float, float]:
    """Frequencies, cumulative periodogram 0..1, its largest distance from the straight line, and Bartlett's 95 % band.

    Box and Jenkins: for white noise the distance is that of Kolmogorov and Smirnov for as many samples as frequencies.
    """
    frequencies = np.arange(1, len(x) // 2) / (len(x) * period)
    power: Floats = np.abs(np.fft.rfft(x)[1:len(x) // 2]) ** 2
    total = power.sum()
    curve = np.cumsum(power) / total if total > 0.0 else np.linspace(0, 1, len(power))
    line = np.arange(1, len(curve) + 1) / len(curve)
    return frequencies, curve, float(np.abs(curve - line).max()), float(kolmogi(0.05)) / math.sqrt(len(curve))


def correlate_with_input(name: str, u: Floats, by: Floats, residual: Floats, period: float) -> Follows:
    """Cross-correlation with an input (n,); both are filtered `by` the colour of its steps to make them white."""
    steps, residual_steps = (apply_whitener(np.diff(x), by) for x in (u, residual))
    # a jump of the command would stand for the whole test
    steps, residual_steps = (np.clip(x, -WILD * x.std(), WILD * x.std()) for x in (steps, residual_steps))
    size = math.sqrt(float(np.sum(residual_steps**2)) * float(np.sum(steps**2))) or 1.0
    curve: Floats = correlate(residual_steps, steps, -BEFORE, AFTER) / size
    lags: Floats = np.linspace(-BEFORE * period, AFTER * period, AFTER + BEFORE + 1)
    peak = BEFORE + 1 + int(np.abs(curve[BEFORE + 1:]).argmax())  # what comes before its cause is feedback
    # Bartlett: what is left of both colours widens the band. Of all lags the largest is taken: they share the 1 %
    wider = 1.0 + 2.0 * float(np.sum(autocorrelate(residual_steps)[1:] * autocorrelate(steps)[1:]))
    bound = float(ndtri(1 - (1 - RESIDUAL_TEST_CONFIDENCE) / 2 / AFTER)) * math.sqrt(max(wider, 1.0) / len(steps))
    return Follows(name, float(curve[peak]), float(lags[peak]), bound, lags, curve)


def bin_residual(name: str, quantity: Floats, residual: Floats) -> Depends | None:
    """Means of the residual (n,) over BINS of the quantity (n,) with as many samples in each; None for too few."""
    has_value = ~np.isnan(quantity) & ~np.isnan(residual)
    q, r = quantity[has_value], residual[has_value]
    edges = np.unique(np.quantile(q, np.linspace(0, 1, BINS + 1))) if len(q) else np.empty(0)
    power = float(np.mean(r**2)) if len(r) else 0.0
    if len(edges) < 5 or power == 0.0:
        return None
    where = np.clip(np.searchsorted(edges, q, side="right") - 1, 0, len(edges) - 2)
    count = np.maximum(np.bincount(where, minlength=len(edges) - 1), 1)
    means = np.bincount(where, r, len(edges) - 1) / count
    centres = np.bincount(where, q, len(edges) - 1) / count
    spread = np.sqrt(np.maximum(np.bincount(where, r**2, len(edges) - 1) / count - means**2, 0.0))
    correlation = autocorrelate(r - means[where])
    first = int(np.argmax(correlation < 0.05)) or len(correlation)
    thin = 1.0 + 2.0 * float(correlation[1:first].sum())  # neighbours say the same: as many samples count as one
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
        residual = means * weights - columns @ np.linalg.lstsq(columns, means * weights, rcond=None)[0]
        share = 1.0 - float(residual @ residual) / total if total > 0.0 else 0.0
        if share > best[0] + 0.02:
            best = (share, word)
    return best[1]


CELL_SPEEDS = (0.0, 1e-3, 3e-3, 10e-3, 30e-3, 100e-3, 300e-3, np.inf)  # m/s, edges; noise alone is 0.14 mm/s
AMPLITUDES = (0.0, 0.03e-3, 0.1e-3, 0.3e-3, 1e-3, 3e-3, 10e-3, 30e-3, np.inf)  # m


class DeviationMap(NamedTuple):
    """Error over noise floor of each signal in cells of speed and amplitude; NaN where there are too few rows.

    `speeds` (m + 1,) m/s and `amplitudes` (n + 1,) m are the edges of the cells that hold rows; each array of `ratio`
    has shape (n, m).
    """

    speeds: Floats
    amplitudes: Floats
    ratio: Mapping[str, Floats]


def map_deviation(trace: Trace, residual: Mapping[str, Floats], floor: Mapping[str, float],
                  fewest: int = 30) -> DeviationMap | None:
    """RMS residual over floor by speed and amplitude of the ram; None if no cell has `fewest` rows.

    Args:
        trace: gives the motion. The speed is that over 20 rows; the amplitude is half the range of the position within
            0.25 s before and after.
        residual: (n,) of each signal, NaN where it is not judged.
        floor: noise floor of each signal, > 0, in the unit of its residual.
        fewest: rows that a cell needs.
    """
    position = fill_gaps(trace.controlled)
    speeds, amplitudes = (np.array(edges) * trace.scale for edges in (CELL_SPEEDS, AMPLITUDES))
    speed = np.abs(position[np.minimum(np.arange(len(position)) + 10, len(position) - 1)]
                   - position[np.maximum(np.arange(len(position)) - 10, 0)]) / (20 * trace.period)
    width = 2 * round(0.25 / trace.period) + 1
    amplitude = 0.5 * (maximum_filter1d(position, width) - minimum_filter1d(position, width))
    cells = (np.digitize(amplitude, amplitudes) - 1) * (len(CELL_SPEEDS) - 1) + np.digitize(speed, speeds) - 1
    shape, size = (len(AMPLITUDES) - 1, len(CELL_SPEEDS) - 1), (len(AMPLITUDES) - 1) * (len(CELL_SPEEDS) - 1)
    is_judged = ~np.all([np.isnan(r) for r in residual.values()], axis=0)
    enough = np.bincount(cells[is_judged], minlength=size).reshape(shape) >= fewest
    if not enough.any():
        return None
    ratio = {}
    for name, r in residual.items():
        has_value = ~np.isnan(r)
        count = np.bincount(cells[has_value], minlength=size).reshape(shape)
        square = np.bincount(cells[has_value], r[has_value] ** 2, minlength=size).reshape(shape)
        ratio[name] = np.where(enough & (count > 0), np.sqrt(square / np.maximum(count, 1)) / floor[name], np.nan)
    down, across = (slice(np.flatnonzero(enough.any(axis))[0], np.flatnonzero(enough.any(axis))[-1] + 1)
                    for axis in (1, 0))
    return DeviationMap(speeds[across.start:across.stop + 1], amplitudes[down.start:down.stop + 1],
                        {name: r[down, across] for name, r in ratio.items()})
