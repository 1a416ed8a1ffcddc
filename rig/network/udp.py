"""CAN frames between the processes of one machine: UDP multicast that cannot leave it.

The datagrams are those of python-can's `udp_multicast`. Its own bus listens on every interface, sends by the default
route, needs one to exist at all, and hears its own frames; here the group is joined on 127.0.0.1, sent to from there
with a TTL of 0, and a bus does not hear itself, as on a real one. All nodes hear all frames in one order, as on a real
one too: the kernel hands a datagram to one socket after the other, and a node that heard it early could answer before
the others have it. The turn to send (`Turn`) keeps the next frame back until this one is everywhere.
"""
from __future__ import annotations

import contextlib
import ctypes
import errno
import ipaddress
import os
import socket
import struct
import zlib
from collections.abc import Collection
from pathlib import Path

import numpy as np

from plant.errors import RigError
from rig.benches.bench import FD

GROUP, PORT = "239.74.163.2", 43113  # python-can's defaults
_LOOPBACK = socket.inet_aton("127.0.0.1")
_IP_MULTICAST_ALL = 49  # linux/in.h; without it a socket hears the groups other programs joined
_SO_ATTACH_FILTER, _SO_RCVBUFFORCE, SO_TIMESTAMPNS, SO_RXQ_OVFL = 26, 33, 35, 40  # asm-generic/socket.h
_RECEIVE_BUFFER = 8 << 20  # bytes asked for
_RECEIVE_TIMEOUT = struct.pack("@qq", 0, 20_000)  # struct timeval, s and us: the longest that `await_frame` waits


def is_group(text: str) -> bool:
    """Whether a text is an IPv4 multicast group."""
    try:
        return ipaddress.IPv4Address(text).is_multicast
    except ValueError:
        return False


def open_sender() -> socket.socket:
    """A socket that sends to groups on this machine only: from 127.0.0.1, with a TTL of 0. Raises OSError."""
    tx = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        tx.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, _LOOPBACK)
        tx.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        tx.bind(("127.0.0.1", 0))
    except OSError:
        tx.close()
        raise
    return tx


def attach_filter(rx: socket.socket, own_port: int, cob_ids: Collection[int], left_out: bool = False) -> None:
    """A socket filter (classic BPF): no datagram from `own_port`, and of python-can's layout only these COB-IDs.

    `left_out`: all but these COB-IDs. A datagram of another layout passes; who reads it decodes it. At most 64 COB-IDs
    are filtered, else all pass. Whether a frame is CAN FD makes no difference here. Raises OSError.
    """
    load_half, load_byte, load_word = 0x28, 0x30, 0x20  # at an absolute place, counted from the UDP header
    equal, at_least, always, give = 0x15, 0x35, 0x05, 0x06
    keep_bits, shift_left, copy, add_copy = 0x54, 0x64, 0x07, 0x4C
    accept, drop = 0xFFFFFFFF, 0
    program = [(load_half, 0, 0, 0), (equal, 0, 1, own_port), (give, 0, 0, drop)]
    if len(cob_ids) <= 64:
        listed, others = (drop, accept) if left_out else (accept, drop)
        text = [(8, 0x8BA97469), (8 + 20, 0xAE617262), (8 + 31, 0x6E5F6964)]  # map of 11, "ti.."; "arb..", "n_id"
        for place, word in text:
            program += [(load_word, 0, 0, place), (equal, 1, 0, word), (give, 0, 0, accept)]
        # The identifier stands here itself, or 0xCC, 0xCD or 0xCE and 1, 2 or 4 bytes; behind it "is_extended_id" and
        # a truth value, whose last bit goes where the COB-ID has it.
        branches = [(give, 0, 0, accept)]
        for first, load, at, flag in ((0xCE, load_word, 1, 20), (0xCD, load_half, 1, 18), (0xCC, load_byte, 1, 17),
                                      (0x80, load_byte, 0, 16)):
            body = [(load_word, 0, 0, 8 + 35 + flag - 4), (equal, 1, 0, 0x645F6964), (give, 0, 0, accept),  # "d_id"
                    (load_byte, 0, 0, 8 + 35 + flag), (keep_bits, 0, 0, 1), (shift_left, 0, 0, 31), (copy, 0, 0, 0),
                    (load, 0, 0, 8 + 35 + at), (add_copy, 0, 0, 0), (always, 0, 0, len(branches))]
            taken = (equal, 0, len(body), first) if at else (at_least, len(body), 0, first)
            branches = [(load_byte, 0, 0, 8 + 35), taken, *body, *branches]
        program += [*branches, *(step for cob_id in cob_ids for step in (
            (equal, 0, 1, cob_id & ~FD), (give, 0, 0, listed))), (give, 0, 0, others)]
    else:
        program.append((give, 0, 0, accept))
    steps = bytearray(b"".join(struct.pack("=HBBI", *step) for step in program))
    code = (ctypes.c_char * len(steps)).from_buffer(steps)
    rx.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, struct.pack("@HP", len(program), ctypes.addressof(code)))


