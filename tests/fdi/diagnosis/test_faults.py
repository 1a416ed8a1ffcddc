"""Faults as data: lists, bad files, levels, groups; bands and precursors: what leaves them, limits, files, the page."""

import json
import math
import re
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from noisy_traces import SHORT as RAMP_AND_SINE, record_plant
from physics_cases import PREFLIGHT
from places import ROOT
from refusals import catch_refusal
from rig_command import answer, refuse, rig, write_file
from short_runs import simulate_trace

from fdi.diagnosis import make_bands
from fdi.diagnosis.ambiguity import cut_intervals, find_groups
from fdi.diagnosis.bands import (
    Bands,
    BandVerdict,
    describe_other_model,
    format_bands,
    judge_position,
    judge_trace,
    list_design,
    load_bands,
    load_default_bands,
    matches_command,
    parse_bands,
)
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
from fdi.diagnosis.make_bands import choose_bands, learn_bands, make_bands_by_simulation, simulate_units
from fdi.diagnosis.precursors import compute_features, format_precursor, measure_precursors
from fdi.diagnosis.refine import list_unknowns
from fdi.estimation import Free
from fdi.thresholds import BAND_EVENT_SAMPLES
from fdi.trace import Section, Trace, find_sections
from plant import Fault, Hold, Model, build_profile as profile, find_plant, load_model
from plant.faults import place_fault
from plant.segments import Ramp, Step
from rig.campaign.judge import build_matrix, simulate_case

GAP = {"title": "play", "parameter": "feedback_gap.width", "range": [0.0, 5e-4], "acceptable": 4e-5,
       "maintenance": 9e-5}
EHA = find_plant("eha")


def write(path: Path, **keys: Any) -> Path:
    """A fault file with one fault: GAP with other keys; None leaves one out."""
    table = {key: value for key, value in {**GAP, **keys}.items() if value is not None}
    lines = [f"{key} = {json.dumps(value).replace(': ', ' = ')}" for key, value in table.items()]
    return write_file(path, "\n".join(["[faults.play]", *lines]) + "\n")


def test_the_papers_faults_are_a_file_with_the_limits_of_table_2() -> None:
    assert list_fault_files() == ["paper", "wider"] and load_faults() == FAULTS
    assert [(f.name, f.symbol, f.unit, *f.limits) for f in FAULTS] == [
        ("filter_clogging", "Kintas", "1", 0.0, 0.25, 0.35), ("spool_friction", "FSS", "N", 5.0, 35.0, 70.0)]
    assert FRICTION.list_changes(45.0) == {"spool.static_friction": 45.0, "spool.dynamic_friction": pytest.approx(30.0)}
    wider = load_faults("wider")
    assert len(wider) == 11 and set(FAULTS) <= set(wider) and all(f.source and f.title for f in wider)


@pytest.mark.parametrize(("keys", "words"), [
    ({"parameter": "no.such"}, ["parameter", "plant eha"]),
    ({"parameter": "feedback_gap.length"}, ["parameter", "(width)"]),
    ({"acceptable": 2e-4, "maintenance": 1e-4}, ["acceptable", "between"]),
    ({"maintenance": 1.0}, ["maintenance", "within the range"]),
    ({"acceptable": -1.0}, ["acceptable", "within the range"]),
    ({"range": [1e-5, 5e-4]}, ["range", "healthy size"]),
    ({"range": [-1.0, 1.0]}, ["range", "from 0 to 1 m"]),
    ({"range": [1.0]}, ["range", "[a number, a number]"]),
    ({"unit": "mm"}, ["unit", "m, that of feedback_gap.width"]),
    ({"mantenance": 1.0}, ["mantenance", "did you mean 'maintenance'?"]),
    ({"title": None}, ["also the key 'title'"]),
    ({"acceptable": "much"}, ["acceptable", "a number"]),
    ({"follow": ["jack.mass"]}, ["follow", "table of factors"]),
    ({"follow": {"no.such": 1.0}}, ["follow", "plant eha"]),
    ({"follow": {"jack.mass": -1.0}}, ["follow", "values of jack.mass", "not -1"]),
    ({"axis": [1e-4, 0.0]}, ["axis", "within the range"]), ({"axis": [0.0, 1e-3]}, ["axis", "within the range"]),
    ({"parameter": "controller.current_limit"}, ["parameter", "a replay of the measured drive shows"]),
    ({"parameter": "filter.law"}, ["parameter", "filter.law has named choices"]),
    ({"parameter": "quantisation.lsb"}, ["parameter", "a replay of the measured drive shows"]),
    ({"both_ways": 1}, ["both_ways", "true or false"])])
