"""The C firmware in this process: its CANopen stack and its controller behind the interfaces of the Python ones.

The stack takes any object dictionary, so the tests of `rig.device` run on it unchanged, with the EDS of any node. The
firmware also runs as a program, with faults built in or under the sanitizers.
"""

import contextlib
import ctypes
import shutil
import struct
import subprocess
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import pytest

from dbc import EDS
from plant.model import Model
from rig.device import Device, NmtState, SdoAbort, Value
from rig.device.dictionary import Dictionary, Entry
from rig.firmware.build import FLAGS, FOLDER, build_program
from rig.network.frame import Frame, Send
from rig.network.node_objects import GAINS, Gains

SUPPORT = Path(__file__).parent / "firmware"
STRICT = (*FLAGS, "-Werror")
UNDEFINED = ("-g", "-fsanitize=undefined", "-fno-sanitize-recover=all")
NEEDS_A_BUS = ("main.c", "options.c", "serve.c", "port_socketcan.c", "port_udp.c", "turn.c", "wait.c")
DOMAIN_BYTES = 1 << 20

_KINDS = {"f": 2, "d": 2, **dict.fromkeys("bhiq", 1)}
_TEXT, _DOMAIN = 3, 4


class _Object(ctypes.Structure):
    _fields_ = [("index", ctypes.c_uint16), ("sub", ctypes.c_uint8), ("kind", ctypes.c_uint8),
                ("size", ctypes.c_uint8), ("flags", ctypes.c_uint8), ("initial", ctypes.c_uint64),
                ("low", ctypes.c_int64), ("high", ctypes.c_int64), ("text", ctypes.c_char_p),
                ("text_length", ctypes.c_uint32)]  # fmt: skip


class _Dictionary(ctypes.Structure):
    _fields_ = [("objects", ctypes.POINTER(_Object)), ("count", ctypes.c_size_t),
                ("values", ctypes.POINTER(ctypes.c_uint64)), ("node_id", ctypes.c_uint8)]  # fmt: skip


class CFrame(ctypes.Structure):
    """`struct frame`."""

    _fields_ = [("t_ns", ctypes.c_int64), ("cob_id", ctypes.c_uint32), ("length", ctypes.c_uint8),
                ("data", ctypes.c_uint8 * 8)]  # fmt: skip


_Bytes = ctypes.POINTER(ctypes.c_uint8)
_SendFunction = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_uint32, _Bytes, ctypes.c_uint8)
_Plain = ctypes.CFUNCTYPE(None, ctypes.c_void_p)
_Numbered = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_uint16)
_Write = ctypes.CFUNCTYPE(ctypes.c_uint32, ctypes.c_void_p, ctypes.c_uint16, ctypes.c_uint8, _Bytes, ctypes.c_uint32)
_Change = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int, ctypes.c_int)
_Node = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_uint8)


class _Output(ctypes.Structure):
    _fields_ = [("send", _SendFunction), ("context", ctypes.c_void_p)]


class _Hooks(ctypes.Structure):
    _fields_ = [("context", ctypes.c_void_p), ("on_sync", _Plain), ("on_rpdo", _Numbered), ("on_write", _Write),
                ("on_nmt", _Change), ("on_sync_lost", _Plain), ("on_heartbeat_lost", _Node)]  # fmt: skip


def skip_without_compiler() -> None:
    """Skip the test that calls this where there is no C compiler."""
    if not any(map(shutil.which, ("gcc", "cc", "clang"))):
        pytest.skip("no C compiler: apt-get install gcc libc6-dev")


