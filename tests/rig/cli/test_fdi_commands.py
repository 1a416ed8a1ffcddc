"""`rig compare`, `diff`, `fdi`, `explain`, `add`, `remove` as typed: words, JSON, exit statuses, pages, model files."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from effect_files import SPRING, restored_catalogue
from noisy_traces import SHORT, record_healthy, record_plant
from places import ROOT
from rig_command import CommandResult, answer, refuse, rig, write_file
from short_runs import HIDDEN, list_trace_arguments, write_measured_runs
from synthetic_run import record_run

from fdi.diagnosis.diagnosis import diagnose
from fdi.diagnosis.faults import CLOGGING, FRICTION, Level
from fdi.discovery import update_model
from fdi.estimation import Value
from fdi.report.diagnosis_report import describe_verdict
from fdi.trace import Trace
from fdi.trace.csv_table import write_csv
from plant import Model, load_model, load_plant


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """est, repeat of a healthy plant; fault with spool friction."""
    folder = tmp_path_factory.mktemp("traces")
    record_healthy(2).write_csv(folder / "est.csv")
    record_healthy(3).write_csv(folder / "repeat.csv")
    record_plant(CLOGGED).write_csv(folder / "clogged.csv")
    record_plant(STUCK, SHORT).write_csv(folder / "short.csv")
    record_plant({"spool.static_friction": 30.0, "spool.dynamic_friction": 20.0}).write_csv(folder / "fault.csv")
    return folder


@pytest.fixture(scope="module")
def fault(folder: Path) -> CommandResult:
    return rig("compare", folder / "fault.csv", "--out", folder / "fault.html")


def test_json_of_a_model_that_fits(folder: Path) -> None:
    comparison = answer("compare", folder / "est.csv", "--repeat", folder / "repeat.csv")
    assert (comparison["verdict"], comparison["repeats"]) == ("WITHIN_FLOOR", 1)
    assert {name: signal["unit"] for name, signal in comparison["signals"].items()} == {
        "xj": "m", "p12": "Pa", "xs": "m"}
    for name, floor in (("xj", 2e-6), ("p12", 2e4), ("xs", 1e-6)):
        signal = comparison["signals"][name]
        assert (signal["error"], signal["floor"]) == pytest.approx((floor, floor), rel=0.05)
        assert signal["ratio"] == pytest.approx(signal["error"] / signal["floor"]) and signal["closed_loop_error"] > 0
    assert 0 < comparison["solver_error"] < 0.1 * comparison["signals"]["xj"]["floor"]
    assert set(comparison["blocks"]) == {"controller", "servovalve", "jack", "sensor"}
    assert all({"section", "t0", "t1", "share", "condition"} <= set(place) for place in comparison["where"])
    assert sum(place["share"] for place in comparison["where"]) == pytest.approx(1.0, abs=0.01)


def test_words_of_a_model_that_does_not(fault: CommandResult, folder: Path) -> None:
    assert (fault.status, fault.err) == (1, "")
    assert re.match(r"MODEL_INCOMPLETE  The model does not explain this trace: XJ error [\d.]+ um, noise floor "
                    r"[\d.]+ um; the servovalve disagrees; controller, jack and sensor fit.\n", fault.out)
    assert [words for words in (
        "from the command alone", "equal to the last digit", "halving the step", "floor     the model's sensor noise",
        "where     motion within 3 mm", "scatter   scatter", f"page      {folder / 'fault.html'}",
        f"next      rig explain {folder / 'fault.csv'}") if words not in fault.out] == []
    assert "nan" not in fault.out and not re.search(r"\d[eE][-+]\d", fault.out)


def test_a_page_that_needs_no_network(fault: CommandResult, folder: Path) -> None:
    page = (folder / "fault.html").read_text()
    assert "MODEL_INCOMPLETE" in page and page.count("<svg") == 5 and "</html>" in page
    assert not re.search(r"""(?:src|href)=["']?(?:https?:)?//|@import|<script[^>]*src""", page)
    assert page.count("<script") == 1 and len(page) < 3_000_000
    assert not re.search(r"\bnan\b", re.sub(r"<(svg|script).*?</\1>", "", page, flags=re.DOTALL))
    assert [words for words in ("Com and XJ to Cor", "Is the residual noise", "By speed and amplitude",
                                "What the residual depends on", "jack.damping", "share of the squared")
            if words not in page] == []


