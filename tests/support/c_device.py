"""C code for tests: datagrams and devices in this process; programs with faults or sanitizers, beside a test."""

import contextlib
import ctypes
import shutil
import subprocess
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

from rig.firmware.build import FLAGS, FOLDER, build_device, build_program
from rig.network import Frame, Send

SUPPORT = Path(__file__).parent / "firmware"
STRICT = (*FLAGS, "-Werror")
UNDEFINED = ("-g", "-fsanitize=undefined", "-fno-sanitize-recover=all")


class CFrame(ctypes.Structure):
    """`struct frame`."""

    _fields_ = [("t_ns", ctypes.c_int64), ("cob_id", ctypes.c_uint32), ("length", ctypes.c_uint8),
                ("data", ctypes.c_uint8 * 8)]


SEND = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_uint32, ctypes.POINTER(ctypes.c_uint8), ctypes.c_uint8)


class COutput(ctypes.Structure):
    """`struct output`."""

    _fields_ = [("send", SEND), ("context", ctypes.c_void_p)]


class CNode:
    """A device of examples/ as a node of an embedded bus: its code in this process, with no time but the test's.

    Undefined behaviour ends the process. `arrange` puts the arguments of its `NAME_init` behind the state in order.
    """

    def __init__(self, send: Send, folder: Path, name: str, arrange: Callable[[COutput], tuple[object, ...]]) -> None:
        skip_without_compiler()
        self._library = ctypes.CDLL(str(build_device(folder, (*STRICT, *UNDEFINED, "-shared", "-fPIC"))))
        self._state = ctypes.create_string_buffer(1 << 16)  # larger than any of their states
        self._send = SEND(lambda context, cob_id, data, length: send(cob_id, bytes(data[:length])))
        self._name = name
        self._call("init", *arrange(COutput(self._send, None)))

    def _call(self, function: str, *arguments: object) -> None:
        getattr(self._library, f"{self._name}_{function}")(self._state, *arguments)

    def receive(self, frame: Frame) -> None:
        """A frame of another node."""
        data = (ctypes.c_uint8 * 8)(*frame.data)
        self._call("receive", ctypes.byref(CFrame(frame.t_ns, frame.cob_id, len(frame.data), data)))

    def tick(self, t_ns: int) -> None:
        """Its timers."""
        self._call("tick", ctypes.c_int64(t_ns))


needs_compiler = pytest.mark.skipif(not any(map(shutil.which, ("gcc", "cc", "clang"))),
                                    reason="no C compiler: apt-get install gcc libc6-dev")


def skip_without_compiler() -> None:
    """Skip the test whose fixture or device calls this where `needs_compiler` would skip it."""
    if needs_compiler.args[0]:
        pytest.skip(needs_compiler.kwargs["reason"])


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
