"""Faults as data: the shipped lists, bad files in one line, levels of faults that fall or go both ways, groups."""

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from places import ROOT
from refusals import catch_refusal
from rig_command import refuse, rig

from fdi.diagnosis.ambiguity import cut_intervals, find_groups
from fdi.diagnosis.diagnosis import diagnose
from fdi.diagnosis.faults import (
    CLOGGING,
    FAULTS,
    FRICTION,
    Estimate,
    Level,
    choose_faults,
    classify_size,
    compute_severity,
    judge_size,
    list_fault_files,
    load_faults,
)
from fdi.diagnosis.refine import (
    list_unknowns,
)
from fdi.estimation.fit import Free
from plant.faults import Fault, place_fault
from plant.model import load_model
from plant.plants import find_plant
from rig.campaign.judge import build_matrix, simulate_case

GAP = {"title": "play", "parameter": "feedback_gap.gap", "range": [0.0, 5e-4], "acceptable": 4e-5, "maintenance": 9e-5}
EHA = find_plant("eha")


def write(path: Path, **keys: Any) -> Path:
    """A fault file with one fault: GAP with other keys; None leaves one out."""
    table = {key: value for key, value in {**GAP, **keys}.items() if value is not None}
    lines = [f"{key} = {json.dumps(value).replace(': ', ' = ')}" for key, value in table.items()]
    path.write_text("\n".join(["[faults.play]", *lines]) + "\n")
    return path


def test_the_papers_faults_are_a_file_with_the_limits_of_table_2() -> None:
    assert list_fault_files() == ["paper", "wider"] and load_faults() == FAULTS
    assert [(f.name, f.symbol, f.unit, *f.limits) for f in FAULTS] == [
        ("filter_clogging", "Kintas", "1", 0.0, 0.25, 0.35), ("spool_friction", "FSS", "N", 5.0, 35.0, 70.0)]
    assert FRICTION.list_changes(45.0) == {"spool.static_friction": 45.0, "spool.dynamic_friction": pytest.approx(30.0)}
    wider = load_faults("wider")
    assert len(wider) == 11 and set(FAULTS) <= set(wider) and all(f.source and f.title for f in wider)


@pytest.mark.parametrize(("keys", "words"), [
    ({"parameter": "no.such"}, ["parameter", "plant eha"]),
    ({"parameter": "feedback_gap.width"}, ["parameter", "(gap)"]),
    ({"acceptable": 2e-4, "maintenance": 1e-4}, ["acceptable", "between"]),
    ({"maintenance": 1.0}, ["maintenance", "within the range"]),
    ({"acceptable": -1.0}, ["acceptable", "within the range"]),
    ({"range": [1e-5, 5e-4]}, ["range", "healthy size"]),
    ({"range": [-1.0, 1.0]}, ["range", "from 0 to 1 m"]),
    ({"range": [1.0]}, ["range", "[a number, a number]"]),
    ({"unit": "mm"}, ["unit", "m, that of feedback_gap.gap"]),
    ({"mantenance": 1.0}, ["mantenance", "did you mean 'maintenance'?"]),
    ({"title": None}, ["also the key 'title'"]),
    ({"acceptable": "much"}, ["acceptable", "a number"]),
    ({"follow": ["jack.mass"]}, ["follow", "table of factors"]),
    ({"follow": {"no.such": 1.0}}, ["follow", "plant eha"]),
    ({"follow": {"jack.mass": -1.0}}, ["follow", "values of jack.mass", "not -1"]),
    ({"axis": [1e-4, 0.0]}, ["axis", "within the range"]), ({"axis": [0.0, 1e-3]}, ["axis", "within the range"]),
    ({"parameter": "controller.current_limit"}, ["parameter", "a replay of the measured drive shows"]),
    ({"parameter": "quantisation.lsb"}, ["parameter", "a replay of the measured drive shows"]),
    ({"both_ways": 1}, ["both_ways", "true or false"])])
def test_a_bad_fault_is_one_line_with_status_2(tmp_path: Path, keys: dict[str, Any], words: list[str]) -> None:
    file = write(tmp_path / "bad.toml", **keys)
    text = catch_refusal(load_faults, file)
    assert "\n" not in text and all(word in text for word in ("bad.toml", "faults.play", *words)), text


