"""What each effect of ram, transducer and firmware does, against a closed form; and that friction only takes energy."""
from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from effects_cases import EASY, QUIET_SPOOL, WHOLE, H, drive_plant, measure_spool
from hypothesis import given, settings
from hypothesis import strategies as st
from node_bench import FirmwareDesk

from plant import Actuator, Model, simulate
from plant.compile import interpret_function
from plant.controller import compute_answers
from plant.effects import CATALOGUE
from plant.effects.sensors import Lag, Recoil, mount_compliance, sensor_lag
from plant.model import build_initial_state, collect_bindings
from plant.state import Input, State
from plant.step import compute_coefficients, step_plant
from rig.network.codec import Control

COMMAND = np.r_[np.zeros(10), np.full(150, 2e-3), 2e-3 + 1e-3 * np.sin(np.arange(250) * 0.02)]
STEADY = np.full(80, 1e-3)  # A
AREA = WHOLE["jack.area"]
LEAKY = {"jack.leakage": 3e-11}


def list_steady_cases() -> Iterator[Any]:
    """Model, current, load and force of dry friction at the speed v of the ram, N."""
    yield pytest.param(EASY.replace({"jack.damping": 20e3}), STEADY, 0.0, lambda v: 0.0, id="viscous drag")
    yield pytest.param(EASY.replace(LEAKY), np.zeros(60), 6e3, lambda v: 0.0, id="leakage")
    dry = {"jack.static_friction": 1600.0, "jack.dynamic_friction": 1000.0}
    for sign in (1.0, -1.0):
        yield pytest.param(QUIET_SPOOL.replace(dry), sign * STEADY, 0.0, lambda v: np.sign(v) * 1000.0,
                           id=f"jack friction {sign:+g}")
        yield pytest.param(QUIET_SPOOL.replace({"friction_asymmetry.asymmetry": 0.3}), sign * STEADY, 0.0,
                           lambda v: np.sign(v) * 500.0 + 0.3 * 500.0, id=f"friction asymmetry {sign:+g}")
    for speed in (0.002, 0.01, 0.05):
        model = QUIET_SPOOL.replace({"stribeck.rise": 0.5, "stribeck.speed": 0.01})
        current = speed * AREA / model["valve.flow_gain"] / measure_spool(model, 1.0)
        yield pytest.param(model, np.full(400, current), 0.0,
                           lambda v: 500.0 + 0.5 * 800.0 * np.exp(-(v / 0.01) ** 2), id=f"stribeck {speed:g}")
    for deflection in (5e-6, 2e-5, 1e-4):
        yield pytest.param(QUIET_SPOOL.replace({"presliding.deflection": deflection}), STEADY, 0.0, lambda v: 500.0,
                           id=f"presliding {deflection:g}")


@pytest.mark.parametrize(("model", "current", "load", "dry"), list(list_steady_cases()))
def test_pressure_at_constant_speed_is_friction_drag_and_load(model: Model, current: np.ndarray, load: float,
                                                             dry: Callable[[float], float]) -> None:
    _, p12, _, _, v = drive_plant(model, current, load)[1][:, -1]
    assert AREA * p12 == pytest.approx(dry(v) + model["jack.damping"] * v + load, rel=2e-3)
    assert abs(v) > 1e-6


def test_leakage_shows_as_speed_in_proportion_to_pressure() -> None:
    """Valve closed, a load on the ram: GQ XS = 0 = QJ + GQ/GP P12, QJ = AJ XJ' + CLK P12."""
    model = EASY.replace(LEAKY)
    _, p12, _, _, v = drive_plant(model, np.zeros(60), 6e3)[1][:, -1]
    conductance = LEAKY["jack.leakage"] + model["valve.flow_gain"] / model["valve.pressure_gain"]
    assert AREA * v == pytest.approx(-conductance * p12, rel=1e-4)


def test_moving_mass_is_pressure_in_proportion_to_acceleration() -> None:
    model = EASY.replace({"jack.mass": 200.0, "jack.damping": 0.0})
    _, p12, _, _, v = drive_plant(model, 2e-3 * np.sin(2 * np.pi * 20 * np.arange(200) * 1e-3))[1]
    inner = slice(60, -1)
    acceleration = np.gradient(v, 1e-3)[inner]
    np.testing.assert_allclose(AREA * p12[inner], 200.0 * acceleration, atol=0.01 * 200 * abs(acceleration).max())


def test_a_ram_with_asymmetric_friction_at_rest_holds_more_one_way() -> None:
    """Loads up to FS (1 - d) against extension and FS (1 + d) with it move nothing, more does."""
    model = WHOLE.replace({"friction_asymmetry.asymmetry": 0.3})
    for load, moves in ((559.0, False), (561.0, True), (-1039.0, False), (-1041.0, True)):
        assert (drive_plant(model, np.zeros(30), load)[0].state.jack_position != 0.0) == moves, load


