"""The blocks of the electrohydraulic actuator: flow and force of its jack, balanced from measured signals.

For a plant whose declaration says that `plant.forced` can balance it (`Plant.balances`).
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fdi.estimation import (
    BRIDGED_ROWS,
    Columns,
    Floor,
    differentiate,
    extend_flags,
    find_floors,
    floor_from_data,
    replay_current,
    simulate_reading_noise,
)
from fdi.thresholds import BLOCK_EXCESS_LEAST, NOISY_SENSOR_RATIO, SHAPE_TIE_GAIN, SPOOL_FITS_RATIO
from fdi.trace import Flags, Floats, Trace, bridge_gaps, rms
from plant import Model, compute_flow_balance, compute_force_balance

XJ, P12, XS = "xj", "p12", "xs"
SPAN = 0.02  # s; the flow is compared over the ram's way in it: longer adds up noise of XS, shorter shows that of XJ
MEAN = 0.011  # s, over which the direction of motion is told
SURE = 5.0  # standard deviations of the speed that tell a moving ram
LOOSE = 2e-3  # m/s; the speed of the sensed position must show the direction too
PLAYS = (2e-5, 6e-5, 1.5e-4)  # m, hysteresis of any shape as a sum of plays
FEWEST_FORCE_ROWS = 400  # with known forces; fewer are the ends of steps, where speed is hardest to tell
PUSH = 8e3  # Pa, a step of the known load within a sample, over the area, from which on it is left out


class Balance(NamedTuple):
    """The jack's two residuals and what they were made of, columns (n,)."""

    way: Floats  # m, XJ sensed less XJ from the flow, gained over SPAN; NaN where it cannot be told
    force: Floats  # Pa, P12 less what the motion takes; NaN unless the ram surely moves, and without P12
    gain: float  # by which the ram moves further than the flow says, as a fraction
    speed: Floats  # m/s, from the flow
    position: Floats  # m, as the flow adds it up


def compute_balance(trace: Trace, model: Model, run: Columns) -> Balance:
    """Flow and force of the jack from measured XS and P12; an XS that was not measured is the replay's."""
    columns = [trace.column(name) if name in trace.outputs else run[name] for name in (P12, XS)]
    (p12, is_p12_missing), (xs, is_xs_missing) = (bridge_gaps(column, BRIDGED_ROWS) for column in columns)
    xj = bridge_gaps(trace.controlled, BRIDGED_ROWS)[0]
    sensed_speed = differentiate(xj, max(5, round(MEAN / trace.period) | 1), 1) / trace.period
    is_bad = is_p12_missing | is_xs_missing | ~trace.usable
    if P12 not in trace.outputs:  # not the replay's, which hangs on the valve, but what motion takes where it is sure
        error = _compute_force_residual(trace, model, p12, xj, sensed_speed)
        p12, is_bad = p12 - np.nan_to_num(error), is_bad | np.isnan(error)
    saturated_share = 0.98  # of the supply pressure: the edges' law says nothing about the speed there
    is_bad |= np.abs(p12) > saturated_share * model["supply.pressure"]
    sensed, speed = compute_flow_balance(model, xs, p12, float(xj[0]))
    lag = count_span_rows(trace.period)
    way = difference_over(trace.controlled - sensed, lag)
    way[extend_flags(is_bad, lag)] = np.nan
    dx = difference_over(xj, lag)
    has_value = ~np.isnan(way) & ~np.isnan(dx)
    power = float(np.sum(dx[has_value] ** 2))
    gain = float(np.sum(dx[has_value] * way[has_value])) / power if power > 0.0 else 0.0
    # without a measured spool the flow is the servovalve's, and the forces take their speed from the position
    ram_speed = speed * (1 + max(-0.2, min(gain, 0.2))) if XS in trace.outputs else sensed_speed
    is_known = P12 in trace.outputs
    force = _compute_force_residual(trace, model, p12, xj, ram_speed) if is_known else np.full(len(trace), np.nan)
    force[is_bad] = np.nan
    return Balance(way, force, gain, speed, sensed)


def count_span_rows(period: float) -> int:
    """SPAN in rows."""
    return max(1, round(SPAN / period))


def difference_over(x: Floats, rows: int) -> Floats:
    """x less what it was so many rows before; NaN at the start."""
    out = np.full(len(x), np.nan)
    out[rows:] = x[rows:] - x[:-rows]
    return out