def test_bad_files_and_lists(tmp_path: Path) -> None:
    for content, word in (("", "at least one table"), ("[faults]\n", "at least one table"), ("x = 1\n", "only tables"),
                          ("[faults.a]\n", "also the key 'title'"), ("[faults\n", "TOML")):
        (tmp_path / "bad.toml").write_text(content)
        assert word in catch_refusal(load_faults, tmp_path / "bad.toml")
    write(tmp_path / "two.toml").open("a").write((tmp_path / "two.toml").read_text().replace("play]", "other]"))
    assert "of its own" in catch_refusal(load_faults, tmp_path / "two.toml")
    assert "a fault file" in catch_refusal(choose_faults, None, find_plant("ehs"))
    for words in (["fdi", "x.csv", "--faults", "none"], ["check", str(tmp_path / "bad.toml")]):
        assert rig(*words).status == 2


def test_a_new_fault_passes_its_own_checks_and_is_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert rig("new", "fault", "my_gap", "--json").json["verdict"] == "COMPLETE"
    assert rig("list", "faults", "--faults", "my_gap.toml", "--json").json["faults"][0]["maintenance"] == 3.178
    assert rig("check", "my_gap.toml").status == 0


DRIFT = place_fault(Fault("drift", "", "sensor_gain.error", (-0.5, 0.5), 0.1, 0.2, both_ways=True), EHA)
WEAK = place_fault(Fault("weak", "", "torque_motor.gain", (0.5, 3.0), 1.8, 1.4), EHA)


@pytest.mark.parametrize(("fault", "size", "level"), [
    (DRIFT, Estimate(-0.15, -0.18, -0.12), Level.MAINTENANCE), (DRIFT, Estimate(0.0, -0.05, 0.05), Level.ACCEPTABLE),
    (DRIFT, Estimate(0.09, -0.05, 0.2), None), (DRIFT, Estimate(-0.25, -0.28, -0.22), Level.NON_NOMINAL),
    (WEAK, Estimate(2.2, 2.1, 2.3), Level.ACCEPTABLE), (WEAK, Estimate(1.6, 1.5, 1.7), Level.MAINTENANCE),
    (WEAK, Estimate(1.3, 1.2, 1.35), Level.NON_NOMINAL), (WEAK, Estimate(2.0, 1.7, 2.3), None)])
def test_levels_of_faults_that_fall_or_go_both_ways(fault: Fault, size: Estimate, level: Level | None) -> None:
    assert judge_size(fault, size) == level
    assert classify_size(fault, fault.healthy) == Level.ACCEPTABLE and compute_severity(fault, fault.healthy) == 0.0
    ends = [fault.place_size(departure) for departure in fault.limits[1:]]
    assert [compute_severity(fault, end) for end in ends] == pytest.approx([1.0, 2.0])
    assert fault.turn_up().limits == pytest.approx(fault.limits)


def test_a_size_that_one_of_many_tests_finds_by_chance_is_no_fault() -> None:
    by_chance = Estimate(-0.062, -0.101, -0.023)  # 3.1 standard deviations
    assert judge_size(DRIFT, by_chance) == Level.MAINTENANCE and judge_size(DRIFT, by_chance, tested=11) is None
    assert judge_size(DRIFT, Estimate(-0.1, -0.14, -0.06), tested=11) == Level.MAINTENANCE


def pair(x: float, total: float, each: float) -> Any:
    """A posterior of two linear sizes: their sum is known to `total` s.d., their difference to `each`."""
    first = replace(CLOGGING, name="a", parameter="one.size", range=(0.0, 1.0))
    second = replace(CLOGGING, name="b", parameter="two.size", range=(0.0, 1.0))
    free = tuple(Free(f.parameter, 0.0, 1.0, 10.0, 0.0, 1.0, 0.02) for f in (first, second))
    same, apart = np.ones((2, 2)) / 2, np.array([[1.0, -1.0], [-1.0, 1.0]]) / 2
    fit = SimpleNamespace(free=free, x=np.array([x, x]), covariance=total**2 * same + each**2 * apart)
    return SimpleNamespace(faults=(first, second), fit=fit)


@pytest.mark.parametrize(("x", "total", "grouped"), [(0.0, 0.02, False), (0.2, 0.02, True), (0.35, 0.02, True),
                                                     (0.35, 0.5, False)])
def test_faults_that_only_show_as_a_sum_are_a_group(x: float, total: float, grouped: bool) -> None:
    """Each may be absent, but not both: then the sum would be 0."""
    found = pair(x, total, 5.0)
    wide = {name: Estimate(x, 0.0, 1.0) for name in "ab"}
    cut = cut_intervals(found, ["a", "b"], wide)
    assert find_groups(found, dict.fromkeys("ab")) == (("a", "b"),) * grouped
    if x == 0.0:  # neither can be less than nothing, so neither can be much
        assert all(size.high < 0.08 for size in cut.values())
    if x == 0.35:
        assert all(size.low == 0.0 for size in cut.values())


