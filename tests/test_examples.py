"""The programs of examples/ do what their page says."""

import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from effect_files import restored_catalogue
from places import ROOT
from rig_command import rig
from short_runs import HIDDEN, write_measured_runs

EXAMPLES = ROOT / "examples"


def test_the_page_lists_every_program() -> None:
    page = (EXAMPLES / "README.md").read_text()
    assert [path.name for path in EXAMPLES.glob("*.py") if f"({path.name})" not in page] == []


def test_an_effect_of_ones_own() -> None:
    said = rig("effects", "--effects", EXAMPLES / "cogging.py", "cogging")
    assert said.status == 0 and "F sin(2 pi XJ / pitch)" in said.out


def test_a_sequence_with_own_profile_and_measure(tmp_path: Path) -> None:
    said = rig("run", EXAMPLES / "growing_sine.toml", "--out", tmp_path / "run", "--json")
    assert said.status == 0 and said.json["verdict"] == "PASS"
    checks = {check["name"]: check for check in said.json["checks"]}
    assert 0.0 < checks["RMS error"]["value"] < 500.0 and checks["no emergency"]["passed"]


def test_tests_of_a_controller(tmp_path: Path) -> None:
    words = ["-m", "pytest", "-q", "-p", "no:cacheprovider", str(EXAMPLES / "test_controller.py")]
    done = subprocess.run([sys.executable, *words,
                           "--rig-out", str(tmp_path / "results")], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    assert "3 passed" in done.stdout


def test_missing_physics_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                  capsys: pytest.CaptureFixture[str]) -> None:
    """The program on shorter recordings than those of `rig simulate --samples`; among all effects its search takes a
    minute.
    """
    def write_samples(words: list[str], cwd: Path, check: bool) -> None:
        assert words[-3:] == ["simulate", "--samples", "--quiet"]
        for file, name in zip(write_measured_runs(cwd, HIDDEN).values(), ("run", "run2", "held"), strict=True):
            file.rename(cwd / f"{name}.csv")

    program = str(EXAMPLES / "find_missing_physics.py")
    monkeypatch.setattr(sys, "argv", [program, str(tmp_path)])
    monkeypatch.setattr(subprocess, "run", write_samples)
    with restored_catalogue("null_bias", "constant_load", "spool_friction", "jack_friction"):
        runpy.run_path(program, run_name="__main__")
    said = capsys.readouterr().out
    assert "null_bias" in said and said.rstrip().endswith("WITHIN_FLOOR")
    assert "<svg" in (tmp_path / "residual.svg").read_text() and (tmp_path / "better.toml").exists()