def test_the_right_parameters_bring_it_to_the_floor(folder: Path) -> None:
    friction = ["--set", "spool.static_friction=30", "--set", "spool.dynamic_friction=20"]
    assert answer("compare", folder / "fault.csv", *friction)["verdict"] == "WITHIN_FLOOR"
    text = 'name = "stiff"\n[spool]\nstatic_friction = 30.0\ndynamic_friction = 20.0\n'
    result = rig("compare", folder / "fault.csv", "--model", write_file(folder / "model.toml", text))
    assert result.status == 0 and result.out.startswith("WITHIN_FLOOR  The model explains this trace")
    assert "next" not in result.out


def test_results_go_where_they_should(folder: Path) -> None:
    words = ("--out", folder / "told.json", "--signals", "xj, xs", "--report")
    assert rig("compare", folder / "est.csv", "--quiet", *words) == CommandResult(0, "", "", ())
    assert set(json.loads((folder / "told.json").read_text())["signals"]) == {"xj", "xs"}
    assert "WITHIN_FLOOR" in (folder / "compare.html").read_text()


def test_a_run_of_the_bench(preflight: Path) -> None:
    """The log of a whole run over the bus, quantised as its frames are."""
    comparison = answer("compare", preflight)
    assert comparison["verdict"] == "WITHIN_FLOOR" and comparison["blocks"]["controller"] < 1.2


def test_few_rows_still_have_a_page(tmp_path: Path) -> None:
    short = {name: getattr(record_healthy(2), name)[:300] for name in ("com", "xj", "cor", "p12", "xs")}
    Trace.from_columns(short, 1e-3, {}).write_csv(tmp_path / "short.csv")
    result = rig("compare", tmp_path / "short.csv", "--out", tmp_path / "short.html")
    assert result.status in (0, 1) and (tmp_path / "short.html").exists(), result.err


def test_a_run_is_the_same_as_itself_in_any_format_and_another_differs(tmp_path: Path) -> None:
    log, csv, other = record_run(tmp_path / "trace.mcap", stop=2000), tmp_path / "run.csv", tmp_path / "other.csv"
    Trace.read(log, all=True).write_csv(csv)
    same = answer("diff", log, csv)
    assert (same["verdict"], same["pairs"][0]["same_command"], same["runs"][1]["source"]) == ("SAME", True, str(csv))
    assert not any(check["changed"] for check in same["checks"])
    trace = Trace.read(csv)
    write_csv(other, {"t": trace.t, "com": trace.com, "xj": trace.xj + 1e-4 * (trace.t > 1.0), "cor": trace.cor})
    result = rig("diff", csv, other, "--report")
    page = (tmp_path / "diff.html").read_text(encoding="utf-8")
    assert result.status == 1 and result.out.startswith("DIFFERENT") and "P12 of B: only A has it" in result.out
    assert "B - A" in page and page.count("<svg") == 1


SIGNALS = {"xj", "p12", "xs"}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_measured_runs(tmp_path_factory.mktemp("runs"), HIDDEN)


@pytest.fixture(scope="module")
def explanation(runs: dict[str, Path]) -> CommandResult:
    """One search; its page is page.html beside the run."""
    return rig("explain", *list_trace_arguments(runs), "--json", "--out", runs["est"].with_name("page.html"))


def test_the_effect_is_named_with_its_evidence(explanation: CommandResult) -> None:
    answer, truth = explanation.json, HIDDEN["null_bias.current"]
    best, *others = answer["candidates"]
    assert (explanation.status, answer["verdict"], answer["effects"]) == (1, "EXPLAINED", ["null_bias"])
    assert (best["effect"], best["word"]) == ("null_bias", "explains")
    assert best["ratio"] < 1.1 and best["evidence"] > 1000.0 and best["p_value"] < 1e-6
    current = best["parameters"]["null_bias.current"]
    assert current["unit"] == "A" and current["low"] < truth < current["high"] < current["low"] + 0.1 * truth
    assert all(other["ratio"] > best["ratio"] for other in others) and answer["blind_to"] and answer["notes"] == []


def test_baseline_and_floor(explanation: CommandResult) -> None:
    base, best = explanation.json["baseline"], explanation.json["candidates"][0]
    for fit in (base, best):
        assert set(fit["error"]) == set(fit["holdout"]) == set(base["floor"]) == SIGNALS
    assert base["floor"]["xj"] == pytest.approx(2e-6, rel=0.1) and base["error"]["xj"] > 10.0 * base["floor"]["xj"]
    assert all(best["error"][signal] < 1.1 * floor and best["holdout"][signal] < 1.15 * floor
               for signal, floor in base["floor"].items())


