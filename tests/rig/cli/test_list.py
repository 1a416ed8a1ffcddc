"""`rig list`: every name that a command takes; `rig` alone says what to do first; completion in the shell."""
from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from rig_command import refuse, rig

from plant import Model, load_model
from plant.effects import CATALOGUE
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


@pytest.mark.parametrize(("kind", "begin", "names"), [
    ("parameter", "filter.c", ["filter.clogging="]), ("effect", "null_b", ["null_bias"]),
    ("model", "", ["eha", "ehs", "servo", "own.toml", "ownfolder/"]), ("sequence", "pre", ["preflight"]),
    ("sequence", "own", ["own.toml", "ownfolder/"])])
def test_names_that_options_take(kind: str, begin: str, names: list[str], tmp_path: Path,
                                 monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("ownfolder").mkdir()
    for name in ("own.toml", "own.txt"):
        Path(name).touch()
    assert getattr(completion, f"complete_{kind}")(begin) == names
    assert {name.rstrip("=") for name in completion.complete_parameter("")} >= set(Model().values)


@pytest.mark.skipif(importlib.util.find_spec("argcomplete") is None, reason="no argcomplete (extra shell)")
@pytest.mark.parametrize(("line", "expected"), [
    ("rig con", {"conformance"}), ("rig run --set filter.c", {"filter.clogging="}), ("rig run pref", {"preflight"}),
    ("rig run --model eh", {"eha", "ehs"}), ("rig list para", {"parameters"}),
    ("rig compare --rep", {"--repeat", "--report"})])
def test_the_answer_to_the_shell(line: str, expected: set[str], tmp_path: Path) -> None:
    answer = tmp_path / "answer"
    environment = {**os.environ, "_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line)),
                   "_ARGCOMPLETE_STDOUT_FILENAME": str(answer), "_ARGCOMPLETE_SUPPRESS_SPACE": "1",
                   "_ARGCOMPLETE_IFS": "\n", "PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "-m", "rig.cli.main"], env=environment, cwd=tmp_path, check=False,
                   capture_output=True, timeout=60)
    assert {word.strip() for word in answer.read_text().split("\n")} == expected
