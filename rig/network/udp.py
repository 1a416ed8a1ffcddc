"""CAN frames between the processes of one machine: UDP multicast that cannot leave it.

The datagrams are those of python-can's `udp_multicast`. Its own bus listens on every interface, sends by the default
route, needs one to exist at all, and hears its own frames; here the group is joined on 127.0.0.1, sent to from there
with a TTL of 0, and a bus does not hear itself, as on a real one. All nodes hear all frames in one order, as on a real
one too: the kernel hands a datagram to one socket after the other, and a node that heard it early could answer before
the others have it. The turn to send (turn.py) keeps the next frame back until this one is everywhere.
"""
from __future__ import annotations

import ctypes
import errno
import os
import select
import socket
import struct
import zlib
from collections.abc import Collection
from ctypes import addressof, c_char
from pathlib import Path

import can
import numpy as np
from can.interfaces.udp_multicast.utils import pack_message, unpack_message

from plant.errors import RigError

PORT = 43113  # python-can's
_LOOPBACK = socket.inet_aton("127.0.0.1")
_IP_MULTICAST_ALL = 49  # linux/in.h; without it a socket hears the groups other programs joined
_SO_ATTACH_FILTER = 26  # asm-generic/socket.h
_SO_RXQ_OVFL = 40  # asm-generic/socket.h: count of datagrams the kernel dropped
_BUFFER = 4 << 20  # bytes asked for; a burst beyond the buffer is lost


class LoopbackBus(can.BusABC):
    """A python-can bus on one IPv4 multicast group, loopback only. `overflows` counts the frames the kernel dropped."""

    def __init__(self, group: str, port: int = PORT) -> None:
        self.channel_info = f"udp_multicast {group}:{port} on the loopback interface"
        self.overflows = 0
        self._is_filtered = False
        self._destination = group, port
        try:
            self._tx = open_sender()
            self._rx = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            try:
                self._rx.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
                self._rx.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
                join_group(self._rx, group, port)
                self._turn = Turn(group, port)
            except OSError:
                self._tx.close()
                self._rx.close()
                raise
        except OSError as error:
            raise can.CanInitializationError(f"{group}: {error.strerror}") from error
        self._own = self._tx.getsockname()
        super().__init__(channel=group)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        while select.select([self._rx], [], [], timeout)[0]:
            data, ancillary, _, sender = self._rx.recvmsg(4096, socket.CMSG_SPACE(4))
            self._count_losses(ancillary)
            if sender != self._own:
                return _decode_message(data), False
            timeout = 0.0  # what is behind our own frame has come already; recv() waits again if nothing has
        return None, False

    def receive_waiting(self, timeout: float) -> list[can.Message]:
        """All messages that are waiting; if there are none, wait up to `timeout` seconds for the first.

        One wait for all of them: python-can waits, and asks the clock, for each. Raises OSError when the bus is gone.
        """
        messages: list[can.Message] = []
        if timeout > 0 and not select.select([self._rx], [], [], timeout)[0]:
            return messages
        while True:
            try:
                data, ancillary, _, sender = self._rx.recvmsg(4096, socket.CMSG_SPACE(4), socket.MSG_DONTWAIT)
            except BlockingIOError:
                return messages
            self._count_losses(ancillary)
            if sender != self._own:
                messages.append(_decode_message(data))

    def _count_losses(self, ancillary: list[tuple[int, int, bytes]]) -> None:
        for level, kind, value in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, _SO_RXQ_OVFL) and not self._is_filtered:
                (self.overflows,) = struct.unpack("=I", value)

    def leave_out(self, cob_ids: Collection[int]) -> None:
        """Let the kernel drop the frames with these COB-IDs: one that Python decodes costs 30 us.

        `overflows` is not counted any more: to the kernel a frame that was filtered out is one that was lost.
        """
        self._is_filtered = True
        attach_filter(self._rx, self._own[1], cob_ids, left_out=True)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        data = pack_message(msg)
        try:
            self._turn.take()
            try:
                self._tx.sendto(data, self._destination)
            finally:
                self._turn.give()
        except RigError as error:
            raise can.CanOperationError(str(error)) from error
        except OSError as error:
            raise can.CanOperationError(f"{self.channel_info}: {error.strerror}") from error

    def fileno(self) -> int:
        return self._rx.fileno()

    def shutdown(self) -> None:
        super().shutdown()
        self._rx.close()
        self._tx.close()
        self._turn.close()