def test_effects_that_hide_in_the_tolerances_are_listed_with_what_would_reveal_them(explanation: CommandResult) -> None:
    blind = {b["effect"]: b for b in explanation.json["blind_to"]}
    offset = blind["sensor_offset"]  # no size of it shows in a closed loop
    assert (offset["smallest_visible"], offset["usual"], offset["unit"]) == (None, 2e-4, "m")
    assert "end stop" in offset["revealed_by"]
    assert "null_bias" not in blind and "constant_load" not in blind
    assert "command_rate_limit" in explanation.json["seen_without_noise"]


@pytest.mark.slow
def test_both_effects_of_the_readme_are_named(here: Path) -> None:
    """A repeat on which the right second effect misses another stop is no evidence against it."""
    assert rig("simulate", "--samples", "--quiet").status == 0
    answer = rig("explain", "run.csv", "--repeat", "run2.csv", "--holdout", "held.csv", "--json").json
    assert (answer["verdict"], {*answer["effects"]}) == ("EXPLAINED", {"null_bias", "jack_friction"})


@pytest.fixture(scope="module")
def addition(runs: dict[str, Path]) -> tuple[CommandResult, Path]:
    """The right effect in a new model file; not to be written to."""
    model = runs["est"].with_name("biased.toml")
    return rig("add", "null_bias", *list_trace_arguments(runs), "--json", "--out", model), model


@pytest.fixture
def model(addition: tuple[CommandResult, Path], tmp_path: Path) -> Path:
    """A copy of that file."""
    return Path(shutil.copy(addition[1], tmp_path / "biased.toml"))


def test_the_error_falls_to_the_floor(addition: tuple[CommandResult, Path]) -> None:
    result, path = addition
    floor, (before, after) = result.json["floor"], result.json["ledger"]
    assert (result.status, result.json["model"], result.json["helps"]) == (0, str(path), True)
    assert (before["effect"], after["effect"]) == (None, "null_bias")
    assert "null_bias added" in Path(result.json["report"]).read_text()
    assert min(before["error"]["xj"], before["holdout"]["xj"]) > 20.0 * floor["xj"]
    assert all(after["error"][signal] < 1.1 * level and after["holdout"][signal] < 1.15 * level
               for signal, level in floor.items())


def test_the_file_is_a_model_with_intervals_and_provenance(addition: tuple[CommandResult, Path], runs: dict[str, Path]
                                                           ) -> None:
    result, path = addition
    model, provenance = update_model.load_model_file(path)
    assert model.effects == ("null_bias",) and load_model(path) == model
    value = result.json["parameters"]["null_bias.current"]
    assert model["null_bias.current"] == pytest.approx(value["value"], rel=1e-5)
    assert value["low"] < HIDDEN["null_bias.current"] < value["high"]
    assert re.search(r"^current = .*# A, .*\(95 %\)$", path.read_text(), re.MULTILINE)
    assert provenance.effects == ("null_bias",) and provenance.trace and provenance.trace.file == str(runs["est"])
    assert provenance.software.startswith("eha-rig") and [r.effect for r in provenance.ledger] == [None, "null_bias"]
    before = update_model.remove_all_effects(model, provenance)
    assert before.effects == () and before.values == Model().values


def test_a_run_at_rest_shows_next_to_nothing(tmp_path: Path) -> None:
    """Noise alone is left of it, also with a bias hidden: it does not say that nothing is missing."""
    command = write_file(tmp_path / "rest.csv", "t,com\n0,0\n2,0\n")
    run = tmp_path / "run.csv"
    assert rig("simulate", "--command", command, "--set=null_bias.current=5e-5", "--out", run).status == 0
    answer = rig("explain", run, "--json", "--out", tmp_path / "page.html").json
    assert (answer["verdict"], answer["effects"]) == ("NOT_RESOLVABLE", [])
    blind = {b["effect"]: b["revealed_by"] for b in answer["blind_to"]}
    assert "motion" in blind["moving_mass"] and "gauge" in blind["filter_clogging"]


def test_such_a_model_simulates_and_lacks_nothing(model: Path, runs: dict[str, Path], tmp_path: Path) -> None:
    assert rig("simulate", "--model", model, "--out", tmp_path / "s.csv", "--quiet").status == 0
    result = rig("explain", *list_trace_arguments(runs), "--model", model, "--out", tmp_path / "found.json")
    assert result.status == 0 and result.out.startswith("NOTHING_MISSING")
    assert "the residual is noise" in result.out and "not detectable" in result.out and "next" not in result.out
    assert json.loads((tmp_path / "found.json").read_text())["verdict"] == "NOTHING_MISSING"


