"""Results are whole or absent: nothing is replaced unasked, and a full disk leaves no part of a file."""
from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import pytest
from rig_command import rig
from synthetic_run import record_run

from fdi.output import write_text, write_whole
from fdi.trace.trace import Trace
from plant import InputError

SMALLEST = 4096  # bytes that a file may have


def run_limited(*words: str) -> subprocess.CompletedProcess[str]:
    """`rig` in a process in which no file grows beyond SMALLEST bytes, as on a disk that is full then."""
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (SMALLEST, SMALLEST))

    return subprocess.run([sys.executable, "-B", "-m", "rig.cli.main", *words], capture_output=True, text=True,
                          preexec_fn=limit, check=False)


@pytest.mark.parametrize("name", ["run.csv", "run.mcap", "frames.asc"])
def test_a_full_disk_leaves_what_was_there_and_no_part(tmp_path: Path, name: str) -> None:
    record_run(tmp_path / "trace.mcap")
    Trace.read(tmp_path / "trace.mcap").write_csv(tmp_path / "in.csv")
    out = tmp_path / "out"
    out.mkdir()
    if name == "run.mcap":
        words = ["import", str(tmp_path / "in.csv"), "--out", str(out / name)]
    else:
        words = ["export", str(tmp_path / "trace.mcap"), "--out", str(out / name), "--force"]
    for before in (None, b"before"):
        if before is not None:
            (out / name).write_bytes(before)
        said = run_limited(*words)
        assert said.returncode == 2 and said.stderr.count("\n") == 1, said
        assert {path.name: path.read_bytes() for path in out.iterdir()} == ({} if before is None else {name: before})


def test_simulate_and_export_do_not_replace_a_file_unasked(tmp_path: Path) -> None:
    command = tmp_path / "c.csv"
    command.write_text("t,com\n0,0\n0.05,1e-3\n")
    out = tmp_path / "s.csv"
    simulate = ["simulate", "--command", str(command), "--steps", "10", "--out", str(out), "--quiet"]
    assert rig(*simulate).status == 0
    first = out.read_bytes()
    refused = rig(*simulate, "--seed", "1")
    assert refused.status == 2 and "--force" in refused.err and refused.err.count("\n") == 1
    assert out.read_bytes() == first
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