def test_a_bad_fault_is_one_line_with_status_2(tmp_path: Path, keys: dict[str, Any], words: list[str]) -> None:
    text = catch_refusal(load_faults, write(tmp_path / "bad.toml", **keys))
    assert all(word in text for word in ("bad.toml", "faults.play", *words)), text


def test_bad_files_and_lists(tmp_path: Path) -> None:
    for content, word in (("", "at least one table"), ("[faults]\n", "at least one table"), ("x = 1\n", "only tables"),
                          ("[faults.a]\n", "also the key 'title'"), ("[faults\n", "TOML")):
        assert word in catch_refusal(load_faults, write_file(tmp_path / "bad.toml", content))
    write(tmp_path / "two.toml").open("a").write((tmp_path / "two.toml").read_text().replace("play]", "other]"))
    assert "of its own" in catch_refusal(load_faults, tmp_path / "two.toml")
    assert "a fault file" in catch_refusal(choose_faults, None, find_plant("ehs"))
    for words in (["fdi", "x.csv", "--faults", "none"], ["check", str(tmp_path / "bad.toml")]):
        assert rig(*words).status == 2


def test_a_new_fault_passes_its_own_checks_and_is_listed(here: Path) -> None:
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


@pytest.mark.parametrize(("x", "total", "is_group"), [(0.0, 0.02, False), (0.2, 0.02, True), (0.35, 0.02, True),
                                                      (0.35, 0.5, False)])
def test_faults_that_only_show_as_a_sum_are_a_group(x: float, total: float, is_group: bool) -> None:
    """Each may be absent, but not both: then the sum would be 0."""
    refinement = pair(x, total, 5.0)
    cut = cut_intervals(refinement, ["a", "b"], {name: Estimate(x, 0.0, 1.0) for name in "ab"})
    assert find_groups(refinement, dict.fromkeys("ab")) == (("a", "b"),) * is_group
    if x == 0.0:  # neither can be less than nothing, so neither can be much
        assert all(size.high < 0.08 for size in cut.values())
    if x == 0.35:
        assert all(size.low == 0.0 for size in cut.values())


def test_a_healthy_unit_within_its_tolerances_is_in_no_group() -> None:
    refinement = pair(0.215, 0.01, 5.0)
    refinement.faults = tuple(replace(fault, healthy=0.2) for fault in refinement.faults)
    levels = dict.fromkeys("ab")
    assert find_groups(refinement, levels) and find_groups(refinement, levels, {"one.size": 0.001})
    assert not find_groups(refinement, levels, {"one.size": 0.015, "two.size": 0.015})


def test_a_range_that_begins_at_the_nominal_size_holds_every_healthy_unit() -> None:
    """Else the fit of a unit at the low end of its tolerance leaves more than noise, and no fault explains it."""
    kind = find_plant("ema")
    fault, placed_fault = kind.faults[0], choose_faults(None, kind)[0]
    assert fault.range[0] == placed_fault.healthy > placed_fault.range[0] and fault.range[1] == placed_fault.range[1]


def test_a_fault_may_be_an_effect_without_starts() -> None:
    """Of a phase beside its size nothing is known then, so the size alone is free."""
    model = load_model(str(ROOT / "plant" / "models" / "new_plant.py"))
    fault = place_fault(Fault("drag", "drag", "dry_friction.torque", (0.0, 5.0), 0.5, 1.0, "ours"), model.kind)
    assert list_unknowns(model.with_effects(["dry_friction"]), [fault])[0].name == "dry_friction.torque"


def test_backlash_is_measured_although_rows_hang_on_its_impacts() -> None:
    model = load_model("ema")
    faults = [fault for fault in choose_faults(None, model.kind) if fault.name == "backlash"]
    matrix = build_matrix({"case": [{"backlash": 8e-5}], "seeds": 1}, model, "", "test", faults)
    diagnosis = diagnose(simulate_case(matrix.cases[0], matrix.spec, model), model, faults=faults)
    assert diagnosis.verdict == "MAINTENANCE" and diagnosis.ruling == "backlash"
    assert diagnosis.sizes["backlash"].low < 8e-5 < diagnosis.sizes["backlash"].high


