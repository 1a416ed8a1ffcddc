"""One suite for everything in the catalogue: what it says of itself, and what every law must keep to."""

import numpy as np
import pytest
from effects_cases import EASY, LAWS, QUIET_SPOOL, WHOLE
from physics_cases import PREFLIGHT
from refusals import catch_refusal

from plant import Actuator, Model, simulate
from plant.effects import CATALOGUE
from plant.model import find_quantity
from plant.parameters import load_nominal_values
from plant.selftest import list_extremes
from plant.starts import compute_changes, compute_levels, parse_hint

CANONICAL = (
    "filter_clogging", "spool_friction", "jack_friction", "viscous_drag", "moving_mass", "internal_leakage",
    "null_bias", "torque_motor_hysteresis", "coil_lag", "current_limit", "nozzle_asymmetry", "feedback_gap",
    "spool_overlap", "spool_underlap", "orifice_root", "flow_force", "supply_droop", "supply_ripple", "compressibility",
    "viscosity_drift", "stribeck", "presliding", "friction_asymmetry", "mount_compliance", "rod_backlash",
    "aero_stiffness", "constant_load", "sensor_lag", "sensor_gain", "sensor_offset", "quantisation", "transport_delay",
    "command_rate_limit", "structural_resonance",
)
COMMAND = np.r_[np.zeros(10), np.full(150, 2e-3), 2e-3 + 1e-3 * np.sin(np.arange(250) * 0.02)]
SHORT = np.r_[np.zeros(3), np.full(22, 3e-3)]  # what plain Python runs
FEW = 20  # steps a cycle


NOISY = {"current_noise.white": 1e-4, "current_noise.hum": 1e-4}


def largest(name: str) -> dict[str, float]:
    return dict(CATALOGUE[name].starts[-1]) if name != "current_noise" else NOISY


def columns(model: Model, command: np.ndarray = COMMAND, **options) -> np.ndarray:
    return np.array(simulate(model, command, **options))


def same_interpreted(model: Model) -> bool:
    fast, slow = (columns(model, SHORT, seed=3, steps=FEW, fast=fast) for fast in (True, False))
    return bool((fast == slow).all())


def test_the_catalogue_is_the_canonical_one() -> None:
    assert set(CATALOGUE) == {*CANONICAL, "current_noise"}


def test_each_says_what_it_is() -> None:
    for name, e in CATALOGUE.items():
        assert e.law and e.symptoms and e.source and e.parameters, name
        assert e.base or e.function.__doc__, name
        assert set(e.fitted) <= set(e.parameters) and bool(e.fitted) == (not e.disturbance), name
        for other in e.confused_with:
            assert other in CATALOGUE or find_quantity(other), name
            assert other not in CATALOGUE or name in CATALOGUE[other].confused_with, other
        assert all(name in CATALOGUE[other].excludes for other in e.excludes), name
        assert e.firmware == (name == "command_rate_limit")


def test_the_starts_of_each_are_values_that_it_allows() -> None:
    for name in CANONICAL:
        e, usual = CATALOGUE[name], load_nominal_values() | dict(CATALOGUE[name].off)
        assert len(e.starts) >= 2, name
        for start in e.starts:
            assert tuple(start) == e.fitted, name
            assert not any(e.parameters[parameter].refuses(value) for parameter, value in start.items()), name
            assert start != {parameter: usual[parameter] for parameter in start}, name
            assert e.is_active(start) or e.base, name
        for parameter, quantity in e.parameters.items():  # what is said to be typical is what a fit tries
            for value in parse_hint(quantity) if parameter == e.fitted[0] and len(e.fitted) == 1 else ():
                sizes = [abs(start[parameter]) for start in e.starts]
                assert min(sizes) / 4 <= abs(value) <= 4 * max(sizes), parameter


@pytest.mark.parametrize("steps", [FEW, 50, 100])
def test_the_whole_catalogue_at_its_off_values_changes_no_bit(steps: int) -> None:
    load = np.linspace(0.0, 8e3, len(COMMAND))
    bare, off = (columns(m, load=load, seed=1, steps=steps) for m in (Model(), Model().with_effects(LAWS)))
    assert (bare == off).all()


