"""Suites: matrix, report, requirements, JUnit, diagnosis; a crash or a timeout costs only its case; dry runs."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from junit_schema import read_valid_junit
from places import ROOT
from rig_command import (
    SHORT,
    CommandResult,
    answer,
    finished,
    grown,
    interrupted,
    job,
    refuse,
    rig,
    started,
    write_file,
)

from fdi.trace import CheckResult
from rig.cli import is_suite_file
from rig.evidence.requirements import Evidence, JudgedCheck, trace_requirements
from rig.run import JobChoice
from rig.suite.dry_run import make_dry_run
from rig.suite.suite import (
    Case,
    CaseResult,
    build_suite,
    find_status,
    find_verdict,
    read_suite_file,
    write_junit,
)

CODE = """
import os, time

def crash(window):
    os.kill(os.getpid(), 9)

def hang(window):
    open(__file__ + ".hangs", "w").close()
    while True:
        time.sleep(0.01)

def fail(window):
    return window.nothing
"""
OWN_CHECK = '{{ name = "own", kind = "python", python = "own.py:{}", high = 1.0, requirement = "R-3" }},'
SUITE = """
title = "All kinds"
requirements = ["R-1", "R-2", "R-9"]

[[case]]
sequence = "short.toml"
seed = [1, 2]

[[case]]
name = "weak"
sequence = "short.toml"
set = { "filter.clogging" = 0.9, "jack.mass" = [90.0, 110] }
requirement = "R-2"

[[case]]
sequence = ["crash.toml", "fail.toml"]

[[case]]
sequence = "hang.toml"
timeout = 1.0
"""


def write_sequences(folder: Path) -> None:
    (folder / "short.toml").write_text(SHORT.replace("high = 30.0", 'requirement = "R-1", high = 30.0'))
    (folder / "own.py").write_text(CODE)
    for name in ("crash", "hang", "fail"):
        (folder / f"{name}.toml").write_text(SHORT.replace("checks = [", f"checks = [\n  {OWN_CHECK.format(name)}"))


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, CommandResult]:
    """The folder of a suite that ran as a user's command, and what the command said."""
    folder = tmp_path_factory.mktemp("suite")
    write_sequences(folder)
    (folder / "suite.toml").write_text(SUITE)
    process = started("run", folder / "suite.toml", "--out", folder / "out", "--junit", folder / "out" / "junit.xml",
                      "--jobs", 2)
    return folder / "out", finished(process)


def test_each_case_has_its_verdict_and_the_worst_is_that_of_the_suite(suite: tuple[Path, CommandResult]) -> None:
    folder, result = suite
    report = json.loads((folder / "suite.json").read_text())
    cases = {case["name"]: case for case in report["cases"]}
    assert list(cases) == ["short, seed 1", "short, seed 2", "weak, jack.mass=90", "weak, jack.mass=110", "crash",
                           "fail", "hang"]
    assert [(case["verdict"], case["seed"]) for case in cases.values()] == [
        ("PASS", 1), ("PASS", 2), ("FAIL", 0), ("FAIL", 0), ("ERROR", 0), ("ERROR", 0), ("ERROR", 0)], result
    assert (result.status, report["verdict"], report["jobs"]) == (1, "ERROR", 2)
    for name, why in (("crash", r"its process was ended by SIGKILL"), ("hang", "it took longer than 1 s"),
                      ("fail", r".*own\.py:13: fail: expected .*AttributeError.*")):
        assert re.fullmatch(why, cases[name]["why"])
    assert cases["weak, jack.mass=90"]["set"] == {"filter.clogging": 0.9, "jack.mass": 90.0}
    assert "jack.mass = 110 kg" in cases["weak, jack.mass=110"]["differences"]


def test_a_line_for_each_case_and_a_table(suite: tuple[Path, CommandResult]) -> None:
    lines = suite[1].out.splitlines()
    assert lines[0] == "All kinds: 7 cases, 2 at a time"
    assert sorted(line.split()[0] for line in lines[1:8]) == ["ERROR"] * 3 + ["FAIL"] * 2 + ["PASS"] * 2
    assert {word for line in lines[1:8] for word in line.split() if word.endswith("/7")} == {
        f"{n}/7" for n in range(1, 8)}
    assert lines[8] == "ERROR  5 of 7 cases did not pass: weak, jack.mass=90, weak, jack.mass=110, crash and 2 more."
    assert "Traceback" not in suite[1].err