def test_a_plant_and_faults_of_ones_own(here: Path) -> None:
    """`rig fdi`, `rig campaign` and `rig trend` with both; bands and maps speak of this plant and of no other."""
    pytest.importorskip("pyarrow", reason="the extra fleet is not installed")
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
    options = ["--model", "new_plant.py", "--trust", "--faults", "faults.toml"]
    Path("unit").mkdir()
    run = "unit/2026-03-01.csv"
    rig("simulate", *options[:3], "--set", "dry_friction.torque=1.2", "--seed", "3", "--out", run)
    assert rig("fdi", "--learn-bands", *options, "--out", "bands.toml", "--json").json["judges"] == ["bearing"]
    diagnosis = rig("fdi", run, *options, "--bands", "bands.toml", "--out", "page.html", "--json").json
    assert (diagnosis["ruling"], diagnosis["bands"]["ruling"]) == ("bearing", "bearing")
    assert diagnosis["events"] and {event["section"] for event in diagnosis["events"]} == {"step to 0.5 rad"}
    assert [set(grid["faults"]) for grid in diagnosis["grids"]] and "bearing" in diagnosis["grids"][0]["faults"]
    text = re.sub("<[^>]*>", " ", Path("page.html").read_text())
    assert not re.search(r"\b(ram|jack|spool|valve|servo|XJ|XS|Kintas|FSS)\b", text)
    assert "--bands: of bearing" in refuse("fdi", run, *options[:3], "--bands", "bands.toml")
    trend = rig("trend", "unit", *options, "--json").json
    assert [fault["name"] for fault in trend["faults"]] == ["bearing", "winding", "magnet"]
    cases = ["--fault", "bearing=1", "--seeds", "1", "--jobs", "1", "--out", "campaign"]
    campaign = rig("campaign", *options, *cases, "--json").json
    assert campaign["status"] == {"ok": 1} and campaign["faults"] == trend["faults"]


CLOGGED, RUBBED = "filter_clogging", "spool_friction"
NAN = math.nan


PARTS = find_sections(PREFLIGHT)


@cache
def units(clogging: float = NAN, friction: float = NAN, sliding: float = 1 / 1.5, count: int = 16) -> np.ndarray:
    kind = make_kind(clogging, friction, sliding)
    return simulate_units(load_model(), PREFLIGHT, np.zeros_like(PREFLIGHT), kind, count, seed=4321)


def make_kind(clogging: float = NAN, friction: float = NAN, sliding: float = 1 / 1.5) -> dict[str, float]:
    """Units with these faults, NaN for none."""
    clogged = {} if math.isnan(clogging) else CLOGGING.list_changes(clogging)
    rubbing = {FRICTION.parameter: friction, "spool.dynamic_friction": sliding * friction}
    return clogged | ({} if math.isnan(friction) else rubbing)


def judged(x: np.ndarray, bands: Bands | None = None) -> BandVerdict:
    return judge_position(PREFLIGHT, x, 1e-3, bands or load_default_bands(), parts=PARTS)


def levels(verdicts: list[BandVerdict], fault: str) -> list[Level]:
    return [j.levels[fault] for j in verdicts]


def test_healthy_units_stay_within() -> None:
    """Tolerances, coloured noise, hum, stuck where the last move left them: no event, no level, nothing rules."""
    acceptable = {CLOGGED: Level.ACCEPTABLE, RUBBED: Level.ACCEPTABLE}
    for j in map(judged, units()):
        assert (j.events, j.ruling, j.levels, j.notes) == ((), None, acceptable, ())


@pytest.mark.parametrize(("size", "fault", "other"), [((0.35, NAN), CLOGGED, RUBBED),
                                                      ((NAN, 40.0), RUBBED, CLOGGED)])
def test_a_fault_is_named(size: tuple[float, float], fault: str, other: str) -> None:
    """A single fault past MidBand rules, and the other is left in peace."""
    verdicts = [judged(x) for x in units(*size)]
    assert {j.ruling for j in verdicts} == {fault} and min(levels(verdicts, fault)) >= Level.MAINTENANCE
    assert set(levels(verdicts, other)) == {Level.ACCEPTABLE}
    assert all(e.t_out - e.t_in >= 0.9 * BAND_EVENT_SAMPLES * 1e-3 and e.excess > 0 for j in verdicts for e in j.events)


