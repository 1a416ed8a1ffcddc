"""The catalogue: what it says of itself, what every law must keep to; a user's own effects, good and bad."""

import gc
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from effect_files import COGGING, HEAD, MEMORY
from effects_cases import EASY, LAWS, QUIET_SPOOL, WHOLE
from physics_cases import PREFLIGHT, SILENT
from refusals import catch_refusal
from rig_command import answer, refuse, write_file

from plant import (
    Actuator,
    Model,
    build_profile,
    check_effect,
    ensure_starts,
    find_plant,
    find_quantity,
    load_nominal_values,
    simulate,
)
from plant.effects import CATALOGUE, load_effects
from plant.selftest import list_extremes
from plant.starts import compute_changes, compute_levels, find_starts, parse_hint

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


@pytest.mark.parametrize("name", [*CANONICAL, "current_noise"])
def test_each_says_what_it_is(name: str) -> None:
    e = CATALOGUE[name]
    assert e.law and e.symptoms and e.source and e.parameters
    assert e.base or e.function.__doc__
    assert set(e.fitted) <= set(e.parameters) and bool(e.fitted) == (not e.disturbance)
    for other in e.confused_with:
        assert other in CATALOGUE or find_quantity(other)
        assert other not in CATALOGUE or name in CATALOGUE[other].confused_with, other
    assert all(name in CATALOGUE[other].excludes for other in e.excludes)
    assert e.firmware == (name == "command_rate_limit")


@pytest.mark.parametrize("name", CANONICAL)
def test_the_starts_of_each_are_values_that_it_allows(name: str) -> None:
    e, usual = CATALOGUE[name], load_nominal_values() | dict(CATALOGUE[name].off)
    assert len(e.starts) >= 2
    for start in e.starts:
        assert tuple(start) == e.fitted
        assert not any(e.parameters[parameter].refuses(value) for parameter, value in start.items())
        assert start != {parameter: usual[parameter] for parameter in start}
        assert e.is_active(start) or e.base
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
    assert (fast == columns(Model().replace(largest(name)), SHORT, seed=3, steps=FEW, fast=False)).all()


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
    levels = [np.sqrt(((a - b) ** 2).mean()) / noise for a, b, noise in (
        (with_it.xj, without.xj, 2e-6), (with_it.p12, without.p12, 2e4), (with_it.xs, without.xs, 1e-6))]
    assert max(levels) > 1.0


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


