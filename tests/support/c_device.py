"""The C firmware in this process: its CANopen stack and its controller behind the interfaces of the Python ones.

The stack takes any object dictionary, so the tests of `rig.device` run on it unchanged, with the EDS of any node.
"""
from __future__ import annotations

import ctypes
import shutil
import struct
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, cast

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
NEEDS_A_BUS = ("main.c", "serve.c", "port_socketcan.c", "port_udp.c", "turn.c", "wait.c")
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
                ("values", ctypes.POINTER(ctypes.c_uint64))]  # fmt: skip


class CFrame(ctypes.Structure):
    """`struct frame`."""

    _fields_ = [("t_ns", ctypes.c_int64), ("cob_id", ctypes.c_uint16), ("length", ctypes.c_uint8),
                ("data", ctypes.c_uint8 * 8)]  # fmt: skip


_Bytes = ctypes.POINTER(ctypes.c_uint8)
_SendFunction = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_uint16, _Bytes, ctypes.c_uint8)
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


class _Calls:
    """Calls of the library, and the Python errors that hooks raise in the middle of them: C lets none through."""

    def __init__(self) -> None:
        self._errors: list[BaseException] = []

    def guard(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a hook from C; its error is kept."""
        try:
            return function(*arguments)
        except Exception as error:  # raised again by `finish`
            self._errors.append(error)
            return None

    def finish(self) -> None:
        """Raise the first error of a hook."""
        if self._errors:
            error, self._errors = self._errors[0], []
            raise error


def _make_output(calls: _Calls, send: Send) -> _Output:
    def transmit(_: object, cob_id: int, data: Any, length: int) -> None:
        calls.guard(send, cob_id, bytes(data[:length]))

    return _Output(_SendFunction(transmit), None)


class _View:
    """The part of `rig.device.Device` that tests look at, of a `struct device` at an address."""

    def __init__(self, address: int, node_id: int, od: Dictionary, calls: _Calls) -> None:
        self.node_id, self.od = node_id, od
        self.emcy = _Emcy(address, calls)
        self.pdo = _Pdos(address)
        self._lib, self._address, self._calls = load_library(), address, calls
        self._positions = {key: i for i, key in enumerate(sorted(od.entries))}
        self.domains: dict[tuple[int, int], bytes] = {}

    @property
    def state(self) -> NmtState:
        """NMT state."""
        return NmtState(self._lib.host_state(ctypes.c_void_p(self._address)))

    def read(self, index: int, sub: int = 0) -> Value:
        """See `Device.read`."""
        entry = self.od.entries[index, sub]
        if not entry.code:
            return self.domains.get((index, sub), entry.default)
        size = struct.calcsize("<" + entry.code)
        bits = self._lib.host_values(ctypes.c_void_p(self._address))[self._positions[index, sub]]
        return cast(Value, struct.unpack("<" + entry.code, bits.to_bytes(8, "little")[:size])[0])

    def write(self, index: int, sub: int, value: Value) -> None:
        """See `Device.write`."""
        if (index, sub) not in self.od:
            raise KeyError((index, sub))
        bits = int.from_bytes(struct.pack("<" + self.od.entries[index, sub].code, value), "little")
        self._lib.host_values(ctypes.c_void_p(self._address))[self._positions[index, sub]] = bits
        self._lib.device_configure(ctypes.c_void_p(self._address), index)

    def transmit(self, n: int) -> None:
        """See `Device.transmit`."""
        self._lib.device_transmit(ctypes.c_void_p(self._address), n)
        self._calls.finish()


class _Emcy:
    def __init__(self, address: int, calls: _Calls) -> None:
        self._lib, self._address, self._calls = load_library(), ctypes.c_void_p(address), calls

    @property
    def active(self) -> list[int]:
        codes = (self._lib.host_error_code(self._address, i) for i in range(16))
        return [code for code in codes if code >= 0]

    def raise_error(self, code: int, register: int = 1, info: bytes = b"") -> None:
        self._lib.host_raise(self._address, code, int(register), info, len(info))
        self._calls.finish()

    def clear(self, code: int = -1, info: bytes = b"") -> None:
        self._lib.host_clear(self._address, code, info[0] if info else -1)
        self._calls.finish()


class _Rpdo:
    def __init__(self, address: int, position: int) -> None:
        self._address, self._position = ctypes.c_void_p(address), position

    @property
    def fresh(self) -> bool:
        return bool(load_library().host_is_fresh(self._address, self._position))


class _Pdos:
    def __init__(self, address: int) -> None:
        self.rpdos = {n: _Rpdo(address, n - 1) for n in (1, 2)}


def _write_frame(frame: Frame) -> CFrame:
    data = (ctypes.c_uint8 * 8)(*frame.data)
    return CFrame(frame.t_ns, frame.cob_id, len(frame.data), data)


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
        self.on_sync: Callable[[], None] = lambda: None
        self.on_rpdo: Callable[[int], None] = lambda n: None
        self.on_write: Callable[[int, int, bytes], None] = lambda index, sub, data: None
        self.on_nmt: Callable[[NmtState, NmtState], None] = lambda old, new: None
        self.on_sync_lost: Callable[[], None] = lambda: None
        self.on_heartbeat_lost: Callable[[int], None] = lambda node: None
        library, calls, od = load_library(), _Calls(), Dictionary(eds_path, node_id)
        self._memory = ctypes.create_string_buffer(library.host_device_size())
        super().__init__(ctypes.addressof(self._memory), node_id, od, calls)
        objects = [_make_object(key, od.entries[key]) for key in sorted(od.entries)]
        self._objects = (_Object * len(objects))(*objects)
        self._values = (ctypes.c_uint64 * len(objects))()
        self._buffer = ctypes.create_string_buffer(DOMAIN_BYTES)
        self._output = _make_output(calls, send)
        self._hooks = _Hooks(
            None, _Plain(lambda _: calls.guard(lambda: self.on_sync())),
            _Numbered(lambda _, n: calls.guard(lambda: self.on_rpdo(n))),
            _Write(self._write_object),
            _Change(lambda _, old, new: calls.guard(lambda: self.on_nmt(NmtState(old), NmtState(new)))),
            _Plain(lambda _: calls.guard(lambda: self.on_sync_lost())),
            _Node(lambda _, node: calls.guard(lambda: self.on_heartbeat_lost(node))))  # fmt: skip
        table = _Dictionary(self._objects, len(objects), self._values)
        if not library.device_init(self._memory, node_id, table, self._output, self._hooks, self._buffer, DOMAIN_BYTES):
            Device(node_id, eds_path, send)  # must refuse it too, and says why
            raise AssertionError(f"the Python stack accepts {eds_path}")

    def _write_object(self, _: object, index: int, sub: int, data: Any, length: int) -> int:
        value = ctypes.string_at(data, length)
        try:
            self.on_write(index, sub, value)
        except SdoAbort as abort:
            return abort.code
        if not self.od.entries[index, sub].code:
            self.domains[index, sub] = value
        return 0

    def receive(self, frame: Frame) -> None:
        """See `Device.receive`."""
        self._lib.device_receive(self._memory, ctypes.byref(_write_frame(frame)))
        self._calls.finish()

    def tick(self, t_ns: int) -> None:
        """See `Device.tick`."""
        self._lib.device_tick(self._memory, t_ns)
        self._calls.finish()


class CFirmware:
    """`rig.nodes.firmware.Firmware` in C; `gains` are written as the rig does before a start. No effects of a model."""

    def __init__(self, send: Send, gains: Gains | None = None, model: Model | None = None) -> None:
        assert model is None or not model.effects
        library, self._calls = load_library(), _Calls()
        self._memory = ctypes.create_string_buffer(library.host_controller_size())
        self._output = _make_output(self._calls, send)
        assert library.controller_init(self._memory, self._output)
        self.device = _View(ctypes.addressof(self._memory), 2, Dictionary(EDS[2], 2), self._calls)
        for sub, value in enumerate(gains or (), 1):
            self.device.write(GAINS, sub, value)

    def receive(self, frame: Frame) -> None:
        """See `Firmware.receive`."""
        load_library().controller_receive(self._memory, ctypes.byref(_write_frame(frame)))
        self._calls.finish()

    def tick(self, t_ns: int) -> None:
        """See `Firmware.tick`."""
        load_library().controller_tick(self._memory, t_ns)
        self._calls.finish()