@pytest.mark.parametrize(("size", "fault", "share", "least", "most"), [
    ((0.25, NAN), CLOGGED, 0.9, Level.MAINTENANCE, None), ((0.40, NAN), CLOGGED, 1.0, Level.NON_NOMINAL, None),
    ((NAN, 35.0), RUBBED, 0.97, Level.MAINTENANCE, None), ((NAN, 70.0), RUBBED, 0.97, Level.NON_NOMINAL, None),
    ((0.1, NAN), CLOGGED, 0.9, None, Level.ACCEPTABLE), ((NAN, 25.0), RUBBED, 1.0, None, Level.ACCEPTABLE),
    *(((NAN, size), CLOGGED, 1.0, None, Level.ACCEPTABLE) for size in (20.0, 35.0, 60.0))])
def test_limits_stand_where_table_2_says(size: tuple[float, float], fault: str, share: float, least: Level | None,
                                         most: Level | None) -> None:
    """Nearly every unit with a fault of that size leaves its band, and with a smaller one stays.

    Friction delays a step as clogging does; the ramps tell how much of that is friction's.
    """
    unit_levels = levels([judged(x) for x in units(*size, count=48 if least else 16)], fault)
    assert np.mean([(least or level) <= level <= (most or level) for level in unit_levels]) >= share


def test_spikes_do_not_count() -> None:
    """One or two samples beyond are no event, wherever they are and however far; three in a row are."""
    x = units()[0]
    rng = np.random.default_rng(1)
    at = np.sort(rng.choice(np.arange(500, len(x) - 30, 40), 150, replace=False))
    for size in (1, 2):
        spiked = x.copy()
        for k in range(size):
            spiked[at + k] += 5e-3 * rng.choice([-1, 1], len(at))
        assert judged(spiked).events == ()
    spiked = x.copy()
    spiked[5000:5000 + BAND_EVENT_SAMPLES] += 5e-3
    assert {e.signal for e in judged(spiked).events} == {"position", "speed"}


def test_entry_and_exit_times() -> None:
    """A push of 0.16 mm for 100 ms on the ramp is one stay outside of that length."""
    x = units()[1].copy()
    x[5000:5100] += 1.6e-4
    events = [e for e in judged(x).events if e.signal == "position"]
    assert [(e.band, round(e.t_in, 3), round(e.t_out, 3)) for e in events] == [("middle", 5.0, 5.1)]
    assert events[0].section == "ramp at 0.5 mm/s" and 4e-5 < events[0].excess < 1.2e-4


def test_missing_samples() -> None:
    """A section that lost too much is left out and said; a fault without any section has no level."""
    x = units(friction=50.0)[0].copy()
    x[500:4001] = np.nan
    verdict = judged(x)
    assert verdict.levels == {RUBBED: Level.MAINTENANCE}
    assert sum("is missing" in note for note in verdict.notes) == 4 and (
        "filter_clogging is not judged" in verdict.notes[-1])
    assert "a measured position" in catch_refusal(judged, np.full(len(x), np.nan))


def test_bands_of_another_command_are_refused() -> None:
    """In one line that says which they are of; so is a load they do not know."""
    bands, com, nothing = load_default_bands(), PREFLIGHT, np.zeros(1000)
    other = np.where((np.arange(len(com)) >= 500) & (np.arange(len(com)) < 1500), 4e-3, com)
    for words, call in (
            ("the command of the bands, preflight (4 steps, 2 ramps)", partial(judge_position, other, other)),
            ("has 2 sections", partial(judge_position, com[:2000], com[:2000])),
            ("unloaded plant", partial(judge_position, com, units()[0], load=np.full(len(com), 5e3)))):
        assert words in catch_refusal(call, period=1e-3, bands=bands)
    assert "steps or slow ramps" in catch_refusal(make_bands_by_simulation, load_model(), nothing, nothing, 1e-3)
    assert [matches_command(bands, each, 1e-3) for each in (com, other)] == [True, False]


SHORT = profile((Hold(time=0.3), Step(to=2e-3, time=0.4), Ramp(to=3e-3, time=1.5), Hold(time=0.2))).command


@cache
def short_bands(force: float = 0.0) -> Bands:
    return make_bands_by_simulation(load_model(), SHORT, np.full(len(SHORT), force), 1e-3, count=64, faulty=48, seed=1)


