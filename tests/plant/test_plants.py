"""Every plant, shipped or a user's: one suite over what it declares; and what is wrong in a plant file, in one line."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from physics_cases import PREFLIGHT
from places import ROOT
from refusals import catch_refusal
from rig_command import rig

from plant import Model, load_model, simulate
from plant.lanes import Lanes
from plant.plant_check import check_behaviour
from plant.plants import list_plants, load_plant
from plant.segments import build_profile

EXAMPLE = ROOT / "plant" / "models" / "new_plant.py"  # copies with its name share its compiled code
TEXT = EXAMPLE.read_text()
ROWS = 300


def list_models() -> Iterator[str]:
    yield from (*list_plants(), str(EXAMPLE))


@pytest.fixture(params=list_models(), ids=lambda name: Path(name).stem)
def model(request: pytest.FixtureRequest) -> Model:
    return load_model(request.param)


def find_command(model: Model) -> np.ndarray:
    """The most lively rows of its nominal test, of a plant without one those of preflight."""
    profile = model.kind.profile
    whole = build_profile(profile).command if profile else PREFLIGHT
    middle = int(np.abs(np.diff(whole)).argmax())
    return np.ascontiguousarray(whole[max(middle - 5, 0):][:ROWS])


def silence(model: Model) -> Model:
    return model.replace({s.noise: 0.0 for s in model.kind.signals.outputs if s.noise})


def test_runs_are_finite_and_repeatable_and_those_of_plain_python(model: Model) -> None:
    com = find_command(model)
    once, again, plain = (simulate(model, com, seed=2, steps=20, fast=fast) for fast in (True, True, False))
    assert once._fields == tuple(s.name for s in model.kind.signals)
    assert np.isfinite(once).all() and np.ptp(getattr(once, model.kind.signals.controlled.name)) > 0.0
    assert np.array_equal(once, again) and np.array_equal(once, plain)


def test_lanes_are_single_runs(model: Model) -> None:
    quiet, com = silence(model), find_command(model)
    run = simulate(quiet, com, steps=20)
    whole = np.column_stack([getattr(run, s.name) for s in quiet.kind.signals.columns])
    out = Lanes(quiet, ()).closed_loop(np.empty((3, 0)), com, np.zeros(len(com)))
    assert all(np.array_equal(lane, whole) for lane in out)
    drive = getattr(run, quiet.kind.signals.drive.name)
    replayed = Lanes(quiet, ()).replay(np.empty((1, 0)), drive, np.zeros(len(com)))[0]
    outputs = np.column_stack([getattr(run, s.name) for s in quiet.kind.signals.outputs])
    assert np.array_equal(replayed, outputs) or model.effects  # an effect on a reading acts on the controller too


def test_effects_at_their_off_values_change_nothing(model: Model) -> None:
    every = model.with_effects(e.name for e in model.kind.list_effects())
    com = find_command(model)[:40]
    assert np.array_equal(*(simulate(m, com, seed=1, steps=20, fast=False) for m in (model, every)))


def test_a_model_file_of_a_users_plant_is_the_same_model_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(TEXT)
    model = load_model("mine.py").replace({"dry_friction.torque": 0.3, "motor.resistance": 2.5})
    (tmp_path / "unit.toml").write_text(model.to_toml())
    again = load_model(tmp_path / "unit.toml")
    assert (again.values, again.effects, again.kind) == (model.values, model.effects, model.kind)
    (tmp_path / "mine.py").write_text(TEXT.replace("= 2.0\n", "= 4.0\n", 1))
    assert load_model("mine.py")["motor.resistance"] == 4.0  # another file under the same name is another plant


def test_a_model_file_runs_its_plant_only_with_trust(tmp_path: Path) -> None:
    (tmp_path / "new_plant.py").write_text(TEXT)
    (tmp_path / "unit.toml").write_text('plant = "new_plant.py"\n[motor]\nresistance = 3.0\n')
    words = ("simulate", "--model", tmp_path / "unit.toml", "--out", tmp_path / "s.csv")
    refused = rig(*words)
    assert refused.status == 2 and "--trust" in refused.err and not (tmp_path / "s.csv").exists()
    assert rig(*words, "--trust").status == 0
    assert (tmp_path / "s.csv").read_text().startswith("t,demand,voltage,angle,current,torque\n")


def test_the_written_example_passes_its_checks(tmp_path: Path) -> None:
    file = tmp_path / "new_plant.py"
    assert rig("new", "plant", "new_plant", "--out", file).status == 0
    said = rig("check", file, "--json")
    assert said.status == 0 and said.json["verdict"] == "SOUND" and len(said.json["checks"]) == 7
    assert rig("new", "plant", "new_plant", "--out", file).status == 2  # it replaces nothing


def test_its_own_effect_may_have_the_name_of_a_shared_one(tmp_path: Path) -> None:
    file = tmp_path / "own.py"
    file.write_text(TEXT.replace("dry_friction", "stribeck"))
    own = load_model(file)
    assert own.find_effect("stribeck").parameters.keys() == {"stribeck.torque"}
    assert own.replace({"stribeck.torque": 0.4}).effects == ("stribeck",)
    assert load_model("eha").find_effect("stribeck").parameters.keys() == {"stribeck.rise", "stribeck.speed"}


@pytest.mark.parametrize(("old", "new", "message"), [
    ('Quantity("ohm", "R", low=0.01, high=100, tolerance=0.05)', 'Quantity("")', "motor.resistance.*unit"),
    ("resistance: Annotated[float, Quantity(\"ohm\", \"R\", low=0.01, high=100, tolerance=0.05)] = 2.0",
     "resistance: float = 2.0", "motor.*Annotated"),
    ("tolerance=0.05)] = 2.0", "tolerance=0.05)]", "motor.resistance.*nominal value"),
    ("tolerance=0.05)] = 2.0", "tolerance=0.05)] = 2000.0", "motor.resistance.*to 100 ohm"),
    ("tolerance=0.05)] = 2.0", 'tolerance=0.05)] = "2"', "motor.resistance.*nominal value"),
    ('Signal("angle", "theta", "rad"', 'Signal("angle", "theta", ""', "signal angle.*unit"),
    ("return s.angle, s.current", "return (s.angle,)", "measure.*2 numbers, angle, current"),
    ("return s.angle, s.current", "return s.angle, s.amps", r"\.py:\d+: measure.*amps"),
    ('@effect("friction"', '@effect("fricton"', "effect dry_friction.*voltage, load, friction"),
    ('"motor.resistance", (2.0', '"motor.resistence", (2.0', "fault winding.*motor.resistance"),
    ("moves=(\"angle\",)", "moves=(\"angel\",)", "moves.*angle"),
    ("moves=(\"angle\",)", "moves=lambda s, d, p: State(s.current, s.speed, s.angle - d)",
     "moves.*angle.* rad, not by -1"),
    ("x + p.dry_friction.torque", "x + p.friction.torque", "effect dry_friction.*p.dry_friction.FIELD.*not p.friction"),
    ('"drive"),', '"output"),', "expected one signal of role drive"),
    ("period: Annotated", "cycle: Annotated", "controller.*period|period"),
    ("return State(current, speed", "return Stat(current, speed", r"\.py:\d+.*Stat"),
    ("def control(", "def control(x, ", "control.*4 arguments"),
    ("def step(", "def step((", r"\.py:\d+.*Python"),
    ("PLANT = Plant(", "PLAN = Plant(", "PLANT"),
    ("Step(to=0.5, time=0.9)", "0.5", "profile.*segments"),
])
def test_a_wrong_plant_file_is_refused_in_one_line(old: str, new: str, message: str, tmp_path: Path) -> None:
    assert old in TEXT
    file = tmp_path / "wrong.py"
    file.write_text(TEXT.replace(old, new, 1))
    said = catch_refusal(load_plant, file)
    assert re.search(message, said) and "\n" not in said and str(file) in said


def test_the_signal_may_be_in_another_unit_than_the_state_that_moves(tmp_path: Path) -> None:
    file = tmp_path / "degrees.py"
    file.write_text(TEXT.replace("return s.angle, s", "return 50.0 * s.angle, s"))
    kind = load_plant(file)
    assert kind.find_share_moved(kind.move) == pytest.approx(1.0)


def test_fields_that_do_not_move_along_fail_the_check(tmp_path: Path) -> None:
    """A motor's angle and the angle of the wheel behind a stiff shaft, moved by the same angle in spite of the gear."""
    file = tmp_path / "shaft.py"
    file.write_text(TEXT.replace("    angle: float = 0.0", "    angle: float = 0.0\n    motor: float = 0.0").replace(
        "- load)", "- load - 2e3 * (s.angle - s.motor / ratio))").replace(
        "(s.speed + speed))", "(s.speed + speed), s.motor + h * ratio * speed)").replace(
        '("angle",)', '("angle", "motor")'))
    moves = next(found for found in check_behaviour(load_model(file)) if found.check == "moves")
    assert not moves.passed