def test_the_ledger_goes_on_and_a_useless_effect_is_said_so(model: Path, addition: tuple[CommandResult, Path]) -> None:
    report = answer("add", "spool_overlap", "--model", model, status=1)  # the runs are those of the file
    assert not report["helps"] and [row["effect"] for row in report["ledger"]] == [None, "null_bias", "spool_overlap"]
    assert report["ledger"][0]["error"]["xj"] == pytest.approx(addition[0].json["ledger"][0]["error"]["xj"], rel=1e-5)
    assert set(load_model(model).effects) == {"null_bias", "spool_overlap"}
    assert model.with_name("biased.toml.bak").read_text() == addition[1].read_text()


def test_without_it_the_error_rises_again(model: Path, runs: dict[str, Path]) -> None:
    removal = answer("remove", "null_bias", *list_trace_arguments(runs), "--model", model)
    before, after = removal["ledger"][-2:]
    assert after["removed"] and after["effect"] == "null_bias"
    assert all(after[which]["xj"] > 10.0 * before[which]["xj"] for which in ("error", "holdout"))
    assert load_model(model).effects == () and update_model.read_provenance(model).effects == ()


def test_taken_out_without_a_run_all_else_stays(model: Path) -> None:
    mass = load_model(model)["jack.mass"]
    result = rig("remove", "null_bias", "--model", model)
    assert result.status == 0 and "give a TRACE" in result.out
    assert (load_model(model).effects, load_model(model)["jack.mass"]) == ((), mass)


def test_a_base_effect_comes_out_at_its_value_before(tmp_path: Path) -> None:
    path = write_file(tmp_path / "m.toml", "[spool]\nstatic_friction = 40.0\ndynamic_friction = 30.0\n")
    assert rig("remove", "spool_friction", "--model", path, "--quiet").status == 0
    assert load_model(path).values == Model().values


def test_a_model_with_a_users_effect_finds_its_file_or_asks_for_it(tmp_path: Path) -> None:
    effect_file, run, file = write_file(tmp_path / "spring.py", SPRING), tmp_path / "s.csv", tmp_path / "m.toml"
    with restored_catalogue():
        assert rig("simulate", "--effects", effect_file, "--set=spring.stiffness=1e5", "--out", run,
                   "--quiet").status == 0
        model = Model().replace({"spring.stiffness": 1e5})
        provenance = update_model.Provenance(effects=("spring",), effect_files=(str(effect_file),))
        interval = {"spring.stiffness": Value(1e5, 9e4, 1.1e5, "N/m")}
        file.write_text(update_model.format_model_file(model, interval, provenance))
        assert update_model.load_model_file(file) == (model, provenance)
        kind = load_plant(ROOT / "plant" / "models" / "new_plant.py")  # brings its own effects along
        plant_model = write_file(tmp_path / "mine.toml", f'plant = "{kind.key}"\neffects = ["spring", "dry_friction"]\n'
                                 f'[provenance]\neffect_files = ["{effect_file}"]\n')
        assert update_model.load_model_file(plant_model)[0].effects == ("spring", "dry_friction")
    with restored_catalogue():
        result = rig("compare", run, "--model", file, "--trust")
    assert result.status == 0 and str(effect_file) in result.err, result.err
    effect_file.rename(tmp_path / "elsewhere.py")
    for words in (["add", "null_bias", run], ["explain", run]):
        assert f"--effects {effect_file} with it, where spring is defined" in refuse(*words, "--model", file)


CLOGGED = {"filter.clogging": 0.3}
STUCK = {"spool.static_friction": 45.0, "spool.dynamic_friction": 30.0}


@pytest.fixture(scope="module")
def clogged(folder: Path) -> CommandResult:
    return rig("fdi", folder / "clogged.csv", "--out", folder / "clogged.json")


def test_json_of_a_healthy_unit(folder: Path) -> None:
    diagnosis = answer("fdi", folder / "est.csv")
    assert set(diagnosis) >= {"level", "ruling", "events", "precursors", "grid", "refined"}
    assert set(diagnosis["grid"]["merged"]) >= {"kintas", "fss"} <= set(diagnosis["refined"])
    assert diagnosis["level"] == {"filter_clogging": "acceptable", "spool_friction": "acceptable"}
    assert (diagnosis["ruling"], diagnosis["verdict"], diagnosis["events"]) == (None, "ACCEPTABLE", [])
    for size in (diagnosis["refined"]["kintas"], diagnosis["refined"]["fss"]):
        assert 0.0 <= size["low"] <= size["value"] <= size["high"]
    assert diagnosis["refined"]["method"] == "least squares" and diagnosis["refined"]["simulations"] > 300
    assert {"step", "ramp"} <= set(diagnosis["grid"]) and not any(
        other["unhealthy"] for other in diagnosis["others"].values())


