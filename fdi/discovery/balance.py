"""What is missing in the balance of forces, flows and torques, over time, from measured signals."""
from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.discovery.search import Hypothesis, Search
from fdi.estimation.likelihood import Problem
from fdi.trace.signals import OUTPUTS
from fdi.trace.trace import Trace

Floats = NDArray[np.float64]

SPEED_WINDOW, ACCELERATION_WINDOW = 15, 31  # samples of the smoothing polynomials; a millisecond apart at 1 kHz
EDGE = 50  # samples at both ends that smoothing knows one side of only
CREEP = 2e-4  # m/s, below which a ram counts as at rest
UNITS = {"force": "N", "flow": "m3/s", "current": "A"}


class Balance(NamedTuple):
    """What is missing at one place: `missing` (n,) in `unit`, and how it compares with sensor noise alone."""

    place: str  # "force", "flow", "current"
    unit: str
    missing: Floats
    noise: float  # RMS that sensor noise alone gives
    ratio: float  # RMS of what is missing over that
    smooth: NDArray[np.bool_]  # (n,) rows in which no signal moves faster than smoothing can follow

    @property
    def size(self) -> float:
        """RMS of what is missing, the noise taken out."""
        return float(np.sqrt(max(float(np.nanmean(self.missing**2)) - self.noise**2, 0.0)))


class States(NamedTuple):
    """The signals a law may depend on, (n,) each, SI units."""

    position: Floats
    speed: Floats
    pressure: Floats
    spool: Floats
    current: Floats
    time: Floats
    spool_speed: Floats
    command: Floats
    direction: Floats  # of the ram: -1, 0 or 1, smooth across a stop
    way: Floats  # m that the ram has gone since its last reversal
    acceleration: Floats


def compute_balances(search: Search, h: Hypothesis, unseen: Problem | None = None,
                     floor: Mapping[str, float] | None = None) -> tuple[list[Balance], States]:
    """The balances of ram, valve and torque motor under a hypothesis, the most unbalanced first.

    Each is taken on the measurement and on the model's own replay, smoothed alike; the difference is what is missing.
    Signals that were not measured are the replay's: then a place behind them cannot show anything.
    `unseen`: the problem of another run, a held-out one; default: that of the search. `floor`: noise of each signal,
    SI; default: what the hypothesis leaves.
    """
    problem = unseen or search.problem
    trace = problem.trace
    names = [f.name for f in h.fit.free]
    values = {**problem.model.values, **h.fit.values}
    replay = problem.predict_signals(names, np.array([[h.fit.values[n] for n in names]]))[0]
    measured = replay.copy()
    for row, signal in enumerate(trace.outputs):
        there = ~np.isnan(trace.measurements[row])
        measured[OUTPUTS.index(signal), there] = trace.measurements[row, there]
    before = np.concatenate([[0.0], trace.cor[:-1]])
    period = problem.model.values["controller.period"]
    own = _compute_terms(replay, before, trace.load, values, period)
    seen = _compute_terms(measured, before, trace.load, values, period)
    known = search.estimate_floor(h) if floor is None else floor
    level = [known.get(s, 0.0) for s in OUTPUTS]
    rng = np.random.default_rng(0)
    draws = 4  # simulated runs without anything missing
    kept = find_smooth_rows(trace)
    noisy = [_compute_terms(replay + rng.standard_normal(replay.shape) * np.array(level)[:, None], before, trace.load,
                            values, period) for _ in range(draws)]
    smooth = np.logical_and.reduce([find_followed_rows(x, noise) for x, noise in zip(measured, level, strict=True)])
    found = []
    for place, unit in ((place, unit) for place, unit in UNITS.items() if place in own):
        missing = (seen[place] - own[place])[kept]
        noise = float(np.sqrt(np.mean([_mean_square((n[place] - own[place])[kept]) for n in noisy])))
        rms = float(np.sqrt(_mean_square(missing)))
        found.append(Balance(place, unit, missing, noise, rms / noise if noise else 0.0, smooth[kept]))
    position = replay[0] if np.isnan(measured[0]).all() else _smooth(measured[0], SPEED_WINDOW)
    speed = _measure_speed(measured[0], period)
    states = (position, speed, measured[1], measured[2], before, trace.t, _measure_speed(measured[2], period),
              trace.com, np.clip(speed / CREEP, -1.0, 1.0), measure_way(position, speed),
              _smooth(measured[0], ACCELERATION_WINDOW, deriv=2, delta=period))
    return sorted(found, key=lambda b: -b.ratio), States(*(x[kept] for x in states))