def test_folders_and_page(suite: tuple[Path, CommandResult]) -> None:
    folder, _ = suite
    page = (folder / "suite.html").read_text()
    links = re.findall(r'<a href="([^"]+)"', page)
    assert set(links) == {"short-seed-1/report.html", "short-seed-2/report.html", "weak-jack.mass%3D90/report.html",
                          "weak-jack.mass%3D110/report.html"}
    for name in ("short-seed-1", "short-seed-2", "weak-jack.mass=90", "weak-jack.mass=110"):
        assert json.loads((folder / name / "verdict.json").read_text())["verdict"] in ("PASS", "FAIL")
        assert "R-1" in (folder / name / "report.html").read_text()
    assert "script" not in page and page.count("http") == 0


def test_requirements_are_traced(suite: tuple[Path, CommandResult]) -> None:
    folder, result = suite
    report = json.loads((folder / "suite.json").read_text())
    requirements = {each["id"]: each for each in report["requirements"]}
    assert list(requirements) == ["R-1", "R-2", "R-9", "R-3"]
    assert [each["verdict"] for each in requirements.values()] == ["FAIL", "FAIL", "NOT_COVERED", "OPEN"]
    assert [each["check"] for each in requirements["R-2"]["checks"]] == ["whole run"] * 2
    assert {(each["case"], each["verdict"]) for each in requirements["R-3"]["checks"]} == {
        ("crash", "OPEN"), ("fail", "OPEN"), ("hang", "OPEN")}
    assert "note      no check verifies R-9" in result.out


def test_junit_is_valid_and_complete(suite: tuple[Path, CommandResult]) -> None:
    folder, _ = suite
    root = read_valid_junit(folder / "junit.xml")
    assert [each.get("errors") for each in root] == ["0"] * 4 + ["1"] * 3
    weak = root.find("testsuite[@name='weak, jack.mass=90']")
    (testcase,) = weak.findall("testcase[failure]")
    assert testcase.get("name") == "overshoot" and "requirement R-1" in str(testcase.findtext("system-out"))
    assert re.fullmatch(r"measured [\d.]+ %, limits <= 30 %", str(testcase[0].get("message")))
    assert {"R-1: overshoot", "R-2: whole run"} <= {each.get("value") for each in weak.findall("properties/property")}


def test_several_sequences_on_the_command_line_and_junit_of_one(tmp_path: Path) -> None:
    write_sequences(tmp_path)
    short = tmp_path / "short.toml"
    cases = rig("run", short, short, "--seed", 3, "--json", "--jobs", 1, "--out", tmp_path / "out").json["cases"]
    assert [(case["name"], Path(case["folder"]).name, case["seed"]) for case in cases] == [
        ("short", "short", 3), ("short (2)", "short-2", 3)]
    assert cases[0]["checks"] == cases[1]["checks"]
    assert rig("run", short, "--out", tmp_path, "--junit", tmp_path / "j.xml", "--quiet").status == 0
    root = read_valid_junit(tmp_path / "j.xml")
    assert [case.get("name") for case in root[0].findall("testcase")][:3] == ["run", "overshoot", "no emergency"]
    assert "R-1: overshoot" in [each.get("value") for each in root[0].findall("properties/property")]


