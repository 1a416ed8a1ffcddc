"""The reference model once more, written from the equations alone, to hold the plant against.

`simulate_explicit` is a plain integration with Karnopp's friction, in steps of 1 us and less; `simulate_linear` the
matrix exponential where nothing saturates. Neither shares code or scheme with plant/.
"""

from collections import namedtuple
from collections.abc import Mapping
from typing import Any

import numba
import numpy as np
from scipy.linalg import expm

CYCLE = 1e-3  # s


# the symbols of the equations, filter law and clogging worked in
Plant = namedtuple("Plant", (
    "GAP Imax GM JF BF KF XFM KSF GQF1 GPF1 PS1 ASV MS CS FSS FDS XSM GQ GP PSR AJ MJ CJ FSJ FDJ CLK XJM"))


def convert_parameters(v: Mapping[str, float]) -> Plant:
    """The symbols from "group.field" values; clogging after the law "sqrt"."""
    opening = 1 - v["filter.clogging"]
    assert v["filter.law"] == 0.5
    return Plant(
        v["controller.proportional_gain"], v["controller.current_limit"], v["torque_motor.gain"], v["flapper.inertia"],
        v["flapper.damping"], v["flapper.stiffness"], v["flapper.travel"], v["feedback_spring.stiffness"],
        v["pilot.flow_gain"] * opening**0.5, v["pilot.pressure_gain"] * opening, v["supply.pressure"] * opening,
        v["spool.end_area"], v["spool.mass"], v["spool.damping"], v["spool.static_friction"],
        v["spool.dynamic_friction"], v["spool.travel"], v["valve.flow_gain"], v["valve.pressure_gain"],
        v["supply.pressure"], v["jack.area"], v["jack.mass"], v["jack.damping"], v["jack.static_friction"],
        v["jack.dynamic_friction"], v["jack.leakage"], v["jack.travel"])


@numba.njit
def _dry(v: float, force: float, static: float, dynamic: float) -> float:
    """Net force on a body at speed v after dry friction (Karnopp with a band of zero width)."""
    if v > 0.0:
        return force - dynamic
    if v < 0.0:
        return force + dynamic
    if abs(force) <= static:
        return 0.0
    return force - dynamic if force > 0.0 else force + dynamic


@numba.njit
def _move(x: float, v: float, acceleration: float, h: float, travel: float) -> tuple[float, float]:
    new = v + h * acceleration
    if new * v < 0.0:
        new = 0.0
    x = x + h * new
    if abs(x) >= travel:
        return (travel if x > 0.0 else -travel), 0.0
    return x, new


@numba.njit
def _explicit(p: Any, com: Any, measured_current: Any, replay: bool, load: Any, substeps: int, out: Any) -> None:
    xf = vf = xs = vs = xj = vj = p12 = current = 0.0
    h = 1e-3 / substeps
    for k in range(len(com)):
        law_current = p.GAP * (com[k] - xj)
        answer = measured_current[k] if replay else min(max(law_current, -p.Imax), p.Imax)
        out[0, k], out[1, k], out[2, k], out[3, k] = xj, answer, p12, xs
        for _ in range(substeps):
            acceleration = (p.GM * current - p.KSF * xs - p.KF * xf - p.BF * vf) / p.JF
            vf = vf + h * acceleration
            xf = xf + h * vf
            if abs(xf) >= p.XFM:
                xf, vf = (p.XFM if xf > 0.0 else -p.XFM), 0.0
            p1 = p.GPF1 * xf - p.GPF1 / p.GQF1 * p.ASV * vs
            p1 = min(max(p1, -p.PS1), p.PS1)
            xs, vs = _move(xs, vs, _dry(vs, p.ASV * p1 - p.CS * vs, p.FSS, p.FDS) / p.MS, h, p.XSM)
            # P12 = GP XS - GP/GQ (AJ XJ' + CLK P12), solved for P12
            p12 = (p.GP * xs - p.GP / p.GQ * p.AJ * vj) / (1.0 + p.GP / p.GQ * p.CLK)
            p12 = min(max(p12, -p.PSR), p.PSR)
            force = _dry(vj, p.AJ * p12 - p.CJ * vj - load[k], p.FSJ, p.FDJ)
            xj, vj = _move(xj, vj, force / p.MJ, h, p.XJM)
        current = answer


def simulate_explicit(v: Mapping[str, float], com: Any, load: Any = None, measured_current: Any = None,
                      substeps: int = 1000) -> Any:
    """Rows XJ, Cor, P12, XS, shape (4, n), at 1 us (semi-implicit Euler); `measured_current` instead of the law's."""
    out = np.empty((4, len(com)))
    force = np.zeros(len(com)) if load is None else np.asarray(load, float)
    current = np.zeros(len(com)) if measured_current is None else np.asarray(measured_current, float)
    _explicit(convert_parameters(v), np.asarray(com, float), current, measured_current is not None, force, substeps,
              out)
    return out


def _p12(p: Plant, y: Any) -> float:
    line = (p.GP * y[2] - p.GP / p.GQ * p.AJ * y[5]) / (1 + p.GP / p.GQ * p.CLK)
    return float(np.clip(line, -p.PSR, p.PSR))


def _forces(p: Plant, y: Any, current: float) -> tuple[float, float, float]:
    xf, vf, xs, vs, _, vj = y
    p1 = float(np.clip(p.GPF1 * (xf - p.ASV * vs / p.GQF1), -p.PS1, p.PS1))
    return (p.GM * current - p.KSF * xs - p.KF * xf - p.BF * vf, p.ASV * p1 - p.CS * vs,
            p.AJ * _p12(p, y) - p.CJ * vj)


def simulate_linear(v: Mapping[str, float], com: Any) -> Any:
    """Rows XJ, Cor, P12, XS without friction, exact to rounding; asserts that nothing saturates."""
    p, out, y, current = convert_parameters(v), np.empty((4, len(com))), np.zeros(6), 0.0
    unit = np.eye(6)
    wide = p._replace(PS1=np.inf, PSR=np.inf)

    def rates(y: Any, current: float) -> Any:
        torque, push, pull = _forces(wide, y, current)
        return np.array([y[1], torque / p.JF, y[3], push / p.MS, y[5], pull / p.MJ])

    a = np.column_stack([rates(column, 0.0) for column in unit] + [rates(np.zeros(6), 1.0)])
    one = expm(CYCLE * np.vstack([a, np.zeros(7)]))
    for k, demand in enumerate(com):
        answer = p.GAP * (demand - y[4])
        out[:, k] = y[4], answer, _p12(wide, y), y[2]
        y = one[:6, :6] @ y + one[:6, 6] * current
        current = answer
    assert np.abs(out[1]).max() < p.Imax and np.abs(out[2]).max() < p.PSR and np.abs(out[3]).max() < p.XSM
    return out