def open_sockets(group: str, port: int, stack: contextlib.ExitStack) -> tuple[socket.socket, socket.socket, Turn]:
    """A socket that hears the group, on 127.0.0.1 alone, one that sends to it, and the turn. Raises OSError."""
    tx = stack.enter_context(open_sender())
    rx = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    set_receive_options(rx)
    rx.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    rx.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
    rx.bind((group, port))
    rx.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(group) + _LOOPBACK)
    turn = Turn(group, port)
    stack.callback(turn.close)
    return rx, tx, turn


def set_receive_options(raw: socket.socket) -> None:
    """A large receive buffer (beyond the system's limit where the rights allow), a limit for waiting in the kernel, the
    kernel's time of each frame and the count of its losses. By default the kernel keeps 477 frames.
    """
    try:
        raw.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BUFFER)
    except OSError:
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
    raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, _RECEIVE_TIMEOUT)
    raw.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    raw.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)


TURN_LIMIT_NS = 1_000_000_000  # a turn takes 20 us; one that takes a second is held by a stopped or foreign program
_TURN, _USERS, _REMOVED, _MARK, _SEMAPHORES = range(5)
_MARK_VALUE = 0x4548
_NOWAIT, _UNDO = 0o4000, 0x1000  # linux/ipc.h, linux/sem.h
_CREATE = 0o1000
_REMOVE, _GET_PID, _GET_VALUE, _SET_VALUE = 0, 11, 12, 16
_OPERATION = np.dtype([("number", np.uint16), ("change", np.int16), ("flags", np.int16)])  # struct sembuf

# Waiting for zero and counting up is one operation to the kernel, so a new set needs no first value.
TAKE = np.array([(_TURN, 0, 0), (_TURN, 1, _UNDO)], _OPERATION)
GIVE = np.array([(_TURN, -1, _UNDO)], _OPERATION)
_JOIN = np.array([(_REMOVED, 0, _NOWAIT), (_USERS, 1, _UNDO)], _OPERATION)
_LEAVE = np.array([(_USERS, -1, _UNDO)], _OPERATION)
_LEAVE_LAST = np.array([(_USERS, -1, _UNDO), (_USERS, 0, _NOWAIT), (_REMOVED, 1, 0)], _OPERATION)
_RESTORE = np.array([(_REMOVED, -1, _NOWAIT)], _OPERATION)
_CLAIM_UNUSED = np.array([(_USERS, 0, _NOWAIT), (_REMOVED, 1, 0)], _OPERATION)


def find_key(group: str, port: int) -> int:
    """Key of the semaphores of a group and port; rig/firmware/turn.c calculates the same.

    The number is that of the semaphores: a set of another layout has another key.
    """
    return zlib.crc32(f"eha-rig {group} {port} {_SEMAPHORES}".encode()) & 0x7FFFFFFF


