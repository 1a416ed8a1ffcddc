"""One suite for everything in the catalogue, and what effects with memory and a user's own must do."""
from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from effect_files import COGGING, HEAD, MEMORY, STIFF, restored_catalogue
from hypothesis import given, settings
from hypothesis import strategies as st
from physics_cases import SILENT

from plant import Actuator, InputError, Model, simulate
from plant.effects import CATALOGUE, load_effects
from plant.effects.sensors import Lag, sensor_lag
from plant.state import Input, State

# A value met in practice for each effect: enough to be seen.
TYPICAL: dict[str, dict[str, float]] = {
    "filter_clogging": {"filter.clogging": 0.3},
    "spool_friction": {"spool.static_friction": 35.0, "spool.dynamic_friction": 25.0},
    "jack_friction": {"jack.static_friction": 1600.0, "jack.dynamic_friction": 1000.0},
    "viscous_drag": {"jack.damping": 10e3},
    "moving_mass": {"jack.mass": 200.0},
    "internal_leakage": {"jack.leakage": 3e-11},
    "null_bias": {"null_bias.current": 2e-4},
    "current_noise": {"current_noise.white": 1e-4, "current_noise.hum": 1e-4},
    "spool_overlap": {"spool_overlap.overlap": 20e-6},
    "constant_load": {"constant_load.force": 2e3},
    "aero_stiffness": {"aero_stiffness.stiffness": 5e5},
    "sensor_offset": {"sensor_offset.offset": 50e-6},
    "sensor_lag": {"sensor_lag.time": 2e-3},
}
LAWS = [name for name, entry in CATALOGUE.items() if not entry.base]
BASES = [name for name, entry in CATALOGUE.items() if entry.base]
COMMAND = np.r_[np.zeros(10), np.full(150, 2e-3), 2e-3 + 1e-3 * np.sin(np.arange(250) * 0.02)]
FEW = 20  # steps a cycle where plain Python runs too


@pytest.fixture
def file(tmp_path: Path) -> Iterator[Path]:
    """A place for an effect file; what it registers is forgotten afterwards."""
    with restored_catalogue():
        yield tmp_path / "mine.py"


def columns(model: Model, **options) -> np.ndarray:
    return np.array(simulate(model, COMMAND, **options))


def same_interpreted(model: Model, cycles: int = 40) -> bool:
    short = COMMAND[:cycles]
    fast, slow = (np.array(simulate(model, short, seed=3, steps=FEW, fast=fast)) for fast in (True, False))
    return bool((fast == slow).all())


def test_every_effect_has_a_typical_value_here() -> None:
    assert set(TYPICAL) == set(CATALOGUE)
    assert all(set(TYPICAL[name]) <= set(CATALOGUE[name].parameters) for name in TYPICAL)


@pytest.mark.parametrize("name", TYPICAL)
def test_finite_and_deterministic(name: str) -> None:
    model = Model().replace(TYPICAL[name])
    once, again = columns(model, seed=1), columns(model, seed=1)
    assert np.isfinite(once).all()
    assert (once == again).all()


@pytest.mark.parametrize("name", LAWS)
def test_absent_at_its_off_value(name: str) -> None:
    """Bit for bit, so that a fit may start there."""
    assert (columns(Model().having([name])) == columns(Model())).all()


@pytest.mark.parametrize("name", TYPICAL)
def test_visible_at_a_typical_value(name: str) -> None:
    with_it, without = simulate(SILENT.replace(TYPICAL[name]), COMMAND), simulate(SILENT, COMMAND)
    seen = [np.sqrt(((a - b) ** 2).mean()) / noise for a, b, noise in (
        (with_it.xj, without.xj, 2e-6), (with_it.p12, without.p12, 2e4), (with_it.xs, without.xs, 1e-6))]
    assert max(seen) > 1.0


