"""The plant against the closed forms of docs/physics.md and independent solvers; the error of its step."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st
from physics_cases import PREFLIGHT, SILENT, SMOOTH
from physics_reference import simulate_explicit, simulate_linear

from plant import Actuator, Array, Hold, Input, Model, build_profile, compile_function, simulate
from plant.eha import State, compute_coefficients, step_actuator
from plant.friction import clip
from plant.segments import Chirp, Ramp, Sine
from rig.bench.benchmarks import FRICTIONLESS, QUIET, measure_accuracy
from rig.cli import main

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
    error = rate / KPOS + DROOP * (FDJ + V["jack.damping"] * rate)
    assert (run.com - run.xj)[1000:].mean() == pytest.approx(error, rel=0.01)


@pytest.mark.parametrize("friction", [5.0, 10.0, 20.0, 40.0])
def test_limit_cycle_of_the_stuck_spool(friction: float) -> None:
    run = simulate(SILENT.replace(spool(friction)), ramp(0.5e-3, 10.0))
    assert (run.com - run.xj)[1000:].std() == pytest.approx(2.05e-6 * friction, rel=0.05)


@pytest.mark.parametrize("friction", [5.0, 35.0])
def test_break_away_error(friction: float) -> None:
    run = simulate(SILENT.replace(spool(friction)), ramp(20e-6, 10.0))
    row = int(np.argmax(run.xs != 0.0))
    assert (run.com - run.xj)[row] == pytest.approx(friction * KF / (GPF * ASV * GM * GAP), rel=0.01)


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
    gain = GQF * (1 - clogging) ** power * KSF / (KF * ASV)  # GQF1 KSF / (KF ASV), 1/s
    assert lag == pytest.approx(speed / gain, rel=0.01)


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
CYCLES = (0.5e-3, 2e-3, 5e-3, 10e-3)


def play(period: float, current: Array, load: Array) -> list[tuple[float, float, float]]:
    """The readings at the start of each cycle of the plant alone."""
    plant, readings = Actuator(SILENT.replace({"controller.period": period})), []
    for amount, force in zip(current.tolist(), load.tolist(), strict=True):
        readings.append(plant.sample())
        plant.advance(amount, force)
    return readings


@pytest.mark.parametrize("period", CYCLES)
def test_a_current_moves_the_plant_as_the_same_current_held_on_the_usual_cycle(period: float) -> None:
    longer, shorter = max(period, 1e-3), min(period, 1e-3)
    every, rng = round(longer / shorter), np.random.default_rng(1)
    current, load = rng.uniform(-5e-3, 5e-3, 40), rng.uniform(-5e3, 5e3, 40)
    slow = play(longer, current, load)
    assert slow == play(shorter, np.repeat(current, every), np.repeat(load, every))[::every]


GENTLE = build_profile((Hold(time=0.05), Ramp(to=1e-3, time=1.0), Sine(amplitude=3e-3, frequency=1.0, time=1.0),
                Chirp(amplitude=0.5e-3, f0=1.0, f1=20.0, fade=20.0, time=2.0))).command  # nothing saturates


def rms(x: np.ndarray) -> np.ndarray:
    return np.sqrt((x**2).mean(axis=0))


Solver = Callable[[Mapping[str, float], np.ndarray], np.ndarray]
FINE = partial(simulate_explicit, substeps=200_000)  # 5 ns: its error falls with the step
LINEAR = {"xj": 0.002e-6, "xs": 0.002e-6, "p12": 0.05e5, "cor": 1e-8}
STOPS = {"xj": 0.02e-6, "xs": 0.02e-6, "p12": 0.05e5, "fine xj": 0.005e-6}
# A spool so heavy that it takes milliseconds of all the pressure the filter leaves, PS1 = PSR (1 - Kintas). With the
# real one P1 is at its limit for microseconds only: nothing would notice another limit.
HEAVY = {"spool.mass": 5.0, "pilot.pressure_gain": 6.59e12}
PILOT = {"fine xj": 0.1e-6, "fine xs": 0.1e-6, "fine p12": 0.05e5}  # XJ 95 um with the limit of a clean filter
# The stick-slip of the loop has a phase of its own: small differences stay, and it does not run away.
STICKING = {"xj": 1e-6, "largest xj": 5e-6}
LOAD = 4000.0 * np.sin(2 * np.pi * 3e-3 * np.arange(1500)) + 2000.0 * (np.arange(1500) > 700)


def list_cases() -> Iterator[Any]:
    """Model, command, load, independent solver, and the most that may be left, RMS, SI."""
    for clogging in (0.0, 0.3):
        yield SMOOTH.replace({"filter.clogging": clogging}), GENTLE, None, simulate_linear, LINEAR
    for clogging in (0.0, 0.5):
        clogged = SMOOTH.replace({"filter.clogging": clogging})
        for step in (1e-3, -5e-3):  # 1 mm saturates the pressures, 5 mm drives flapper and spool to their stops
            yield clogged, np.r_[np.zeros(3), np.full(57, step)], None, FINE, STOPS
        to_and_fro = np.r_[np.zeros(3), np.full(20, 2e-3), np.full(17, -2e-3)]
        yield clogged.replace(HEAVY), to_and_fro, None, FINE, PILOT
    # 0.017 um, nearly all of it the explicit scheme's
    yield SMOOTH, PREFLIGHT, None, partial(simulate_explicit, substeps=4000), {"xj": 0.03e-6, "largest xj": 0.3e-6}
    yield SILENT.replace({"filter.clogging": 0.3, "jack.leakage": 2e-11}), PREFLIGHT, None, simulate_explicit, STICKING
    swing = 1e-3 * np.sin(2 * np.pi * 2e-3 * np.arange(1500))
    yield SILENT, swing, LOAD, partial(simulate_explicit, load=LOAD), {"xj": 1e-6, "p12": 0.2e5}


@pytest.mark.parametrize(("model", "command", "load", "solver", "limits"), list(list_cases()))
def test_against_an_independent_solver(model: Model, command: np.ndarray, load: np.ndarray | None, solver: Solver,
                                       limits: dict[str, float]) -> None:
    truth = dict(zip(("xj", "cor", "p12", "xs"), solver(model.values, command), strict=True))
    runs = {"": simulate(model, command, load)}
    runs["largest"], runs["fine"] = runs[""], simulate(model, command, load, steps=2000 if len(command) < 99 else 100)
    for which, most in limits.items():
        kind, _, column = which.rpartition(" ")
        residual = getattr(runs[kind], column) - truth[column]
        assert (np.abs(residual).max() if kind == "largest" else rms(residual)) < most, which


def test_rig_simulate_follows_an_independent_simulation_at_1_us(tmp_path: Path) -> None:
    """The acceptance test, through the command: spool friction and noise of the position off."""
    command, out = tmp_path / "c.csv", tmp_path / "s.csv"
    rows = "\n".join(f"{k / 1000:.3f},{com!r}" for k, com in enumerate(PREFLIGHT.tolist()))
    command.write_text(f"t,com\n{rows}\n")
    off = {name: 0.0 for name in (*FRICTIONLESS, *QUIET) if not name.startswith("jack")}
    options = [f"--set={name}=0" for name in ("spool.static_friction", "spool.dynamic_friction",
                                              "sensors.position_noise")]
    assert main.main(["simulate", *options, "--command", str(command), "--out", str(out), "--quiet"]) == 0
    xj = np.genfromtxt(out, delimiter=",", names=True)["xj"]
    assert rms(xj - simulate_explicit(Model().replace(off).values, PREFLIGHT)[0]) < 0.1e-6


@pytest.mark.parametrize(("law", "exponent"), [("sqrt", 0.5), ("linear", 1.0), ("pressure", 0.0)])
def test_filter_laws_against_an_explicit_scheme(law: str, exponent: float) -> None:
    """The reference knows "sqrt" alone: the rest of the power is put into its flow gain."""
    clogged = {"filter.clogging": 0.35, "filter.law": law}
    values = SILENT.replace({"filter.clogging": 0.35, "pilot.flow_gain": 0.069 * 0.65 ** (exponent - 0.5)}).values
    truth = rms(simulate_explicit(values, PREFLIGHT)[0] - simulate_explicit(SILENT.values, PREFLIGHT)[0])
    ours = rms(simulate(SILENT.replace(clogged), PREFLIGHT).xj - simulate(SILENT, PREFLIGHT).xj)
    assert ours == pytest.approx(truth, abs=0.3e-6)


def test_error_of_the_step_is_small_and_finer_steps_are_better() -> None:
    table = measure_accuracy(PREFLIGHT, (50, 100))
    assert table[0]["rms"] > table[1]["rms"]
    most = {"rms": 0.005, "largest": 0.05, "rms_friction": 0.7, "largest_friction": 3.0}  # um
    assert all(table[1][key] < limit for key, limit in most.items())