def test_a_healthy_unit_within_its_tolerances_is_in_no_group() -> None:
    found = pair(0.215, 0.01, 5.0)
    found.faults = tuple(replace(fault, healthy=0.2) for fault in found.faults)
    levels = dict.fromkeys("ab")
    assert find_groups(found, levels) and find_groups(found, levels, {"one.size": 0.001})
    assert not find_groups(found, levels, {"one.size": 0.015, "two.size": 0.015})


def test_a_range_that_begins_at_the_nominal_size_holds_every_healthy_unit() -> None:
    """Else the fit of a unit at the low end of its tolerance leaves more than noise, and no fault explains it."""
    kind = find_plant("ema")
    declared, placed = kind.faults[0], choose_faults(None, kind)[0]
    assert declared.range[0] == placed.healthy > placed.range[0] and declared.range[1] == placed.range[1]


def test_a_fault_may_be_an_effect_without_starts() -> None:
    """Of a phase beside its size nothing is known then, so the size alone is free."""
    model = load_model(str(ROOT / "plant" / "models" / "new_plant.py"))
    fault = place_fault(Fault("drag", "drag", "dry_friction.torque", (0.0, 5.0), 0.5, 1.0, "ours"), model.kind)
    assert list_unknowns(model.with_effects(["dry_friction"]), [fault])[0].name == "dry_friction.torque"


def test_backlash_is_measured_although_rows_hang_on_its_impacts() -> None:
    model = load_model("ema")
    faults = [fault for fault in choose_faults(None, model.kind) if fault.name == "backlash"]
    drawn = build_matrix({"case": [{"backlash": 8e-5}], "seeds": 1}, model, "", "test", faults)
    found = diagnose(simulate_case(drawn.cases[0], drawn.spec, model), model, faults=faults)
    assert found.verdict == "MAINTENANCE" and found.ruling == "backlash"
    assert found.sizes["backlash"].low < 8e-5 < found.sizes["backlash"].high


def test_a_plant_and_faults_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`rig fdi`, `rig campaign` and `rig trend` with both; bands and maps speak of this plant and of no other."""
    monkeypatch.chdir(tmp_path)
    assert rig("new", "plant", "new_plant").status == 0
    Path("faults.toml").write_text("""
[faults.bearing]
title = "friction of the bearings"
parameter = "dry_friction.torque"
range = [0, 20]
acceptable = 0.3
maintenance = 0.8

[faults.winding]
title = "rise of the winding's resistance"
parameter = "motor.resistance"
range = [2, 4]
acceptable = 2.3
maintenance = 3.5

[faults.magnet]
title = "weak magnets"
parameter = "motor.torque_constant"
range = [0.02, 0.05]
acceptable = 0.045
maintenance = 0.04
""")
    own = ["--model", "new_plant.py", "--trust", "--faults", "faults.toml"]
    Path("unit").mkdir()
    run = "unit/2026-03-01.csv"
    rig("simulate", *own[:3], "--set", "dry_friction.torque=1.2", "--seed", "3", "--out", run)
    made = rig("fdi", "--learn-bands", *own, "--out", "bands.toml", "--json").json
    assert made["judges"] == ["bearing"]
    found = rig("fdi", run, *own, "--bands", "bands.toml", "--out", "page.html", "--json").json
    assert (found["ruling"], found["bands"]["ruling"]) == ("bearing", "bearing")
    assert found["events"] and {event["section"] for event in found["events"]} == {"step to 0.5 rad"}
    assert [set(grid["faults"]) for grid in found["grids"]] and "bearing" in found["grids"][0]["faults"]
    said = re.sub("<[^>]*>", " ", Path("page.html").read_text())
    assert not re.search(r"\b(ram|jack|spool|valve|servo|XJ|XS|Kintas|FSS)\b", said)
    assert "--bands: of bearing" in refuse("fdi", run, *own[:3], "--bands", "bands.toml")
    trend = rig("trend", "unit", *own, "--json").json
    assert [fault["name"] for fault in trend["faults"]] == ["bearing", "winding", "magnet"]
    cases = ["--fault", "bearing=1", "--seeds", "1", "--jobs", "1", "--out", "campaign"]
    counted = rig("campaign", *own, *cases, "--json").json
    assert counted["status"] == {"ok": 1} and counted["faults"] == trend["faults"]