def _compute_force_residual(trace: Trace, model: Model, p12: Floats, xj: Floats, speed: Floats) -> Floats:
    takes, _, dynamic = compute_force_balance(model, xj, speed, p12, trace.load)
    size = max(1, round(MEAN / trace.period)) | 1
    kernel = np.ones(size) / size
    mean = np.convolve(speed, kernel, "same")
    bend = mean[2 * size:] - 2.0 * mean[size:-size] + mean[:-2 * size]  # of means that share no sample
    noise = float(np.median(np.abs(bend))) / 0.6745 / math.sqrt(6.0)
    sensed_speed = np.convolve(np.gradient(xj, trace.period), kernel, "same")
    direction = np.where(mean > SURE * noise, 1.0, np.where(mean < -SURE * noise, -1.0, 0.0))
    direction[(np.abs(sensed_speed) > LOOSE) & (np.sign(sensed_speed) != direction)] = 0.0
    turned = extend_flags(np.diff(direction, prepend=direction[0]) != 0.0, size)
    turned |= np.roll(turned, -size) | ~_find_resolved(speed, trace.period)
    pushed = np.abs(np.diff(trace.load, prepend=trace.load[0])) > PUSH * model["jack.area"]
    turned |= extend_flags(pushed, size)  # a step of the known load: the speed changes within a sample
    return np.where((direction == 0.0) | turned, np.nan, p12 - (takes + direction * dynamic) / model["jack.area"])


def _find_resolved(speed: Floats, period: float) -> Flags:
    """Where the change of speed is the same over two and over four samples: there is no jerk between them."""
    near, wide = np.gradient(speed, period), np.zeros(len(speed))
    wide[2:-2] = (speed[4:] - speed[:-4]) / (4 * period)
    apart = np.abs(near - wide)
    most_apart = 4.0  # standard deviations by which accelerations over two and four samples may differ
    return apart <= most_apart * float(np.median(apart)) / 0.6745


def share_error(trace: Trace, b: Balance, xs: Floats, p12: Floats, floor: float, is_noisy: bool
                ) -> tuple[float, float]:
    """Ratios of flow and sensor to the floor, m: the one at fault carries all, the other what it alone explains.

    At fault is whichever error describes `b.way` better; xs m, p12 Pa, (n,), as in the balance. `is_noisy`: the sensed
    position changes from sample to sample by more than its noise, as no flow can make it.

    The descriptions are least-squares fits of a few shapes of each kind. None of them is made of the sensed position,
    whose noise is in the residual itself.
    """
    lag, x = count_span_rows(trace.period), b.position
    rates = [np.concatenate([[0.0], np.cumsum(r)[:-1]]) * trace.period for r in _list_rate_shapes(xs, p12)]
    places = [x, b.speed, p12, *(apply_play(x, width) for width in PLAYS)]
    has_value = ~np.isnan(b.way)
    columns = [difference_over(s, lag)[has_value] for s in (*rates, *places)]
    error, (rate, place, gain, both) = _measure_remainders(b.way[has_value], columns, len(rates))
    effective = int(has_value.sum()) / lag

    def measure_evidence(one: float, other: float) -> float:
        """Twice the log likelihood by which `one` describes worse than `other`."""
        return effective * math.log(max(one, 1e-3 * floor) ** 2 / max(other, 1e-3 * floor) ** 2)

    whole = error / floor
    gain_suffices = measure_evidence(gain, both) < SHAPE_TIE_GAIN + len(columns)
    is_tie = gain_suffices or abs(measure_evidence(rate, place)) < SHAPE_TIE_GAIN
    if whole**2 - 1.0 < BLOCK_EXCESS_LEAST or (is_tie and not is_noisy):
        return whole, whole
    if not is_tie and rate < place:
        return whole, math.sqrt(1.0 + max(0.0, rate**2 - both**2) / floor**2)
    return math.sqrt(1.0 + max(0.0, place**2 - both**2) / floor**2), whole


def _measure_remainders(y: Floats, columns: list[Floats], first: int
                        ) -> tuple[float, tuple[float, float, float, float]]:
    """RMS of y, and of what the `first` columns, the others, the first of the others, and all of them leave of it."""
    every = [*columns, y]
    size = np.sqrt([np.mean(c**2) for c in every])
    scale, gram = np.where(size > 0.0, size, 1.0), np.zeros((len(every), len(every)))
    rows = 100_000  # at a time
    for k in range(0, len(y), rows):
        z = np.column_stack([c[k:k + rows] for c in every]) / scale
        # not z.T @ z, here and elsewhere: the threads of BLAS wait for a busy core, and 1 ms becomes 0.9 s
        gram += np.einsum("ki,kj->ij", z, z) / len(y)

    def measure_remainder(pick: slice) -> float:
        inverse = np.linalg.pinv(gram[pick, pick], rcond=1e-9, hermitian=True)
        part = gram[pick, -1]
        return float(size[-1]) * math.sqrt(max(0.0, 1.0 - float(part @ inverse @ part)))

    return float(size[-1]), (measure_remainder(slice(0, first)), measure_remainder(slice(first, -1)),
                             measure_remainder(slice(first, first + 1)), measure_remainder(slice(0, -1)))


def _list_rate_shapes(xs: Floats, p12: Floats) -> list[Floats]:
    """Errors of speed that a valve or a jack can make, as functions of opening and pressure, each of order one."""
    x, p = xs / 1e-4, p12 / 1e6
    edge, narrow, pressure_sign = np.tanh(xs / 2e-5), np.tanh(xs / 5e-6), np.tanh(p / 0.3)
    return [np.ones(len(x)), x, np.abs(x), p, np.abs(p), x * p, x * np.abs(x), np.abs(x) * p, x * x * p,
            x * np.abs(p), x * p * p, edge, narrow, pressure_sign, edge * np.abs(p)]