@cache
def load_library() -> ctypes.CDLL:
    """The firmware without its ports, with every warning an error and undefined behaviour a crash."""
    sources = [path for path in sorted(FOLDER.glob("*.c")) if path.name not in NEEDS_A_BUS]
    library = build_program("firmware.so", [*sources, SUPPORT / "host.c"], (*STRICT, *UNDEFINED, "-shared", "-fPIC"))
    loaded = ctypes.CDLL(str(library))
    loaded.host_device_size.restype = loaded.host_controller_size.restype = ctypes.c_size_t
    loaded.host_values.restype = ctypes.POINTER(ctypes.c_uint64)
    loaded.host_is_fresh.restype = loaded.device_init.restype = loaded.controller_init.restype = ctypes.c_bool
    loaded.device_init.argtypes = [ctypes.c_void_p, ctypes.c_uint8, _Dictionary, _Output, _Hooks, ctypes.c_void_p,
                                   ctypes.c_uint32]  # fmt: skip
    loaded.controller_init.argtypes = [ctypes.c_void_p, _Output]
    for receive, tick in ((loaded.device_receive, loaded.device_tick),
                          (loaded.controller_receive, loaded.controller_tick)):  # fmt: skip
        receive.argtypes = [ctypes.c_void_p, ctypes.POINTER(CFrame)]
        receive.restype = None
        tick.argtypes = [ctypes.c_void_p, ctypes.c_int64]
    loaded.host_clear.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_int16]
    return loaded


