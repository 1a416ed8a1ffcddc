"""Every closed form of docs/physics.md on the plant itself; passive parts take energy and never give it."""

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st
from physics_cases import SILENT, SMOOTH

from plant import Actuator, Model, simulate
from plant.compile import compile_function
from plant.eha import State, compute_coefficients, step_actuator
from plant.friction import clip
from plant.state import Input

V = Model().values
GAP, GM, KF = V["controller.proportional_gain"], V["torque_motor.gain"], V["flapper.stiffness"]
KSF, ASV, AJ = V["feedback_spring.stiffness"], V["spool.end_area"], V["jack.area"]
GPF, GQF, GP, GQ = V["pilot.pressure_gain"], V["pilot.flow_gain"], V["valve.pressure_gain"], V["valve.flow_gain"]
CLK, FDJ = V["jack.leakage"], V["jack.dynamic_friction"]
KPOS = GAP * GM * GQ / (KSF * AJ)
DROOP = (1 / GP + CLK / GQ) * KSF / (GM * GAP) / AJ  # m/N


def ramp(rate: float, seconds: float) -> np.ndarray:
    """A ramp after 0.1 s of rest."""
    return np.r_[np.zeros(100), np.arange(round(seconds * 1000)) * 1e-3 * rate]


def spool(friction: float, ratio: float = 1.5) -> dict[str, float]:
    return {"spool.static_friction": friction, "spool.dynamic_friction": friction / ratio}


def follow(model: Model, currents: np.ndarray) -> np.ndarray:
    """Spool position after each cycle of the given currents, m."""
    plant, out = Actuator(model), np.empty(len(currents))
    for k, current in enumerate(currents):
        plant.advance(current)
        out[k] = plant.state.spool_position
    return out


@pytest.mark.parametrize(("rate", "friction"), [
    (0.5e-3, 0.0), (0.5e-3, 5.0),
    # fast enough that the ram never stops in the spool's limit cycle: then its own friction has one sign
    (20e-3, 0.0), (20e-3, 5.0), (20e-3, 20.0), (20e-3, 35.0)])
def test_steady_ramp_error_does_not_depend_on_spool_friction(rate: float, friction: float) -> None:
    run = simulate(SILENT.replace(spool(friction)), ramp(rate, 4.0 if rate < 1e-3 else 1.8))
    expected = rate / KPOS + DROOP * (FDJ + V["jack.damping"] * rate)
    assert (run.com - run.xj)[1000:].mean() == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("friction", [5.0, 10.0, 20.0, 40.0])
def test_limit_cycle_of_the_stuck_spool(friction: float) -> None:
    run = simulate(SILENT.replace(spool(friction)), ramp(0.5e-3, 10.0))
    assert (run.com - run.xj)[1000:].std() == pytest.approx(2.05e-6 * friction, rel=0.05)


@pytest.mark.parametrize("friction", [5.0, 35.0])
def test_break_away_error(friction: float) -> None:
    run = simulate(SILENT.replace(spool(friction)), ramp(20e-6, 10.0))
    moved = int(np.argmax(run.xs != 0.0))
    assert (run.com - run.xj)[moved] == pytest.approx(friction * KF / (GPF * ASV * GM * GAP), rel=0.01)


def test_spool_hysteresis() -> None:
    friction = 20.0
    rise = np.arange(2000) * 8e-7  # A
    currents = np.r_[rise, rise[::-1]]
    lag = GM * currents / KSF - follow(SILENT.replace(spool(friction, 1.0)), currents)
    half = friction * KF / (GPF * ASV * KSF)
    slow = 8e-4 * GM / KSF / (GQF * KSF / (KF * ASV))  # the pilot loop's own lag at this rate
    assert lag[1900] == pytest.approx(half + slow, rel=0.01)
    assert lag[3900] == pytest.approx(-half - slow, rel=0.01)


@pytest.mark.parametrize(("clogging", "law", "power"), [(0.0, "sqrt", 0.5), (0.35, "sqrt", 0.5), (0.35, "linear", 1.0),
                                                        (0.35, "pressure", 0.0)])
def test_pilot_loop_gain(clogging: float, law: str, power: float) -> None:
    """On a current ramp the spool lags by its rate over Kv."""
    speed = 1e-3  # m/s of the spool
    currents = np.arange(300) * 1e-3 * speed * KSF / GM
    model = SMOOTH.replace({"filter.clogging": clogging, "filter.law": law})
    lag = currents[-1] * GM / KSF - follow(model, currents)[-1]
    lag += 0.5e-3 * speed  # at the end of a cycle the held current is half a cycle behind its ramp
    assert lag == pytest.approx(speed / kv(clogging, power), rel=0.01)


def kv(clogging: float, power: float) -> float:
    """GQF1 KSF / (KF ASV), 1/s."""
    return GQF * (1 - clogging) ** power * KSF / (KF * ASV)


def test_largest_speed() -> None:
    model = SMOOTH.replace({"jack.damping": 0.0, "jack.leakage": 0.0, "controller.current_limit": 9e-3})
    run = simulate(model, np.full(200, 0.035))
    assert np.diff(run.xj).max() * 1000 == pytest.approx(GQ * V["spool.travel"] / AJ, rel=1e-6)
    assert GQ * V["spool.travel"] / AJ == pytest.approx(0.25)


@pytest.mark.parametrize("force", [-3000.0, 1000.0, 5000.0])
def test_droop_under_load(force: float) -> None:
    run = simulate(SMOOTH, np.zeros(1500), load=np.full(1500, force))
    assert run.xj[-1] == pytest.approx(-DROOP * force, rel=1e-3)


def overshoot(record, gain, target, steps, h):
    """Largest position on a step to `target` with a controller that answers at once."""
    p = record[0]
    k = compute_coefficients(p, h)
    s, top = REST, 0.0
    for i in range(steps):
        current = clip(gain * (target - s.jack_position), p.controller.current_limit)
        s, _ = step_actuator(s, 0.0, Input(current, 0.0, 0.0, i * h, 0.0, h), p, k)
        top = max(top, s.jack_position)
    return top


REST = State()


@pytest.mark.parametrize(("clogging", "percent"), [(0.0, 2.4), (0.1, 3.5), (0.25, 5.5), (0.35, 7.2)])
def test_overshoot_of_the_continuous_loop(clogging: float, percent: float) -> None:
    model = SILENT.replace({"filter.clogging": clogging, "controller.proportional_gain": GAP * 100 / KPOS})
    top = compile_function(overshoot)(model.build_record(), model["controller.proportional_gain"], 1e-3, 100_000, 2e-6)
    assert (top / 1e-3 - 1) * 100 == pytest.approx(percent, abs=0.1)


H = 1e-5


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
        s, _ = step_actuator(s, 0.0, u, p, k)
    assert energy(s) <= before * (1 + 1e-9)


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


def test_a_held_load_does_not_move_a_ram_in_stiction() -> None:
    """Valve closed by a leak-free plant: below the static level nothing moves, above it something does."""
    quiet = np.zeros(200)
    model = SILENT.replace({"controller.proportional_gain": 0.0})
    assert (simulate(model, quiet, np.full(200, 799.0)).xj == 0.0).all()
    assert simulate(model, quiet, np.full(200, 801.0)).xj[-1] < 0.0
