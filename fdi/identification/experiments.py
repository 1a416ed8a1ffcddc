"""Which run would show the parameters that the present runs do not: candidate runs simulated with the fitted model.

For each candidate the slopes of its signals by all unknowns say how narrow the intervals would be with it beside the
present runs. The sensors are those of the present runs; one candidate repeats these runs with all sensors.
"""
from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.estimation import noise as noises
from fdi.estimation.fit import Fit
from fdi.estimation.likelihood import Free, scaled_bounds
from fdi.estimation.replay import hold_inputs
from fdi.estimation.unidentifiable import LogFree, LogFrictionRatio, LogProblem, remove_slope
from fdi.estimation.unknowns import silence_readings
from fdi.identification.free_parameters import get_systematic_sd
from fdi.identification.global_fit import find_flat, scale_values
from fdi.thresholds import IDENTIFIABLE_SHARE, IDENTIFIED_INTERVAL_FACTOR, INTERVAL_95_SD
from fdi.trace.signals import OUTPUTS, SIGNALS
from fdi.trace.trace import Trace
from plant.lanes import Lanes
from plant.model import Model

Floats = NDArray[np.float64]

DIFFERENCE = 0.01  # of a logarithm, or of half a range, for slopes
STEPS = 20  # solver steps a cycle


class Experiment(NamedTuple):
    """A run that could be made: its name, what to do, its command, (n,) m, by the model, and whether under a load."""

    name: str
    what: str
    build: Callable[[Model], Floats]
    is_loaded: bool = False


class Advice(NamedTuple):
    """How to learn a parameter: the run that narrows its interval most, None where no candidate would do."""

    parameter: str
    experiment: str | None
    what: str
    share: float  # of half the range that the interval would take up with that run beside the present ones


def _move(model: Model, levels: Sequence[tuple[float, float]], scale: float, speed: float = math.inf) -> Floats:
    """A command that goes to each of some (level, seconds), times `scale` m, at `speed` m/s, and holds it."""
    period, at, parts = model["controller.period"], 0.0, []
    for level, seconds in levels:
        to = level * scale
        if to != at and speed < math.inf:
            parts.append(np.linspace(at, to, max(2, round(abs(to - at) / speed / period)), endpoint=False))
        parts.append(np.full(max(1, round(seconds / period)), to))
        at = to
    return np.concatenate(parts)


def _build_steps(model: Model) -> Floats:
    levels = (0.0, 0.1, 0.0, 0.6, -0.6, 0.0, -0.1, 0.0)
    return _move(model, [(level, 0.8 if abs(level) < 0.5 else 1.5) for level in levels], model["jack.travel"])


def _build_ramps(model: Model) -> Floats:
    x = 0.03 * model["jack.travel"]
    return _move(model, ((0.0, 0.3), (1.0, 0.5), (-1.0, 0.5), (0.0, 0.3)), x, x / 2.0)


def _build_sweep(model: Model) -> Floats:
    t = np.arange(0.0, 5.0, model["controller.period"])
    com = 0.03 * model["jack.travel"] * np.sin(2.0 * np.pi * (0.5 * t + 1.9 * t**2))  # 0.5 to 19.5 Hz
    return np.concatenate([_move(model, ((0.0, 0.3),), 0.0), com])


def _build_stops(model: Model) -> Floats:
    speed = 0.2 * model["valve.flow_gain"] * model["spool.travel"] / model["jack.area"]  # with the spool a fifth open
    return _move(model, ((0.0, 0.3), (1.0, 0.8), (-1.0, 0.8), (0.0, 0.3)), 1.1 * model["jack.travel"], speed)


EXPERIMENTS = (
    Experiment("steps", "steps of a tenth and of six tenths of the stroke", _build_steps),
    Experiment("ramps", "ramps as slow as 1.5 % of the stroke a second", _build_ramps),
    Experiment("sweep", "a sine sweep from 0.5 to 20 Hz of 3 % of the stroke", _build_sweep),
    Experiment("stops", "a command 10 % beyond both end stops, held there for 0.8 s", _build_stops),
    Experiment("load", "steps under a known force, a third of the largest, pushing and pulling (column load)",
               _build_steps, is_loaded=True),
)


