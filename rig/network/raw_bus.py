"""One CAN frame in, one CAN frame out, as compiled code: SocketCAN and the project's UDP bus, with kernel times.

A COB-ID has the flags of frame.py: EXTENDED for an identifier of 29 bits, FD for CAN FD.

A loop that must not be late is a plain function that calls `receive_frame` and `send_frame`, compiled as a whole by
`plant.compile.compile_function`. It runs without the interpreter lock; it makes no Python object and allocates nothing.

    with RawBus("udp_multicast:239.0.0.1", (sync, drive)) as bus:   # COB-IDs; Python: opens, sets the filters
        run = compile_function(my_loop)
        run(bus.port, ...)                                                            # in a thread of its own

    def my_loop(port, ...):
        status, t_ns, cob_id, length, data = receive_frame(port, deadline_ns)
        if status == FRAME: ...
        status = send_frame(port, cob_id, 8, data)

`data` is the payload as one signed 64-bit integer, first byte lowest, bytes beyond `length` zero. A CAN FD frame has up
to 64 bytes, of which `data` is the first 8. All bytes of the frame that came last stand at port.octets[PAYLOAD_IN:
PAYLOAD_IN + length]; `send_payload` sends those at PAYLOAD_OUT, which `send_frame` overwrites.

All times are those of CLOCK_MONOTONIC, ns (`time.monotonic_ns()`); `receive_frame` gives the time at which the kernel
received the frame. A port belongs to one thread.

Filters: the kernel drops frames with other identifiers (CAN_RAW_FILTER; on UDP a socket filter, which also drops the
bus's own frames); it does not tell CAN FD from classical frames, which compiled code does. What still arrives and was
not asked for is dropped, as remote frames, error frames and damaged datagrams are.

System calls cost most of the time that a loop takes. `await_frame` waits inside the call that receives, which makes one
call a frame; `receive_frame` needs three where it has to wait, and keeps its deadline to the microsecond.
"""

import contextlib
import errno
import fcntl
import os
import socket
import struct
import time
from collections.abc import Sequence
from typing import NamedTuple

import can
import msgpack  # type: ignore[import-untyped]
import numpy as np
from can.interfaces.udp_multicast.utils import pack_message
from numpy.typing import NDArray

from plant import ForeignCall, RigError, bind_later, keep_apart, require
from rig.benches import EXTENDED, FD, SWITCHED, to_integer
from rig.network.bus import CONTROLLER_ERROR, RX_OVERFLOW, can_open, parse_spec, require_interface
from rig.network.frame import IDENTIFIER, has_valid_length
from rig.network.udp import (
    FLOCK,
    PORT,
    SO_RXQ_OVFL,
    SO_TIMESTAMPNS,
    TURN_LIMIT_NS,
    TURN_PAUSE_NS,
    Turn,
    attach_filter,
    open_sockets,
    set_receive_options,
)

# status of receive_frame
TIMEOUT, FRAME = 0, 1
# status of send_frame
SENT, QUEUE_FULL = 0, 1
# of both: FAILED, the kernel refused (errno in the port); of send_frame: the turn to send did not come
FAILED, NO_TURN = -1, -2

SOCKETCAN, UDP = 0, 1
KINDS = {"socketcan": SOCKETCAN, "udp_multicast": UDP}

# The port's memory, as words of 8 bytes. First single numbers ..
_KIND, _RX, _TX, _TURN, _ERROR = range(5)
_IN_KERNEL, _IN_CONTROLLER = 5, 6  # frames lost on the way in
_LATEST = 7  # time of the last frame: of two frames in a queue the second is not the earlier one
_OWN, _COUNTS_LOSSES = 8, 9  # UDP: own port, network order; whether the kernel's count is of losses alone
_STAMPED, _LISTED = 10, 11  # whether kernel times are used; how many COB-IDs beyond the classical ones are received
# .. then what the kernel reads and writes (asm-generic, 64 bit), as byte offsets
_MESSAGE, _VECTOR, _POLL, _TIME, _ERRNO, _SENDER, _LOCK = 256, 320, 336, 352, 368, 432, 448
_CONTROL, _ALLOWED, _FRAME_IN, _FRAME_OUT = 512, 1024, 1280, 1360  # _FRAME: struct can_frame, canfd_frame
_IN, _OUT, _WIDE_OUT, _LIST = 2048, 4096, 4608, 5120  # datagrams: in; out, with 11 and with 29 bits
_CONTROL_SIZE, _IN_SIZE, _OUT_SIZE, _SENDER_SIZE, _LIST_SIZE = 256, 2048, 512, 16, 4096
_CAN_SIZE, _CANFD_SIZE = 16, 72
PAYLOAD_IN, PAYLOAD_OUT = _FRAME_IN + 8, _FRAME_OUT + 8  # 64 bytes each