def test_a_stiff_plant_without_tolerances_is_explained(tmp_path: Path) -> None:
    """An explicit current diverges in ten steps a cycle, with which the search begins; and no unit is off nominal."""
    text = re.sub(r", tolerance=[\d.]+", "", TEXT).replace("] = 2e-3", "] = 6e-5").replace(
        "* s.speed)) / (inductance + h * p.motor.resistance)",
        "* s.speed - p.motor.resistance * s.current)) / inductance")
    file, run = tmp_path / "stiff.py", tmp_path / "run.csv"
    file.write_text(text)
    rig("simulate", "--model", file, "--set", "dry_friction.torque=0.4", "--out", run)
    found = rig("explain", run, "--model", file, "--json").json
    assert (found["verdict"], found["effects"]) == ("EXPLAINED", ["dry_friction"])


def test_a_plant_that_diverges_is_refused_with_signal_and_time(tmp_path: Path) -> None:
    file = tmp_path / "unstable.py"
    file.write_text(TEXT.replace("current - load", "current - load + 1e5 * s.speed * abs(s.speed)"))
    said = rig("simulate", "--model", file, "--out", tmp_path / "s.csv")
    assert said.status == 2 and re.search(r"angle|current|voltage", said.err) and "t = 0.0" in said.err
    assert not (tmp_path / "s.csv").exists()
    (first,) = (f for f in check_behaviour(load_model(file)))
    assert not first.passed and "t = 0.1" in first.text


@pytest.mark.parametrize("plant", ["eha", pytest.param("ema", marks=pytest.mark.slow), "mine.py"])
@pytest.mark.parametrize(("kind", "check"), [("sequence", ["check", "my_new.toml"]),
                                             ("fault", ["check", "my_new.toml"]),
                                             ("effect", ["effects", "--effects", "my_new.py", "my_new"])])
def test_a_new_file_passes_its_own_check(kind: str, check: list[str], plant: str, tmp_path: Path,
                                         monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(TEXT)
    assert rig("new", kind, "my_new", "--model", plant, "--json").json["verdict"] == "COMPLETE"
    said = rig(*check, "--model", plant, "--json")
    assert said.status == 0 and "are of a bench" in rig("new", kind, "other", "--node", "3").err
    if kind == "effect":
        trial = said.json["effects"][0]["self_test"]
        assert trial["faults"] == [] and trial["visible"]
        assert {"start", "level", *(s.name for s in load_model(plant).kind.signals.outputs)} == set(trial["shown"][0])
