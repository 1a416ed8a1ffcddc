"""The C firmware for tests: its datagrams in this process; programs with faults or sanitizers, beside a test."""

import contextlib
import ctypes
import shutil
import subprocess
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from rig.firmware.build import FLAGS, FOLDER, build_program

SUPPORT = Path(__file__).parent / "firmware"
STRICT = (*FLAGS, "-Werror")
UNDEFINED = ("-g", "-fsanitize=undefined", "-fno-sanitize-recover=all")


class CFrame(ctypes.Structure):
    """`struct frame`."""

    _fields_ = [("t_ns", ctypes.c_int64), ("cob_id", ctypes.c_uint32), ("length", ctypes.c_uint8),
                ("data", ctypes.c_uint8 * 8)]


def skip_without_compiler() -> None:
    """Skip the test that calls this where there is no C compiler."""
    if not any(map(shutil.which, ("gcc", "cc", "clang"))):
        pytest.skip("no C compiler: apt-get install gcc libc6-dev")


@cache
def load_datagrams() -> ctypes.CDLL:
    """The functions of datagram.c, with every warning an error and undefined behaviour a crash."""
    flags = (*STRICT, *UNDEFINED, "-shared", "-fPIC")
    library = ctypes.CDLL(str(build_program("datagram.so", [FOLDER / "datagram.c"], flags)))
    library.datagram_pack.restype = ctypes.c_size_t
    return library


SANITIZERS = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def build_faulty(*flags: str) -> Path:
    """The program with faults, every warning an error."""
    sources = [path for path in sorted(FOLDER.glob("*.c")) if path.name != "main.c"]
    return build_program("faulty", [*sources, SUPPORT / "faulty.c"], (*STRICT, *flags))


@contextlib.contextmanager
def run_program(*words: str | Path) -> Iterator[subprocess.Popen[str]]:
    """A program beside the test; it is terminated at the end, and must then end with status 0."""
    program = subprocess.Popen(list(map(str, words)), stderr=subprocess.PIPE, text=True)
    try:
        yield program
    finally:
        program.terminate()
        _, errors = program.communicate(timeout=120)
    assert (program.returncode, errors) == (0, "")
