"""Completion in the shell: the names that options take, and the answer to a shell where argcomplete is installed."""
from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from plant import Model
from rig.cli import completion


def test_names_that_options_take(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert {name.rstrip("=") for name in completion.complete_parameter("")} >= set(Model().values)
    assert completion.complete_parameter("filter.c") == ["filter.clogging="]
    assert completion.complete_effect("null_b") == ["null_bias"]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.toml").write_text("")
    (tmp_path / "own.txt").write_text("")
    (tmp_path / "ownfolder").mkdir()
    assert completion.complete_model("") == ["eha", "ehs", "servo", "own.toml", "ownfolder/"]
    assert completion.complete_sequence("pre") == ["preflight"]
    assert completion.complete_sequence("own") == ["own.toml", "ownfolder/"]


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
