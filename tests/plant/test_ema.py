"""The physics of the electromechanical actuator against closed forms, an independent solver and its own energy."""

from collections import namedtuple
from functools import cache
from math import pi
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from plant import compile_function, ema
from plant.ema import compute_coefficients, step

Array = NDArray[np.float64]
GROUPS = ema.PLANT.parameters
Input = namedtuple("Input", "drive load noise t phase h")
make_record: Any = namedtuple  # its fields are known at run time
Parameters = make_record("Parameters", tuple(GROUPS))
USUAL = Parameters(*(cls() for cls in GROUPS.values()))
RADIUS = USUAL.screw.lead / (2.0 * pi * USUAL.screw.ratio)  # m a radian of the motor
MOTOR = USUAL.motor.inertia / RADIUS**2  # kg, as the nut feels it
MASS, STIFF = USUAL.surface.mass, 1.0 / USUAL.screw.compliance
NO_FRICTION = {"surface.damping": 0.0, "surface.friction": 0.0,
               "motor.damping": 0.0, "screw.relaxation": 0.0}
NO_DRY = {"surface.friction": 0.0}


def change_parameters(**changes: float) -> Any:
    p = USUAL
    for name, value in changes.items():
        group, _, field = name.partition(".")
        p = p._replace(**{group: getattr(p, group)._replace(**{field: value})})
    return p


def fill_states(s: Any, drive: Any, load: Any, p: Any, h: float, out: Any) -> None:
    """out[i] = current, motor position and speed, position and speed of the surface before step i."""
    k, m = compute_coefficients(p, h), 0.0
    for i in range(len(drive)):
        out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4] = (
            s.current, s.motor_position, s.motor_speed, s.position, s.speed)
        s, m = step(s, m, Input(drive[i], load[i], 0.0, i * h, 0.0, h), p, k)


@cache
def compile_run() -> Any:
    return compile_function(fill_states, {})


def run(p: Any, drive: Array, h: float = 1e-5, s: ema.State | None = None, load: float = 0.0) -> Array:
    out = np.empty((len(drive), 5))
    compile_run()(s or ema.State(), np.asarray(drive, float), np.full(len(drive), load), p, h, out)
    return out


def hold(value: float, time: float, h: float = 1e-5) -> Array:
    return np.full(round(time / h), value)


def test_the_current_follows_as_a_first_order_lag_and_the_voltage_limits_it() -> None:
    i = run(USUAL, hold(1.0, 3e-3))[:, 0]
    assert np.abs(i - (1.0 - np.exp(-USUAL.drive.bandwidth * 1e-5 * np.arange(len(i))))).max() < 1e-4
    i = run(change_parameters(**{"drive.voltage": 5.0}), hold(20.0, 0.02))[:, 0]
    rise = 5.0 / USUAL.motor.resistance * (1.0 - np.exp(-5e-4 * USUAL.motor.resistance / USUAL.motor.inductance))
    assert i[50] == pytest.approx(rise, rel=1e-2)  # the motor has hardly moved
    assert i.max() < 5.0 / USUAL.motor.resistance


def test_two_masses_on_the_screw_swing_at_their_frequency_and_keep_their_energy() -> None:
    s = run(change_parameters(**NO_FRICTION), hold(0.0, 1.0), s=ema.State(motor_position=1e-4))
    stretch = s[:, 1] - s[:, 3]
    up = np.flatnonzero((stretch[:-1] < 0.0) & (stretch[1:] >= 0.0))
    times = up + stretch[up] / (stretch[up] - stretch[up + 1])
    frequency = 2.0 * pi / (np.diff(times).mean() * 1e-5)
    assert frequency == pytest.approx(np.sqrt(STIFF * (1.0 / MOTOR + 1.0 / MASS)), rel=2e-5)
    energy = 0.5 * (MOTOR * s[:, 2]**2 + MASS * s[:, 4]**2 + STIFF * stretch**2)
    assert np.abs(energy / energy[0] - 1.0).max() < 1e-4


def test_a_rigid_screw_moves_both_masses_as_one() -> None:
    s = run(change_parameters(**NO_FRICTION, **{"screw.compliance": 0.0}), hold(10.0, 0.01))
    gained = (s[-1, 4] - s[500, 4]) / (1e-5 * (len(s) - 501))
    assert gained == pytest.approx(10.0 * USUAL.motor.torque_constant / RADIUS / (MOTOR + MASS), rel=1e-9)
    assert np.abs(s[:, 1] - s[:, 3]).max() < 1e-12


def test_stiction_breaks_at_its_level_and_sliding_needs_the_dynamic_one() -> None:
    thrust = USUAL.motor.torque_constant / RADIUS
    rising = np.linspace(0.0, 0.3, 400_000)
    p = change_parameters(**{"motor.damping": 0.0, "surface.travel": 10.0})
    moving = int(np.argmax(run(p, rising)[:, 4] != 0.0))
    assert rising[moving] * thrust == pytest.approx(p.surface.friction * (1.0 + p.surface.stiction), rel=1e-3)
    v = run(p, hold(1.0, 20.0, 1e-4), 1e-4)[-1, 4]  # (Kt i/r - FD)/C, from m v' = 0
    assert v == pytest.approx((thrust - p.surface.friction) / p.surface.damping, rel=1e-3)


@pytest.mark.parametrize("width", [5e-5, 2e-4])
def test_the_surface_waits_for_the_motor_by_the_backlash_and_the_wind_up_of_friction(width: float) -> None:
    p = change_parameters(**{"screw.backlash": width, "surface.stiction": 0.0})
    s = run(p, np.sin(2.0 * pi * 0.25 * 2e-5 * np.arange(200_000)), 2e-5)
    lost_motion, slides = np.abs(s[:, 1] - s[:, 3]), s[:, 4] != 0.0
    force = 100.0 + p.surface.damping * np.median(np.abs(s[slides, 4]))
    assert np.median(lost_motion[slides]) == pytest.approx(0.5 * width + force / STIFF, rel=0.02)  # apart from impacts


def test_the_smooth_model_agrees_with_an_independent_solver() -> None:
    p = change_parameters(**NO_DRY)

    def rate(t: float, y: Array) -> list[float]:
        i, integral, z, w, x, v = y
        error = 8.0 * np.sin(2.0 * pi * 5.0 * t) - i
        volt = p.motor.inductance * p.drive.bandwidth * error + integral
        force = STIFF * (z - x + p.screw.relaxation * (w - v))
        torque = p.motor.torque_constant * i / RADIUS
        return [(volt - p.motor.resistance * i) / p.motor.inductance, p.motor.resistance * p.drive.bandwidth * error, w,
                (torque - p.motor.damping / RADIUS**2 * w - force) / MOTOR, v, (force - p.surface.damping * v) / MASS]

    at = np.arange(0.0, 0.4, 1e-3)
    truth = solve_ivp(rate, (0.0, 0.4), np.zeros(6), method="LSODA", rtol=1e-11, atol=1e-14, t_eval=at).y[4]
    t = 1e-5 * (np.arange(40_000) + 0.5)
    x = run(p, 8.0 * np.sin(2.0 * pi * 5.0 * t))[::100, 3]
    assert np.abs(x - truth).max() < 2e-7 < 1e-5 * np.abs(truth).max()


def test_the_surface_stops_at_the_end_of_its_travel() -> None:
    s = run(USUAL, hold(10.0, 3.0, 1e-4), 1e-4)
    assert np.abs(s[:, 3]).max() <= USUAL.surface.travel
    assert s[-1, 4] == 0.0 and np.isfinite(s).all()