# steps a cycle where plain Python runs too
DEMAND = HEAD + '''
class Rounding(NamedTuple):
    """The firmware takes the demand in whole steps."""
    step: Annotated[float, Quantity("m", low=0, high=1e-2)] = 0.0

@effect("command", Rounding, law="Com in whole steps")
def rounding(x, s, u, p):
    size = p.rounding.step if p.rounding.step > 0.0 else 1.0
    return size * float(int(x / size)) if p.rounding.step > 0.0 else x
'''


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A place for an effect file."""
    return tmp_path / "mine.py"


def load_text(file: Path, text: str) -> list[str]:
    """Write an effect file and load it; the names of its effects."""
    return load_effects(write_file(file, text))


def test_the_users_effect_is_found_and_acts(file: Path) -> None:
    """A force periodic over a metre is a spring where the ram moves millimetres."""
    searched = COGGING.replace("law=", 'searched_in=("eha",), law=')
    assert load_text(file, searched) == ["cogging"] == [CATALOGUE.special.pop("cogging").name]
    assert load_text(file, COGGING) == ["cogging"]
    model = SILENT.replace({"cogging.force": 5e5 / (2.0 * np.pi), "cogging.length": 1.0})
    ours = columns(WHOLE.replace({"aero_stiffness.stiffness": 5e5}))
    assert np.abs(columns(model)[2] - ours[2]).max() < 5e-6  # the same physics, at the start of the step not its middle
    assert same_interpreted(model)
    assert (columns(Model().with_effects(["cogging"])) == columns(Model())).all()


def test_the_users_effect_with_memory(file: Path) -> None:
    assert load_text(file, MEMORY) == ["wear"] and CATALOGUE["wear"].parameters["wear.rate"].unit == "N/m"
    plant, places = Actuator(SILENT.replace({"wear.rate": 3e5}), fast=False, steps=FEW), [0.0]
    for current in 4e-3 * np.sin(np.arange(300) * 0.05):
        plant.advance(current)
        places.append(plant.state.jack_position)
    way = np.abs(np.diff(places)).sum()
    assert plant.memory.load.travelled == pytest.approx(way, rel=0.01) and way > 1e-3


@pytest.mark.parametrize(("text", "message"), [
    ("effect(", ":1: expected Python ("),
    ("import no_such_module", ":1: expected code that runs without an exception, not ModuleNotFoundError"),
    ("x = 1 / 0", "ZeroDivisionError"),
    ("x = 1", "at least one function marked with @effect"),
    (COGGING.replace('"load"', '"laod"'), "no port 'laod'"),
    (COGGING.replace('Quantity("N")] = 0.0', 'Quantity("N")]'), "effect cogging, force: expected a default, its off"),
    (COGGING.replace('Quantity("N")] = 0.0', 'Quantity(low=0)] = 0.0'), "effect cogging, force: expected Quantity(\"u"),
    (COGGING.replace("def cogging", "def null_bias"), "the name is taken"),
    (HEAD + "raise ValueError('two\\nlines')", "ValueError: two"),
])
def test_a_bad_file_is_refused_in_one_line(file: Path, text: str, message: str) -> None:
    assert "a Python file with effects" in catch_refusal(load_effects, file)  # there is none yet
    line = catch_refusal(load_text, file, text)
    assert message in line and str(file) in line


@pytest.mark.parametrize(("body", "port", "use"), [
    ("return x + p.cogging.farce", "load", partial(simulate, command=COMMAND)),
    ("return x + open('f')", "position", Actuator), ("return [x, 'text']", "load", partial(simulate, command=COMMAND))])
def test_a_law_that_cannot_run_is_refused(file: Path, body: str, port: str, use: Callable[[Model], object]) -> None:
    load_text(file, COGGING[:COGGING.index("    return x +")].replace("load", port) + f"    {body}\n")
    assert "cogging" in catch_refusal(use, Model().with_effects(["cogging"]))
    assert gc.isenabled()  # it is off while a law is compiled


@pytest.mark.parametrize(("text", "name", "sized"), [
    (COGGING, "cogging", "cogging.force"), (DEMAND, "rounding", "rounding.step")])
def test_an_effect_without_a_hint_starts_where_it_shows(file: Path, text: str, name: str, sized: str) -> None:
    """Nothing is said about how large it is: sizes are found that show 3, 30 and 300 times the noise."""
    load_text(file, text)
    starts = find_starts(CATALOGUE[name], PREFLIGHT)
    assert all(tuple(start) == CATALOGUE[name].fitted for start in starts)
    upwards = [start for start in starts if start[sized] > 0.0 and start.get("cogging.length", 1e-3) == 1e-3]
    levels = compute_levels(compute_changes(CATALOGUE[name], upwards, PREFLIGHT)).max(axis=1)
    assert levels == pytest.approx([3.0, 30.0, 300.0], rel=0.5)
    assert {start["cogging.length"] for start in starts} == {1e-3, 4e-4, 2.5e-3} if name == "cogging" else True


def test_a_shared_effect_starts_where_another_plant_shows_it() -> None:
    """Microamperes are a null bias of a servovalve and not of a motor; the EHA keeps its own sizes."""
    command = build_profile(find_plant("ema").profile).command
    before = CATALOGUE["constant_load"].starts
    effect = ensure_starts("constant_load", command, plant="ema")
    levels = compute_levels(compute_changes(effect, effect.starts, command, plant="ema"), "ema").max(axis=1)
    assert levels.min() > 1.0 and (levels < 10.0).any() and (levels > 100.0).any()
    assert {next(iter(start.values())) > 0.0 for start in effect.starts} == {True, False}
    assert ensure_starts("constant_load", command, plant="ema") is effect
    assert ensure_starts("constant_load", PREFLIGHT).starts == before


@pytest.mark.parametrize("name", ["moving_mass", "torque_gain"])
def test_an_effect_of_the_plants_own_parameters_starts_on_either_side_of_nominal(name: str) -> None:
    command, kind = build_profile(find_plant("ema").profile).command, find_plant("ema")
    effect = replace(kind.find_effect(name), starts=())
    nominal = kind.nominal[effect.fitted[0]]
    assert {start[effect.fitted[0]] > nominal for start in find_starts(effect, command, plant="ema")} == {True, False}


def test_a_hint_spares_the_search(file: Path) -> None:
    load_text(file, COGGING.replace('Quantity("N")', 'Quantity("N", low=0, typical="0.2-5 kN")')
              .replace("above=0)", 'above=0, typical="1-4 mm")'))
    starts = ensure_starts("cogging", PREFLIGHT).starts
    force, length = (sorted({start[f"cogging.{name}"] for start in starts}) for name in ("force", "length"))
    assert starts == CATALOGUE["cogging"].starts
    assert (force, length) == (pytest.approx([200.0, 1000.0, 5000.0]), pytest.approx([1e-3, 2e-3, 4e-3]))


def test_a_phase_starts_at_quarter_turns_and_an_angle_where_it_usually_is(file: Path) -> None:
    load_text(file, COGGING.replace('Quantity("N")', 'Quantity("N", low=0, typical="0.2-5 kN")').replace(
        "\n@effect", '    phase: Annotated[float, Quantity("rad")] = 0.0\n'
                      '    tilt: Annotated[float, Quantity("rad")] = 0.1\n\n@effect', 1).replace(
        "/ p.cogging.length", "/ p.cogging.length + p.cogging.phase + p.cogging.tilt"))
    starts = find_starts(CATALOGUE["cogging"], PREFLIGHT)
    phases, tilts = (sorted({start[f"cogging.{name}"] for start in starts}) for name in ("phase", "tilt"))
    assert phases == pytest.approx([quarter * 0.5 * np.pi for quarter in range(-1, 4)])  # for either range of a turn
    assert tilts == pytest.approx([0.04, 0.1, 0.25])


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_the_trial_of_an_unsound_effect(file: Path) -> None:
    text = COGGING.replace("return x +", "return (x + 1.0) * (1.0 + p.cogging.force) ** 400 +")
    load_text(file, text.replace('Quantity("N")', 'Quantity("N", low=0, high=1e3)').replace('"load"', '"position"'))
    off, *infinite = check_effect("cogging", COMMAND).faults
    assert off.startswith("at its off value it changes the plant")
    assert infinite and all("has no number any more" in fault for fault in infinite)


def test_the_trial_of_an_effect_that_does_not_show(file: Path) -> None:
    load_text(file, COGGING)
    report = check_effect("cogging", np.zeros(100))
    assert report.faults == ("no size of it changes anything on this command",) and not report.visible


def test_the_catalogue_is_told_for_machines() -> None:
    rows = {row["effect"]: row for row in answer("effects")["effects"]}
    assert set(rows) == {effect.name for effect in find_plant("eha").list_effects()}
    assert rows["coil_lag"]["confused_with"] == ["transport_delay", "sensor_lag"]
    assert rows["spool_overlap"]["excludes"] == ["spool_underlap"] and rows["spool_overlap"]["starts"]
    assert rows["command_rate_limit"]["in_firmware"] and "self_test" not in rows["command_rate_limit"]


def test_the_catalogue_of_a_users_plant_has_its_signals(tmp_path: Path) -> None:
    wheel, slide = files("plant").joinpath("models", "new_plant.py").read_text(), tmp_path / "slide.py"
    slide.write_text(wheel.replace('"rad"', '"m"').replace('"V/rad"', '"V/m"'))
    rows = {row["effect"]: row for row in answer("effects", "--model", slide)["effects"]}
    assert set(rows) == {"command_rate_limit", "dry_friction", "quantisation"}
    assert "theta = LSB" in rows["quantisation"]["law"] and "theta_c'" in rows["command_rate_limit"]["law"]
    assert "suits the plant" in refuse("effects", "null_bias", "--model", slide)
