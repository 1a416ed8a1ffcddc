"""`rig explain`, `rig add` and `rig remove` on runs made with a tenth of their step: answers, pages, model files."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from effect_files import STIFF, restored_catalogue
from rig_command import Said, answer, refuse, rig
from short_runs import HIDDEN, list_trace_arguments, write_measured_runs

from fdi.discovery import update_model
from fdi.estimation.fit import Value
from plant import Model, load_model

SIGNALS = {"xj", "p12", "xs"}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_measured_runs(tmp_path_factory.mktemp("runs"), HIDDEN)


@pytest.fixture(scope="module")
def found(runs: dict[str, Path]) -> Said:
    """One search; its page is page.html beside the run."""
    return rig("explain", *list_trace_arguments(runs), "--json", "--out", runs["est"].with_name("page.html"))


def test_the_effect_is_named_with_its_evidence(found: Said) -> None:
    said, hidden = found.json, HIDDEN["null_bias.current"]
    best, *others = said["candidates"]
    assert (found.status, said["verdict"], said["effects"]) == (1, "EXPLAINED", ["null_bias"])
    assert (best["effect"], best["word"]) == ("null_bias", "explains")
    assert best["ratio"] < 1.1 and best["evidence"] > 1000.0 and best["p_value"] < 1e-6
    current = best["parameters"]["null_bias.current"]
    assert current["unit"] == "A" and current["low"] < hidden < current["high"] < current["low"] + 0.1 * hidden
    assert all(other["ratio"] > best["ratio"] for other in others) and said["blind_to"] and said["notes"] == []


def test_baseline_and_floor(found: Said) -> None:
    base, best = found.json["baseline"], found.json["candidates"][0]
    for told in (base, best):
        assert set(told["error"]) == set(told["holdout"]) == set(base["floor"]) == SIGNALS
    assert base["floor"]["xj"] == pytest.approx(2e-6, rel=0.1) and base["error"]["xj"] > 10.0 * base["floor"]["xj"]
    assert all(best["error"][signal] < 1.1 * floor and best["holdout"][signal] < 1.15 * floor
               for signal, floor in base["floor"].items())


def test_effects_that_hide_in_the_tolerances_are_listed_with_what_would_reveal_them(found: Said) -> None:
    blind = {b["effect"]: b for b in found.json["blind_to"]}
    offset = blind["sensor_offset"]  # no size of it shows in a closed loop
    assert (offset["smallest_visible"], offset["usual"], offset["unit"]) == (None, 2e-4, "m")
    assert "end stop" in offset["revealed_by"]
    assert "null_bias" not in blind and "constant_load" not in blind
    assert "command_rate_limit" in found.json["seen_without_noise"]


@pytest.mark.slow
def test_both_effects_of_the_readme_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A repeat on which the right second effect misses another stop is no evidence against it."""
    monkeypatch.chdir(tmp_path)
    assert rig("simulate", "--samples", "--quiet").status == 0
    said = rig("explain", "run.csv", "--repeat", "run2.csv", "--holdout", "held.csv", "--json").json
    assert (said["verdict"], {*said["effects"]}) == ("EXPLAINED", {"null_bias", "jack_friction"})


def test_the_page_of_a_search_needs_no_network(found: Said, runs: dict[str, Path]) -> None:
    page = runs["est"].with_name("page.html").read_text()
    assert "null_bias explains the residual" in page and page.count("<svg") == 1
    assert "http" not in page.replace("http://www.w3.org", "")


@pytest.fixture(scope="module")
def added(runs: dict[str, Path]) -> tuple[Said, Path]:
    """The right effect in a new model file; not to be written to."""
    model = runs["est"].with_name("biased.toml")
    return rig("add", "null_bias", *list_trace_arguments(runs), "--json", "--out", model), model


@pytest.fixture
def model(added: tuple[Said, Path], tmp_path: Path) -> Path:
    """A copy of that file."""
    return Path(shutil.copy(added[1], tmp_path / "biased.toml"))


