"""The benchmarks run, say what they measured, and say what they could not."""
from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from physics_cases import PREFLIGHT

from rig import bench, cli

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason=f"no gcc; {bench.GET_GCC}")


@needs_gcc
def test_c_and_python_take_the_same_step() -> None:
    cost = bench.step_vs_c(PREFLIGHT, rounds=3)
    assert cost is not None
    assert cost.identical
    assert cost.difference < 1e-9  # m, with another rounding: no more than stick-slip makes of it
    assert cost.ratio < 2.0  # 1.15 on a quiet machine; here only that nothing is grossly wrong


def test_without_gcc_it_says_so(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(bench.shutil, "which", lambda name: None)
    monkeypatch.setattr(bench, "cycle_cost", lambda: 4e-6)
    assert cli.main(["bench"]) == 0
    assert "step beside C: skipped, there is no gcc; to get it: apt-get install gcc" in capsys.readouterr().out


def test_json(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    monkeypatch.setattr(bench, "step_vs_c", lambda command: None)
    assert cli.main(["bench", "--json", "--out", str(tmp_path / "b.json")]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer == json.loads((tmp_path / "b.json").read_text())
    assert answer["times_real_time"] > 20
    assert 0 < answer["cycle"] < 1e-3


def test_a_path_that_cannot_be_written_is_told_in_one_line(
        monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(bench, "report", lambda command: {"step": None})
    assert cli.main(["bench", "--out", str(tmp_path / "none" / "b.json"), "--quiet"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--out" in line and "none/b.json: expected a file that can be written (No such file" in line


def test_a_cycle_from_python_costs_far_less_than_a_cycle() -> None:
    assert bench.cycle_cost(2000, 3) < 200e-6
