"""Results are whole or absent, and nothing that was there is lost; `rig simulate` takes the seconds it says."""

import importlib.util
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rig_command import answer, refuse, rig
from synthetic_run import record_run

from fdi.output import write_text, write_whole
from fdi.trace.trace import Trace
from plant import InputError
from rig.recorder.convert import RAW_SUFFIXES

HEAD = "t,com,xj,cor\n"
COMMANDS = {  # name -> words, of what suffix the result is
    "view": (["view", "{log}", "--out", "{out}"], ".rrd"),
    "view, a picture": (["view", "{log}", "--out", "{out}"], ".png"),
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
    line = refuse(*(word.format(out=out, **sources) for word in words))
    assert line.startswith(f"rig {words[0]}: ") and {path: path.read_bytes() for path in before} == before
    return line


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
    (["report", "{log}", "--out", "{out}"], "log"), (["report", "{csv}", "--out", "{out}"], "csv"),
    (["export", "{csv}", "--out", "{out}"], "csv"), (["recover", "{log}", "--out", "{out}"], "log"),
    (["simulate", "--command", "{command}", "--out", "{out}"], "command")])
def test_the_source_is_not_written_over(sources: dict[str, Path], words: list[str], out: str) -> None:
    assert "expected another file than the one that is read" in _refused(words, sources, sources[out])


def test_an_export_without_frames_leaves_what_was_there(sources: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "old.blf").write_text("precious")
    assert rig("import", sources["csv"], "--out", tmp_path / "signals.mcap").status == 0
    assert rig("export", tmp_path / "signals.mcap", "--out", tmp_path / "old.blf").status == 2
    assert (tmp_path / "old.blf").read_text() == "precious"


SMALLEST = 4096  # bytes that a file may have


def run_limited(*words: str) -> subprocess.CompletedProcess[str]:
    """`rig` in a process in which no file grows beyond SMALLEST bytes, as on a disk that is full then."""
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (SMALLEST, SMALLEST))

    return subprocess.run([sys.executable, "-B", "-m", "rig.cli.main", *words], capture_output=True, text=True,
                          preexec_fn=limit, check=False)


@pytest.mark.parametrize("name", ["run.csv", "run.mcap", "frames.asc"])
def test_a_full_disk_leaves_what_was_there_and_no_part(tmp_path: Path, name: str) -> None:
    record_run(tmp_path / "trace.mcap", stop=3000)
    Trace.read(tmp_path / "trace.mcap").write_csv(tmp_path / "in.csv")
    out = tmp_path / "out"
    out.mkdir()
    words = ["import", f"{tmp_path}/in.csv"] if name == "run.mcap" else ["export", f"{tmp_path}/trace.mcap", "--force"]
    words += ["--out", str(out / name)]
    for before in ({}, {name: b"before"}):
        for file, content in before.items():
            (out / file).write_bytes(content)
        said = run_limited(*words)
        assert (said.returncode, said.stderr.count("\n")) == (2, 1), said
        assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_simulate_and_export_do_not_replace_a_file_unasked(sources: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "s.csv"
    simulate = ["simulate", "--command", sources["command"], "--steps", "10", "--out", out, "--quiet"]
    assert rig(*simulate).status == 0
    first = out.read_bytes()
    assert "--force" in refuse(*simulate, "--seed", "1") and out.read_bytes() == first
    assert rig(*simulate, "--seed", "1", "--force").status == 0 and out.read_bytes() != first
    export = ["export", str(out), "--out", str(tmp_path / "e.csv")]
    assert [rig(*words).status for words in (export, export, [*export, "--force"])] == [0, 2, 0]


def test_a_failure_in_the_middle_leaves_the_file_before(tmp_path: Path) -> None:
    place = tmp_path / "a.txt"
    write_text(place, "before")
    place.chmod(0o640)
    with pytest.raises(ZeroDivisionError), write_whole(place) as part:
        part.write_text("half")
        raise ZeroDivisionError
    assert place.read_text() == "before" and list(tmp_path.iterdir()) == [place]
    write_text(place, "after")
    assert place.read_text() == "after" and place.stat().st_mode & 0o777 == 0o640


def test_links_and_devices_are_written_through(tmp_path: Path) -> None:
    (tmp_path / "real.txt").write_text("")
    (tmp_path / "link.txt").symlink_to(tmp_path / "real.txt")
    write_text(tmp_path / "link.txt", "text")
    assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "real.txt").read_text() == "text"
    write_text("/dev/null", "text")
    with pytest.raises(InputError, match="can be written"):
        write_text(tmp_path / "no" / "a.txt", "text")


def simulated(folder: Path, *words: object) -> np.ndarray:
    """The trace of a simulation, by column."""
    told = answer("simulate", "--out", folder / "s.csv", *words)
    table = np.genfromtxt(folder / "s.csv", delimiter=",", names=True)
    assert (table.dtype.names, len(table)) == (("t", "com", "xj", "cor", "p12", "xs", "load"), told["cycles"])
    return table


def written(folder: Path, t: np.ndarray, com: np.ndarray, load: np.ndarray) -> Path:
    rows = "\n".join(f"{a:.4f},{b!r},{c!r}" for a, b, c in zip(t, com.tolist(), load.tolist(), strict=True))
    (folder / "c.csv").write_text(f"t,com,load\n{rows}\n")
    return folder / "c.csv"


@pytest.mark.parametrize("period", [0.0005, 0.001, 0.002])
def test_a_ramp_and_a_step_keep_their_seconds(period: float, tmp_path: Path) -> None:
    """A ramp of 5 mm/s for 0.3 s, then a step of 1 mm, and a load that comes with it."""
    t = np.arange(501) / 1000
    com, load = np.where(t < 0.3, 5e-3 * t, 2.5e-3), np.where(t < 0.3, 0.0, 2e3)
    run = simulated(tmp_path, "--command", written(tmp_path, t, com, load), f"--set=controller.period={period}")
    assert run["t"][-1] == pytest.approx(0.5, abs=0.001) and np.diff(run["t"]) == pytest.approx(period)
    row = np.floor(run["t"] * 1000 + 1e-6).astype(int)
    assert (run["com"] == com[row]).all() and (run["load"] == load[row]).all()
    late = run["t"] > 0.1
    speed = np.polyfit(run["t"][late & (run["t"] < 0.3)], run["xj"][late & (run["t"] < 0.3)], 1)[0]
    assert speed == pytest.approx(5e-3, rel=0.02)
    assert run["xj"][-1] == pytest.approx(2.5e-3, abs=50e-6)