def advise_experiments(model: Model, free: Sequence[Free], problem: LogProblem, fit: Fit | None, unseen: Sequence[str]
                       ) -> list[Advice]:
    """For each parameter that is not identifiable the candidate run that would show it best.

    Args:
        model: the fitted one.
        free: all unknowns, those that the present runs do not show as well.
        problem: the present runs.
        fit: what they gave; None where they gave nothing.
        unseen: the parameters to learn.
    """
    x = scale_values(free, model.values)
    present = replace(problem, model=silence_readings(model), steps=STEPS, bare=None, _lanes={})
    known = np.diag([f.prior**-2 for f in free])
    if fit is not None:
        known = known + _measure_information(present, free, x)
    found = {}
    for experiment in EXPERIMENTS:
        com = experiment.build(model)
        part = np.arange(len(com)) / len(com)
        force = 0.3 * model["jack.area"] * model["supply.pressure"] * experiment.is_loaded
        load = force * (((part > 0.2) & (part < 0.45)).astype(float) - ((part >= 0.45) & (part < 0.7)))
        trace = _simulate(model, com, load, problem.trace.outputs)
        run = replace(present, trace=trace, also=(), _lanes={})
        found[experiment.name] = known + _measure_information(run, free, x)
    what = {e.name: e.what for e in EXPERIMENTS}
    missing = [s for s in OUTPUTS if s not in problem.trace.outputs]
    if missing and fit is not None:
        runs = [_simulate(model, t.com, t.load, OUTPUTS) for t in (problem.trace, *problem.also)]
        noise = tuple(noises.white_noise(model[SIGNALS[s].noise]) for s in OUTPUTS)
        sensed = replace(present, trace=runs[0], also=tuple(runs[1:]), noise=noise, _lanes={})
        found["sensors"] = np.diag([f.prior**-2 for f in free]) + _measure_information(sensed, free, x)
        what["sensors"] = f"the same runs with {' and '.join(SIGNALS[s].symbol for s in missing)} measured"
    shares = {name: _compute_shares(free, information) for name, information in found.items()}
    advice = []
    for name in unseen:
        share, best = min((shares[experiment][name], experiment) for experiment in shares)
        is_enough = share <= IDENTIFIABLE_SHARE
        advice.append(Advice(name, best if is_enough else None, what[best] if is_enough else "", share))
    return advice


def _simulate(model: Model, com: Floats, load: Floats, outputs: Sequence[str]) -> Trace:
    """The closed loop on a command, as a recording without noise."""
    out = Lanes(silence_readings(model), (), STEPS).closed_loop(np.empty((1, 0)), com, load)[0]
    columns = {"com": com, "xj": out[:, 0], "cor": out[:, 1], "p12": out[:, 2], "xs": out[:, 3], "load": load}
    return hold_inputs(Trace.from_columns(columns, model["controller.period"], {}), tuple(outputs))


def _measure_information(problem: LogProblem, free: Sequence[Free], x: Floats) -> Floats:
    """What runs tell of scaled unknowns at `x` (p,): the matrix (p, p) of their slopes' products."""
    low, high = scaled_bounds(free)
    steps = np.array([DIFFERENCE / f.scale if isinstance(f, LogFree) else DIFFERENCE for f in free])
    steps = np.where(x + steps > high, -steps, steps)
    white = problem.compute_white_residuals(free, np.vstack([x, np.clip(x + np.diag(steps), low, high)]))
    jacobian = remove_slope((white[1:] - white[0]) / steps[:, None, None], find_flat(problem, free, x))
    rows = jacobian.reshape(len(free), -1)
    information: Floats = rows @ rows.T
    return information


def _compute_shares(free: Sequence[Free], information: Floats) -> dict[str, float]:
    """Of half its range, the half width of each parameter's interval."""
    covariance = np.linalg.pinv(information)
    names = [f.name for f in free]
    shares = {}
    for k, f in enumerate(free):
        slope = np.zeros(len(free))
        slope[k] = f.scale
        if isinstance(f, LogFrictionRatio):
            dynamic = names.index(f.dynamic_name)
            slope[dynamic] = free[dynamic].scale
        spread = IDENTIFIED_INTERVAL_FACTOR * float(np.sqrt(slope @ covariance @ slope))
        shares[f.name] = INTERVAL_95_SD * float(np.hypot(spread, get_systematic_sd(f.name))) / (f.scale * f.prior)
    return shares
