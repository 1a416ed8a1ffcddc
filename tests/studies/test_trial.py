"""The blind trial: its simulator against an independent one, its cases, its counting."""
from __future__ import annotations

import csv
import gzip
import io
import json
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import SHARED
from rich.console import Console

from fdi.report.terminal import print_report
from fdi.trace.trace import Trace
from plant import InputError, Model
from plant.effects import CATALOGUE
from plant.lanes import Lanes
from studies.hidden_effects import cases, command, hidden, trial_score
from studies.hidden_effects.__main__ import main
from studies.hidden_effects.run_trial import RIG_EXPLAIN, load_explain, run_trial
from studies.hidden_effects.trial_score import build_trial_report, describe_progress
from studies.hidden_effects.truth import SYMBOLS, has_compiler, nominal_symbols, parameter_names, simulate_truth

PRACTICE = SHARED / "practice"
EXACT: dict[str, dict[str, float]] = {
    "00": {"FSS": 45.0, "FDS": 30.0}, "01": {"Kintas": 0.3}, "02": {"bias": 0.03 * 8e-3}, "06": {"aero": 5.4e5},
    "09": {"cog": 2750.0, "cog_l": 2.5e-3}, "10": {"FSS": 33.0, "FDS": 22.0, "Kintas": 0.21},
}
pytestmark = pytest.mark.skipif(not has_compiler(), reason="no gcc: the trial's simulator cannot be built")
shared = pytest.mark.skipif(not PRACTICE.exists(), reason="no ../shared: no traces of an independent simulator")


def rms(x: np.ndarray) -> float:
    return float(np.sqrt((x**2).mean()))


def read(path: Path) -> dict[str, np.ndarray]:
    with gzip.open(path, "rt") as file:
        header, *rows = csv.reader(file)
    return dict(zip(header, np.array(rows, dtype=float).T, strict=True))


@shared
@pytest.mark.parametrize(("case", "name"), [*((case, "est") for case in EXACT), ("02", "holdout"), ("09", "holdout")])
def test_the_simulator_leaves_sensor_noise_of_an_independent_trace(case: str, name: str) -> None:
    trace = read(PRACTICE / case / f"{name}.csv.gz")
    run = simulate_truth(trace["com"], EXACT[case], load=trace["load"], cor=trace["cor"])
    assert rms(run.xj - trace["xj"]) == pytest.approx(2e-6, rel=0.05)
    assert rms(run.p12 - trace["p12"]) == pytest.approx(2e4, rel=0.03)
    assert rms(run.xs - trace["xs"]) == pytest.approx(1e-6, rel=0.03)


@shared
def test_commands_and_loads_are_those_of_the_practice_traces() -> None:
    trace = read(PRACTICE / "04/est.csv.gz")
    assert np.abs(command.preflight_command() - trace["com"]).max() < 1e-10
    for name in ("est", "holdout"):
        load = read(PRACTICE / f"04/{name}.csv.gz")["load"]
        assert (command.known_load_profile(len(load), 6000.0) == load).all()


def test_hold_outs_are_random_commands_within_the_stroke() -> None:
    rng = np.random.default_rng(1)
    made = [command.sample_holdout_command(rng) for _ in range(50)]
    assert all(5000 < len(com) < 40_000 and np.abs(com).max() < 10e-3 and com[-1] == 0 for com in made)
    assert len({len(com) for com in made}) > 40


def test_every_effect_of_the_catalogue_is_hidden_in_some_case() -> None:
    assert set(hidden.CATALOGUE) == {name for name, effect in CATALOGUE.items() if not effect.disturbance}
    assert len(hidden.OUTSIDE) >= 8 and not set(hidden.OUTSIDE) & set(CATALOGUE)


@pytest.mark.parametrize("name", [*hidden.CATALOGUE, *hidden.OUTSIDE])
def test_a_hidden_effect_shows_and_grows(name: str) -> None:
    """Coarse steps: only that it does something, more of it more, and that all stays finite."""
    whole = command.preflight_command()
    com = np.concatenate([whole[400:1700], whole[9000:9600], whole[11_000:13_000]])  # a large step, a sine, the chirp
    load = command.known_load_profile(len(com), 6000.0)
    bare, shown = simulate_truth(com, {}, load=load, steps=200), []
    for part in (0.3, 1.0):
        effect = hidden.sample_hidden_effect(name, nominal_symbols(), np.random.default_rng(2), part, part)
        changes = {key: value for key, value in effect.changes.items() if key in parameter_names()}
        assert changes.keys() | set(hidden.NOT_SIMULATED) >= effect.changes.keys()
        run = simulate_truth(com, changes, load=load, steps=200)
        columns = [run.xj - bare.xj, run.cor - bare.cor, run.p12 - bare.p12, run.xs - bare.xs]
        assert np.isfinite(columns).all()
        shown.append(max(rms(x) / floor for x, floor in zip(columns, (2e-6, 7.6e-6, 2e4, 1e-6), strict=True)))
    assert shown[1] > 0.3
    if name not in ("orifice_root", "compressibility", "mount_compliance", "command_rate_limit"):  # softer is more
        assert shown[1] > shown[0]