@pytest.mark.parametrize("deflection", [5e-6, 2e-5, 1e-4])
def test_presliding_is_a_spring_for_small_loads(deflection: float) -> None:
    plant = drive_plant(QUIET_SPOOL.replace({"presliding.deflection": deflection}), np.zeros(3000), 50.0)[0]
    slipped = -np.log(1.0 - 50.0 / 500.0) * 500.0  # N: the bristles' spring, softening towards the dynamic level
    assert plant.state.jack_position == pytest.approx(-slipped * deflection / 800.0, rel=1e-3)


def test_mount_compliance_shows_the_force_as_position() -> None:
    model = EASY.replace({"mount_compliance.compliance": 5e-8})
    sensed, p12, _, x, _ = drive_plant(model, 3e-3 * np.sin(np.arange(100) * 0.3), 4e3)[1]
    np.testing.assert_allclose(sensed - x, 5e-8 * AREA * p12, rtol=1e-9, atol=1e-18)
    assert abs(sensed - x).max() > 1e-4


def test_backlash_loses_its_width_at_every_reversal() -> None:
    model = EASY.replace({"rod_backlash.width": 1e-4})
    sensed, _, _, x, _ = drive_plant(model, 3e-3 * np.sin(2 * np.pi * 4 * np.arange(500) * 1e-3))[1]
    assert np.ptp(x[250:]) - np.ptp(sensed[250:]) == pytest.approx(1e-4, rel=5e-3)  # peaks lie between samples
    assert (sensed - x).min() == pytest.approx(-0.5e-4) and (sensed - x).max() == pytest.approx(0.5e-4)
    standing = np.flatnonzero(np.diff(sensed[130:]) == 0.0) + 130
    assert np.ptp(x[standing[:5]]) < 1e-4 and len(standing) > 5


def test_sensor_gain_and_offset() -> None:
    model = EASY.replace({"sensor_gain.error": -0.02, "sensor_offset.offset": 50e-6})
    sensed, _, _, x, _ = drive_plant(model, STEADY)[1]
    np.testing.assert_allclose(sensed, 0.98 * x + 50e-6, rtol=1e-12)


def test_two_effects_at_one_port_both_act() -> None:
    load = {"constant_load.force": 1000.0, "aero_stiffness.stiffness": 5e5}
    run = simulate(EASY.replace(load), np.full(600, 2e-3))
    assert run.p12[-100:].mean() * AREA == pytest.approx(1000.0 + 5e5 * run.xj[-100:].mean(), rel=0.01)


def test_constant_load_equals_the_load_of_the_command() -> None:
    by_effect = simulate(WHOLE.replace({"constant_load.force": 1500.0}), COMMAND)
    by_input = simulate(WHOLE, COMMAND, load=np.full(len(COMMAND), 1500.0))
    assert (by_effect.xj == by_input.xj).all()


@pytest.mark.parametrize("tau", [0.3e-3, 3e-3])
@pytest.mark.parametrize("signal", ["step", "ramp", "sine"])
def test_sensor_lag_is_a_first_order_lag(tau: float, signal: str) -> None:
    h = H
    p = WHOLE.replace({"sensor_lag.time": tau}).build_record()[0]
    t, w = np.arange(1, 4001) * h, 2 * np.pi * 40
    x, expected = {
        "step": (np.full_like(t, 1e-3), 1e-3 * (1 - np.exp(-(t - h / 2) / tau))),  # it rises within the first step
        "ramp": (t, t - tau * (1 - np.exp(-t / tau))),
        "sine": (np.sin(w * t), (np.sin(w * t) - w * tau * (np.cos(w * t) - np.exp(-t / tau))) / (1 + (w * tau) ** 2)),
    }[signal]
    m, sensed = Lag(), np.empty_like(x)
    for i, value in enumerate(x):
        sensed[i], m = sensor_lag(value, m, State(), Input(h=h), p)
    np.testing.assert_allclose(sensed, expected, atol=2e-4 * np.abs(x).max())


@pytest.mark.parametrize("more", [{}, {"sensor_lag.time": 2e-3}])
def test_the_first_sample_has_the_sensors_offset(more: dict[str, float]) -> None:
    """The transducer shows it before the plant has made a step."""
    model = WHOLE.replace({"sensor_offset.offset": 50e-6} | more)
    for fast in (True, False):
        plant = Actuator(model, steps=20, fast=fast)
        run = simulate(model, np.zeros(3), steps=20, fast=fast)
        assert plant.sample()[0] == run.xj[0] == 50e-6
        assert run.cor[0] == -50e-6 * model["controller.proportional_gain"]
        plant.advance(0.0)
        assert plant.sample()[0] == run.xj[1] == 50e-6  # nor is there a jump in the second


def test_readings_are_whole_steps_and_their_error_is_evenly_spread() -> None:
    """The noise is quantised too; where it is as large as the step, the error's variance is LSB^2/12."""
    model = WHOLE.replace({"quantisation.lsb": 5e-6, "sensors.position_noise": 5e-6})
    plain = model.replace({"quantisation.lsb": 0.0})
    one, other = Actuator(model, seed=4), Actuator(plain, seed=4)
    reads, was = (np.array([plant.sample()[0] for _ in range(4000)]) for plant in (one, other))
    np.testing.assert_allclose(reads / 5e-6, np.round(reads / 5e-6), atol=1e-9)
    assert abs(reads - was).max() <= 2.5e-6 * (1 + 1e-9)
    assert np.var(reads - was) == pytest.approx(5e-6**2 / 12, rel=0.06)


