"""`rig list`, `rig doctor` and the shell: every name that a command takes, and what this machine can do."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from rig_command import answer, refuse, rig

from plant import Model, load_model
from plant.effects import CATALOGUE
from rig import doctor
from rig.cli import completion
from rig.cli.command_list import COMMANDS
from rig.cli.commands.list import KINDS
from rig.cli.main import FIRST_STEPS
from rig.sequences import checks, load_sequence


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_a_table_without_cut_words(kind: str) -> None:
    rows = rig("list", kind, "--json").json[kind]
    said = rig("list", kind)
    assert said.status == 0 and "…" not in said.out
    words = set(said.out.split())
    assert rows and all(row["name"] in words for row in rows)


def test_the_parameters_are_those_that_set_takes() -> None:
    rows = {row["name"]: row for row in rig("list", "parameters", "--json").json["parameters"]}
    assert rows.keys() >= Model().values.keys()
    assert rows.keys() >= {name for e in CATALOGUE.values() if e.port and e.file is None for name in e.parameters
                           if name.partition(".")[0] == "null_bias"}
    assert rows["filter.clogging"] == {"name": "filter.clogging", "unit": "1", "default": 0.0, "range": ">= 0, < 1"}
    assert rows["filter.law"]["default"] == "sqrt" and "linear" in rows["filter.law"]["range"]
    for name, row in rows.items():
        if isinstance(row["default"], float):
            load_model().replace({name: row["default"]})  # a default is a value that --set takes
    own = {row["name"]: row["default"] for row in
           rig("list", "parameters", "jack", "--set", "jack.mass=150", "--json").json["parameters"]}
    assert all("jack" in name for name in own) and own["jack.mass"] == 150.0


def test_sequences_checks_and_models_can_be_used() -> None:
    assert [row["name"] for row in rig("list", "checks", "--json").json["checks"]] == list(checks.KINDS)
    sequences, models = (rig("list", kind, "--json").json[kind] for kind in ("sequences", "models"))
    assert all(load_sequence(row["name"]).title == row["title"] for row in sequences)
    assert all(load_model(row["name"]).plant == row["plant"] for row in models)


def test_bad_kinds_are_one_line() -> None:
    assert "parameters" in refuse("list", "nonsense")
    nothing = rig("list", "signals", "nonsense")
    assert (nothing.status, nothing.out.split(".")[0]) == (0, "no signals of that name")


def test_the_first_steps_are_commands_that_exist() -> None:
    named = re.findall(r"^    rig (\w+)", FIRST_STEPS, re.MULTILINE)
    alone = rig()
    assert (alone.status, alone.out, alone.err.count("\n")) == (2, FIRST_STEPS + "\n", 1)
    assert len(named) >= 5 and set(named) <= set(COMMANDS)


@pytest.mark.skipif(importlib.util.find_spec("argcomplete") is None, reason="no argcomplete (extra shell)")
@pytest.mark.parametrize(("line", "expected"), [
    ("rig con", {"conformance"}), ("rig run --set filter.c", {"filter.clogging="}),
    ("rig compare --rep", {"--repeat", "--report"}), ("rig effects null_b", {"null_bias"}),
    ("rig run --model ", {"eha", "ehs", "ema", "servo", "emps", "own.py", "own.toml", "ownfolder/"}),
    ("rig check pre", {"preflight", "preflight_ema"}), ("rig check own", {"own.toml", "ownfolder/"})])
def test_the_answer_to_the_shell(line: str, expected: set[str], tmp_path: Path) -> None:
    (tmp_path / "ownfolder").mkdir()
    for name in ("own.toml", "own.py", "own.txt"):
        (tmp_path / name).touch()
    answer = tmp_path / "answer"
    environment = {**os.environ, "_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line)),
                   "_ARGCOMPLETE_STDOUT_FILENAME": str(answer), "_ARGCOMPLETE_SUPPRESS_SPACE": "1",
                   "_ARGCOMPLETE_IFS": "\n", "PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "-m", "rig.cli.main"], env=environment, cwd=tmp_path, check=False,
                   capture_output=True, timeout=60)
    assert {word.strip() for word in answer.read_text().split("\n")} == expected


def test_completion_knows_all_parameters() -> None:
    assert {name.rstrip("=") for name in completion.list_parameters()} >= set(Model().values)


@pytest.fixture(scope="module")
def findings() -> list[doctor.Finding]:
    return doctor.examine_machine(seconds=0.05)


def test_each_finding_is_there_once_and_says_what_it_is_for_and_how_to_get_it(findings: list[doctor.Finding]) -> None:
    for finding in findings:
        assert finding.area and finding.name and finding.found and finding.purpose, finding
        assert bool(finding.remedy) == (finding.status != "ok"), finding
    names = {finding.name for finding in findings}
    assert len(names) == len(findings) and names >= {
        "Python", "packages", "CAN in the kernel", "CAN interface", "CAN guest", "rerun", "Vulkan", "C compiler",
        "compiled code", "disk", "kernel", "priority", "memory lock", "clock", "timer at 1 kHz"}


def test_a_missing_package_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(doctor, "read_requirements", lambda: {"": ["numpy", "no-such-distribution"]})
    said = rig("doctor", "--seconds", "0")
    assert said.status == 1 and "missing: no-such-distribution" in said.out
    assert said.out.splitlines()[0] == "FAIL  The bench cannot run without: packages."


def test_tools_that_are_not_there_are_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_SEARCH_PATH", "/nowhere")
    found = {finding.name: finding for finding in [*doctor.examine_tools(), *doctor.examine_buses()]}
    assert found["C compiler"].status == "missing" and "gcc" in found["C compiler"].remedy
    assert found["CAN guest"].remedy == "apt-get install user-mode-linux kmod iproute2"


def test_json_is_one_object_and_nothing_else(tmp_path: Path) -> None:
    told = answer("doctor", "--seconds", "0", "--out", tmp_path / "doctor.json")
    assert told == json.loads((tmp_path / "doctor.json").read_text()) and told["verdict"] == "PASS"
    assert {"area", "name", "status", "found", "purpose", "remedy", "needed"} == set(told["findings"][0])
    assert rig("doctor", "--seconds", "0", "--quiet") == (0, "", "")