_SOL_CAN_RAW, _CAN_RAW_FILTER, _CAN_RAW_ERR_FILTER, _CAN_RAW_FD_FRAMES = 101, 1, 2, 5
_RTR, _ERR, _CANFD_BRS = 0x40000000, 0x20000000, 1  # linux/can.h: remote and error frames; bit of canfd_frame.flags
_DONTWAIT, _POLLIN = 0x40, 1
_REALTIME, _MONOTONIC, _ABSOLUTE = 0, 1, 1

_recvmsg = ForeignCall("qiqi", "recvmsg")
_send = ForeignCall("qiqqi", "send")
_ppoll = ForeignCall("iqqqq", "ppoll")
_fcntl = ForeignCall("iiiq", "fcntl")
_clock_gettime = ForeignCall("iiq", "clock_gettime")
_clock_nanosleep = ForeignCall("iiiqq", "clock_nanosleep")
_errno_location = ForeignCall("q", "__errno_location")
_memcpy = ForeignCall("qqqq", "memcpy")


class Port(NamedTuple):
    """What compiled code knows of a bus: one block of memory, seen as words, as 32-bit integers and as bytes."""

    words: NDArray[np.int64]
    halves: NDArray[np.int32]
    octets: NDArray[np.uint8]


# ---------------------------------------------------------------------------------------- time