def test_the_firmware_follows_a_step_as_a_ramp() -> None:
    model = Model().replace({"command_rate_limit.rate": 0.1})
    com = np.r_[np.zeros(5), np.full(60, 5e-3), np.full(60, -1e-3)]
    taken = compute_answers(model, com, np.zeros(125)) / model["controller.proportional_gain"]
    assert np.diff(taken)[4:20] == pytest.approx(np.full(16, 0.1e-3))
    assert abs(np.diff(taken)).max() <= 0.1e-3 * (1 + 1e-9)
    assert taken[60] == pytest.approx(min(5e-3, 8e-3 / 3.8)) and taken[-1] == pytest.approx(-1e-3)
    slow = np.cumsum(np.full(125, 0.09e-3))
    assert not compute_answers(model, slow, slow).any()  # slower commands are as they were, the first one too


def test_the_rigs_own_firmware_limits_the_rate_too() -> None:
    """Frame by frame, from the first active cycle; and anew after each activation."""
    model = Model().replace({"command_rate_limit.rate": 0.1})
    desk = FirmwareDesk(model)
    wanted = [0.0, *(0.1e-3 * k for k in range(1, 6))]
    for _ in range(2):
        drives = [desk.cycle(int(Control.ACTIVE), demand) for demand in (0.0, *[5e-3] * 5)]
        assert [drive and drive.current for drive in drives] == pytest.approx([3.8 * x for x in wanted], abs=1e-8)
        desk.cycle(0)


@pytest.mark.parametrize("changes", [{}, {"command_rate_limit.rate": 0.1}])
def test_the_firmware_alone_answers_as_in_the_loop(changes: dict[str, float]) -> None:
    model = Model().replace(changes)
    run = simulate(model, COMMAND, seed=2)
    assert (compute_answers(model, COMMAND, run.xj) == run.cor).all()


@given(st.floats(-0.3, 0.3), st.floats(-1.0, 1.0), st.floats(1e-3, 0.1), st.floats(0.0, 0.9),
       st.one_of(st.just(0.0), st.floats(1e-6, 1e-4)))
@settings(max_examples=25, deadline=None)
def test_friction_only_takes_energy(v: float, rise: float, speed: float, asymmetry: float, deflection: float) -> None:
    """A ram on a closed valve: kinetic energy and that of the bristles never grow."""
    names = ("stribeck", "friction_asymmetry", "presliding")
    p = WHOLE.with_effects(names).replace({"stribeck.rise": abs(rise), "stribeck.speed": speed,
                                     "friction_asymmetry.asymmetry": 0.0 if deflection else asymmetry,
                                     "presliding.deflection": deflection}).build_record()[0]
    k, u, s = compute_coefficients(p, H), Input(h=H), build_initial_state(names)._replace(jack_speed=v)
    moved = interpret_function(step_plant, collect_bindings(names))
    stiffness = 800.0 / deflection if deflection else 0.0
    last = np.inf
    for _ in range(60):
        bristle = s.memory.jack_drag[1]
        bent = bristle.kept * (bristle.deflection + H * s.jack_speed)
        now = 0.5 * 100.0 * s.jack_speed**2 + 0.5 * stiffness * bent**2
        assert now <= last * (1 + 1e-9) + 1e-15
        last, s = now, moved(s, u, p, k)


def test_the_order_of_the_sensors_chain_is_that_of_its_signal() -> None:
    assert [e for e in CATALOGUE if CATALOGUE[e].port == "position"] == [
        "mount_compliance", "rod_backlash", "sensor_lag", "sensor_gain", "sensor_offset"]


def test_a_heavy_body_on_its_mount_rings_as_its_equation_says() -> None:
    mass, compliance, ratio = 20.0, 1.0 / 27e6, 0.05
    g = {"mount_compliance.compliance": compliance, "mount_compliance.mass": mass,
         "mount_compliance.damping_ratio": ratio}
    model = EASY.replace(g)
    p, h = model.build_record()[0], 1e-5
    sensed, recoil = [], Recoil()
    for k in range(4000):  # 40 ms, a step of pressure
        x, recoil = mount_compliance(0.0, recoil, State(pressure=1e6), Input(h=h, t=k * h), p)
        sensed.append(x)
    t = h * np.arange(1, 4001)
    w = 1.0 / np.sqrt(mass * compliance)
    damped = w * np.sqrt(1.0 - ratio**2)
    decay = np.exp(-ratio * w * t)
    exact = compliance * AREA * 1e6 * (1.0 - decay * (np.cos(damped * t) + ratio * w / damped * np.sin(damped * t)))
    np.testing.assert_allclose(sensed, exact, atol=0.01 * exact.max())
    assert exact.max() > 1.8 * compliance * AREA * 1e6, "it overshoots"