@pytest.mark.parametrize("name", LAWS)
def test_compiled_equals_interpreted(name: str) -> None:
    assert same_interpreted(Model().replace(TYPICAL[name]))


def test_the_reference_model_compiled_equals_interpreted() -> None:
    everything = {k: v for name in BASES for k, v in TYPICAL[name].items()}
    assert same_interpreted(Model().replace(everything | {"controller.integral_gain": 20.0,
                                                          "controller.derivative_gain": 1e-3}))


@given(st.sets(st.sampled_from(LAWS), min_size=2, max_size=4))
@settings(max_examples=3, deadline=None, derandomize=True)
def test_sets_of_effects_compiled_equal_interpreted(names: set[str]) -> None:
    model = Model().replace({k: v for name in names for k, v in TYPICAL[name].items()})
    assert set(model.effects) == names
    assert same_interpreted(model)
    assert np.isfinite(columns(model)).all()


def test_the_order_in_which_effects_are_named_does_not_matter() -> None:
    changes = TYPICAL["sensor_lag"] | TYPICAL["sensor_offset"] | TYPICAL["null_bias"]
    back = dict(reversed(list(changes.items())))
    assert Model().replace(changes).effects == Model().replace(back).effects  # and so the same code
    assert Model().replace(changes).values == Model().replace(back).values


def test_two_effects_at_one_port_both_act() -> None:
    load = {"constant_load.force": 1000.0, "aero_stiffness.stiffness": 5e5}
    plain = SILENT.replace({"jack.static_friction": 0.0, "jack.dynamic_friction": 0.0})
    run = simulate(plain.replace(load), np.full(600, 2e-3))
    assert run.p12[-100:].mean() * plain["jack.area"] == pytest.approx(1000.0 + 5e5 * run.xj[-100:].mean(), rel=0.01)


def test_constant_load_equals_the_load_of_the_command() -> None:
    by_effect = simulate(SILENT.replace({"constant_load.force": 1500.0}), COMMAND)
    by_input = simulate(SILENT, COMMAND, load=np.full(len(COMMAND), 1500.0))
    assert (by_effect.xj == by_input.xj).all()


def test_null_bias_shifts_position_and_not_pressure() -> None:
    smooth = SILENT.replace({f"{b}.{k}_friction": 0.0 for b in ("spool", "jack") for k in ("static", "dynamic")})
    run = simulate(smooth.replace(TYPICAL["null_bias"]), np.zeros(600))
    assert run.xj[-1] == pytest.approx(2e-4 / smooth["controller.proportional_gain"], rel=1e-3)
    assert run.p12[-1] == pytest.approx(0.0, abs=1.0)


@pytest.mark.parametrize("tau", [0.3e-3, 3e-3])
@pytest.mark.parametrize("signal", ["step", "ramp", "sine"])
def test_sensor_lag_is_a_first_order_lag(tau: float, signal: str) -> None:
    h = 1e-5
    p = SILENT.replace({"sensor_lag.time": tau}).record()[0]
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


def test_sensor_lag_in_the_loop() -> None:
    """At constant speed the transducer is behind by the speed times its time constant."""
    plant = Actuator(SILENT.replace({"sensor_lag.time": 2e-3}))
    for _ in range(100):
        plant.advance(2e-3)
    lag = plant.state.jack_position - plant.sample()[0]
    assert lag == pytest.approx(2e-3 * plant.state.jack_speed, rel=1e-3)


@pytest.mark.parametrize("more", [{}, {"sensor_lag.time": 2e-3}])
def test_the_first_sample_has_the_sensors_offset(more: dict[str, float]) -> None:
    """The transducer shows it before the plant has made a step."""
    model = SILENT.replace({"sensor_offset.offset": 50e-6} | more)
    for fast in (True, False):
        plant = Actuator(model, steps=FEW, fast=fast)
        run = simulate(model, np.zeros(3), steps=FEW, fast=fast)
        assert plant.sample()[0] == run.xj[0] == 50e-6
        assert run.cor[0] == -50e-6 * model["controller.proportional_gain"]
        plant.advance(0.0)
        assert plant.sample()[0] == run.xj[1] == 50e-6  # nor is there a jump in the second