def test_any_command() -> None:
    """Bands by simulation of a command that nobody has seen before judge as those of the preflight do."""
    bands = short_bands()
    assert all(map(bands.shows, bands.faults))
    for kind, ruling in ((make_kind(0.4), CLOGGED), (make_kind(friction=60.0), RUBBED), (make_kind(), None)):
        x = simulate_units(load_model(), SHORT, np.zeros_like(SHORT), kind, 16, seed=99)
        assert {judge_position(SHORT, row, 1e-3, bands).ruling for row in x} == {ruling}


def test_a_model_may_have_a_friction_near_midband_but_not_at_it() -> None:
    near, beyond = (partial(make_bands_by_simulation, load_model().replace(make_kind(friction=size)), SHORT,
                            0.0 * SHORT, 1e-3, 8, 8) for size in (30.0, 35.0))
    assert (near().find(RUBBED).amounts.tolist() == [30.0, 35.0, 50.0, 70.0, 100.0, 140.0]
            and "short of MidBand (FSS 35), not 35" in catch_refusal(beyond))


def test_faults_of_a_list_of_ones_own() -> None:
    """Where none is a friction, ramps judge the others as well."""
    bands = make_bands_by_simulation(load_model(), SHORT, 0.0 * SHORT, 1e-3, 48, 32, seed=1, faults=[CLOGGING])
    parsed_bands = parse_bands(format_bands(bands), "")
    assert {ramp.fault for ramp in parsed_bands.ramps} == {CLOGGED} and parsed_bands.shows(parsed_bands.faults[0])
    for size, level in ((0.0, Level.ACCEPTABLE), (1.2 * CLOGGING.maintenance, Level.NON_NOMINAL)):
        x = simulate_units(load_model(), SHORT, np.zeros_like(SHORT), CLOGGING.list_changes(size), 16, seed=99)
        assert {judge_position(SHORT, row, 1e-3, parsed_bands).levels[CLOGGED] for row in x} == {level}
    noise = make_bands.sample_sensor_noise(np.random.default_rng(1), load_model(), len(SHORT))
    assert set(measure_precursors(trace(SHORT + noise, SHORT), parsed_bands.precursors)["break_away"].adds) == {CLOGGED}


def test_a_known_load_is_simulated(monkeypatch: pytest.MonkeyPatch) -> None:
    """A healthy unit under 5 kN is not blamed: where no bands fit, they are made with the load."""
    force = np.full(len(SHORT), 5e3)
    monkeypatch.setattr(make_bands, "make_bands_by_simulation", lambda *a, **k: short_bands(5e3))
    bands = choose_bands(SHORT, force, 1e-3)
    j = judge_trace(simulate_trace(load_model(), SHORT, force, seed=3), bands)
    assert (j.ruling, j.events) == (None, ()) and "5000 N" in bands.provenance["load"]


def test_the_file(tmp_path: Path) -> None:
    """What is written is read again, to the digit; it is small, says where it is from, and can be reviewed.

    A step of no whole number of mm is read again, too, and any character in the name of the command.
    """
    again = load_bands(write_file(tmp_path / "b.toml", format_bands(load_default_bands())))
    assert judged(units(0.3)[0], again) == judged(units(0.3)[0])
    assert {"made", "command", "command_hash", "model", "runs", "seed", "software"} <= again.provenance.keys()
    assert (tmp_path / "b.toml").stat().st_size < 40_000
    some = short_bands()
    odd = replace(some, precursors={"overshoot_0.341mm": next(iter(some.precursors.values()))},
                  provenance={**some.provenance, "command": "\U0001d6fc \x7f \udcff.csv"})
    for bands in (load_default_bands(), some, odd):
        text = format_bands(bands)
        assert format_bands(parse_bands(text, "")) == text


@pytest.mark.parametrize(("old", "new", "word"), [
    ("period_ms = 1\n", "period_ms = 0\n", "a file of bands"),
    ("amounts = [5.0, ", "amounts = [500.0, ", "rising"),
    ("amounts = [5.0, ", "amounts = [", "of other lengths"),
    ('plant = "eha"', 'plant = "ema"', "bands of the plant eha"),
    ("[[ramp]]\nsection = ", "[[ramp]]\nsection = 9", "not a ramp of the command"),
    ("", "[bands", "TOML"), ("", "x = 1\n", "bands"), ("", "[bands]\nperiod_ms = 1\n", "key")])