def plants(effect: hidden.Hidden) -> dict[str, float]:
    """The plant's names for what is hidden."""
    entry, changes = CATALOGUE[effect.name], effect.changes
    if entry.base:
        return {SYMBOLS[symbol]: value for symbol, value in changes.items() if symbol in SYMBOLS}
    more = {"stribeck": {"stribeck.speed": changes.get("stribeck_v", 0.0)},
            "supply_ripple": {"supply_ripple.frequency": changes.get("ripple_hz", 0.0)},
            "structural_resonance": {"structural_resonance.frequency": 35.0,
                                     "structural_resonance.damping_ratio": 0.02}}
    return {entry.fitted[0]: effect.value} | more.get(effect.name, {})


def test_the_plants_effects_are_what_the_table_says_as_written_twice() -> None:
    """Both replay the same current with the same size hidden; what is left is far below the sensors' noise."""
    com = np.concatenate([command.preflight_command()[500:1700], command.preflight_command()[11_000:13_000]])
    load = command.known_load_profile(len(com), 6000.0)
    drive = simulate_truth(com, {}, load=load).cor
    # of a signed effect one seed gives the sign -, one +
    drawn = [hidden.sample_hidden_effect(name, nominal_symbols(), np.random.default_rng(seed), 0.7, 0.7)
             for seed in (1, 2) for name, law in hidden.CATALOGUE.items() if seed == 1 or law.signed]
    drawn = [effect for effect in drawn if effect.name != "command_rate_limit"]  # not in the plant
    model = Model().with_effects(effect.name for effect in drawn)
    names = sorted({name for effect in drawn for name in plants(effect)})
    rows = [[plants(effect).get(name, model[name]) for name in names] for effect in drawn]
    ours = Lanes(model, names, 100).replay(np.array(rows), drive, load)
    for effect, mine in zip(drawn, ours, strict=True):
        known = set(parameter_names()) - {"bristle_v"}
        changes = {key: value for key, value in effect.changes.items() if key in known}
        truth = simulate_truth(com, changes, load=load, cor=drive)
        columns = zip(mine.T, (truth.xj, truth.p12, truth.xs), (2e-6, 2e4, 1e-6), strict=True)
        left = [rms(x - y) / floor for x, y, floor in columns]
        assert max(left) < (1.0 if effect.name == "compressibility" else 0.5), (effect.name, effect.size, left)


def test_a_case_repeats_by_its_seed(tmp_path: Path) -> None:
    case = cases.sample_case(11, level="bench")
    assert str(case) == str(cases.sample_case(11, level="bench")) != str(cases.sample_case(12, level="bench"))
    cases.write_case(case, tmp_path)
    again, holdout = cases.measure_case(case, "holdout").trace, read(tmp_path / "holdout.csv.gz")
    for name in ("com", "xj", "cor", "p12", "xs", "load"):
        assert holdout[name] == pytest.approx(getattr(again, name), rel=1e-8), name
    truth = tomllib.loads((tmp_path / "truth.toml").read_text())
    assert truth["effects"] == [h["effect"] for h in truth["hidden"]] and truth["base_ratio"].keys() == {
        "xj", "xj_drift", "p12", "xs", "controller"}
    est, repeat = (Trace.read(tmp_path / f"{name}.csv.gz") for name in ("est", "repeat"))
    assert len(est) == 13_500 and (est.com == repeat.com).all() and not (est.xj == repeat.xj).any()


def test_chosen_signals_change_nothing_else_about_a_case() -> None:
    for seed in range(30):
        random = cases.sample_case(seed)
        for signals in cases.SIGNALS:
            chosen = cases.sample_case(seed, signals=signals)
            assert chosen.signals == signals and str(chosen._replace(signals=random.signals)) == str(random)


