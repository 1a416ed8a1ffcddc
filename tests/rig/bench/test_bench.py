"""The benchmarks run, say what they measured, and say what they could not."""
from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from physics_cases import PREFLIGHT

from rig.bench import plant, stopwatch
from rig.bench.recordings import build_long_recordings_report, make_command, record_unit
from rig.cli import main

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason=f"no gcc; {stopwatch.GET_GCC}")


@needs_gcc
def test_c_and_python_take_the_same_step() -> None:
    cost = plant.compare_step_with_c(PREFLIGHT, rounds=3)
    assert cost is not None and cost["identical"] and cost["ratio"] > 0.0
    assert cost["difference"] < 1e-9  # m, with another rounding: no more than stick-slip makes of it


def test_without_gcc_it_says_so(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
                                tmp_path: Path) -> None:
    """And the JSON answer has what was measured."""
    monkeypatch.setattr(stopwatch.shutil, "which", lambda name: None)
    for name, value in (("bus_run_speed", 10.0), ("run_process_speed", 6.0), ("help_time", 0.1)):
        monkeypatch.setattr(plant, f"measure_{name}", lambda value=value: value)
    assert main.main(["bench"]) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert "C skipped: gcc is not installed; to get it: apt-get install gcc" in words
    assert main.main(["bench", "--json", "--out", str(tmp_path / "b.json")]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer == json.loads((tmp_path / "b.json").read_text())
    assert answer["times_real_time"] > 0 and answer["cycle"] > 0
    assert (answer["run_process"], answer["help_process"]) == (6.0, 0.1)


def test_whole_processes_are_timed() -> None:
    assert plant.measure_help_time(rounds=1) > 0
    assert plant.measure_run_process_speed(rounds=1) > 0


def test_a_path_that_cannot_be_written_is_told_in_one_line(
        monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(plant, "run_benchmarks", lambda command, progress: {
        "step": None, "times_real_time": 1.0, "cycle": 1.0, "lockstep": 1.0, "run_process": 1.0, "help_process": 1.0})
    assert main.main(["bench", "--out", str(tmp_path / "none" / "b.json"), "--quiet"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--out" in line and "none/b.json: expected a file that can be written (No such file" in line


def test_cost_of_recordings(capsys: pytest.CaptureFixture[str]) -> None:
    """The table names length, CPU time and memory of each command; lengths that nobody can mean are refused."""
    costs = [{"command": "compare", "length": 1800.0, "cpu": 46.7, "memory": 1_350_000_000, "verdict": "WITHIN_FLOOR",
              "interrupted": 0.4}]
    report = build_long_recordings_report({"seed": 0, "cpus": 2, "costs": costs})
    assert report.sentence == "1800 s of recording at 1 kHz take 1.35 GB at most."
    assert main.main(["bench", "recordings", "--lengths", "60,x"]) == 2
    assert "--lengths" in capsys.readouterr().err


def test_recordings_repeat_by_their_seed() -> None:
    """A recording is as long as asked for, holds what a bench measures, and is the same for the same seed."""
    com = make_command(15.0, 3)
    assert len(com) == 15_000
    once, again = (record_unit(com[:2000], 3) for _ in range(2))
    assert once.signals == ("com", "xj", "cor", "p12", "xs", "load")
    assert (once.xs == again.xs).all()
    assert (record_unit(com[:2000], 4).xs != once.xs).any()