def test_the_error_falls_to_the_floor(added: tuple[Said, Path]) -> None:
    said, path = added
    floor, (before, after) = said.json["floor"], said.json["ledger"]
    assert (said.status, said.json["model"], said.json["helps"]) == (0, str(path), True)
    assert (before["effect"], after["effect"]) == (None, "null_bias")
    assert "null_bias added" in Path(said.json["report"]).read_text()
    assert min(before["error"]["xj"], before["holdout"]["xj"]) > 20.0 * floor["xj"]
    assert all(after["error"][signal] < 1.1 * level and after["holdout"][signal] < 1.15 * level
               for signal, level in floor.items())


def test_the_file_is_a_model_with_intervals_and_provenance(added: tuple[Said, Path], runs: dict[str, Path]) -> None:
    said, path = added
    model, known = update_model.load_model_file(path)
    assert model.effects == ("null_bias",) and load_model(path) == model
    value = said.json["parameters"]["null_bias.current"]
    assert model["null_bias.current"] == pytest.approx(value["value"], rel=1e-5)
    assert value["low"] < HIDDEN["null_bias.current"] < value["high"]
    assert re.search(r"^current = .*# A, .*\(95 %\)$", path.read_text(), re.MULTILINE)
    assert known.effects == ("null_bias",) and known.trace and known.trace.file == str(runs["est"])
    assert known.software.startswith("eha-rig") and [r.effect for r in known.ledger] == [None, "null_bias"]
    before = update_model.remove_all_effects(model, known)
    assert before.effects == () and before.values == Model().values


def test_a_run_at_rest_shows_next_to_nothing(tmp_path: Path) -> None:
    """Noise alone is left of it, also with a bias hidden: it does not say that nothing is missing."""
    command = tmp_path / "rest.csv"
    command.write_text("t,com\n0,0\n2,0\n")
    run = tmp_path / "run.csv"
    assert rig("simulate", "--command", command, "--set=null_bias.current=5e-5", "--out", run).status == 0
    said = rig("explain", run, "--json", "--out", tmp_path / "page.html").json
    assert (said["verdict"], said["effects"]) == ("NOT_RESOLVABLE", [])
    blind = {b["effect"]: b["revealed_by"] for b in said["blind_to"]}
    assert "motion" in blind["moving_mass"] and "gauge" in blind["filter_clogging"]


def test_such_a_model_simulates_and_lacks_nothing(model: Path, runs: dict[str, Path], tmp_path: Path) -> None:
    assert rig("simulate", "--model", model, "--out", tmp_path / "s.csv", "--quiet").status == 0
    said = rig("explain", *list_trace_arguments(runs), "--model", model, "--out", tmp_path / "found.json")
    assert said.status == 0 and said.out.startswith("NOTHING_MISSING")
    assert "the residual is noise" in said.out and "not detectable" in said.out and "next" not in said.out
    assert json.loads((tmp_path / "found.json").read_text())["verdict"] == "NOTHING_MISSING"


def test_the_ledger_goes_on_and_a_useless_effect_is_said_so(model: Path, added: tuple[Said, Path]) -> None:
    told = answer("add", "spool_overlap", "--model", model, status=1)  # the runs are those of the file
    assert not told["helps"] and [row["effect"] for row in told["ledger"]] == [None, "null_bias", "spool_overlap"]
    assert told["ledger"][0]["error"]["xj"] == pytest.approx(added[0].json["ledger"][0]["error"]["xj"], rel=1e-5)
    assert set(load_model(model).effects) == {"null_bias", "spool_overlap"}
    assert model.with_name("biased.toml.bak").read_text() == added[1].read_text()


def test_without_it_the_error_rises_again(model: Path, runs: dict[str, Path]) -> None:
    told = answer("remove", "null_bias", *list_trace_arguments(runs), "--model", model)
    before, after = told["ledger"][-2:]
    assert after["removed"] and after["effect"] == "null_bias"
    assert all(after[which]["xj"] > 10.0 * before[which]["xj"] for which in ("error", "holdout"))
    assert load_model(model).effects == () and update_model.read_provenance(model).effects == ()