@pytest.mark.parametrize("name", LAWS)
def test_compiled_equals_interpreted_alone_or_with_the_others(name: str) -> None:
    """Compiled with the whole catalogue and interpreted by itself: the same numbers."""
    fast = columns(Model().with_effects(LAWS).replace(largest(name)), SHORT, seed=3, steps=FEW)
    slow = columns(Model().replace(largest(name)), SHORT, seed=3, steps=FEW, fast=False)
    assert (fast == slow).all()


def test_all_at_once() -> None:
    """Each at its smallest start, but for the one that another excludes; finite, and the same in plain Python."""
    together = {k: v for name in CANONICAL if name != "spool_underlap" for k, v in CATALOGUE[name].starts[0].items()}
    model = Model().with_effects(LAWS).replace(together | NOISY)
    assert np.isfinite(columns(model)).all()
    assert same_interpreted(model)


@pytest.mark.parametrize("name", CANONICAL)
def test_finite_and_deterministic_over_the_preflight(name: str) -> None:
    models = [WHOLE.replace(start) for start in CATALOGUE[name].starts]
    once = [columns(model, PREFLIGHT, seed=1, steps=FEW) for model in models]
    assert np.isfinite(once).all() and (once[0] == columns(models[0], PREFLIGHT, seed=1, steps=FEW)).all()


@pytest.mark.parametrize("name", LAWS)
def test_finite_at_the_ends_of_its_range(name: str) -> None:
    for values in list_extremes(CATALOGUE[name]):
        assert np.isfinite(columns(WHOLE.replace(values), steps=FEW)).all(), values


@pytest.mark.parametrize("name", ["command_rate_limit", "internal_leakage"])
def test_more_of_it_shows_more(name: str) -> None:
    load = np.full(len(PREFLIGHT), 5e3 if name == "internal_leakage" else 0.0)
    level = compute_levels(compute_changes(CATALOGUE[name], CATALOGUE[name].starts, PREFLIGHT, load)).max(axis=1)
    assert level[-1] > 3.0 and (np.diff(level) > 0.0).all()


@pytest.mark.parametrize("name", [name for name in CANONICAL if name != "internal_leakage"])
def test_visible_at_its_largest_start(name: str) -> None:
    """In closed loop over the preflight, without the phase of the spool's stick-slip, above the noise of one sensor."""
    with_it, without = (simulate(m, PREFLIGHT, steps=FEW) for m in (QUIET_SPOOL.replace(largest(name)), QUIET_SPOOL))
    seen = [np.sqrt(((a - b) ** 2).mean()) / noise for a, b, noise in (
        (with_it.xj, without.xj, 2e-6), (with_it.p12, without.p12, 2e4), (with_it.xs, without.xs, 1e-6))]
    assert max(seen) > 1.0


@pytest.mark.parametrize("name", CANONICAL)
def test_it_converges_with_the_step(name: str) -> None:
    """50 us against 5 us over steps and a sine: what a fit runs is the plant to a fraction of the sensors' noise."""
    dry = CATALOGUE[name].port == "jack_drag"  # a knife's edge is no matter of the step: friction only where it acts
    model = (QUIET_SPOOL if dry else EASY).replace(CATALOGUE[name].starts[len(CATALOGUE[name].starts) // 2])
    coarse, fine = (simulate(model, COMMAND, steps=steps) for steps in (20, 200))
    assert [np.sqrt(((getattr(coarse, name) - getattr(fine, name)) ** 2).mean()) < limit
            for name, limit in (("xj", 1e-6), ("xs", 0.5e-6))] == [True, True]


def test_the_actuator_with_the_whole_catalogue_is_the_simulation() -> None:
    model = Model().with_effects(LAWS).replace({"quantisation.lsb": 5e-6, "rod_backlash.width": 5e-5,
                                          "transport_delay.cycles": 1.5, "presliding.deflection": 2e-5})
    run, plant = simulate(model, COMMAND, seed=5), Actuator(model, seed=5)
    for k, current in enumerate([0.0, *run.cor[:-1].tolist()]):
        assert plant.sample() == (run.xj[k], run.p12[k], run.xs[k])
        plant.advance(current)


def test_what_excludes_each_other_may_stand_side_by_side_but_not_act() -> None:
    both = Model().with_effects(["spool_overlap", "spool_underlap"])
    assert both.replace({"spool_overlap.overlap": 1e-5}).effects == ("spool_overlap", "spool_underlap")
    line = catch_refusal(both.replace, {"spool_overlap.overlap": 1e-5, "spool_underlap.underlap": 1e-5})
    assert "not both at work" in line
