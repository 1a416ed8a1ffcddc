"""Compiles the reference firmware, and devices of a user's own on its CANopen stack and ports.

    python -m rig.firmware.build [FOLDER]

compiles the C files of a folder, with the object table of the EDS in it if there is one, and prints the program's path.
Programs are kept under a hash of their sources and of the compiler.
"""

import hashlib
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from fdi.output import write_text, write_whole
from plant import InputError, RigError, find_cache_folder, require
from rig.firmware.object_table import write_object_table

FOLDER = Path(__file__).parent
REFERENCE = ("controller.c", "main.c", "object_table.c")  # the reference firmware; the rest is for any device
# Without fused multiply-add, so that the control law gives the bits of plant/pid.py.
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-pedantic")


def build_controller() -> Path:
    """The controller for SocketCAN and the project's UDP bus as a program of this machine, compiled if necessary.

    Raises:
        InputError: no C compiler is installed.
        RigError: the compiler reports an error.
    """
    return build_program("controller", sorted(FOLDER.glob("*.c")), FLAGS)


def build_device(folder: Path, flags: Sequence[str] = (*FLAGS, "-Werror")) -> Path:
    """The program of a folder with C files and at most one EDS, on this stack, compiled if necessary.

    Raises:
        InputError: the folder has no C file, its EDS cannot be read, or no C compiler is installed.
        RigError: the compiler reports an error.
    """
    own = sorted(folder.glob("*.c"))
    require(own, folder, "", "a folder with the C files of a device")
    stack = [path for path in sorted(FOLDER.glob("*.c")) if path.name not in REFERENCE]
    own += [_write_generated(write_object_table(eds)) / "object_table.c" for eds in folder.glob("*.eds")]
    return build_program(folder.resolve().name, [*own, *stack], flags)


def _write_generated(texts: dict[str, str]) -> Path:
    """A folder of the cache with these files."""
    folder = find_cache_folder() / f"generated-{hashlib.sha256(repr(texts).encode()).hexdigest()[:16]}"
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        write_text(folder / name, text)
    return folder


def build_program(name: str, sources: Sequence[Path], flags: Sequence[str]) -> Path:
    """Compile and link C `sources` (headers: their folders and this one) to a program or library in the cache folder.

    Raises:
        InputError: no C compiler is installed.
        RigError: the compiler reports an error.
    """
    compiler = find_compiler()
    folders = list(dict.fromkeys([*(source.parent for source in sources), FOLDER]))
    files = sorted({*sources, *(path for folder in folders for path in folder.glob("*.h"))})
    digest = hashlib.sha256(repr((compiler, Path(compiler).stat().st_mtime_ns, flags)).encode())
    for path in files:
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    program = find_cache_folder() / f"{name}-{digest.hexdigest()[:16]}"
    if not program.exists():
        program.parent.mkdir(parents=True, exist_ok=True)
        compile_c(compiler, [*flags, *(f"-I{folder}" for folder in folders), *map(str, sources)], program)
    return program


def find_compiler(where: str = "--controller", use: str = "to build the firmware with") -> str:
    """The path of the C compiler. Raises InputError, with what it is for, if there is none."""
    for name in ("gcc", "cc", "clang"):
        if path := shutil.which(name):
            return path
    raise InputError(where, "", f"a C compiler {use}: apt-get install gcc libc6-dev")


def compile_c(compiler: str, words: Sequence[str], program: Path) -> None:
    """Run the compiler; the finished program takes its name in one step, because two runs may build at once.

    Raises:
        RigError: with the first error that the compiler reports.
    """
    with write_whole(program) as part:
        process = subprocess.run([compiler, *words, "-o", str(part), "-lm"], capture_output=True, text=True,
                                 check=False)
        if process.returncode != 0:
            messages = process.stderr.splitlines()
            lines = [line for line in messages if "error" in line or "undefined" in line] or messages
            raise RigError(f"{compiler}: {(lines or ['no message'])[0]}")


if __name__ == "__main__":
    try:
        print(build_device(Path(*sys.argv[1:2])))
    except RigError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