def test_a_wrong_file_is_refused(old: str, new: str, word: str, tmp_path: Path) -> None:
    """In one line."""
    content = format_bands(load_default_bands())
    assert old in content
    file = write_file(tmp_path / "b.toml", content.replace(old, new) if old else new)
    assert word in catch_refusal(load_bands, file)
    assert "a file that can be read" in catch_refusal(load_bands, tmp_path / "none.toml")


OTHER = {"jack.mass": 150.0}


def test_bands_remember_their_model_through_a_file() -> None:
    """Its faults and its noise do not count; bands of another model are refused."""
    com = RAMP_AND_SINE[:1400]
    model = Model().replace(OTHER)
    bands = parse_bands(format_bands(make_bands_by_simulation(model, com, np.zeros_like(com), 1e-3, 8, 8)), "file")
    same = {"filter.clogging": 0.2, "spool.static_friction": 20.0, "spool.dynamic_friction": 10.0,
            "sensors.position_noise": 5e-6}
    assert [list_design(x.replace(same), FAULTS) for x in (Model(), model)] == [{}, OTHER]
    assert describe_other_model(bands, model) == describe_other_model(bands, model.replace(same)) == ""
    for other in (Model(), model.replace({"jack.mass": 151.0})):
        assert describe_other_model(bands, other) == "the model eha with jack.mass = 150.0"
    line = catch_refusal(diagnose, record_plant(com=RAMP_AND_SINE, seed=1), model, load_default_bands())
    assert re.search(r"--bands: made for the model eha with all parameters nominal.*mass = 150", line)


def trace(x: np.ndarray, com: np.ndarray | None = None) -> Trace:
    com = PREFLIGHT if com is None else com
    return Trace.from_columns({"com": com, "xj": x, "cor": np.full(len(x), 1e-3)}, 1e-3, {})


def test_a_fleet_of_its_own() -> None:
    """Another design's response, learned from healthy traces, is healthy then; its faults are still found."""
    model = load_model().replace({"pilot.flow_gain": 0.069 * 0.88})

    def fleet(kind: dict[str, float], count: int, seed: int) -> list[Trace]:
        return [trace(x) for x in simulate_units(model, PREFLIGHT, np.zeros_like(PREFLIGHT), kind, count, seed)]

    sound = fleet(make_kind(), 32, 7)
    strange = [judge_trace(t, load_default_bands()) for t in sound]
    assert np.mean([j.severity[CLOGGED] for j in strange]) > 0.3
    own = learn_bands(sound)
    assert own.provenance["made"].startswith("from 32 healthy traces")
    fresh = [judge_trace(t, own) for t in fleet(make_kind(), 16, 8)]
    assert [j.events for j in fresh] == [()] * 16
    assert np.mean([j.severity[CLOGGED] for j in fresh]) < 0.2
    assert {judge_trace(t, own).ruling for t in fleet(make_kind(0.4), 8, 9)} == {CLOGGED}
    assert own.precursors["overshoot_5mm"]["healthy"] != load_default_bands().precursors["overshoot_5mm"]["healthy"]


def test_a_fleet_that_cannot_be_learned_from() -> None:
    """Too few, another command in one of them, holes."""
    own = [trace(x) for x in units()[:6]]
    other, holed = PREFLIGHT.copy(), units()[7].copy()
    other[500:1500], holed[3000:4000] = 4e-3, np.nan
    for traces, reason in ((own[:3], "at least 5"), ([*own, trace(units()[7], other)], "odd.csv: com"),
                           ([*own, trace(holed)], "missing")):
        assert reason in catch_refusal(learn_bands, traces, names=[*"abcdef", "odd.csv"][:len(traces)])
    doubtful = learn_bands([*own, trace(units(0.5)[0])], names=[*"abcdef", "clogged.csv"])
    assert doubtful.provenance["doubtful"].endswith(": clogged.csv")


def test_the_command(tmp_path: Path) -> None:
    """`rig fdi --learn-bands` writes a file, from a command or from traces; without a place for it, one line."""
    com = profile((Hold(time=0.1), Step(to=2e-3, time=0.15), Ramp(to=2.5e-3, time=0.9))).command
    rows = "\n".join(f"{k / 1000:.3f},{value:.9g}" for k, value in enumerate(com))
    command = write_file(tmp_path / "c.csv", f"t,com\n{rows}\n")
    bands = answer("fdi", "--learn-bands", "--command", command, "--out", tmp_path / "b.toml")
    assert bands["judges"] == [CLOGGED, RUBBED]
    assert load_bands(tmp_path / "b.toml").provenance["command"].endswith("c.csv")
    assert "--out" in refuse("fdi", "--learn-bands")