def test_words_and_json_of_a_clogged_filter(clogged: CommandResult, folder: Path) -> None:
    diagnosis = json.loads((folder / "clogged.json").read_text())
    match = re.match(r"MAINTENANCE  Filter clogging requires maintenance: Kintas ([\d.]+)\b", clogged.out)
    kintas, text = diagnosis["refined"]["kintas"], " ".join(clogged.out.split())
    assert match and float(match[1]) == pytest.approx(kintas["value"], abs=0.1 * (kintas["high"] - kintas["low"]))
    assert kintas["low"] < CLOGGED["filter.clogging"] < kintas["high"]
    assert [words for words in ("spool friction is acceptable", "0.25 and 0.35", "first overshoot", "first begins",
                                "simulations", "* marks the ruling fault") if words not in text] == []
    assert (clogged.status, clogged.err, diagnosis["ruling"]) == (1, "", "filter_clogging") and diagnosis["events"]
    assert all(set(event) >= {"band", "signal", "t_in", "t_out"} and event["t_in"] < event["t_out"]
               for event in diagnosis["events"])


def test_another_command_is_judged_without_bands(folder: Path) -> None:
    diagnosis = diagnose(Trace.read(folder / "short.csv"))
    assert diagnosis.levels == {CLOGGING.name: Level.ACCEPTABLE, FRICTION.name: Level.MAINTENANCE}
    assert (diagnosis.band_verdict, diagnosis.events) == (None, ()) and any(
        note.startswith("no bands") for note in diagnosis.notes)
    assert diagnosis.sizes[FRICTION.name].value == pytest.approx(45.0, rel=0.06)


def test_a_fault_that_only_the_bands_blame_is_explained(folder: Path, tmp_path: Path) -> None:
    """A null bias moves the response out of the bands of clogging; the fit knows better, and that is said."""
    record_plant({"null_bias.current": 2.4e-4}).write_csv(tmp_path / "biased.csv")
    result = rig("fdi", tmp_path / "biased.csv", "--out", tmp_path / "biased.html")
    page = (tmp_path / "biased.html").read_text()
    assert result.status == 0 and result.out.startswith("ACCEPTABLE")
    for text in (" ".join(result.out.split()), page):
        bias = re.search(r"filter clogging: the bands call it non-nominal.* beside null bias ([\d.]+) mA", text)
        assert bias and float(bias[1]) == pytest.approx(0.24, rel=0.05)
    assert len(re.findall(r"<td[^>]*>step to 0 mm</td>", page)) > 1  # two steps, two lines
    assert "eha-rig" in page and "mathdefault" not in page


def test_nothing_is_blamed_where_something_else_is_wrong() -> None:
    """Spool and ram see a lag of the transducer that no fault and no tolerance explains."""
    diagnosis = diagnose(record_plant({"sensor_lag.time": 3e-3}, SHORT))
    assert diagnosis.verdict == "SOMETHING_ELSE" and diagnosis.ruling is None
    assert all(each in (None, Level.ACCEPTABLE) for each in diagnosis.levels.values())
    assert all(0.0 <= size.low <= size.value <= size.high for size in diagnosis.sizes.values())
    assert "Something else is wrong" in describe_verdict(diagnosis)


def test_a_gap_is_told(folder: Path, tmp_path: Path) -> None:
    """A quarter of a second is missing while the ram moves on: what is left is judged."""
    trace = Trace.read(folder / "est.csv")
    is_present = np.abs(np.arange(len(trace)) - 9824.5) > 125.0
    columns = {name: np.where(is_present, trace.column(name), np.nan) for name in ("com", "xj", "cor", "p12", "xs")}
    Trace.from_columns(columns, trace.period, {}).write_csv(tmp_path / "gap.csv")
    diagnosis = diagnose(Trace.read(tmp_path / "gap.csv"), load_model())
    assert any("missing in 250 of 13500 rows" in note for note in diagnosis.notes)
    assert all(each in (None, Level.ACCEPTABLE) for each in diagnosis.levels.values()) and diagnosis.ruling is None


def test_a_unit_without_leakage_is_judged(folder: Path) -> None:
    """A parameter that is zero in the model has no logarithm."""
    assert rig("fdi", folder / "short.csv", "--set", "jack.leakage=0", "--json").json["refined"]["kintas"]["low"] == 0.0