def find_followed_rows(x: Floats, noise: float, share: float = 0.03) -> NDArray[np.bool_]:
    """Rows of a signal (n,) that the smoothing polynomials follow: to its noise, or to a share of its local swing."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d  # here, as it takes a second to import

    window = ACCELERATION_WINDOW
    swing = maximum_filter1d(x, 3 * window) - minimum_filter1d(x, 3 * window)
    off = np.abs(x - _smooth(x, window)) > 6.0 * noise + share * swing
    followed: NDArray[np.bool_] = ~(maximum_filter1d(off.astype(np.int8), window).astype(bool))
    return followed


def measure_way(position: Floats, speed: Floats, least: float = 3e-4) -> Floats:
    """The distance since the last reversal, (n,) m; below the `least` speed, m/s, a ram keeps its direction."""
    moving = np.where(np.abs(speed) > least, np.sign(speed), 0.0)
    last = np.maximum.accumulate(np.where(moving != 0.0, np.arange(len(speed)), 0))
    side = moving[last]
    begin = np.maximum.accumulate(np.where(np.diff(side, prepend=side[:1]) != 0.0, np.arange(len(speed)), 0))
    path = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(position)))])
    way: Floats = path - path[begin]
    return way


def find_smooth_rows(trace: Trace) -> NDArray[np.bool_]:
    """All rows; of an excerpt those that smoothing does not carry across a joint, and that are compared at all."""
    if not trace.parts:
        return np.ones(len(trace), bool)
    kept = trace.usable.copy()
    for part in trace.parts:
        kept[part.first:part.first + EDGE] = False
        kept[part.stop - EDGE:part.stop] = False
    return kept


def _mean_square(x: Floats) -> float:
    """Mean square of what counts: neither the ends nor the few samples in which something stops or breaks away."""
    inner = x[EDGE:-EDGE] ** 2
    return float(np.nanmean(np.minimum(inner, np.nanpercentile(inner, 99.5))))


def _measure_speed(x: Floats, period: float) -> Floats:
    return _smooth(x, SPEED_WINDOW, deriv=1, delta=period)


def _smooth(x: Floats, window: int, **derivative: float) -> Floats:
    """Cubics through the samples of a window, or their derivative (Savitzky and Golay)."""
    from scipy.signal import savgol_filter  # here, as it takes a second to import

    smooth: Floats = savgol_filter(x, window, 3, **derivative)
    return smooth


def _compute_terms(signals: Floats, current: Floats, load: Floats, p: Mapping[str, float], period: float
                   ) -> dict[str, Floats]:
    """Left side minus right side of the equations of motion (of the reference model, or of a pump), from (3, n)."""
    x, p12, xs = signals
    v = _measure_speed(x, period)
    a = _smooth(x, ACCELERATION_WINDOW, deriv=2, delta=period)
    smooth = _smooth(p12, ACCELERATION_WINDOW)
    sliding = np.clip(v / CREEP, -1.0, 1.0) * p["jack.dynamic_friction"]
    force = p["jack.area"] * smooth - p["jack.damping"] * v - load - sliding - p["jack.mass"] * a
    if "pump.displacement" in p:
        return {"force": force, "flow": _compute_pump_flow(current, v, _smooth(p12, SPEED_WINDOW), p)}
    spool = _smooth(xs, SPEED_WINDOW)
    conductance = p["valve.flow_gain"] / p["valve.pressure_gain"] + p["jack.leakage"]
    flow = p["valve.flow_gain"] * spool - conductance * _smooth(p12, SPEED_WINDOW) - p["jack.area"] * v
    flapper = p["spool.end_area"] * _measure_speed(xs, period) / p["pilot.flow_gain"]
    torque = p["flapper.stiffness"] * flapper + p["feedback_spring.stiffness"] * spool
    return {"force": force, "flow": flow, "current": current - torque / p["torque_motor.gain"]}


def _compute_pump_flow(speed: Floats, v: Floats, p12: Floats, p: Mapping[str, float]) -> Floats:
    """Flow that a pump at motor `speed` (n,) delivers and the jack does not take, m3/s."""
    area = p["jack.area"] * np.where(speed < 0.0, p["pump.area_ratio"], 1.0)
    left: Floats = p["pump.displacement"] * speed - area * v - p["jack.leakage"] * p12
    return left