def test_kinds_are_drawn_as_often_as_they_should() -> None:
    drawn = [cases.sample_case(seed) for seed in range(600)]
    for kind, share in cases.KINDS.items():
        assert sum(case.kind == kind for case in drawn) / 600 == pytest.approx(share, abs=0.06)
    assert {len(case.effects) for case in drawn if case.kind == "two"} == {2}
    assert len({case.effects[0].name for case in drawn if case.kind == "one"}) == len(hidden.CATALOGUE)
    assert max(case.level.scatter for case in drawn) <= 0.02


def test_the_noise_of_a_bench_is_coloured_and_hums() -> None:
    noise = cases.measure_case(cases.sample_case(5, "nothing", level="bench"), "est").noise
    xj, t = noise["xj"], np.arange(13_500) * 1e-3
    hum = abs(2 * np.mean(xj * np.exp(-2j * np.pi * 50 * t)))
    assert hum == pytest.approx(0.7e-6, abs=0.1e-6)
    assert np.corrcoef(xj[1:], xj[:-1])[0, 1] == pytest.approx(0.8, abs=0.03)
    assert rms(noise["p12"]) == pytest.approx(2e4, rel=0.03)
    assert abs(np.corrcoef(noise["p12"][1:], noise["p12"][:-1])[0, 1]) < 0.03


def test_nothing_hidden_leaves_no_trace_of_an_effect() -> None:
    case = cases.sample_case(5, "nothing", level="bench")
    ratios = cases.measure_effect_ratios(case, cases.measure_case(case, "est"), [])
    assert max(ratios.values()) < 1e-6


def record(seed: int, kind: str, effects: Sequence[str], verdict: str, named: Sequence[str], floors: float = 9.0,
           **more: Any) -> dict[str, Any]:
    """A record as a trial writes it."""
    shown = {"xj": floors, "xj_drift": 99.0, "p12": floors, "xs": 0.0, "controller": 0.0}
    each = [{"effect": name, "size": 1.0, "value": 20.0} | ({"ratio": shown} if len(effects) > 1 else {})
            for name in effects]
    truth = {"kind": kind, "effects": list(effects), "signals": "xj,p12,xs", "base_ratio": shown, "hidden": each,
             "plant": {"MJ": 101.0}}
    answer = {"verdict": verdict, "effects": list(named), "baseline": {"floor": {"xj": 1.0}}} | more
    return {"seed": seed, "truth": truth, "answer": answer, "seconds": 5.0 if seed else 30.0}


def candidate(low: float, high: float, left: float) -> list[dict[str, Any]]:
    return [{"effect": "spool_friction", "parameters": {"spool.static_friction": {"low": low, "high": high}},
             "holdout": {"xj": left}}]


RECORDS = [
    record(0, "nothing", [], "NOTHING_MISSING", []),
    record(1, "nothing", [], "EXPLAINED", ["coil_lag"]),
    record(2, "one", ["spool_friction"], "EXPLAINED", ["spool_friction"], candidates=candidate(19, 21, 1.1)),
    record(3, "one", ["spool_friction"], "AMBIGUOUS", ["coil_lag", "spool_friction"], candidates=candidate(21, 22, 2)),
    record(4, "one", ["spool_friction"], "EXPLAINED", ["coil_lag"]),
    record(5, "one", ["spool_friction"], "NOT_RESOLVABLE", [], floors=1.5),
    record(6, "outside", ["periodic torque"], "UNEXPLAINED", []),
    record(7, "outside", ["periodic torque"], "EXPLAINED", ["null_bias"], floors=1.0),
    record(8, "two", ["null_bias", "coil_lag"], "EXPLAINED", ["coil_lag", "null_bias"]),
    record(9, "two", ["null_bias", "coil_lag"], "PARTLY", ["null_bias"]),
]


def test_rates_count_what_they_say() -> None:
    found = [(rate.good, rate.of, rate.bad) for rate in trial_score.count_rates(RECORDS)]
    assert found == [(1, 2, (1,)), (2, 3, (4,)), (2, 3, (4,)), (1, 2, (3,)), (1, 2, (3,)), (1, 1, ()), (1, 2, (7,)),
                     (1, 2, (9,)), (9, 10, (0,))]
    assert trial_score.average_named_effects(RECORDS) == 1.5


@pytest.mark.parametrize(("usual", "good"), [(25.0, 1), (15.0, 0)])
def test_an_effect_that_is_said_to_be_hidden_at_its_size_is_admitted(usual: float, good: int) -> None:
    blind = [{"effect": "constant_load", "parameter": "constant_load.force", "usual": usual}]
    one = record(4, "one", ["constant_load"], "NOTHING_MISSING", [], blind_to=blind)
    rates = {rate.name.strip(): rate.good for rate in trial_score.count_rates([one])}
    assert rates["or listed as not detectable at its size"] == good
    assert rates["one effect: the truth is named"] == 0


