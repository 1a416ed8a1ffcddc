"""`rig diff` as typed: words, files and exit status."""
from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from synthetic_run import record_run

from fdi.trace.trace import Trace
from rig.cli.main import main


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A short run as a log, and a CSV of it."""
    folder = tmp_path_factory.mktemp("runs")
    log = record_run(folder / "trace.mcap", stop=2000)
    Trace.read(log, all=True).write_csv(folder / "run.csv")
    return log, folder / "run.csv"


def test_a_run_is_the_same_as_itself_in_any_format(runs: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["diff", *map(str, runs), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["verdict"] == "SAME" and answer["pairs"][0]["same_command"]
    assert answer["runs"][1]["source"] == str(runs[1]) and not any(check["changed"] for check in answer["checks"])


def test_another_run_is_different_and_gets_a_page(runs: tuple[Path, Path], tmp_path: Path,
                                                  capsys: pytest.CaptureFixture[str]) -> None:
    trace = Trace.read(runs[1])
    other = tmp_path / "other.csv"
    rows = np.column_stack([trace.t, trace.com, trace.xj + 1e-4 * (trace.t > 1.0), trace.cor])
    np.savetxt(other, rows, delimiter=",", header="t,com,xj,cor", comments="", fmt="%.9g")
    assert main(["diff", str(runs[1]), str(other), "--report"]) == 1
    text, page = capsys.readouterr().out, (tmp_path / "diff.html").read_text(encoding="utf-8")
    assert text.startswith("DIFFERENT") and "P12 of B: only A has it" in text
    assert "B - A" in page and page.count("<svg") == 1


def test_one_run_is_not_enough(runs: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["diff", str(runs[0])])
    assert "required: B" in capsys.readouterr().err
    assert main(["diff", str(runs[0]), "absent.csv"]) == 2 and "absent.csv" in capsys.readouterr().err