def test_a_position_law_that_cannot_run_is_refused(file: Path) -> None:
    file.write_text(COGGING.replace('"load"', '"position"').replace("p.cogging.force", "p.cogging.farce"))
    load_effects(file)
    with pytest.raises(InputError, match="cogging"):
        Actuator(Model().having(["cogging"]))


def test_the_users_effect_is_found_and_acts(file: Path) -> None:
    file.write_text(STIFF.format(scale=1.0))
    assert load_effects(file) == ["spring"]
    model = SILENT.replace({"spring.stiffness": 5e5})
    ours = columns(SILENT.replace({"aero_stiffness.stiffness": 5e5}))
    assert np.abs(columns(model)[2] - ours[2]).max() < 5e-6  # the same physics, at the start of the step not its middle
    assert same_interpreted(model)
    assert (columns(Model().having(["spring"])) == columns(Model())).all()


def test_the_users_effect_with_memory(file: Path) -> None:
    file.write_text(MEMORY)
    load_effects(file)
    model = SILENT.replace({"wear.rate": 3e5, "constant_load.force": 100.0})
    assert same_interpreted(model)
    plant, way, last = Actuator(model), 0.0, 0.0
    for current in 4e-3 * np.sin(np.arange(300) * 0.05):
        plant.advance(current)
        way += abs(plant.state.jack_position - last)
        last = plant.state.jack_position
    assert plant.state.memory.load[1].travelled == pytest.approx(way, rel=0.01)
    assert way > 1e-3


def test_the_users_effect_runs_at_full_speed(file: Path) -> None:
    file.write_text(STIFF.format(scale=1.0))
    load_effects(file)
    long = np.tile(COMMAND, 8)

    def cost(model: Model) -> float:
        def once() -> float:
            start = time.perf_counter()
            simulate(model, long)
            return time.perf_counter() - start
        once()
        return min(once() for _ in range(7))

    assert cost(SILENT.replace({"spring.stiffness": 1e5})) < 2.0 * cost(SILENT)


@pytest.mark.parametrize(("text", "said"), [
    ("effect(", "a file that Python can run"),
    ("import no_such_module", "a file that Python can run"),
    ("x = 1 / 0", "ZeroDivisionError"),
    ("x = 1", "at least one function marked @effect"),
    (COGGING.replace('"load"', '"laod"'), "no port 'laod'"),
    (COGGING.replace('Quantity("N")] = 0.0', 'Quantity("N")]'), "needs a default"),
    (COGGING.replace("def cogging", "def null_bias"), "the name is taken"),
    (HEAD + "raise ValueError('two\\nlines')", "a file that Python can run"),
])
def test_a_bad_file_is_refused_in_one_line(file: Path, text: str, said: str) -> None:
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        load_effects(file)
    assert said in str(caught.value)
    assert str(file) in str(caught.value)


def test_a_file_with_annotations_as_text(file: Path) -> None:
    file.write_text("from __future__ import annotations\n" + MEMORY)
    assert load_effects(file) == ["wear"]
    assert CATALOGUE["wear"].parameters["wear.rate"].unit == "N/m"


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="a Python file with effects"):
        load_effects(tmp_path / "none.py")


@pytest.mark.parametrize("body", ["return x + p.cogging.farce", "return x + open('f')", "return [x, 'text']"])
def test_a_law_that_cannot_run_is_refused(file: Path, body: str) -> None:
    start = COGGING.index("    return x +")
    file.write_text(COGGING[:start] + f"    {body}\n")
    load_effects(file)
    with pytest.raises(InputError, match="cogging"):
        simulate(Model().having(["cogging"]), COMMAND)
