"""First values of an actuator's parameters by plain regressions on its signals, before any replay.

A replay of a model that is twice off misses every stop of the ram, and a fit from there goes astray. Each block of the
actuator alone is linear: spool over current, speed of the ram over spool and pressure, pressure over acceleration,
speed, friction and load. What the regressions give is within some ten per cent; fits go on from there.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from fdi.estimation.replay import differentiate
from fdi.trace.trace import Trace
from plant.model import Model

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

SMOOTHED = 25  # rows of the parabola that gives speed and acceleration
MOVING = 1e-3  # m/s, above which the ram's friction is the dynamic one
STALLED_ROWS = 20  # at a limit, in a row or not, that show it


def estimate_by_regressions(runs: Sequence[Trace], model: Model, known: frozenset[str] = frozenset()
                            ) -> dict[str, float]:
    """Parameters that the runs show without a replay, SI; those that need a signal nobody measured are left out.

    Args:
        runs: prepared for replay; of one actuator.
        model: with the values of the data sheet, for what the regressions cannot tell.
        known: parameters that are not free, so that others make up for them.
    """
    found: dict[str, float] = {}
    stroke = _estimate_stroke(runs)
    if stroke > 0.98 * model["jack.travel"] or _dwells(np.concatenate([t.xj for t in runs]), stroke):
        found["jack.travel"] = stroke
    if all("p12" in t.outputs for t in runs):
        pressure = np.concatenate([t.mask_unusable("p12") for t in runs])
        highest = _find_limit(pressure)
        if highest > model["supply.pressure"] or _dwells(pressure, highest):
            found["supply.pressure"] = highest
    if all("xs" in t.outputs for t in runs):
        found |= _estimate_spool(runs, model)
    p = {**model.values, **found}
    if all({"xs", "p12"} <= set(t.outputs) for t in runs):
        found |= _estimate_jack(runs, p, "jack.area" not in known)
    elif all("xs" in t.outputs for t in runs):
        gain = _regress([_smooth_speed(t) for t in runs], [[t.mask_unusable("xs")] for t in runs])
        if gain is not None and gain[0] > 0.0:
            found["valve.flow_gain"] = gain[0] * p["jack.area"]
    else:
        gain = _regress([_smooth_speed(t) for t in runs], [[_delay(t.cor, 4)] for t in runs], largest=0.5)
        if gain is not None and gain[0] > 0.0:
            opening = p["torque_motor.gain"] / p["feedback_spring.stiffness"]
            found["valve.flow_gain"] = gain[0] * p["jack.area"] / opening
    return {name: value for name, value in found.items() if np.isfinite(value) and value > 0.0}


def _estimate_spool(runs: Sequence[Trace], model: Model) -> dict[str, float]:
    """Stiffness of the feedback spring, pilot flow gain, and both travels, from current and spool.

    XS settles at GM I/KSF; with the flapper at its stop its speed is GQF XFM/ASV.
    """
    found: dict[str, float] = {}
    size = 61
    every = np.concatenate([t.mask_unusable("xs") for t in runs])
    free = 0.6 * _find_limit(every)
    level = [_average(t.mask_unusable("xs"), size) for t in runs]
    level = [np.where(_average((np.abs(t.xs) > free).astype(float), size) > 0.0, np.nan, x)
             for t, x in zip(runs, level, strict=True)]
    drive = [_average(t.cor, size) for t in runs]
    gain = _regress(level, [[d] for d in drive])
    if gain is None or gain[0] <= 0.0:
        return found
    ratio = model["feedback_spring.stiffness"] / model["torque_motor.gain"] * gain[0]  # KSF/GM of the model over own
    found["feedback_spring.stiffness"] = model["feedback_spring.stiffness"] / np.sqrt(ratio)
    found["torque_motor.gain"] = model["torque_motor.gain"] * np.sqrt(ratio)
    largest = max(float(np.nanmax(np.abs(t.mask_unusable("xs")))) for t in runs)
    if largest > 0.98 * model["spool.travel"] or _dwells(every, _find_limit(every)):
        found["spool.travel"] = _find_limit(every)
    speeds = [np.abs(differentiate(_fill(t.mask_unusable("xs")), 5, 1)) / t.period for t in runs]
    highest = _find_limit(np.concatenate(speeds))
    found["pilot.flow_gain"] = highest * model["spool.end_area"] / model["flapper.travel"]
    return found


def _estimate_jack(runs: Sequence[Trace], p: Mapping[str, float], is_area_free: bool) -> dict[str, float]:
    """Flow gain, leakage, area, mass, damping and friction from spool, pressure, position and load."""
    found: dict[str, float] = {}
    speed = [_smooth_speed(t) for t in runs]
    acceleration = [differentiate(_fill(t.mask_unusable("xj")), SMOOTHED, 2) / t.period**2 for t in runs]
    spool = [_average(t.mask_unusable("xs"), 9) for t in runs]
    pressure = [_average(t.mask_unusable("p12"), 9) for t in runs]
    away = [np.where((np.abs(t.xj) < 0.97 * p["jack.travel"]) & (np.abs(q) < 0.8 * p["supply.pressure"]), 1.0, np.nan)
            for t, q in zip(runs, pressure, strict=True)]
    flow = _regress([v * w for v, w in zip(speed, away, strict=True)],
                    [[x, -q] for x, q in zip(spool, pressure, strict=True)])
    moving = [np.where((np.abs(v) > MOVING) & (np.abs(a) < 20.0), w, np.nan)
              for v, a, w in zip(speed, acceleration, away, strict=True)]
    load = [t.load for t in runs]
    is_loaded = float(np.ptp(np.concatenate(load))) > 0.0
    columns = [[a, v, np.sign(v), *([f] if is_loaded else [])]
               for a, v, f in zip(acceleration, speed, load, strict=True)]
    force = _regress([q * w for q, w in zip(pressure, moving, strict=True)], columns)
    area = p["jack.area"]
    if force is not None:
        if is_loaded and is_area_free and force[3] > 0.0:
            found["jack.area"] = area = 1.0 / force[3]
        names = ("jack.mass", "jack.damping", "jack.dynamic_friction")
        found |= {name: area * x for name, x in zip(names, force[:3], strict=True) if x > 0.0}
        if "jack.dynamic_friction" in found:
            ratio = p["jack.static_friction"] / p["jack.dynamic_friction"]
            found["jack.static_friction"] = ratio * found["jack.dynamic_friction"]
    if flow is not None and flow[0] > 0.0:
        found["valve.flow_gain"] = flow[0] * area
        leakage = flow[1] * area - found["valve.flow_gain"] / p["valve.pressure_gain"]
        if leakage > 0.0:
            found["jack.leakage"] = leakage
    return found


def _estimate_stroke(runs: Sequence[Trace]) -> float:
    """Half the stroke, m, as far as the ram went: the level at which it stayed, not a single noisy sample."""
    return _find_limit(np.concatenate([t.xj for t in runs]))


def _find_limit(x: Floats) -> float:
    """The largest magnitude that some samples reach, so that noise does not set it."""
    size = np.sort(np.abs(x[~np.isnan(x)]))
    return float(np.median(size[-STALLED_ROWS:])) if len(size) else 0.0


def _dwells(x: Floats, limit: float, share: float = 2e-3, rows: int = 5 * STALLED_ROWS) -> bool:
    """Whether a signal stays at its limit."""
    return int((np.abs(x) > (1.0 - share) * limit).sum()) >= rows


def _smooth_speed(trace: Trace) -> Floats:
    speed: Floats = differentiate(_fill(trace.mask_unusable("xj")), SMOOTHED, 1) / trace.period
    return speed


def _fill(x: Floats) -> Floats:
    rows, there = np.arange(len(x)), ~np.isnan(x)
    return np.interp(rows, rows[there], x[there]) if there.any() else np.zeros(len(x))


def _average(x: Floats, size: int) -> Floats:
    mean: Floats = np.convolve(np.pad(_fill(x), size // 2, "edge"), np.full(size, 1.0 / size), "valid")
    return mean


def _delay(x: Floats, rows: int) -> Floats:
    return np.concatenate([np.full(rows, x[0]), x[:-rows]])


def _regress(y: Sequence[Floats], columns: Sequence[Sequence[Floats]], largest: float = 1.0, rounds: int = 6
             ) -> Floats | None:
    """Coefficients of y (n,) on columns, all runs together, by least squares in which outliers count little.

    Rows whose first column is beyond `largest` times its maximum are left out, as all that saturates there. None if the
    rows do not tell the columns apart.
    """
    target = np.concatenate(y)
    table = np.column_stack([np.concatenate(c) for c in zip(*columns, strict=True)])
    there = np.isfinite(target) & np.isfinite(table).all(axis=1)
    if largest < 1.0 and there.any():
        there &= np.abs(table[:, 0]) < largest * np.abs(table[there, 0]).max()
    target, table = target[there], table[there]
    scale = np.sqrt((table**2).mean(axis=0)) if len(table) > 100 else np.zeros(table.shape[1])
    if not (scale > 0.0).all():
        return None
    weight = np.ones(len(target))
    found = np.zeros(table.shape[1])
    for _ in range(rounds):
        rows = (table / scale) * weight[:, None]
        found, _, rank, _ = np.linalg.lstsq(rows, target * weight, rcond=1e-6)
        if rank < len(scale):
            return None
        left = np.abs(target - (table / scale) @ found)
        usual = 1.5 * float(np.median(left)) + 1e-300
        weight = np.sqrt(np.minimum(1.0, usual / np.maximum(left, 1e-300)))
    coefficients: Floats = found / scale
    return coefficients
