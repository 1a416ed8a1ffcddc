"""Passive parts take energy and never give it; stops and saturations hold."""
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from physics_cases import SILENT, SMOOTH

from plant import Actuator, simulate
from plant.friction import clip, soften, solve_velocity
from plant.state import Input, State
from plant.step import compute_coefficients, step_plant

H = 1e-5
speeds = st.one_of(st.just(0.0), st.floats(-1.0, 1.0))
levels = st.floats(0.0, 5e3)
bodies = st.tuples(st.floats(1e-3, 200.0), st.floats(0.0, 1e4), st.floats(1e-6, 1e-2),  # mass, damping, area
                   st.floats(0.0, 1e12), st.floats(1e3, 5e7))  # slope, limit


def slid(v0: float, force: float, line: float, dry: float, body: tuple[float, ...]) -> tuple[float, float]:
    """Speed after a step and the pressure then."""
    mass, damping, area, slope, limit = body
    free, push = mass + H * damping, H * area
    impulse = mass * v0 + H * force
    v = solve_velocity(v0, impulse, push, line, slope, limit, H * dry, 1 / free, 1 / (free + push * slope))
    return v, clip(line - slope * v, limit)


@given(speeds, st.floats(-1e4, 1e4), st.floats(-1e8, 1e8), levels, bodies)
@settings(max_examples=500, deadline=None)
def test_slide_is_the_root_of_its_equation(v0, force, line, dry, body) -> None:
    """m (v - v0) = h (F + A p(v) - c v - dry), dry within its level and against v; or the body has stopped."""
    mass, damping, area, _slope, limit = body
    v, pressure = slid(v0, force, line, dry, body)
    friction = force + area * pressure - damping * v - mass * (v - v0) / H
    scale = abs(force) + area * (abs(line) + limit) + mass * abs(v0) / H + dry + 1e-9
    assert v * v0 >= 0.0
    travelled = 0.5 * H * (v0 + v)
    gained, given_ = 0.5 * mass * (v**2 - v0**2), (force + area * pressure) * travelled
    rounding = 1e-9 * ((abs(force) + area * (abs(line) + limit)) * abs(travelled) + mass * (v**2 + v0**2))
    assert v == 0.0 or gained <= given_ + rounding  # friction and damping do no work; a body that stops has lost all
    if v != 0.0:
        assert friction == pytest.approx(np.sign(v) * dry, abs=1e-9 * scale)
    elif v0 == 0.0:
        assert abs(friction) <= dry + 1e-9 * scale
    else:  # it would have come to rest or turned within the step
        assert friction * np.sign(v0) <= dry + 1e-9 * scale


@given(speeds, levels, bodies)
@settings(max_examples=300, deadline=None)
def test_a_body_left_alone_only_slows_down(v0, dry, body) -> None:
    v, pressure = slid(v0, 0.0, 0.0, dry, body)
    assert abs(v) <= abs(v0) * (1 + 1e-12)
    assert pressure * v <= 0.0


@given(st.floats(-1e3, 1e3), levels)
def test_soften_and_clip_share_the_whole(x: float, band: float) -> None:
    assert soften(x, band) + clip(x, band) == pytest.approx(x, abs=1e-9)
    assert abs(clip(x, band)) <= band


@given(st.floats(-0.03, 0.03), st.floats(-0.5, 0.5), st.booleans(), st.floats(0.0, 1e6))
@settings(max_examples=40, deadline=None)
@example(0.03, -0.5, True, 1e6)
def test_a_ram_on_a_closed_valve_loses_energy(x: float, v: float, dry: bool, stiffness: float) -> None:
    """Spool centred, air stiffness as spring: kinetic and elastic energy together never grow over a millisecond."""
    model = (SILENT if dry else SMOOTH).replace({"aero_stiffness.stiffness": stiffness})
    p = model.build_record()[0]
    k = compute_coefficients(p, H)
    s, u = State(jack_position=x, jack_speed=v), Input(h=H)

    def energy(s: State) -> float:
        return 0.5 * float(p.jack.mass) * s.jack_speed**2 + 0.5 * stiffness * s.jack_position**2

    before = energy(s)
    for _ in range(100):
        u = Input(load=stiffness * (s.jack_position + 0.5 * H * s.jack_speed), h=H)
        s = step_plant(s, u, p, k)
    assert energy(s) <= before * (1 + 1e-9)


@given(st.floats(-3e-5, 3e-5), st.floats(-0.2, 0.2))
@settings(max_examples=30, deadline=None)
def test_a_flapper_left_alone_loses_energy(x: float, v: float) -> None:
    p = SILENT.build_record()[0]
    k, s, f = compute_coefficients(p, H), State(flapper_position=x, flapper_speed=v), p.flapper
    last = np.inf
    for _ in range(50):
        s = step_plant(s._replace(spool_position=0.0, spool_speed=0.0), Input(h=H), p, k)
        now = 0.5 * float(f.inertia) * s.flapper_speed**2 + 0.5 * float(f.stiffness) * s.flapper_position**2
        assert now <= last * (1 + 1e-12)
        last = now


@given(st.lists(st.floats(-0.02, 0.02), min_size=1, max_size=12), st.floats(-6e4, 6e4))
@settings(max_examples=40, deadline=None)
def test_nothing_leaves_its_stops(currents: list[float], load: float) -> None:
    """Any current and load: positions within their travel, pressure within the supply, all finite."""
    plant, m = Actuator(SILENT), SILENT
    for current in np.repeat(currents, 25):
        plant.advance(current, load)
        s = plant.state
        assert abs(s.flapper_position) <= m["flapper.travel"]
        assert abs(s.spool_position) <= m["spool.travel"]
        assert abs(s.jack_position) <= m["jack.travel"]
        assert abs(s.pressure) <= m["supply.pressure"]
        assert np.isfinite(s[:8]).all()


def test_the_ram_rests_at_its_stop_and_leaves_it() -> None:
    model = SILENT.replace({"jack.travel": 2e-3})
    run = simulate(model, np.r_[np.full(300, 5e-3), np.full(300, 0.0)])
    assert run.xj[299] == 2e-3
    assert run.p12[299] == pytest.approx(model["supply.pressure"])
    assert abs(run.xj[-1]) < 30e-6


def test_the_current_is_limited() -> None:
    run = simulate(SILENT, np.full(50, 20e-3))
    assert run.cor.max() == SILENT["controller.current_limit"]


def test_a_held_load_does_not_move_a_ram_in_stiction() -> None:
    """Valve closed by a leak-free plant: below the static level nothing moves, above it something does."""
    quiet = np.zeros(200)
    model = SILENT.replace({"controller.proportional_gain": 0.0})
    assert (simulate(model, quiet, np.full(200, 799.0)).xj == 0.0).all()
    assert simulate(model, quiet, np.full(200, 801.0)).xj[-1] < 0.0
