"""A user's Python in a sequence: profile, check, steps; errors in it; code in a log runs only if it is trusted."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from refusals import catch_refusal
from rig_command import CommandResult, refuse, rig, write_file

from rig.sequences import load_sequence

DOCS = Path(__file__).parents[3] / "docs" / "sequences.md"
SEQUENCE = """
title = "Own"
main = [
  { name = "rest", kind = "hold", time = 0.05 },
  { name = "own", kind = "python", python = "own.py:smooth", time = 0.2, arguments = { to = 1e-3 } },
  { name = "back", kind = "ramp", to = 0.0, time = 0.1 },
]
steps = [
  { python = "own.py:note", when = "before", arguments = { word = "begin" } },
  { python = "own.py:note", when = "after", arguments = { word = "end" } },
]
[[checks]]
name = "largest"
kind = "python"
python = "own.py:largest"
window = "own"
high = 200
unit = "um"
requirement = "R-1"
"""
CODE = """
import numpy as np

def smooth(t, start, to):
    return start + (to - start) * (t / t[-1]) ** 2

def largest(window):
    assert window.t[0] == 0.05 and len(window.p12) == 200
    return 1e6 * np.abs(window.error).max()

def note(run, word):
    print(word)
    with (run.folder / "notes.txt").open("a") as file:
        file.write(f"{word} {run.verdict!r}\\n")