def _read_clock(port: Port, which: int) -> int:
    _clock_gettime(which, port.octets.ctypes.data + _TIME)
    return to_integer(port.words[_TIME // 8] * 1_000_000_000 + port.words[_TIME // 8 + 1])


@bind_later
def read_clock(port: Port) -> int:
    """CLOCK_MONOTONIC, ns."""
    return _read_clock(port, _MONOTONIC)


@bind_later
def sleep_until(port: Port, t_ns: int) -> None:
    """Sleep until CLOCK_MONOTONIC says `t_ns`; a signal does not end it."""
    port.words[_TIME // 8] = t_ns // 1_000_000_000
    port.words[_TIME // 8 + 1] = t_ns % 1_000_000_000
    while _clock_nanosleep(_MONOTONIC, _ABSOLUTE, port.octets.ctypes.data + _TIME, 0) == errno.EINTR:
        pass


# ---------------------------------------------------------------------------------------- receive


@bind_later
@keep_apart
def receive_frame(port: Port, deadline_ns: int) -> tuple[int, int, int, int, int]:
    """The next frame; if none is waiting, wait for one until `deadline_ns` (absolute; 0: do not wait).

    Returns (status, t_ns, cob_id, length, data): FRAME; or TIMEOUT or FAILED with zeros.
    """
    while True:
        status, t_ns, cob_id, length, data = _take_frame(port, _DONTWAIT)
        if status != TIMEOUT or deadline_ns == 0:
            return status, t_ns, cob_id, length, data
        status = _wait_for_input(port, deadline_ns)
        if status != FRAME:
            return status, 0, 0, 0, 0


@keep_apart
def await_frame(port: Port) -> tuple[int, int, int, int, int]:
    """The next frame, as `receive_frame` returns it; TIMEOUT when none has come for 20 ms."""
    return _take_frame(port, 0)


@keep_apart
def _take_frame(port: Port, flags: int) -> tuple[int, int, int, int, int]:
    """The next frame that is asked for: FRAME, TIMEOUT (none is waiting, or has come in time) or FAILED."""
    words = port.words
    while True:
        size = _take_datagram(port, flags)
        if size >= 0:
            if words[_OWN] and words[_OWN] == to_integer(port.halves[_SENDER // 4]) >> 16 & 0xFFFF:
                continue
            cob_id, length, data = _decode(port, size)
            if cob_id >= 0 and _is_allowed(port, cob_id):
                return FRAME, _find_time(port), cob_id, length, data
        elif words[_ERROR] == errno.EAGAIN:
            return TIMEOUT, 0, 0, 0, 0
        elif words[_ERROR] != errno.EINTR:
            return FAILED, 0, 0, 0, 0


def _is_allowed(port: Port, cob_id: int) -> bool:
    if cob_id <= 0x7FF:
        return bool(port.octets[_ALLOWED + (cob_id >> 3)] >> (cob_id & 7) & 1)
    for place in range(_LIST // 8, _LIST // 8 + port.words[_LISTED]):  # noqa: SIM110 - compiled
        if port.words[place] == cob_id:
            return True
    return False


def _take_datagram(port: Port, flags: int) -> int:
    """Its length; -1 with the reason in the port. Notes how many the kernel had to drop before it."""
    base = port.octets.ctypes.data
    port.words[(_MESSAGE + 40) // 8] = _CONTROL_SIZE
    port.words[(_MESSAGE + 8) // 8] = _SENDER_SIZE
    size = _recvmsg(port.words[_RX], base + _MESSAGE, flags)
    if size < 0:
        _note_errno(port)
    return size


def _note_errno(port: Port) -> None:
    base = port.octets.ctypes.data
    port.words[_ERRNO // 8] = 0
    _memcpy(base + _ERRNO, _errno_location(), 4)
    port.words[_ERROR] = port.words[_ERRNO // 8]


def _wait_for_input(port: Port, deadline_ns: int) -> int:
    """FRAME when there is something to read, TIMEOUT or FAILED."""
    remaining_ns = deadline_ns - read_clock(port)
    if remaining_ns <= 0:
        return TIMEOUT
    base = port.octets.ctypes.data
    port.words[_TIME // 8] = remaining_ns // 1_000_000_000
    port.words[_TIME // 8 + 1] = remaining_ns % 1_000_000_000
    count = _ppoll(base + _POLL, 1, base + _TIME, 0)
    if count < 0:
        _note_errno(port)
        return FRAME if port.words[_ERROR] == errno.EINTR else FAILED
    return FRAME if count else TIMEOUT


def _find_time(port: Port) -> int:
    """When the kernel received the frame, on the monotonic clock; never before the one before it, nor in the future.

    The kernel stamps with the wall clock. Its distance to the monotonic clock is taken now: if somebody has set the
    clock in between, the limits hold.
    """
    words = port.words
    place, end = _CONTROL, _CONTROL + words[(_MESSAGE + 40) // 8]
    wall = -1
    while place + 16 <= end:
        size = words[place // 8]
        if port.halves[place // 4 + 2] == socket.SOL_SOCKET:
            if port.halves[place // 4 + 3] == SO_TIMESTAMPNS:
                wall = words[place // 8 + 2] * 1_000_000_000 + words[place // 8 + 3]
            elif port.halves[place // 4 + 3] == SO_RXQ_OVFL and words[_COUNTS_LOSSES]:
                words[_IN_KERNEL] = to_integer(port.halves[place // 4 + 4]) & 0xFFFFFFFF
        if size < 16:
            break
        place += (size + 7) // 8 * 8
    now = read_clock(port)
    t_ns = now
    if wall >= 0 and words[_STAMPED]:
        t_ns = to_integer(wall) - _find_clock_distance(port)
    t_ns = max(min(t_ns, now), to_integer(words[_LATEST]))
    words[_LATEST] = t_ns
    return t_ns


def _find_clock_distance(port: Port) -> int:
    """Wall clock minus monotonic clock, ns. A thread that is interrupted between the two readings reads them again."""
    distance, shortest = 0, 1 << 62
    for _ in range(5):
        before = read_clock(port)
        wall = _read_clock(port, _REALTIME)
        duration = read_clock(port) - before
        if duration < shortest:
            distance, shortest = wall - before - duration // 2, duration
        if duration < 5_000:
            break
    return distance


def _decode(port: Port, size: int) -> tuple[int, int, int]:
    """(COB-ID, length, payload) of what came; -1 for what is no data frame."""
    if port.words[_KIND] == UDP:
        return decode_datagram(port, size)
    cob_id = to_integer(port.halves[_FRAME_IN // 4]) & 0xFFFFFFFF
    if cob_id & _ERR:
        port.words[_IN_CONTROLLER] += cob_id & CONTROLLER_ERROR != 0 and port.octets[PAYLOAD_IN + 1] & RX_OVERFLOW != 0
    if cob_id & (_ERR | _RTR) or size not in (_CAN_SIZE, _CANFD_SIZE):
        return -1, 0, 0
    most = 8
    if size == _CANFD_SIZE:
        cob_id, most = cob_id | FD, 64
    length = min(to_integer(port.octets[_FRAME_IN + 4]), most)
    data = to_integer(port.words[PAYLOAD_IN // 8])
    if length < 8:
        data &= (1 << 8 * length) - 1
    return cob_id, length, data


# ---------------------------------------------------------------------------------------- send


@keep_apart
def send_frame(port: Port, cob_id: int, length: int, data: int) -> int:
    """Put a frame of up to 8 bytes on the bus: SENT; QUEUE_FULL, the frame is lost; FAILED or NO_TURN."""
    port.words[PAYLOAD_OUT // 8] = data
    return send_payload(port, cob_id, length)


@bind_later
@keep_apart
def send_payload(port: Port, cob_id: int, length: int) -> int:
    """Put a frame on the bus whose bytes stand at PAYLOAD_OUT, as `send_frame` does. A length that no frame of this
    kind has is FAILED; so is CAN FD on a SocketCAN bus that was not opened for it.
    """
    if not has_valid_length(cob_id, length):
        port.words[_ERROR] = errno.EINVAL
        return FAILED
    if port.words[_KIND] == UDP:
        return _send_datagram(port, cob_id, length)
    port.halves[_FRAME_OUT // 4] = cob_id & (EXTENDED | IDENTIFIER)
    port.halves[_FRAME_OUT // 4 + 1] = length
    if not cob_id & FD:
        return _transmit(port, _FRAME_OUT, _CAN_SIZE)
    if cob_id & SWITCHED:
        port.octets[_FRAME_OUT + 5] = _CANFD_BRS
    return _transmit(port, _FRAME_OUT, _CANFD_SIZE)


def _send_datagram(port: Port, cob_id: int, length: int) -> int:
    start, size = encode_datagram(port, cob_id, length)
    give_up = 0
    while _set_lock(port, fcntl.F_WRLCK) != 0:
        now = read_clock(port)
        if give_up == 0:
            give_up = now + TURN_LIMIT_NS
        if now > give_up:
            return NO_TURN
        sleep_until(port, now + TURN_PAUSE_NS)
    status = _transmit(port, start, size)
    _set_lock(port, fcntl.F_UNLCK)
    return status


def _set_lock(port: Port, kind: int) -> int:
    """Take the turn, or give it: 0 if that was possible."""
    port.words[_LOCK // 8] = kind
    return _fcntl(port.words[_TURN], fcntl.F_OFD_SETLK, port.octets.ctypes.data + _LOCK)


def _transmit(port: Port, start: int, size: int) -> int:
    words = port.words
    while _send(words[_TX], port.octets.ctypes.data + start, size, _DONTWAIT) < 0:
        _note_errno(port)
        if words[_ERROR] == errno.EAGAIN or words[_ERROR] == errno.ENOBUFS:
            return QUEUE_FULL
        if words[_ERROR] != errno.EINTR:
            return FAILED
    return SENT


# ---------------------------------------------------------------------------------------- datagrams of python-can

# A datagram is a msgpack map; an example tells how python-can packs it. With 29 bits the identifier is two bytes longer
# and the rest is the same.
_EXAMPLE, _WIDE_EXAMPLE = (
    pack_message(can.Message(arbitration_id=most, is_extended_id=most > 0x7FF, data=bytes(range(0xF0, 0xF8))))
    for most in (0x7FF, IDENTIFIER))
_ID_AT, _LENGTH_AT, _DATA_AT = (_EXAMPLE.index(text) + len(text) for text in (b"\xcd", b"\xa3dlc", b"\xc4\x08"))
_TAIL = len(_EXAMPLE) - _DATA_AT - 8  # bytes after the payload
_FD_AT, _SWITCH_AT = (_EXAMPLE[-_TAIL:].index(key) + len(key) for key in (b"is_fd", b"bitrate_switch"))
_NAMES = list(msgpack.unpackb(_EXAMPLE))
_KEYS = [msgpack.packb(name) for name in _NAMES]
_KEY_BYTES, _KEY_LENGTHS = np.frombuffer(b"".join(_KEYS), np.uint8), np.array([len(key) for key in _KEYS])
_ID, _DLC, _PAYLOAD = (_NAMES.index(name) for name in ("arbitration_id", "dlc", "data"))
_EXTENDED, _REMOTE, _IS_ERROR, _FD, _SWITCH, _PASSIVE = (1 << _NAMES.index(name) for name in (
    "is_extended_id", "is_remote_frame", "is_error_frame", "is_fd", "bitrate_switch", "error_state_indicator"))
_FLAGS = _EXTENDED | _REMOTE | _IS_ERROR | _FD | _SWITCH | _PASSIVE
_KEY_STARTS = np.cumsum(_KEY_LENGTHS) - _KEY_LENGTHS
_NOTHING, _TRUE = 0xC0, 0xC3  # msgpack's first byte of a value
_OFF = (0x00, _NOTHING, 0xC2)  # 0, nothing and false
_UNSIGNED, _MAP = 0xCC, _EXAMPLE[0]
_BYTES, _TEXT = 0xC4, 0xD9  # a length of one byte follows; after the next number one of two bytes
_SIZED = (_BYTES, _BYTES + 1, _TEXT, _TEXT + 1)
_SIZES = np.full(256, -1)  # bytes after the first byte
_SIZES[:0x80] = _SIZES[[0xC0, 0xC2, 0xC3]] = 0  # a small number, nothing, false, true
_SIZES[0xA0:0xC0], _SIZES[0xCA:0xD0] = np.arange(32), (4, 8, 1, 2, 4, 8)  # a short text; floats, unsigned numbers


def encode_datagram(port: Port, cob_id: int, length: int) -> tuple[int, int]:
    """Pack the frame whose payload stands at PAYLOAD_OUT as python-can's udp_multicast does; (place in the port, size).
    """
    octets, base, start = port.octets, port.octets.ctypes.data, _OUT
    place = _OUT + _ID_AT
    if cob_id & EXTENDED:
        start, place = _WIDE_OUT, _WIDE_OUT + _ID_AT + 2
        octets[place - 2], octets[place - 1] = cob_id >> 24 & 0x1F, cob_id >> 16 & 0xFF
    octets[place], octets[place + 1] = cob_id >> 8 & 0xFF, cob_id & 0xFF
    place += _DATA_AT - _ID_AT
    octets[place + _LENGTH_AT - _DATA_AT] = octets[place - 1] = length
    _memcpy(base + place, base + PAYLOAD_OUT, length)
    place += length
    _memcpy(base + place, base + _OUT + _OUT_SIZE - _TAIL, _TAIL)
    if cob_id & FD:
        octets[place + _FD_AT] = _TRUE
        octets[place + _SWITCH_AT] += cob_id & SWITCHED != 0
    return start, to_integer(place + _TAIL - start)


@keep_apart
def decode_datagram(port: Port, size: int) -> tuple[int, int, int]:
    """(COB-ID, length, data) of `size` bytes in the port's buffer, as python-can's udp_multicast packs them; -1 for
    what is no data frame, no such map, or contradicts itself. The payload goes to PAYLOAD_IN.
    """
    octets, place, end = port.octets, _IN + 1, _IN + size
    cob_id, dlc, payload, length, flags = -1, -1, 0, 0, 0
    if octets[_IN] != _MAP:
        return -1, 0, 0
    for key in range(len(_KEY_LENGTHS)):
        place = _skip_key(octets, place, end, key)
        if place < 0 or place >= end:
            return -1, 0, 0
        first = to_integer(octets[place])
        place += 1
        count = to_integer(_SIZES[first])
        if first in _SIZED:
            width = 1 if first in (_BYTES, _TEXT) else 2
            count = _read_number(octets, _UNSIGNED, place, width) if place + width <= end else -1
            place += width
        if count < 0 or place + count > end:
            return -1, 0, 0
        if key == _ID:
            cob_id = _read_number(octets, first, place, count)
        elif key == _DLC:
            dlc = _read_number(octets, first, place, count)
        elif key == _PAYLOAD:
            payload, length = place, count if first in (_BYTES, _BYTES + 1, _NOTHING) else -1
        elif _FLAGS >> key & 1 and first not in _OFF:
            flags |= 1 << key
        place += count
    is_valid = place == end and 0 <= cob_id <= (IDENTIFIER if flags & _EXTENDED else 0x7FF) and length >= 0
    refused_flags = _IS_ERROR | _REMOTE if flags & _FD else _IS_ERROR | _REMOTE | _SWITCH | _PASSIVE
    if not is_valid or flags & refused_flags:
        return -1, 0, 0
    if flags & _EXTENDED:
        cob_id |= EXTENDED
    if flags & _FD:
        cob_id |= FD
    if dlc != length or not has_valid_length(cob_id, length):
        return -1, 0, 0
    port.words[PAYLOAD_IN // 8] = 0
    _memcpy(octets.ctypes.data + PAYLOAD_IN, octets.ctypes.data + payload, length)
    return cob_id, length, to_integer(port.words[PAYLOAD_IN // 8])


def _skip_key(octets: NDArray[np.uint8], place: int, end: int, key: int) -> int:
    """The place behind a key, which python-can's order puts here; -1 where something else stands."""
    at, length = to_integer(_KEY_STARTS[key]), to_integer(_KEY_LENGTHS[key])
    if place + length > end:
        return -1
    for i in range(length):
        if octets[place + i] != _KEY_BYTES[at + i]:
            return -1
    return place + length


def _read_number(octets: NDArray[np.uint8], first: int, place: int, count: int) -> int:
    """An unsigned number of `count` bytes, or the first byte itself; -1 for another kind of value."""
    if first < 0x80:
        return first
    if not 0xCC <= first <= 0xCF:
        return -1
    value = 0
    for i in range(count):
        value = value << 8 | to_integer(octets[place + i])
    return value


# ---------------------------------------------------------------------------------------- opening


class RawBus(contextlib.AbstractContextManager["RawBus"]):
    """`socketcan:INTERFACE` or `udp_multicast[:GROUP]` for compiled loops, as a context or to be closed.

    `port` is what the loops get.

    `overflows` counts the frames that were lost on the way in. On UDP with a filter it stays as it is: the kernel
    counts a frame that the filter drops as one that was lost.
    """

    def __init__(self, spec: str, cob_ids: Sequence[int] | None = None, fd: bool = False) -> None:
        """`cob_ids`: those to be received, by default all classical frames of 11 bits. `fd`: open it for CAN FD; the
        COB-ID of such a frame does so too.

        Raises:
            InputError: a bus of another kind.
            RigError: the bus cannot be opened.
        """
        kind, channel = parse_spec(spec, "--bus")
        require(can_open(spec), "--bus", spec,
                "socketcan:INTERFACE or udp_multicast[:GROUP] on a little-endian machine")
        self.spec = spec
        self.port = _make_port()
        self._turn: Turn | None = None
        words = self.port.words
        words[_KIND], words[_LATEST] = KINDS[kind], time.monotonic_ns()
        words[_STAMPED] = words[_COUNTS_LOSSES] = True
        try:
            with contextlib.ExitStack() as stack:
                is_fd = fd or any(cob_id & FD for cob_id in cob_ids or ())
                if kind == "socketcan":
                    self._rx = tx = _open_socketcan(channel, is_fd, stack)
                    words[_VECTOR // 8: _VECTOR // 8 + 2] = words.ctypes.data + _FRAME_IN, _CANFD_SIZE
                else:
                    self._rx, tx = self._open_udp(channel, stack)
                words[_RX], words[_TX] = self._rx.fileno(), tx.fileno()
                self.port.halves[_POLL // 4: _POLL // 4 + 2] = self._rx.fileno(), _POLLIN
                self._allow(range(0x800))
                if cob_ids is not None:
                    self.set_filter(cob_ids)
                elif kind == "socketcan":
                    self._rx.setsockopt(_SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, struct.pack("=I", 0x1FFFFFFF))
                self._opened = stack.pop_all()
        except OSError as error:
            raise RigError(f"{spec}: {error.strerror}") from error

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def descriptors(self) -> tuple[int, int, int, int]:
        """File descriptors of the sockets that receive and send, that of the turn or -1, and the turn's place."""
        turn, place = (-1, 0) if self._turn is None else (self._turn.descriptor, self._turn.place)
        return int(self.port.words[_RX]), int(self.port.words[_TX]), turn, place

    @property
    def overflows(self) -> int:
        return int(self.port.words[_IN_KERNEL] + self.port.words[_IN_CONTROLLER])

    def explain_failure(self, status: int) -> RigError:
        """The error behind the status FAILED or NO_TURN that the last call returned."""
        if status == NO_TURN and self._turn is not None:
            return self._turn.explain_failure()
        return RigError(f"{self.spec}: {os.strerror(int(self.port.words[_ERROR]))}")

    def close(self) -> None:
        """Give the bus back. No thread may be using the port any more."""
        self._opened.close()
        self._turn = None

    def _open_udp(self, group: str, stack: contextlib.ExitStack) -> tuple[socket.socket, socket.socket]:
        """Sockets that receive and send."""
        rx, tx, self._turn = open_sockets(group, PORT, stack)
        self.port.words[_OWN] = socket.htons(tx.getsockname()[1])
        tx.connect((group, PORT))
        self.port.words[_TURN] = self._turn.descriptor
        self.port.octets[_LOCK: _LOCK + FLOCK.size] = np.frombuffer(
            FLOCK.pack(fcntl.F_UNLCK, os.SEEK_SET, self._turn.place, 1, 0), np.uint8)
        return rx, tx

    def set_filter(self, cob_ids: Sequence[int]) -> None:
        """Receive these COB-IDs from now on, CAN FD only if the bus was opened for it. Another thread may be receiving.

        Raises:
            RigError: the kernel refuses.
        """
        is_socketcan = bool(self.port.words[_KIND] == SOCKETCAN)
        self._allow(cob_ids)
        try:
            if is_socketcan:
                # the kernel is fast with masks that have just the bits of such an identifier
                filters = [struct.pack("=II", cob_id & (EXTENDED | IDENTIFIER),
                                       EXTENDED | _RTR | (IDENTIFIER if cob_id & EXTENDED else 0x7FF))
                           for cob_id in cob_ids]
                self._rx.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FILTER, b"".join(filters))
            else:
                attach_filter(self._rx, socket.ntohs(int(self.port.words[_OWN])), cob_ids)
        except OSError as error:
            raise RigError(f"{self.spec}: {error.strerror}") from error
        self.port.words[_COUNTS_LOSSES] = is_socketcan

    def use_kernel_times(self, is_wanted: bool) -> None:
        """Whether a frame gets the time at which the kernel received it (the default), or that of the call, which
        saves three readings of the clock: in lockstep the time does not matter, and in some guests a reading is slow.
        """
        self.port.words[_STAMPED] = is_wanted

    def _allow(self, cob_ids: Sequence[int]) -> None:
        """One bit a COB-ID, for the frames that the kernel lets through; those beyond 11 bits are a list."""
        wide_ids = [cob_id & ~SWITCHED for cob_id in cob_ids if cob_id > 0x7FF]
        if len(wide_ids) > _LIST_SIZE // 8:
            raise RigError(f"{self.spec}: {len(wide_ids)} frames to receive; at most {_LIST_SIZE // 8} are possible")
        bits = np.zeros(0x800, np.uint8)
        bits[[cob_id for cob_id in cob_ids if cob_id <= 0x7FF]] = 1
        self.port.octets[_ALLOWED: _ALLOWED + 256] = np.packbits(bits, bitorder="little")
        self.port.words[_LIST // 8: _LIST // 8 + len(wide_ids)] = wide_ids
        self.port.words[_LISTED] = len(wide_ids)


def _open_socketcan(channel: str, is_fd: bool, stack: contextlib.ExitStack) -> socket.socket:
    require_interface(channel, is_fd)
    raw = stack.enter_context(socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW))
    set_receive_options(raw)
    raw.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FD_FRAMES, int(is_fd))
    raw.bind((channel,))
    return raw


def _make_port() -> Port:
    """The memory, with the addresses that the kernel's structures hold."""
    words = np.zeros((_LIST + _LIST_SIZE) // 8, np.int64)
    port = Port(words, words.view(np.int32), words.view(np.uint8))
    base = words.ctypes.data
    # struct msghdr: name, its length, vectors, their number, control data, its length, flags
    words[_MESSAGE // 8: _MESSAGE // 8 + 7] = base + _SENDER, 0, base + _VECTOR, 1, base + _CONTROL, _CONTROL_SIZE, 0
    words[_VECTOR // 8: _VECTOR // 8 + 2] = base + _IN, _IN_SIZE
    for place, data in ((_OUT, _EXAMPLE), (_WIDE_OUT, _WIDE_EXAMPLE)):  # for `encode_datagram` to fill in
        port.octets[place: place + len(data)] = np.frombuffer(data, np.uint8)
    port.octets[_OUT + _OUT_SIZE - _TAIL: _OUT + _OUT_SIZE] = np.frombuffer(_EXAMPLE[-_TAIL:], np.uint8)
    return port


def make_closed_port() -> Port:
    """A port of no bus: every call fails. To compile a loop before its bus is open."""
    port = _make_port()
    port.words[_RX] = port.words[_TX] = -1
    return port