def test_taken_out_without_a_run_all_else_stays(model: Path) -> None:
    mass = load_model(model)["jack.mass"]
    said = rig("remove", "null_bias", "--model", model)
    assert said.status == 0 and "give a TRACE" in said.out
    assert (load_model(model).effects, load_model(model)["jack.mass"]) == ((), mass)


def test_a_base_effect_comes_out_at_its_value_before(tmp_path: Path) -> None:
    path = tmp_path / "m.toml"
    path.write_text("[spool]\nstatic_friction = 40.0\ndynamic_friction = 30.0\n")
    assert rig("remove", "spool_friction", "--model", path, "--quiet").status == 0
    assert load_model(path).values == Model().values


@pytest.mark.parametrize(("line", "complaint"), [
    (["explain", "est", "--holdout", "est"], "a run that no fit has seen"),
    (["explain", "est", "--repeat", "est"], "the same command run again"),
    (["explain", "est", "--repeat", "holdout"], "another command is no repeat"),
    (["explain", "est", "--signals", "xj,q"], "--signals: q: expected some of xj,p12,xs"),
    (["explain", "est", "--out", "x.txt"], "FILE.html for a page, or FILE.json"),
    (["explain", "est", "--write-effect", "x.txt"], "FILE.py"),
    (["explain", "est", "--holdout", "nowhere.csv"], "a trace that can be read"),
    (["explain", "bare"], "cor"),
    (["add", "nul_bias", "est"], "did you mean null_bias?"),
    (["add", "null_bias"], "the measured run to fit"),
    (["add", "null_bias", "est", "--model", "model"], "one that is not in the model already"),
    (["add", "null_bias", "null_bias", "est"], "one that is not in the model already"),
    (["add", "spool_overlap", "spool_underlap", "est"], "spool_underlap or spool_overlap in a model, not both"),
    (["add", "current_noise", "est"], "this is noise of the bench"),
    (["add", "command_rate_limit", "est"], "a difference between Cor and the model's firmware"),
    (["add", "quantisation", "est"], "steps in the measured positions"),
    (["add", "null_bias", "est", "--holdout", "repeat", "--repeat", "repeat"], "a run that no fit has seen"),
    (["add", "null_bias", "est", "--out", "m.json"], "FILE.toml"),
    (["remove", "null_bias"], "the model file to remove the effect from"),
    (["remove", "coil_lag", "--model", "model"], "one that the model has (null_bias)"),
    (["remove", "null_bias", "coil_lag", "--model", "model"], "one effect at a time"),
])
def test_bad_input_is_told_in_one_line(line: list[str], complaint: str, runs: dict[str, Path], model: Path,
                                       monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(model.parent)
    columns, before = np.loadtxt(runs["est"], delimiter=",", skiprows=1)[:, :3], model.read_text()
    np.savetxt("bare.csv", columns, delimiter=",", header="t,com,xj", comments="")
    files = {**runs, "model": model, "bare": "bare.csv"}
    assert complaint in refuse(*(files.get(word, word) for word in line))
    assert model.read_text() == before and not Path("model.toml").exists()


def test_a_model_with_a_users_effect_finds_its_file_or_asks_for_it(tmp_path: Path) -> None:
    own, run, file = tmp_path / "own.py", tmp_path / "s.csv", tmp_path / "m.toml"
    own.write_text(STIFF.format(scale=1.0))
    with restored_catalogue():
        assert rig("simulate", "--effects", own, "--set=spring.stiffness=1e5", "--out", run, "--quiet").status == 0
        model = Model().replace({"spring.stiffness": 1e5})
        known = update_model.Provenance(effects=("spring",), effect_files=(str(own),))
        interval = {"spring.stiffness": Value(1e5, 9e4, 1.1e5, "N/m")}
        file.write_text(update_model.format_model_file(model, interval, known))
        assert update_model.load_model_file(file) == (model, known)
    with restored_catalogue():
        said = rig("compare", run, "--model", file, "--trust")
    assert said.status == 0 and str(own) in said.err, said.err
    own.rename(tmp_path / "elsewhere.py")
    for words in (["add", "null_bias", run], ["explain", run]):
        assert f"--effects {own} with it, where spring is defined" in refuse(*words, "--model", file)