@pytest.mark.parametrize(("old", "new", "line"), [
    ('sequence = "short.toml"\nseed', 'sequence = "shirt.toml"\nseed', r"suite\.toml:6: case\[0\]\.sequence: .*shirt"),
    ("seed = [1, 2]", "seed = [1, -2]", r"suite\.toml:7: case\[0\]\.seed: expected a whole number from 0 or a list"),
    ("seed = [1, 2]", "seed = []", r"suite\.toml:7: case\[0\]\.seed: expected at least one"),
    ("seed = [1, 2]", "seeds = [1, 2]", r"suite\.toml:7: case\[0\]\.seeds: expected a key: .*'seed'\?"),
    ('"jack.mass" = [90.0, 110]', '"jack.mas" = 90', r"jack\.mas: expected"),
    ('"jack.mass" = [90.0, 110]', '"jack.mass" = [90, -1]', r"jack\.mass: expected .*-1"),
    ("timeout = 1.0", "timeout = 0", r"suite\.toml:\d+: case\[3\]\.timeout: expected a number above 0"),
    ("timeout = 1.0", 'model = "none.toml"', r"none\.toml"),
    ("timeout = 1.0", 'model = "none.py"', r"\d/none\.py: expected"),
    ('title = "All kinds"', "", r"suite\.toml: expected also the key 'title'"),
])
def test_bad_input_is_one_line_before_anything_runs(tmp_path: Path, old: str, new: str, line: str) -> None:
    write_sequences(tmp_path)
    assert old in SUITE
    suite = write_file(tmp_path / "suite.toml", SUITE.replace(old, new))
    assert re.search(line, refuse("run", suite, "--out", tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_ctrl_c_writes_what_is_done(tmp_path: Path) -> None:
    write_sequences(tmp_path)
    suite = write_file(tmp_path / "suite.toml", 'title = "Long"\n[[case]]\nsequence = "short.toml"\n[[case]]\n'
                                                'sequence = ["hang.toml"]\nseed = [1, 2]\n')
    process = started("run", suite, "--out", tmp_path / "out", "--junit", tmp_path / "j.xml",
                      "--jobs", 1)
    while not process.stdout.readline().startswith("PASS"):
        assert process.poll() is None
    assert grown(tmp_path / "own.py.hangs", 0, process)
    result = interrupted(process)
    assert result.status == 130, result
    report = json.loads((tmp_path / "out" / "suite.json").read_text())
    assert [case["verdict"] for case in report["cases"]] == ["PASS", "NOT_RUN", "NOT_RUN"]
    assert len(read_valid_junit(tmp_path / "j.xml").findall("testsuite/testcase[skipped]")) == 2
    assert "Traceback" not in result.err and "3 at" not in result.out
    assert rig("report", tmp_path / "out" / "hang-seed-1", "--quiet").status == 0  # its log was closed


def make_result(verdict: str, *passes: bool, fdi: dict[str, str] | None = None) -> CaseResult:
    """A result of a case with checks "a", "b", .. that verify R-1; diagnosed if `fdi` is given."""
    checks = tuple(CheckResult(name=name, kind="max_error", signal="xj", value=1.0, unit="m", low=0.0, high=2.0,
                               passed=is_passed, t0=0.0, t1=1.0, requirement="R-1")
                   for name, is_passed in zip("abc", passes, strict=False))
    judged_checks = tuple(JudgedCheck(check.name, ("R-1",)) for check in checks)
    case = Case("case", JobChoice(is_diagnosed=bool(fdi)), 1.0, ("R-2",), Path("case"), judged_checks)
    return CaseResult(case, verdict, "because", 1.0, checks, fdi=fdi or {})


@pytest.mark.parametrize(("verdicts", "status", "worst"), [
    ("PASS PASS", 0, "PASS"), ("PASS NOT_JUDGED", 0, "NOT_JUDGED"), ("PASS INVALID_TIMING", 3, "INVALID_TIMING"),
    ("INVALID_TIMING FAIL", 1, "FAIL"), ("ABORTED PASS", 1, "ABORTED"), ("FAIL ERROR", 1, "ERROR")])
def test_the_exit_status_is_the_worst(verdicts: str, status: int, worst: str) -> None:
    results = [make_result(word) for word in verdicts.split()]
    assert (find_status(results, is_interrupted=False), find_verdict(results)) == (status, worst)
    assert find_status(results, is_interrupted=True) == 130


def test_a_late_bench_proves_nothing(tmp_path: Path) -> None:
    """Neither a passed nor a failed check of a run with invalid timing verifies a requirement; JUnit skips failures."""
    late = make_result("INVALID_TIMING", True, False)
    requirements = trace_requirements([late.judged], {})
    assert [(each.id, each.verdict) for each in requirements] == [("R-2", "OPEN"), ("R-1", "OPEN")]
    assert requirements[1].evidence == (Evidence("case", "a", "OPEN"), Evidence("case", "b", "OPEN"))
    (tmp_path / "j.xml").write_text(write_junit("t", [late, make_result("ABORTED", True), make_result("NOT_JUDGED")]))
    root = read_valid_junit(tmp_path / "j.xml")
    assert [[child.tag for child in case if child.tag != "system-out"] for case in root.iter("testcase")] == [
        ["error"], [], ["skipped"], ["failure"], [], ["skipped"]]


def test_the_example_of_the_page(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "suite.md").read_text()
    block = re.search(r"(?m)^    title = (?:.*\n)(?:(?:    .*)?\n)*", text)
    (tmp_path / "acceptance.toml").write_text(re.sub(r"(?m)^    ", "", block[0]))
    assert is_suite_file(str(tmp_path / "acceptance.toml"))
    content, cases = read_suite_file(tmp_path / "acceptance.toml", JobChoice())
    cases = build_suite(content.title, cases, {}).cases
    assert len(cases) == 7 and "This file makes 3 + 4 cases".lower() in " ".join(text.lower().split())
    for name in ("preflight, seed 2", "reactions, lost_feedback, jack.mass=80"):
        assert f"`{name}`" in text and name in [case.name for case in cases]
    assert [case.requirement for case in cases] == [("REQ-1",)] * 3 + [("REQ-2",)] * 4
    assert {case.timeout for case in cases[3:]} == {120.0} and cases[0].timeout > 400.0


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
UNITS = """
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
def units(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, CommandResult]:
    """The folder of a suite with a healthy and a clogged unit and a run without diagnosis; what the command said."""
    folder = tmp_path_factory.mktemp("suite")
    (folder / "steps.toml").write_text(STEPS)
    (folder / "short.toml").write_text(SHORT)
    (folder / "suite.toml").write_text(UNITS)
    return folder / "out", rig("run", folder / "suite.toml", "--out", folder / "out", "--jobs", 1,
                               "--junit", folder / "out" / "junit.xml")


def test_a_fault_fails_its_case_and_no_other(units: tuple[Path, CommandResult]) -> None:
    folder, result = units
    report = json.loads((folder / "suite.json").read_text())
    healthy, clogged, plain = report["cases"]
    assert [case["verdict"] for case in report["cases"]] == ["PASS", "FAIL", "PASS"] and result.status == 1, result
    assert (healthy["fdi"]["verdict"], clogged["fdi"]["verdict"], plain["fdi"]) == ("ACCEPTABLE", "NON_NOMINAL", {})
    assert clogged["fdi"]["level"]["filter_clogging"] == "non_nominal"
    size = clogged["fdi"]["refined"]["kintas"]
    assert 0.35 < size["low"] < 0.6 < size["high"]
    assert all(check["passed"] for check in clogged["checks"])  # the fault alone fails it


def test_report_and_page_show_level_and_size(units: tuple[Path, CommandResult]) -> None:
    folder, result = units
    table = result.out.split("Faults found by rig fdi\n")[1].split("A fault beyond acceptable")[0]
    assert table.count("Kintas 0") == table.count("FSS ") == 2 and table.count("non-nominal") == 1
    assert "rig fdi: filter clogging non-nominal, Kintas 0." in " ".join(result.out.split())
    page = (folder / "suite.html").read_text()
    assert "Filter clogging is non-nominal" in page and "size (95 % interval)" in page
    assert "Kintas 0." in (folder / "unit-filter.clogging=0.6" / "report.html").read_text()


def test_junit_has_the_diagnosis_as_a_test_of_its_own(units: tuple[Path, CommandResult]) -> None:
    folder, _ = units
    healthy, clogged, plain = read_valid_junit(folder / "junit.xml")
    assert [each.get("failures") for each in (healthy, clogged, plain)] == ["0", "1", "0"]
    (testcase,) = clogged.findall("testcase[failure]")
    assert testcase.get("name") == "rig fdi" and "Kintas 0." in str(testcase.findtext("failure"))
    assert "FSS " in str(healthy.findtext("testcase[@name='rig fdi']/system-out"))
    assert plain.find("testcase[@name='rig fdi']") is None


@pytest.mark.parametrize(("verdict", "word", "passes", "problems", "reason"), [
    ("FAIL", "SOMETHING_ELSE", [True], ["", "", "failure"], "rig fdi: SOMETHING_ELSE"),
    ("FAIL", "SOMETHING_ELSE", [False, False], ["", "failure", "failure", "failure"],
     "a and 1 more; rig fdi: SOMETHING_ELSE"),
    ("FAIL", "ACCEPTABLE", [False], ["", "failure", ""], "because"),
    ("FAIL", "ACCEPTABLE", [True], ["failure", "", ""], "because"),  # it did not end as the sequence says
    ("PASS", "CANNOT_TELL", [True], ["", "", "skipped"], "rig fdi cannot tell"),
    ("CANNOT_TELL", "ACCEPTABLE", [True], ["skipped", "", ""], "because"),  # a frame cut a signal off
    ("INVALID_TIMING", "SOMETHING_ELSE", [True], ["error", "", "skipped"], "because")])
def test_what_the_diagnosis_means_for_the_case(verdict: str, word: str, passes: list[bool], problems: list[str],
                                               reason: str, tmp_path: Path) -> None:
    result = make_result(verdict, *passes, fdi={"verdict": word, "sentence": "In words."})
    (tmp_path / "j.xml").write_text(write_junit("t", [result]))
    tags = [[child.tag for child in case if child.tag != "system-out"]
            for case in read_valid_junit(tmp_path / "j.xml").iter("testcase")]
    assert tags == [[each] if each else [] for each in problems] and result.reason == reason


FAR = """
title = "Far"
setup = [{ kind = "hold", time = 0.05 }]
main = [
  { name = "out", kind = "ramp", to = 0.05, time = 0.15 },
  { name = "end", kind = "hold", time = 0.1 },
]
load = [{ kind = "ramp", to = 4e4, time = 0.2 }]
checks = [{ name = "steps", kind = "settling_time", window = [0.0, 0.1], band = 2.0, high = 1.0 },
          { name = "never", kind = "response_within", after = 0.0, signal = "xj", above = 2.0, high = 1.0 }]
guards = [{ name = "far out", signal = "xj", high = 20.0, unit = "mm" }]
"""


def test_a_sequence_within_the_limits(tmp_path: Path) -> None:
    report = answer("check", "preflight")
    largest = {each["name"]: (each["value"], each["section"]) for each in report["demands"]}
    assert (report["verdict"], report["problems"], report["not_predicted"]) == ("WITHIN_LIMITS", [], ["no emergency"])
    assert report["durations"] == {"setup": 0.5, "main": 13.5, "cleanup": 0.5}
    assert (largest["position"][0], largest["step"]) == (5e-3, (5e-3, "step 5 mm"))
    assert largest["speed"] == (pytest.approx(2 * np.pi * 20 * 1e-3, rel=0.03), "chirp")
    assert largest["acceleration"][0] == pytest.approx((2 * np.pi * 20) ** 2 * 1e-3, rel=0.03)
    assert {each["signal"] for each in report["predicted"]["limits"]} == {"xs", "cor"}  # steps; no reason to refuse it


def test_the_prediction_is_that_of_the_run(preflight: Path) -> None:
    """Predicted without a bus, whose frames round the signals: the checks come out alike."""
    dry = make_dry_run(job((ROOT / "rig" / "sequences" / "preflight.toml").read_text()))
    checks = json.loads((preflight / "verdict.json").read_text())["checks"]
    run_values = {check["name"]: check["value"] for check in checks}
    assert {check.name: check.value for check in dry.checks} == pytest.approx(
        {check.name: run_values[check.name] for check in dry.checks}, rel=0.25) and len(dry.checks) == 16


def test_what_is_beyond_the_limits(tmp_path: Path) -> None:
    result = rig("check", write_file(tmp_path / "far.toml", FAR), "--out", tmp_path / "far.html")
    text, page = " ".join(result.out.split()), (tmp_path / "far.html").read_text()
    assert result.status == 1 and [words for words in (
        "BEYOND_LIMITS position 50 mm beyond 40 mm (jack.travel) in 'end', t = 0.150 s",
        "speed 333.3 mm/s beyond 250 mm/s (no-load speed) in 'out'", "load 40 kN beyond 30.15 kN (stall force)",
        "guard 'far out' violated at t = 0.0", "check 'steps': the command does not step here",
        "check 'never': the level was never passed")
        if words not in text] == []
    assert [words for words in ("BEYOND_LIMITS", "<svg", "stall force", "position [mm]", "no-load speed", "load [kN]",
                                "current [mA]") if words not in page] == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["far.html", "far.toml"]


FAULTS = """
faults = [
  { kind = "parameter", parameter = "filter.clogging", value = 0.9, start = 0.05, end = 0.25, ramp = 0.1 },
  { name = "some", kind = "lost", frame = "drive", start = 0.1, count = 2, every = 5 },
  { name = "biased", kind = "offset", signal = "xj", value = 1e-4, start = 0.3, end = 9.0 },
  { name = "mute", kind = "heartbeat", node = "plant", start = 0.2, end = 0.25 },
  { kind = "reset", start = 0.125 },
]
"""


def test_the_faults_of_a_sequence_are_listed_and_drawn(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(SHORT + FAULTS)
    result = rig("check", tmp_path / "s.toml", "--json")
    faults = {each["name"]: each for each in result.json["faults"]}
    assert {name: (each["kind"], each["target"], each["t0"], each["t1"]) for name, each in faults.items()} == {
        "parameter filter.clogging": ("parameter", "filter.clogging", 0.05, 0.25),
        "some": ("lost", "frame drive", 0.1, 0.106), "biased": ("offset", "sensor xj", 0.3, 0.35),
        "mute": ("heartbeat", "node plant", 0.2, 0.25), "reset node": ("reset", "node controller", 0.125, 0.126)}
    assert faults["biased"]["duration"] == pytest.approx(0.05)
    assert faults["parameter filter.clogging"]["size"] == "0 to 0.900 within 100 ms"
    result = rig("check", tmp_path / "s.toml", "--out", tmp_path / "s.html")
    text = " ".join(result.out.split())
    assert "biased sensor xj 0.300 0.350 100 um" in text and "ends with main at 0.35 s, not at 9 s" in text
    page = (tmp_path / "s.html").read_text()
    assert page.count("#ffd8a8") > 5 and all(f">{name}" in page.replace("> ", ">") for name in faults)
