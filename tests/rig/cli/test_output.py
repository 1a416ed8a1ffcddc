"""Places that cannot be written: one line, status 2, and nothing that was there is lost."""
from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
from rig_command import rig
from synthetic_run import record_run

from rig.recorder.convert import RAW_SUFFIXES

HEAD = "t,com,xj,cor\n"
COMMANDS = {  # name -> words, of what suffix the result is
    "view": (["view", "{log}", "--save", "{out}"], ".rrd"),
    "view --out": (["view", "{log}", "--out", "{out}"], ".rrd"),
    "screenshot": (["view", "{log}", "--headless", "--screenshot", "{out}"], ".png"),
    "report": (["report", "{log}", "--out", "{out}"], ".html"),
    "export csv": (["export", "{log}", "--out", "{out}"], ".csv"),
    "export csv.gz": (["export", "{log}", "--out", "{out}"], ".csv.gz"),
    **{f"export {suffix}": (["export", "{log}", "--out", "{out}"], suffix) for suffix in RAW_SUFFIXES},
    "import csv": (["import", "{csv}", "--out", "{out}"], ".mcap"),
    "import frames": (["import", "{can}", "--out", "{out}"], ".mcap"),
    "recover": (["recover", "{log}", "--out", "{out}"], ".mcap"),
    "simulate mcap": (["simulate", "--command", "{command}", "--out", "{out}"], ".mcap"),
    "simulate csv": (["simulate", "--command", "{command}", "--out", "{out}"], ".csv"),
}


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("sources")
    files = {"log": record_run(folder / "trace.mcap", stop=400), "csv": folder / "x.csv", "can": folder / "x.log",
             "command": folder / "command.csv"}
    files["csv"].write_text(HEAD + "0,0,0,0\n0.001,0,0,0\n")
    files["can"].write_text("(0.000000) can0 080#\n(0.001000) can0 080#\n")
    files["command"].write_text("t,com\n0,0\n0.001,0\n0.002,0\n")
    return files


def _refused(words: list[str], sources: dict[str, Path], out: Path) -> str:
    if words[0] == "view" and importlib.util.find_spec("rerun") is None:
        pytest.skip("no rerun")
    before = {path: path.read_bytes() for path in sources.values()}
    said = rig(*(word.format(out=out, **sources) for word in words))
    assert said.status == 2 and said.out == "", said
    assert said.err.count("\n") == 1 and said.err.startswith(f"rig {words[0]}: "), said.err
    assert {path: path.read_bytes() for path in before} == before
    return said.err


@pytest.mark.parametrize("place", ["proc", "no folder", "a file as folder", "a folder"])
@pytest.mark.parametrize("command", COMMANDS)
def test_impossible_places(sources: dict[str, Path], tmp_path: Path, command: str, place: str) -> None:
    words, suffix = COMMANDS[command]
    (tmp_path / "file").write_text("precious")
    (tmp_path / f"folder{suffix}").mkdir()
    out = {"proc": Path(f"/proc/x{suffix}"), "no folder": tmp_path / "none" / f"x{suffix}",
           "a file as folder": tmp_path / "file" / f"x{suffix}", "a folder": tmp_path / f"folder{suffix}"}[place]
    error = _refused(words, sources, out)
    assert "expected a place that can be written" in error and str(out.with_suffix("")) in error
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", f"folder{suffix}"]
    assert (tmp_path / "file").read_text() == "precious"


@pytest.mark.parametrize(("words", "out"), [
    (["view", "{log}", "--save", "{out}"], "log"), (["view", "{log}", "--headless", "--screenshot", "{out}"], "log"),
    (["report", "{log}", "--out", "{out}"], "log"), (["report", "{csv}", "--out", "{out}"], "csv"),
    (["export", "{csv}", "--out", "{out}"], "csv"), (["recover", "{log}", "--out", "{out}"], "log")])
def test_the_source_is_not_written_over(sources: dict[str, Path], words: list[str], out: str) -> None:
    assert "expected another file than the one that is read" in _refused(words, sources, sources[out])


def test_an_export_without_frames_leaves_what_was_there(sources: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "old.blf").write_text("precious")
    assert rig("import", sources["csv"], "--out", tmp_path / "signals.mcap").status == 0
    assert rig("export", tmp_path / "signals.mcap", "--out", tmp_path / "old.blf").status == 2
    assert (tmp_path / "old.blf").read_text() == "precious"