def _decode_message(data: bytes) -> can.Message:
    """The frame in a datagram; a datagram without a valid frame becomes an error frame."""
    try:
        return unpack_message(data, check=True)
    except Exception:  # msgpack and can.Message raise various exceptions on foreign bytes
        return can.Message(is_error_frame=True)


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
    are filtered, else all pass. Raises OSError.
    """
    load_half, load_byte, load_word = 0x28, 0x30, 0x20  # at an absolute place, counted from the UDP header
    equal, at_least, always, give = 0x15, 0x35, 0x05, 0x06
    accept, drop = 0xFFFFFFFF, 0
    program = [(load_half, 0, 0, 0), (equal, 0, 1, own_port), (give, 0, 0, drop)]
    if len(cob_ids) <= 64:
        listed, others = (drop, accept) if left_out else (accept, drop)
        text = [(8, 0x8BA97469), (8 + 20, 0xAE617262), (8 + 31, 0x6E5F6964)]  # map of 11, "ti.."; "arb..", "n_id"
        for place, word in text:
            program += [(load_word, 0, 0, place), (equal, 1, 0, word), (give, 0, 0, accept)]
        program += [(load_byte, 0, 0, 8 + 35),  # the identifier itself, or 0xCC and a byte, or 0xCD and two
                    (at_least, 0, 6, 0x80),
                    (equal, 0, 2, 0xCC), (load_byte, 0, 0, 8 + 36), (always, 0, 0, 3),
                    (equal, 1, 0, 0xCD), (give, 0, 0, accept), (load_half, 0, 0, 8 + 36)]
        program += [step for cob_id in cob_ids for step in ((equal, 0, 1, cob_id), (give, 0, 0, listed))]
        program.append((give, 0, 0, others))
    else:
        program.append((give, 0, 0, accept))
    steps = bytearray(b"".join(struct.pack("=HBBI", *step) for step in program))
    code = (c_char * len(steps)).from_buffer(steps)
    rx.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, struct.pack("@HP", len(program), addressof(code)))


def join_group(rx: socket.socket, group: str, port: int) -> None:
    """Let a socket hear the group, on 127.0.0.1 alone. Raises OSError."""
    rx.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    rx.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
    rx.bind((group, port))
    rx.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(group) + _LOOPBACK)


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
        number = self._operate(TAKE, limit)
        if number:
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
            is_ours = count == _SEMAPHORES and owner == os.geteuid()
            if not is_ours or self._library.semctl(identifier, _MARK, _GET_VALUE) != _MARK_VALUE:
                continue
            if self._operate(_CLAIM_UNUSED, identifier=identifier) == 0:
                self._library.semctl(identifier, 0, _REMOVE)

    def _operate(self, operations: np.ndarray, limit: np.ndarray | None = None, identifier: int = -1) -> int:
        """semtimedop; errno, 0 when done."""
        where = self.identifier if identifier < 0 else identifier
        time = None if limit is None else limit.ctypes.data
        while self._library.semtimedop(where, ctypes.c_void_p(operations.ctypes.data), ctypes.c_size_t(len(operations)),
                                       ctypes.c_void_p(time)):
            number = ctypes.get_errno()
            if number != errno.EINTR:
                return number
        return 0

    def _name_holder(self) -> str:
        """The process that took the turn last, with its name where it can be read."""
        process = self._library.semctl(self.identifier, _TURN, _GET_PID)
        try:
            return f"process {process} ({Path(f'/proc/{process}/comm').read_text().strip()})"
        except OSError:
            return f"process {process}"