class _Stack:
    """A struct of the library and the calls on it.

    A Python error that a hook raises in the middle of a call is raised after it: C lets none through.
    """

    def __init__(self, kind: str, send: Send) -> None:
        self.library, self.kind = load_library(), kind
        self.memory = ctypes.create_string_buffer(getattr(self.library, f"host_{kind}_size")())
        self.output = _Output(_SendFunction(lambda _, cob_id, data, length: self.guard(
            send, cob_id, bytes(data[:length]))), None)
        self._errors: list[BaseException] = []

    def guard(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a hook from C; its error is kept."""
        try:
            return function(*arguments)
        except Exception as error:
            self._errors.append(error)

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function of the library on the struct."""
        result = getattr(self.library, name)(self.memory, *arguments)
        if self._errors:
            raise self._errors.pop()
        return result

    def receive(self, frame: Frame) -> None:
        """See `Device.receive`."""
        data = (ctypes.c_uint8 * 8)(*frame.data)
        self.call(f"{self.kind}_receive", ctypes.byref(CFrame(frame.t_ns, frame.cob_id, len(frame.data), data)))

    def tick(self, t_ns: int) -> None:
        """See `Device.tick`."""
        self.call(f"{self.kind}_tick", t_ns)


class _View:
    """The part of `rig.device.Device` that tests look at, of a struct that begins with a `struct device`."""

    def __init__(self, stack: _Stack, node_id: int, od: Dictionary) -> None:
        self.node_id, self.od, self._stack = node_id, od, stack
        self.receive, self.tick = stack.receive, stack.tick
        self.emcy = _Emcy(stack)
        self.pdo = SimpleNamespace(rpdos={n: _Rpdo(stack, n - 1) for n in (1, 2)})
        self._positions = {key: i for i, key in enumerate(sorted(od.entries))}
        self.domains: dict[tuple[int, int], bytes] = {}

    @property
    def state(self) -> NmtState:
        """NMT state."""
        return NmtState(self._stack.call("host_state"))

    def read(self, index: int, sub: int = 0) -> Value:
        """See `Device.read`."""
        entry = self.od.entries[index, sub]
        if not entry.code:
            return self.domains.get((index, sub), entry.default)
        bits = self._stack.call("host_values")[self._positions[index, sub]].to_bytes(8, "little")
        return cast(Value, struct.unpack_from("<" + entry.code, bits)[0])

    def write(self, index: int, sub: int, value: Value) -> None:
        """See `Device.write`."""
        bits = int.from_bytes(struct.pack("<" + self.od.entries[index, sub].code, value), "little")
        self._stack.call("host_values")[self._positions[index, sub]] = bits
        self._stack.call("device_configure", index)

    def transmit(self, n: int) -> None:
        """See `Device.transmit`."""
        self._stack.call("device_transmit", n)


class _Emcy(NamedTuple):
    stack: _Stack

    @property
    def active(self) -> list[int]:
        codes = (self.stack.call("host_error_code", i) for i in range(16))
        return [code for code in codes if code >= 0]

    def raise_error(self, code: int, register: int = 1, info: bytes = b"") -> None:
        self.stack.call("host_raise", code, int(register), info, len(info))

    def clear(self, code: int = -1, info: bytes = b"") -> None:
        self.stack.call("host_clear", code, info[0] if info else -1)


class _Rpdo(NamedTuple):
    stack: _Stack
    position: int

    @property
    def fresh(self) -> bool:
        return bool(self.stack.call("host_is_fresh", self.position))


def _make_object(key: tuple[int, int], entry: Entry) -> _Object:
    kind, text, bits = _KINDS.get(entry.code, 0), b"", 0
    if isinstance(entry.default, bytes):
        text = entry.default
        kind = _DOMAIN if entry.writable else _TEXT
    else:
        bits = int.from_bytes(struct.pack("<" + entry.code, entry.default), "little")
    marks = (entry.readable, entry.writable, entry.mappable, entry.low is not None, entry.high is not None)
    return _Object(*key, kind, struct.calcsize("<" + entry.code), sum(bool(mark) << i for i, mark in enumerate(marks)),
                   bits, entry.low or 0, entry.high or 0, text, len(text))  # fmt: skip


class CDevice(_View):
    """`rig.device.Device` in C, with the object dictionary of any EDS."""

    def __init__(self, node_id: int, eds_path: Path, send: Send) -> None:
        for hook in ("on_sync", "on_rpdo", "on_nmt", "on_sync_lost", "on_heartbeat_lost", "on_write"):
            setattr(self, hook, lambda *_: None)
        stack, od = _Stack("device", send), Dictionary(eds_path, node_id)
        super().__init__(stack, node_id, od)
        objects = [_make_object(key, od.entries[key]) for key in sorted(od.entries)]
        self._kept = ((_Object * len(objects))(*objects), (ctypes.c_uint64 * len(objects))(),
                      ctypes.create_string_buffer(DOMAIN_BYTES))
        self._hooks = _Hooks(
            None, self._make_hook(_Plain, "on_sync"), self._make_hook(_Numbered, "on_rpdo"), _Write(self._write_object),
            self._make_hook(_Change, "on_nmt", NmtState), self._make_hook(_Plain, "on_sync_lost"),
            self._make_hook(_Node, "on_heartbeat_lost"))
        table = _Dictionary(self._kept[0], len(objects), self._kept[1], 0)
        if not stack.call("device_init", node_id, table, stack.output, self._hooks, self._kept[2], DOMAIN_BYTES):
            Device(node_id, eds_path, send)  # must refuse it too, and says why
            raise AssertionError(f"the Python stack accepts {eds_path}")

    def _make_hook(self, kind: Any, name: str, convert: Callable[[int], int] = int) -> Any:
        return kind(lambda _, *numbers: self._stack.guard(lambda: getattr(self, name)(*map(convert, numbers))))

    def _write_object(self, _: object, index: int, sub: int, data: Any, length: int) -> int:
        value = ctypes.string_at(data, length)
        try:
            self.on_write(index, sub, value)  # type: ignore[attr-defined]
        except SdoAbort as abort:
            return abort.code
        if not self.od.entries[index, sub].code:
            self.domains[index, sub] = value
        return 0


class CFirmware(_Stack):
    """`rig.nodes.firmware.Firmware` in C; `gains` are written as the rig does before a start. No effects of a model."""

    def __init__(self, send: Send, gains: Gains | None = None, model: Model | None = None) -> None:
        assert model is None or not model.effects
        super().__init__("controller", send)
        assert self.call("controller_init", self.output)
        self.device = _View(self, 2, Dictionary(EDS[2], 2))
        for sub, value in enumerate(gains or (), 1):
            self.device.write(GAINS, sub, value)


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
