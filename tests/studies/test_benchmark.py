"""The benchmark of hidden effects: what is made, who answers, and what the scorer counts."""

import ast
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from studies.hidden_effects import score
from studies.hidden_effects.__main__ import main

SCRIPT = Path(score.__file__)


def truth(kind: str, effects: Sequence[str] = (), floors: float = 9.0, where: Sequence[str] = ("xj/s02", "xs/s03"),
          **more: Any) -> dict[str, Any]:
    """A truth as the maker writes it."""
    each = [{"name": name, "size": 1.0, "value": 20.0, "floors": {"xj": floors, "cor": 0.0}} for name in effects]
    return {"kind": kind, "signals": "xj,p12,xs", "effects": each, "floors": {"xj": floors},
            "where": list(where) if effects else [], "holdout_noise": {"xj": 2e-6}} | more


def answer(verdict: str, *effects: str, **more: Any) -> dict[str, Any]:
    return {"verdict": verdict, "effects": list(effects)} | more


FRICTION = "spool_friction"
PAIRS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "00000": (truth("nothing", floors=0.0), answer("nothing", seconds=30.0)),
    "00001": (truth("nothing", floors=0.0), answer("explained", "coil_lag", seconds=5.0, where=["xj/s03"])),
    "00002": (truth("one", [FRICTION]), answer("explained", FRICTION, holdout={"xj": 2.2e-6},
                                               where=["xj/s02", "xj/s04"],
                                               sizes={FRICTION: {"value": 20, "low": 19, "high": 21}})),
    "00003": (truth("one", [FRICTION]), answer("ambiguous", "coil_lag", FRICTION, holdout={"xj": 4e-6},
                                               sizes={FRICTION: {"value": 21, "low": 20.5, "high": 22}})),
    "00004": (truth("one", [FRICTION]), answer("explained", "coil_lag", where=["xj/s02"])),
    "00005": (truth("one", [FRICTION], floors=1.5), answer("nothing")),
    "00006": (truth("outside", ["periodic torque"]), answer("unexplained")),
    "00007": (truth("outside", ["periodic torque"], floors=1.0), answer("explained", "null_bias")),
    "00008": (truth("two", ["null_bias", "coil_lag"]), answer("explained", "coil_lag", "null_bias")),
    "00009": (truth("two", ["null_bias", "coil_lag"]), answer("partly", "null_bias")),
    "00010": (truth("one", [FRICTION]), answer("ambiguous", "a", "b", "c", FRICTION)),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A benchmark of invented cases, with invented answers."""
    (tmp_path / "truth").mkdir()
    for case, (hidden, _) in PAIRS.items():
        (tmp_path / "truth" / f"{case}.json").write_text(json.dumps(hidden))
    (tmp_path / "answers.json").write_text(json.dumps({"answers": {case: given for case, (_, given) in PAIRS.items()}}))
    return tmp_path


def run_script(*arguments: object) -> subprocess.CompletedProcess[str]:
    """The scorer as others run it: without site packages and without this project on the path."""
    return subprocess.run([sys.executable, "-I", "-S", str(SCRIPT), *map(str, arguments)], capture_output=True,
                          text=True, check=False)


def test_the_scorer_needs_the_standard_library_alone() -> None:
    tree = ast.parse(SCRIPT.read_text())
    modules = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    modules |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert {module.partition(".")[0] for module in modules} <= sys.stdlib_module_names


def test_rates_count_what_they_say(folder: Path) -> None:
    scores = json.loads(run_script(folder, folder / "answers.json", "--json").stdout)
    found = {rate["name"]: (rate["good"], rate["of"], rate["without"]) for rate in scores["rates"]}
    assert found == {
        "nothing: answered nothing": (1, 2, ["00001"]),
        "nothing: an effect is named": (1, 2, ["00000"]),
        "one: named": (2, 4, ["00004", "00010"]),
        "one: named alone, explained": (1, 4, ["00003", "00004", "00010"]),
        "one: wrong alone": (1, 4, ["00002", "00003", "00010"]),
        "one, below 2 floors: named": (0, 1, ["00005"]),
        "one, below 2 floors: wrong alone": (0, 1, ["00005"]),
        "one, named: true size in interval": (1, 2, ["00003"]),
        "one, named: held-out run at most 1.15 floors": (1, 2, ["00003"]),
        "two: both named": (1, 2, ["00009"]),
        "two: wrong alone": (0, 2, ["00008", "00009"]),
        "two, named: true sizes in intervals": (0, 0, []),
        "outside: unexplained or partly": (1, 1, []),
        "outside, any size: not explained": (1, 2, ["00007"]),
        "all: answered within 20 s": (1, 2, ["00000"])}
    assert scores["names_on_average"] == 1.5 and scores["seconds"] == {"median": 30.0, "longest": 30.0}


@pytest.mark.parametrize(("text", "expected"), [
    ("[", "expected a JSON file"),
    ("{}", "expected an object with one entry per case"),
    ('{"00002": {"verdict": "perhaps"}}', "case 00002: verdict: expected nothing, explained"),
    ('{"00099": {"verdict": "nothing"}}', "case 00099: case: expected one of the benchmark"),
    ('{"00002": {"verdict": "nothing", "effects": "coil_lag"}}', "case 00002: effects: expected a list"),
    ('{"00002": {"verdict": "nothing", "sizes": {"a": {"low": "x"}}}}', "sizes, holdout, seconds: expected finite"),
])
def test_bad_answers_are_refused_in_one_line(text: str, expected: str, folder: Path) -> None:
    (folder / "answers.json").write_text(text)
    done = run_script(folder, folder / "answers.json")
    assert done.returncode == 2 and done.stdout == "" and len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith(f"score.py: {folder / 'answers.json'}: ") and expected in done.stderr


@pytest.mark.parametrize(("options", "expected"), [
    (["--signals", "xj,pressure"], "--signals: xj,pressure: expected xj or xj,p12 or xj,p12,xs or drawn"),
    (["--cases", "0"], "--cases: 0: expected 1 or more"),
    (["--workers", "0"], "--workers: 0: expected 1 or more"),
    (["--answer", "explain"], "the folder of a benchmark, which --benchmark without --answer makes"),
    (["--out", "trial.txt"], "--out: trial.txt: expected FILE.json")])
def test_bad_options_are_refused_in_one_line(options: list[str], expected: str, tmp_path: Path,
                                             capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*options, "--benchmark", str(tmp_path / "made")]) == 2
    said = capsys.readouterr().err
    assert said.startswith("studies.hidden_effects: ") and expected in said and said.count("\n") == 1
    assert not (tmp_path / "made").exists()
