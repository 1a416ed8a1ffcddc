"""The C firmware as a program on a bus: sound, or with one of the faults of firmware/faulty.c."""

import contextlib
import subprocess
from collections.abc import Iterator
from pathlib import Path

from c_device import STRICT, SUPPORT

from rig.firmware.build import FOLDER, build_program

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
