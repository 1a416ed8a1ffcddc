"""`--fdi` with several runs: each is diagnosed, a fault fails its case, and all results say level and size."""
from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from junit_schema import read_valid_junit
from rig_command import Said, answer, refuse, rig
from short_sequences import SHORT

from fdi.trace.trace import Trace
from rig.run.job import JobChoice
from rig.sequences.checks import CheckResult
from rig.suite.suite import Case, CaseResult, read_suite_file, write_junit

STEPS = """
title = "Steps and a ramp"
setup = [{ kind = "hold", time = 0.1 }]
main = [
  { name = "step", kind = "step", to = 5e-3, time = 0.4 },
  { name = "ramp", kind = "ramp", to = 3e-3, time = 0.6 },
  { name = "back", kind = "step", to = 0.0, time = 0.4 },
]
checks = [{ name = "error", kind = "max_error", window = "ramp", unit = "mm", high = 5.0 }]
"""
SUITE = """
title = "Units"

[[case]]
name = "unit"
sequence = "steps.toml"
set = { "filter.clogging" = [0.0, 0.6] }
fdi = true

[[case]]
sequence = "short.toml"
requirement = "R-1"
"""


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Said]:
    """The folder of a suite with a healthy and a clogged unit and a run without diagnosis; what the command said."""
    folder = tmp_path_factory.mktemp("suite")
    (folder / "steps.toml").write_text(STEPS)
    (folder / "short.toml").write_text(SHORT)
    (folder / "suite.toml").write_text(SUITE)
    return folder / "out", rig("run", folder / "suite.toml", "--out", folder / "out", "--jobs", 2,
                               "--junit", folder / "out" / "junit.xml")


def test_a_fault_fails_its_case_and_no_other(suite: tuple[Path, Said]) -> None:
    folder, said = suite
    answer = json.loads((folder / "suite.json").read_text())
    healthy, clogged, plain = answer["cases"]
    assert [case["verdict"] for case in answer["cases"]] == ["PASS", "FAIL", "PASS"] and said.status == 1, said
    assert (healthy["fdi"]["verdict"], clogged["fdi"]["verdict"], plain["fdi"]) == ("ACCEPTABLE", "NON_NOMINAL", {})
    assert clogged["fdi"]["level"]["filter_clogging"] == "non_nominal"
    size = clogged["fdi"]["refined"]["kintas"]
    assert 0.35 < size["low"] < 0.6 < size["high"]
    assert all(check["passed"] for check in clogged["checks"])  # the fault alone fails it


def test_a_case_is_diagnosed_as_a_single_run(suite: tuple[Path, Said], tmp_path: Path) -> None:
    (tmp_path / "steps.toml").write_text(STEPS)
    alone = answer("run", tmp_path / "steps.toml", "--fdi", "--set", "filter.clogging=0.6", "--out", tmp_path / "run",
                   status=1)["fdi"]
    case = json.loads((suite[0] / "suite.json").read_text())["cases"][1]["fdi"]
    assert (alone["verdict"], alone["level"]) == (case["verdict"], case["level"])
    assert alone["refined"]["kintas"] == pytest.approx(case["refined"]["kintas"], rel=1e-9)
    assert Trace.read(tmp_path / "run").provenance["fdi.faults"].startswith("filter clogging non-nominal, Kintas 0.")


def test_report_and_page_show_level_and_size(suite: tuple[Path, Said]) -> None:
    folder, said = suite
    table = said.out.split("Servovalve\n")[1].split("A fault beyond acceptable")[0]
    assert table.count("Kintas 0") == table.count("FSS ") == 2 and table.count("non-nominal") == 1
    assert "rig fdi: filter clogging non-nominal, Kintas 0." in " ".join(said.out.split())
    page = (folder / "suite.html").read_text()
    assert "Filter clogging is non-nominal" in page and "size (95 % interval)" in page
    assert "Kintas 0." in (folder / "unit-filter.clogging=0.6" / "report.html").read_text()


def test_junit_has_the_diagnosis_as_a_test_of_its_own(suite: tuple[Path, Said]) -> None:
    folder, _ = suite
    healthy, clogged, plain = read_valid_junit(folder / "junit.xml")
    assert [each.get("failures") for each in (healthy, clogged, plain)] == ["0", "1", "0"]
    (failed,) = clogged.findall("testcase[failure]")
    assert failed.get("name") == "rig fdi" and "Kintas 0." in str(failed.findtext("failure"))
    assert "FSS 5" in str(healthy.findtext("testcase[@name='rig fdi']/system-out"))
    assert plain.find("testcase[@name='rig fdi']") is None


def judge(verdict: str, answer: dict[str, Any], *passed: bool) -> CaseResult:
    """A result of a diagnosed case with checks "a", "b", ..."""
    checks = tuple(CheckResult(name, "max_error", "xj", 1.0, "m", 0.0, 2.0, is_passed, 0.0, 1.0, "", ())
                   for name, is_passed in zip("abc", passed, strict=False))
    return CaseResult(Case("case", Path("case"), JobChoice(is_diagnosed=True), 1.0), verdict, "because", 1.0, checks,
                      fdi={"sentence": "In words.", **answer})


@pytest.mark.parametrize(("verdict", "word", "passed", "problems", "reason"), [
    ("FAIL", "SOMETHING_ELSE", [True], ["", "", "failure"], "rig fdi: SOMETHING_ELSE"),
    ("FAIL", "SOMETHING_ELSE", [False, False], ["", "failure", "failure", "failure"],
     "a and 1 more; rig fdi: SOMETHING_ELSE"),
    ("FAIL", "ACCEPTABLE", [False], ["", "failure", ""], "because"),
    ("FAIL", "ACCEPTABLE", [True], ["failure", "", ""], "because"),  # it did not end as the sequence says
    ("PASS", "CANNOT_TELL", [True], ["", "", "skipped"], "rig fdi cannot tell"),
    ("INVALID_TIMING", "SOMETHING_ELSE", [True], ["error", "", "skipped"], "because")])
def test_what_the_diagnosis_means_for_the_case(verdict: str, word: str, passed: list[bool], problems: list[str],
                                               reason: str, tmp_path: Path) -> None:
    result = judge(verdict, {"verdict": word}, *passed)
    (tmp_path / "j.xml").write_text(write_junit("t", [result]))
    found = [[child.tag for child in case if child.tag != "system-out"]
             for case in read_valid_junit(tmp_path / "j.xml").iter("testcase")]
    assert found == [[each] if each else [] for each in problems] and result.reason == reason


def test_the_option_holds_for_all_cases_and_the_key_for_one(tmp_path: Path) -> None:
    (tmp_path / "steps.toml").write_text(STEPS)
    (tmp_path / "short.toml").write_text(SHORT)
    (tmp_path / "suite.toml").write_text(SUITE)
    for base, expected in ((False, [True, True, False]), (True, [True] * 3)):
        _, variants = read_suite_file(tmp_path / "suite.toml", JobChoice(is_diagnosed=base), 1000.0)
        assert [variant.choice.is_diagnosed for variant in variants] == expected
    (tmp_path / "suite.toml").write_text(SUITE.replace("fdi = true", "fdi = 1"))
    line = refuse("run", tmp_path / "suite.toml", "--out", tmp_path / "out")
    assert "case[0].fdi: expected true or false, not 1" in line
