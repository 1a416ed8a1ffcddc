"""The pytest plugin as a user's project sees it: a small project in a folder of its own, run by another pytest."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from places import ROOT
from refusals import catch_refusal
from rig_command import SHORT, rig

from rig.testing.bench import Bench, build_sequence, write_toml

STEP = [{"name": "rest", "kind": "hold", "time": 0.05}, {"name": "step", "kind": "step", "to": 1e-3, "time": 0.2}]
OVERSHOOT = {"name": "overshoot", "kind": "overshoot", "window": "step", "high": 30.0, "requirement": "R-1"}
PROJECT = f"""
STEP = {STEP}
OVERSHOOT = {OVERSHOOT}

def test_passes(rig_bench):
    run = rig_bench.run(command=STEP, checks=[OVERSHOOT])
    run.assert_passed()
    assert run.checks["overshoot"].passed and run.verdict == "PASS"
    assert len(run.trace) == 250 and abs(run.trace.xj[-1] - 1e-3) < 1e-4

def test_fails(rig_bench):
    rig_bench.run(command=STEP)
    rig_bench.run(command=STEP, checks=[dict(OVERSHOOT, high=1.0)]).assert_passed()

def test_model_of_the_command_line(rig_bench):
    assert rig_bench.run(command=STEP).outcome.job.model.name == "weak"

def test_bad_input(rig_bench):
    rig_bench.run(command=STEP, set={{"jack.mas": 1.0}})

def test_without():
    pass
"""


@pytest.fixture
def project(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> pytest.Pytester:
    """A user's project with this plugin and no other; one of its files is the example of docs/pytest.md."""
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    pytester.makepyfile(test_mine=PROJECT)
    page = (ROOT / "docs" / "pytest.md").read_text()
    block = re.search(r"    # test_controller\.py\n(?:(?:    .*)?\n)+?(?=    pytest )", page)
    pytester.makepyfile(test_example=re.sub(r"(?m)^    ", "", block[0]))
    (pytester.path / "weak.toml").write_text('name = "weak"\nplant = "eha"\n[supply]\npressure = 1.9e7\n')
    return pytester


def test_a_project_with_the_fixture(project: pytest.Pytester) -> None:
    result = project.runpytest_subprocess("-p", "rig_pytest", "--rig-model", "weak.toml", "--rig-out",
                                         "out", "--junitxml", "j.xml")
    result.assert_outcomes(passed=6, failed=2)
    result.stdout.fnmatch_lines(["test_example.py ...*", "test_mine.py .F.F.*"])
    result.stdout.re_match_lines([
        r"E +.*CheckFailedError: Command from Python: 1 of 11 checks not passed",
        r"E +overshoot: measured [\d.]+ %, limits <= 1 %, 0\.050 to 0\.250 s, requirement R-1",
        r"E +picture: .*out/test_mine\.py-test_fails/run-2/check-overshoot\.svg",
        r"E +page: .*out/test_mine\.py-test_fails/run-2/report\.html",
        r"-+ runs of rig_bench -+",
        r".*run-1: NOT_JUDGED: the sequence has no checks",
        r".*run-2: FAIL: overshoot",
        r"E +plant\.errors\.InputError: --set: jack\.mas: expected .*",
    ])
    assert "bench.py" not in result.stdout.str().split("test_bad_input")[0]  # the failure is shown at the user's line
    folder = project.path / "out" / "test_mine.py-test_fails" / "run-2"
    assert (folder / "check-overshoot.svg").read_text().startswith("<svg")
    assert "R-1" in (folder / "report.html").read_text()
    cases = {case.get("name"): case for case in ElementTree.parse(project.path / "j.xml").iter("testcase")}
    properties = [(each.get("name"), each.get("value")) for each in cases["test_fails"].iter("property")]
    assert properties[1][1] == f"FAIL {folder}" and properties[2] == ("requirement", "R-1 FAIL overshoot")
    assert not list(cases["test_without"].iter("property"))


def test_a_log_can_be_repeated(tmp_path: Path) -> None:
    run = Bench(tmp_path).run(command=list(np.linspace(0.0, 1e-3, 120)), seed=2, checks=[
        {"name": "error", "kind": "max_error", "high": 1.0, "unit": "mm"}])
    result = rig("run", "--from", run.folder, "--out", tmp_path / "again", "--json")
    assert result.json["checks"][0]["value"] == run.checks["error"].value and result.json["run"]["seed"] == 2


def test_faults_and_checks_are_added_to_a_sequence(tmp_path: Path) -> None:
    (tmp_path / "short.toml").write_text(SHORT)
    run = Bench(tmp_path / "out").run(
        tmp_path / "short.toml", set={"filter.clogging": 0.5},
        faults=[{"kind": "lost", "frame": "feedback", "start": 0.1, "end": 0.2, "every": 9}],
        checks=[{"name": "told", "kind": "event_occurs", "event": "lost"}])
    assert list(run.checks)[:3] == ["overshoot", "no emergency", "told"]
    assert any(event.kind == "fault" for event in run.events)
    assert "filter.clogging = 0.5" in run.outcome.to_json()["differences"]["text"]
    assert "did you mean overshoot?" in catch_refusal(run.assert_passed, "undershoot")


def test_text_of_a_table_is_the_same_table() -> None:
    table = {"title": 'a "b" \\ \n ü', "n": 3, "x": 1e-7, "on": True, "list": [{"to": np.float64(0.1), "k": [1, 2]}],
             "map": {"filter.clogging": 0.5, "spaced name": np.array([1.0, 2.0])}}
    read = tomllib.loads(write_toml(table))
    assert read == {**table, "list": [{"to": 0.1, "k": [1, 2]}],
                    "map": {"filter.clogging": 0.5, "spaced name": [1.0, 2.0]}}
    command = np.random.default_rng(0).normal(size=50) * 1e-4
    assert np.array_equal(build_sequence(None, command).build_main_profile().command, command)


@pytest.mark.parametrize(("arguments", "line"), [
    ({"sequence": "preflight", "command": STEP}, "either a sequence or a command"),
    ({"sequence": None, "command": STEP, "checks": [{"name": "x", "kind": "overshot"}]}, "did you mean 'overshoot'"),
    ({"sequence": None, "command": np.zeros(0)}, "command.csv"),
    ({"sequence": None, "command": np.array([0.0, np.nan])}, "a finite number"),
    ({"sequence": None, "command": [{"kind": "hold", "time": object()}]}, "not object"), ({"sequence": ""}, ".toml"),
    *(({"command": command}, "command: expected a demand for each cycle, all of them real numbers")
      for command in (5, "abc", np.zeros((3, 3)), np.zeros(100) + 1j, np.array(0.0), [1e-3, None])),
    ({"command": STEP, "set": [1]}, "set: expected values by parameter"),
])
def test_what_cannot_be_used_says_so(arguments: dict[str, object], line: str, tmp_path: Path) -> None:
    assert line in catch_refusal(Bench(tmp_path).run, **arguments)


def test_loading_the_plugin_costs_next_to_nothing() -> None:
    """It is loaded in every project of the environment: it imports nothing of the bench, nor what the bench imports."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert project["project"]["entry-points"]["pytest11"] == {"eha_rig": "rig_pytest"}
    assert project["tool"]["setuptools"]["py-modules"] == ["rig_pytest"]
    program = ("import os, pytest, sys; before, settings = set(sys.modules), dict(os.environ); import rig_pytest; "
               "assert dict(os.environ) == settings; print(*sorted(set(sys.modules) - before))")
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT)
    assert result.stdout.split() == ["rig_pytest"]