@pytest.mark.slow
def test_the_shipped_bands_are_what_the_command_makes(tmp_path: Path) -> None:
    """Byte for byte, on this kind of machine."""
    assert rig("fdi", "--learn-bands", "--out", tmp_path / "b.toml", "--quiet").status == 0
    assert (tmp_path / "b.toml").read_text() == format_bands(load_default_bands())


MS = 1e-3


@cache
def run(clogging: float = 0.0, friction: float = 5.0) -> Trace:
    model = load_model().replace({"filter.clogging": clogging, "spool.static_friction": friction,
                                  "spool.dynamic_friction": friction / 1.5})
    return simulate_trace(model, PREFLIGHT, seed=11)


def second_order(zeta: float, omega: float, rows: int, size: float) -> np.ndarray:
    t = np.arange(rows) * MS
    damped = omega * math.sqrt(1 - zeta**2)
    return size * (1 - np.exp(-zeta * omega * t) * (np.cos(damped * t) + zeta * omega / damped * np.sin(damped * t)))


def measure_features(com: np.ndarray, xj: np.ndarray) -> dict[str, float]:
    return {name: float(v[0]) for name, v in compute_features(com, xj[None], MS, find_sections(com)).items()}


@pytest.mark.parametrize(("zeta", "omega"), [(0.3, 100.0), (0.5, 80.0), (0.7, 150.0)])
def test_a_step_of_second_order(zeta: float, omega: float) -> None:
    """Overshoot exp(-pi zeta / root), its square back; settling as on a fine grid."""
    com = np.r_[np.zeros(300), np.full(700, 2e-3)]
    x = np.r_[np.zeros(300), second_order(zeta, omega, 700, 2e-3)]
    features = measure_features(com, x)
    root = math.sqrt(1 - zeta**2)
    over = math.exp(-math.pi * zeta / root)
    fine = np.arange(700_000) * 1e-6
    y = 1 - np.exp(-zeta * omega * fine) * (np.cos(omega * root * fine) + zeta / root * np.sin(omega * root * fine))
    for name, reference in {
            "overshoot_2mm": pytest.approx(100 * over, abs=0.6),
            "undershoot_2mm": pytest.approx(100 * over**2, abs=0.3),
            "settling_time_2mm": pytest.approx(fine[np.flatnonzero(np.abs(y - 1) > 0.05)[-1]], abs=1.5e-3),
            "rest_error": pytest.approx(0.0, abs=1e-6)}.items():
        assert features[name] == reference, name


def test_an_oscillation_on_a_ramp() -> None:
    """A sine of 8 Hz and 50 um about a lag of 7 um gives back just that."""
    ramp = 5e-4 * np.arange(2000) * MS
    com = np.r_[np.zeros(300), ramp, np.full(300, 1e-3), 1e-3 - ramp, np.zeros(300)]
    wave = 5e-5 * np.sin(2 * np.pi * 8 * np.arange(len(com)) * MS)
    way = np.repeat([0.0, 1.0, 0.0, -1.0, 0.0], [300, 2000, 300, 2000, 300])
    features = measure_features(com, com - 7e-6 * way + wave)
    for name, reference in {
            "stick_slip_frequency": pytest.approx(8.0, abs=0.4), "stick_slip_amplitude": pytest.approx(5e-5, rel=0.02),
            "break_away": pytest.approx(5e-5, rel=0.02), "mean_ramp_error": pytest.approx(7e-6, abs=1.5e-6),
            "speed_ripple": pytest.approx(2 * np.pi * 8 * 5e-5 / math.sqrt(2), rel=0.06)}.items():
        assert features[name] == reference, name


def test_what_a_command_does_not_show() -> None:
    """No ramps, no stick-slip; no steps, no overshoot; an oscillation that goes on has no settling time."""
    com = np.r_[np.zeros(200), np.full(800, 1e-3)]
    features = measure_features(com, com + 2e-4 * np.sin(2 * np.pi * 10 * np.arange(1000) * MS))
    assert "break_away" not in features and math.isnan(features["settling_time_1mm"])
    assert format_precursor(math.nan, "settling_time_1mm") == "-"
    assert compute_features(np.zeros(500), np.zeros((1, 500)), MS, [Section("hold", 0, 500, 0.0, 0.0, 0.0)]) == {}
