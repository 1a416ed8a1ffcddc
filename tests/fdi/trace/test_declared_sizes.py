"""Declared sizes are limited: no small file may take gigabytes. Each is read by the command, with little memory."""
from __future__ import annotations

import gzip
import json
import resource
import subprocess
import sys
from pathlib import Path

import pytest
from changed_logs import write_bomb

from fdi.trace.trace import Trace
from plant import InputError
from plant.unpacking import UnpackingError, limit_unpacked_size, unpack_gzip

MEMORY = 1 << 30  # bytes of address space: the program itself takes a third of it


def rig_with_little_memory(*words: object) -> subprocess.CompletedProcess[str]:
    """The command in a process that may not have more than MEMORY."""
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))

    return subprocess.run([sys.executable, "-m", "rig.cli.main", *map(str, words)], preexec_fn=limit, text=True,
                          capture_output=True, timeout=120, env={"OPENBLAS_NUM_THREADS": "1", "PATH": "/usr/bin:/bin"})


def refused(said: subprocess.CompletedProcess[str]) -> bool:
    """Whether a command reported bad input in one line."""
    return said.returncode == 2 and said.stderr.count("\n") == 1 and not said.stdout and "Memory" not in said.stderr


@pytest.mark.parametrize("kind", ["attachment", "record", "one chunk", "lying chunk", "many chunks",
                                  "one chunk indexed often"])
def test_a_small_log_does_not_take_gigabytes(kind: str, tmp_path: Path) -> None:
    log = write_bomb(tmp_path / "trace.mcap", kind)
    for words in (("report", log), ("run", "--from", log), ("fdi", log), ("export", log, "--out", tmp_path / "x.log")):
        assert refused(said := rig_with_little_memory(*words)), (words, said)
    said = rig_with_little_memory("recover", log)  # keeps what is sound, if there is anything
    assert said.returncode in (0, 2) and "Traceback" not in said.stderr, said


def test_a_packed_table_does_not_take_gigabytes(tmp_path: Path) -> None:
    long_line, long_table = tmp_path / "line.csv.gz", tmp_path / "table.csv.gz"
    long_line.write_bytes(gzip.compress(b"t,com,xj,cor" + b" " * (1 << 27)))
    row = b"".join(b"%d.0,%s,0,0\n" % (k, b"0" * 2000) for k in range(100_000))
    long_table.write_bytes(gzip.compress(b"t,com,xj,cor\n" + row))
    for table in (long_line, long_table):
        assert table.stat().st_size < 1_000_000
        assert refused(said := rig_with_little_memory("report", table)), said
        assert refused(said := rig_with_little_memory("simulate", "--command", table)), said


def test_numbers_of_cycles_do_not_take_gigabytes(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("t,com,xj,cor\n" + "".join(f"{0.001 * k:.3f},0,0,0\n" for k in range(500)) +
                                    "4000000,0,0,0\n")
    with pytest.raises(InputError, match="gaps that leave"):
        Trace.read(tmp_path / "t.csv")


def test_brackets_do_not_end_the_program(tmp_path: Path) -> None:
    deep = "[" * 20_000 + "]" * 20_000
    (tmp_path / "m.toml").write_text(f"name = {deep}")
    (tmp_path / "s.toml").write_text(f"title = {deep}")
    (tmp_path / "keys.toml").write_text("title" + ".a" * 5_000 + " = 1")
    (tmp_path / "a.json").write_text(json.dumps({"points": 0}).replace("0", "[" * 200_000 + "]" * 200_000))
    for words in (("simulate", "--model", "m.toml"), ("run", "s.toml"), ("run", "keys.toml"), ("trend", "a.json"),
                  ("fdi", "t.csv", "--bands", "m.toml"), ("campaign", "m.toml")):
        said = rig_with_little_memory(*(tmp_path / word if "." in word else word for word in words))
        assert refused(said), (words, said)


def test_gzip_is_unpacked_up_to_its_limit() -> None:
    assert unpack_gzip(gzip.compress(b"one") + gzip.compress(b"two") + bytes(20)) == b"onetwo"
    most = limit_unpacked_size(100_000)
    with pytest.raises(UnpackingError, match="more than"):
        unpack_gzip(gzip.compress(bytes(most + 20_000_000), 9))
    for damaged in (gzip.compress(b"abc")[:-3], b"\x1f\x8bnothing"):
        with pytest.raises(UnpackingError):
            unpack_gzip(damaged)