def test_the_summary_tells_every_failure_and_is_json() -> None:
    figures = json.loads(json.dumps(trial_score.summarise_trial(RECORDS)))
    assert [f["seed"] for f in figures["failures"]] == [0, 1, 3, 4, 7, 9]
    assert figures["rates"][0]["bad"] == [1] and figures["by_signals"]["xj"]["two effects: both named"] == [0, 0]
    print_report(build_trial_report(figures), Console(file=(shown := io.StringIO()), width=200))
    assert "one effect: the truth is named" in shown.getvalue() and "NOT met" in shown.getvalue()
    assert figures["confusion"]["one: spool_friction"] == {
        "EXPLAINED right": 1, "AMBIGUOUS right": 1, "EXPLAINED wrong": 1}
    assert figures["confusion"]["outside: periodic torque (small)"] == {"EXPLAINED": 1}


def knowing(est: Path, holdout: Path, repeats: Sequence[Path], signals: Sequence[str]) -> dict[str, Any]:
    """An explanation that looks up the truth, and keeps a tally."""
    assert holdout.exists() and repeats[0].exists() and signals[0] == "xj"
    with (est.parent.parent / "tally").open("a") as tally:
        tally.write(".")
    truth = tomllib.loads((est.parent / "truth.toml").read_text())
    if truth["kind"] == "outside":
        raise ValueError("out of my depth")
    return {"verdict": "EXPLAINED" if truth["effects"] else "NOTHING_MISSING", "effects": truth["effects"]}


def test_a_trial_is_taken_up_where_it_was_left(tmp_path: Path) -> None:
    told: list[str] = []
    by = f"{__name__}:knowing"
    seeds = [next(s for s in range(99) if cases.sample_case(s).kind == kind) for kind in ("one", "outside")]
    run_trial(by, seeds[:1], tmp_path, processes=1)
    with (tmp_path / "results.jsonl").open("a") as results:
        results.write('{"seed": 3, "cut')  # a process that was killed
    records = run_trial(by, seeds, tmp_path, processes=1, report_progress=lambda p: told.append(describe_progress(p)))
    assert next(tmp_path.glob("cases-*/tally")).read_text() == ".."
    assert [r["answer"]["verdict"] for r in records] == ["EXPLAINED", "CRASHED"]
    assert "out of my depth" in records[1]["answer"]["error"]
    assert len(told) == 1 and told[0].startswith("2/2")


def test_a_folder_does_not_mix_choices_of_signals(tmp_path: Path) -> None:
    by, seed = f"{__name__}:knowing", next(s for s in range(99) if cases.sample_case(s).signals == "xj")
    for choices, done in ((None, 1), ("xj,p12,xs", 2), ("xj,p12,xs", 2), ("xj", 3)):
        (row,) = run_trial(by, [seed], tmp_path, processes=1, signals=choices)
        assert row["truth"]["signals"] == (choices or "xj")
        assert sum(len(tally.read_text()) for tally in tmp_path.glob("cases-*/tally")) == done


@pytest.mark.parametrize(("option", "value", "expected"), [
    ("--signals", "xj,pressure", "studies.hidden_effects: --signals: xj,pressure: expected xj or xj,p12 or xj,p12,xs"),
    ("--cases", "0", "studies.hidden_effects: --cases: 0: expected 1 or more"),
    ("--jobs", "0", "studies.hidden_effects: --jobs: 0: expected 1 or more"),
    ("--out", "trial.txt", "studies.hidden_effects: --out: trial.txt: expected FILE.json")])
def test_bad_options_are_refused_in_one_line(
        option: str, value: str, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([option, value, "--folder", str(tmp_path / "trial")]) == 2
    assert capsys.readouterr().err == expected + "\n"
    assert not (tmp_path / "trial").exists()


def test_an_explanation_that_is_not_there_is_said_in_one_line() -> None:
    assert callable(load_explain(RIG_EXPLAIN))
    with pytest.raises(InputError, match="module:function"):
        load_explain("studies.hidden_effects.nowhere:explain")


@pytest.mark.slow
def test_blind_trial(tmp_path: Path) -> None:
    """200 cases through `rig explain`: an hour or two."""
    missed = [rate for rate in trial_score.count_rates(run_trial(RIG_EXPLAIN, range(200), tmp_path)) if not rate.met]
    assert missed == []