class Turn:
    """The turn of one group and port. `identifier` is the kernel's, for compiled code (`semtimedop`).

    Raises OSError when the kernel gives no semaphores.
    """

    def __init__(self, group: str, port: int) -> None:
        self._where = f"udp_multicast {group}:{port}"
        self._key = find_key(group, port)
        self._library = ctypes.CDLL(None, use_errno=True)
        self.identifier = self._join()

    def take(self, limit_ns: int = TURN_LIMIT_NS) -> None:
        """Wait for the turn.

        Raises:
            RigError: another program held it for longer than `limit_ns`, or the set was removed.
        """
        limit = np.array([limit_ns // 1_000_000_000, limit_ns % 1_000_000_000], np.int64)
        if number := self._operate(TAKE, limit):
            raise self.explain_failure(number, limit_ns)

    def give(self) -> None:
        """Let the next one send."""
        self._operate(GIVE)

    def explain_failure(self, number: int, limit_ns: int = TURN_LIMIT_NS) -> RigError:
        """The error for `number` (errno) of a wait for the turn."""
        if number == errno.EAGAIN:
            return RigError(f"{self._where}: the turn to send was held for more than {limit_ns * 1e-9:g} s by "
                            f"{self._name_holder()}; stop that program, or take another group")
        return RigError(f"{self._where}: the turn to send was lost ({os.strerror(number)}); somebody removed the "
                        f"semaphores 0x{self._key:08x} (ipcs -s)")

    def close(self) -> None:
        """Leave; the last program removes the semaphores."""
        if self.identifier < 0:
            return
        if self._operate(_LEAVE_LAST):
            self._operate(_LEAVE)
        elif self._library.semctl(self.identifier, 0, _REMOVE):
            self._operate(_RESTORE)  # those of another user stay
        self.identifier = -1

    def _join(self) -> int:
        while True:
            self._remove_unused()
            identifier = int(self._library.semget(self._key, _SEMAPHORES, _CREATE | 0o666))
            if identifier < 0:
                number = ctypes.get_errno()
                raise OSError(number, f"no semaphores for the turn to send: {os.strerror(number)}")
            number = self._operate(_JOIN, identifier=identifier)
            if number == 0:
                self._library.semctl(identifier, _MARK, _SET_VALUE, _MARK_VALUE)
                return identifier
            if number not in (errno.EAGAIN, errno.EIDRM, errno.EINVAL):  # else: being removed just now
                raise OSError(number, f"no semaphores for the turn to send: {os.strerror(number)}")

    def _remove_unused(self) -> None:
        """Remove our sets that nobody uses: their programs were killed.

        A program that is about to join such a set finds it gone, and makes a new one.
        """
        try:
            lines = Path("/proc/sysvipc/sem").read_text().splitlines()[1:]
        except OSError:
            return
        for line in lines:
            _, identifier, _, count, owner = map(int, line.split()[:5])
            if (count == _SEMAPHORES and owner == os.geteuid()
                    and self._library.semctl(identifier, _MARK, _GET_VALUE) == _MARK_VALUE
                    and self._operate(_CLAIM_UNUSED, identifier=identifier) == 0):
                self._library.semctl(identifier, 0, _REMOVE)

    def _operate(self, operations: np.ndarray, limit: np.ndarray | None = None, identifier: int = -1) -> int:
        """semtimedop; errno, 0 when done."""
        where = self.identifier if identifier < 0 else identifier
        time = None if limit is None else limit.ctypes.data
        while self._library.semtimedop(where, ctypes.c_void_p(operations.ctypes.data), ctypes.c_size_t(len(operations)),
                                       ctypes.c_void_p(time)):
            if (number := ctypes.get_errno()) != errno.EINTR:
                return number
        return 0

    def _name_holder(self) -> str:
        """The process that took the turn last, with its name where it can be read."""
        process = self._library.semctl(self.identifier, _TURN, _GET_PID)
        try:
            return f"process {process} ({Path(f'/proc/{process}/comm').read_text().strip()})"
        except OSError:
            return f"process {process}"