"""


def write(folder: Path, sequence: str = SEQUENCE, code: str = CODE) -> Path:
    write_file(folder / "own.py", code)
    return write_file(folder / "own.toml", sequence)


def test_profile_check_and_steps_run_from_a_log_too(tmp_path: Path) -> None:
    result = rig("run", write(tmp_path), "--out", tmp_path / "a", "--json")
    check = result.json["checks"][0]
    assert result.status == 0 and check["passed"] and 1.0 < check["value"] < 200.0
    assert (check["unit"], check["requirement"], check["kind"]) == ("um", ["R-1"], "python")
    assert (tmp_path / "a" / "notes.txt").read_text() == "begin ''\nend 'PASS'\n"
    assert result.err == "begin\nend\n"  # what the code prints does not spoil the JSON answer
    profile = load_sequence(tmp_path / "own.toml").build_main_profile()
    assert profile.command[150] == pytest.approx(1e-3 * 0.25) and profile.sections[1].name == "own"

    (tmp_path / "own.py").unlink()  # the log has it
    line = refuse("run", "--from", tmp_path / "a", "--out", tmp_path / "b")
    assert "expected --trust" in line and "sequence/own.py" in line and not (tmp_path / "b").exists()
    again = rig("run", "--from", tmp_path / "a", "--out", tmp_path / "b", "--trust", "--json")
    assert again.status == 0 and again.json["checks"] == result.json["checks"]
    assert "trusted code: sequence/own.py" in again.err


def test_the_example_of_the_page_works(tmp_path: Path) -> None:
    block = DOCS.read_text().split("The files `settle.toml` and `settle.py`:\n")[1].split("\nAn exception")[0]
    toml, code = re.sub(r"^    ", "", block, flags=re.MULTILINE).split("import numpy as np", 1)
    write_file(tmp_path / "settle.py", "import numpy as np" + code)
    result = rig("run", write_file(tmp_path / "settle.toml", toml), "--out", tmp_path / "out", "--json")
    assert (result.status, result.json["checks"][0]["name"]) == (0, "energy of the error")
    assert (tmp_path / "out" / "note.txt").read_text() == "Own profile, own measure, seed 0"


def run_with(folder: Path, old: str, new: str, *, in_code: bool = True) -> CommandResult:
    source = CODE if in_code else SEQUENCE
    assert old in source
    text = source.replace(old, new)
    return rig("run", (write(folder, code=text) if in_code else write(folder, text)), "--out", folder / "out")


@pytest.mark.parametrize(("old", "new", "line"), [
    ("import numpy as np", "import nump", r"own\.py:2: expected code that runs.*ModuleNotFoundError"),
    ("def largest(window):", "def largest(window:", r"own\.py:7: expected Python \("),
    ("def largest(window):", "def smallest(window):", r"own\.py: largest: expected a function of this name"),
    ("def largest(window):", "def largest(window, more):", r"own\.py:7: largest: expected a function of 1 value \("),
    ("return start +", "raise SystemExit(0)  #", r"own\.py:5: smooth: expected code .* not SystemExit: 0"),
    ("* (t / t[-1]) ** 2", "", r"own\.toml:3: main: expected a function that returns 201 finite numbers.*float"),
    ("(t / t[-1])", "(t[1:] / t[-1])", r"own\.toml:3: main: .*an array of shape \(200,\)"),
    ("(t / t[-1])", "(t / 0.0)", r"own\.toml:3: main: .* with NaN or infinity"),
    ("print(word)", "1 / 0", r"own\.py:12: note: expected .*, not ZeroDivisionError: division by zero"),
    ("np.abs(window.error)", "np.abs(window.speed)", r"own\.py:9: largest: .*AttributeError.*'speed'"),
])
@pytest.mark.filterwarnings("ignore:.*encountered in")
def test_an_error_in_the_code_is_one_line(tmp_path: Path, old: str, new: str, line: str) -> None:
    result = run_with(tmp_path, old, new)
    (message,) = [text for text in result.err.splitlines() if text.startswith("rig run:")]
    assert result.status == 2 and re.search(line, message), result.err


@pytest.mark.parametrize(("old", "new", "line"), [
    ('"own.py:smooth"', '"lib/own.py:smooth"', r"own\.toml:5: main\[1\]\.python: expected FILE\.py:FUNCTION"),
    ('"own.py:smooth"', '"other.py:smooth"', r"own\.toml:5: main\[1\]\.python: expected a Python file beside"),
    ("{ to = 1e-3 }", "{ at = 1e-3 }", r"own\.py:4: smooth: expected a function of 2 values and the arguments at"),
    ("{ to = 1e-3 }", "{ to = [1] }", r"own\.toml:5: main\[1\]\.arguments\.to: expected a number or a text"),
    ('when = "before"', 'when = "during"', r"own\.toml:9: steps\[0\]\.when: expected 'after' or 'before'"),
    ('requirement = "R-1"', 'requirement = ""', r"own\.toml:19: checks\[0\]\.requirement: expected the id"),
])
def test_a_wrong_entry_is_one_line(tmp_path: Path, old: str, new: str, line: str) -> None:
    result = run_with(tmp_path, old, new, in_code=False)
    assert result.status == 2 and len(result.err.splitlines()) == 1 and re.search(line, result.err), result.err


@pytest.mark.parametrize(("expression", "why"), [("None", "no value"), ("float('nan')", "returned nan"),
                                                 ("'x'", "not a number")])
def test_a_value_that_cannot_be_measured_fails_the_check(expression: str, why: str, tmp_path: Path) -> None:
    result = run_with(tmp_path, "return 1e6 * np.abs(window.error).max()", f"return {expression}")
    detail = json.loads((tmp_path / "out" / "verdict.json").read_text())["checks"][0]["detail"]
    assert result.status == 1 and why in detail


def test_the_step_after_runs_even_if_the_run_cannot(tmp_path: Path) -> None:
    file = write(tmp_path, code=CODE.replace("np.abs(window.error)", "window.nothing"))
    assert rig("run", file, "--out", tmp_path / "out").status == 2
    assert (tmp_path / "out" / "notes.txt").read_text() == "begin ''\nend ''\n"
    assert (tmp_path / "out" / "trace.mcap").stat().st_size > 10_000  # the run itself is kept


def test_a_profile_is_computed_once_for_each_start(tmp_path: Path) -> None:
    """A function that is not the same twice does not make a run whose log contradicts itself."""
    sequence = load_sequence(write(tmp_path, code=CODE.replace("start + (to", "start + np.random.rand() * (to")))
    assert np.array_equal(sequence.build_main_profile().command, sequence.build_main_profile().command)


def test_a_file_of_a_bundle_that_is_missing_is_named(tmp_path: Path) -> None:
    sequence = load_sequence(write(tmp_path))
    assert set(sequence.bundle()) == {"own.toml", "own.py"}
    assert "own.py" in catch_refusal(type(sequence).from_bundle, {"own.toml": sequence.bundle()["own.toml"]})