def apply_play(x: Floats, width: float) -> Floats:
    """x behind a play of that width, m: the elementary hysteresis."""
    out, follower, half = [], float(x[0]), 0.5 * width
    for value in x.tolist():
        follower = min(max(follower, value - half), value + half)
        out.append(follower)
    return np.array(out)


def judge_jack(trace: Trace, model: Model, run: Columns, repeats: Sequence[tuple[Trace, Columns]],
               level: Mapping[str, float]) -> dict[str, float | None]:
    """The jack and the sensor of a trace and its repeats; `run` and theirs are the replays they go with.

    Ratios of flow, force and sensor to their floors, None where one cannot be told, and the gain by which the ram moves
    further than the flow says, as a fraction; nothing where too few rows hang together.

    The floor is what the balances leave of the model's own run with the noise `level` of each signal, SI: noise, and
    what the balances neglect, such as a lag of the sensor. The floor from the repeats counts where it is higher.
    """
    b = compute_balance(trace, model, run)
    free = replay_current(trace, model, anchor=0.0)  # the measured position would pull it off its own balance
    model_trace = trace.with_columns({name: free[name] for name in trace.outputs})
    model_balance = compute_balance(add_noise(model_trace, level), model, free)
    repeat_balances = [compute_balance(other, model, theirs) for other, theirs in repeats]
    floor = {"way": rms(model_balance.way), "force": rms(model_balance.force)}
    for name, f in find_floors({"way": b.way, "force": b.force},
                               [{"way": o.way, "force": o.force} for o in repeat_balances], trace.period).items():
        floor[name] = float(np.fmax(floor[name], f.value))
    columns = [trace.column(name) if name in trace.outputs else run[name] for name in (XS, P12)]
    xs, p12 = (bridge_gaps(column, BRIDGED_ROWS)[0] for column in columns)
    if (~np.isnan(b.way)).sum() < FEWEST_FORCE_ROWS or not floor["way"] > 0.0:
        return {}
    is_noisy = (XJ in level
                and floor_from_data(trace.mask_unusable(XJ)).value > NOISY_SENSOR_RATIO * level[XJ])
    flow, sensor = share_error(trace, b, xs, p12, floor["way"], is_noisy)
    flow = flow if XS in trace.outputs else max(flow, sensor)
    most_missing = 0.2  # of the rows; where more are missing, accelerations are guesses
    is_enough = (~np.isnan(b.force)).sum() >= FEWEST_FORCE_ROWS and trace.filled.mean() < most_missing
    is_judged = is_enough and floor["force"] > 0.0
    return {"flow": flow, "force": rms(b.force) / floor["force"] if is_judged else None, "sensor": sensor,
            "gain": b.gain}


def add_noise(trace: Trace, level: Mapping[str, float]) -> Trace:
    """The trace with noise of each signal's level added, always the same."""
    rng = np.random.default_rng(0)
    noisy = {name: trace.column(name) + size * rng.standard_normal(len(trace)) for name, size in level.items()}
    return trace.with_columns(noisy)


def judge_blocks(trace: Trace, model: Model, run: Columns, repeats: Sequence[tuple[Trace, Columns]],
                 signal: Mapping[str, float], noise: Mapping[str, Floor]
                 ) -> tuple[dict[str, float | None], dict[str, float | None]]:
    """Ratios of servovalve, jack and sensor, None where nothing measured can tell, and the parts of the jack's.

    `signal` holds the error over the floor of each measured output. Where the spool is as the model says, an error of
    P12 in the replay is the jack's too: it sees standstill and reversals, which the balance of forces leaves out.
    Without a measured spool the servovalve is judged with its metering edges, as current to flow, and the jack by its
    forces alone; a sensor cannot be told from a valve then.
    """
    level = {XJ: simulate_reading_noise(model, trace.controlled)} | {name: f.value for name, f in noise.items()}
    # the balances of flow and force take the measured signals as the true ones
    is_balanced = bool({P12, XS} & set(trace.outputs)) and not trace.filtered
    jack = judge_jack(trace, model, run, repeats, level) if is_balanced else {}
    parts = {name: jack.get(name) for name in ("flow", "force", "gain")}
    ratios = {"servovalve": parts["flow"], "jack": parts["force"], "sensor": None}
    if XS in trace.outputs:
        jack_ratios = [x for x in (parts["flow"], parts["force"]) if x is not None]
        if jack_ratios and P12 in signal and signal[XS] < SPOOL_FITS_RATIO:
            jack_ratios.append(signal[P12])
        ratios |= {"servovalve": signal[XS], "jack": max(jack_ratios, default=None), "sensor": jack.get("sensor")}
    return ratios, parts
