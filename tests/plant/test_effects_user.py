"""A user's own effects: found, compiled, tried, given starts; and told in one line what is wrong with them."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from effect_files import COGGING, HEAD, MEMORY
from effects_cases import WHOLE
from physics_cases import PREFLIGHT, SILENT
from refusals import catch_refusal
from rig_command import answer, refuse

from plant import Actuator, InputError, Model, simulate
from plant.effects import CATALOGUE, load_effects
from plant.model import list_offered_effects
from plant.plants import find_plant
from plant.segments import build_profile
from plant.selftest import check_effect
from plant.starts import compute_changes, compute_levels, ensure_starts, find_starts

COMMAND = np.r_[np.zeros(10), np.full(150, 2e-3), 2e-3 + 1e-3 * np.sin(np.arange(250) * 0.02)]
FEW = 20  # steps a cycle where plain Python runs too
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


def columns(model: Model, **options) -> np.ndarray:
    return np.array(simulate(model, COMMAND, **options))


def same_interpreted(model: Model, cycles: int = 40) -> bool:
    short = COMMAND[:cycles]
    fast, slow = (np.array(simulate(model, short, seed=3, steps=FEW, fast=fast)) for fast in (True, False))
    return bool((fast == slow).all())


def test_the_users_effect_is_found_and_acts(file: Path) -> None:
    """A force periodic over a metre is a spring where the ram moves millimetres."""
    file.write_text(COGGING)
    assert load_effects(file) == ["cogging"]
    model = SILENT.replace({"cogging.force": 5e5 / (2.0 * np.pi), "cogging.length": 1.0})
    ours = columns(WHOLE.replace({"aero_stiffness.stiffness": 5e5}))
    assert np.abs(columns(model)[2] - ours[2]).max() < 5e-6  # the same physics, at the start of the step not its middle
    assert same_interpreted(model)
    assert (columns(Model().with_effects(["cogging"])) == columns(Model())).all()


def test_the_users_effect_with_memory(file: Path) -> None:
    file.write_text(MEMORY)
    assert load_effects(file) == ["wear"] and CATALOGUE["wear"].parameters["wear.rate"].unit == "N/m"
    plant, places = Actuator(SILENT.replace({"wear.rate": 3e5}), fast=False, steps=FEW), [0.0]
    for current in 4e-3 * np.sin(np.arange(300) * 0.05):
        plant.advance(current)
        places.append(plant.state.jack_position)
    way = np.abs(np.diff(places)).sum()
    assert plant.memory.load.travelled == pytest.approx(way, rel=0.01) and way > 1e-3


@pytest.mark.parametrize(("text", "said"), [
    ("effect(", ":1: expected Python ("),
    ("import no_such_module", ":1: expected code that runs without an exception, not ModuleNotFoundError"),
    ("x = 1 / 0", "ZeroDivisionError"),
    ("x = 1", "at least one function marked with @effect"),
    (COGGING.replace('"load"', '"laod"'), "no port 'laod'"),
    (COGGING.replace('Quantity("N")] = 0.0', 'Quantity("N")]'), "needs a default"),
    (COGGING.replace("def cogging", "def null_bias"), "the name is taken"),
    (HEAD + "raise ValueError('two\\nlines')", "ValueError: two"),
])
def test_a_bad_file_is_refused_in_one_line(file: Path, text: str, said: str) -> None:
    assert "a Python file with effects" in catch_refusal(load_effects, file)  # there is none yet
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        load_effects(file)
    assert said in str(caught.value) and str(file) in str(caught.value)


@pytest.mark.parametrize(("body", "port", "use"), [
    ("return x + p.cogging.farce", "load", partial(simulate, command=COMMAND)),
    ("return x + open('f')", "position", Actuator), ("return [x, 'text']", "load", partial(simulate, command=COMMAND))])
def test_a_law_that_cannot_run_is_refused(file: Path, body: str, port: str, use: Callable[[Model], object]) -> None:
    start = COGGING.index("    return x +")
    file.write_text(COGGING[:start].replace("load", port) + f"    {body}\n")
    load_effects(file)
    assert "cogging" in catch_refusal(use, Model().with_effects(["cogging"]))


@pytest.mark.parametrize(("text", "name", "sized"), [
    (COGGING, "cogging", "cogging.force"), (DEMAND, "rounding", "rounding.step")])
def test_an_effect_without_a_hint_starts_where_it_shows(file: Path, text: str, name: str, sized: str) -> None:
    """Nothing is said about how large it is: sizes are found that show 3, 30 and 300 times the noise."""
    file.write_text(text)
    load_effects(file)
    starts = find_starts(CATALOGUE[name], PREFLIGHT)
    assert all(tuple(start) == CATALOGUE[name].fitted for start in starts)
    upwards = [start for start in starts if start[sized] > 0.0 and start.get("cogging.length", 1e-3) == 1e-3]
    shown = compute_levels(compute_changes(CATALOGUE[name], upwards, PREFLIGHT)).max(axis=1)
    assert shown == pytest.approx([3.0, 30.0, 300.0], rel=0.5)
    assert {start["cogging.length"] for start in starts} == {1e-3, 4e-4, 2.5e-3} if name == "cogging" else True


def test_a_shared_effect_starts_where_another_plant_shows_it() -> None:
    """Microamperes are a null bias of a servovalve and not of a motor; the EHA keeps its own sizes."""
    command = build_profile(find_plant("ema").profile).command
    before = CATALOGUE["constant_load"].starts
    found = ensure_starts("constant_load", command, plant="ema")
    shown = compute_levels(compute_changes(found, found.starts, command, plant="ema"), "ema").max(axis=1)
    assert shown.min() > 1.0 and (shown < 10.0).any() and (shown > 100.0).any()
    assert {next(iter(start.values())) > 0.0 for start in found.starts} == {True, False}
    assert ensure_starts("constant_load", command, plant="ema") is found
    assert ensure_starts("constant_load", PREFLIGHT).starts == before


@pytest.mark.parametrize("name", ["moving_mass", "torque_gain"])
def test_an_effect_of_the_plants_own_parameters_starts_on_either_side_of_nominal(name: str) -> None:
    command, kind = build_profile(find_plant("ema").profile).command, find_plant("ema")
    effect = replace(kind.find_effect(name), starts=())
    nominal = kind.nominal[effect.fitted[0]]
    assert {start[effect.fitted[0]] > nominal for start in find_starts(effect, command, plant="ema")} == {True, False}


def test_a_hint_spares_the_search(file: Path) -> None:
    file.write_text(COGGING.replace('Quantity("N")', 'Quantity("N", low=0, typical="0.2-5 kN")')
                    .replace("above=0)", 'above=0, typical="1-4 mm")'))
    load_effects(file)
    starts = ensure_starts("cogging", PREFLIGHT).starts
    force, length = (sorted({start[f"cogging.{name}"] for start in starts}) for name in ("force", "length"))
    assert starts == CATALOGUE["cogging"].starts
    assert (force, length) == (pytest.approx([200.0, 1000.0, 5000.0]), pytest.approx([1e-3, 2e-3, 4e-3]))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_the_trial_of_an_unsound_effect(file: Path) -> None:
    text = COGGING.replace("return x +", "return (x + 1.0) * (1.0 + p.cogging.force) ** 400 +")
    file.write_text(text.replace('Quantity("N")', 'Quantity("N", low=0, high=1e3)').replace('"load"', '"position"'))
    load_effects(file)
    off, *infinite = check_effect("cogging", COMMAND).faults
    assert off == "at its off value it changes the plant"
    assert infinite and all("has no number any more" in fault for fault in infinite)


def test_the_trial_of_an_effect_that_does_not_show(file: Path) -> None:
    file.write_text(COGGING)
    load_effects(file)
    found = check_effect("cogging", np.zeros(100))
    assert found.faults == ("no size of it changes anything on this command",) and not found.visible


def test_the_catalogue_is_told_for_machines() -> None:
    rows = {row["effect"]: row for row in answer("effects")["effects"]}
    assert set(rows) == {effect.name for effect in list_offered_effects()}
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
