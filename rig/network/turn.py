"""The turn to send on a UDP group: a lock between the processes of one machine, for one frame at a time.

It is a System V semaphore set. The kernel takes the turn back when its holder dies, a wait has a limit, and the error
names the holder. There is no file that a symbolic link could divert. A lock file has no limit for the wait.

Every user of the machine may take the turn, as every user may send on the group: multicast has no access control.
Semaphore 0 is the turn, 1 counts the programs that use the set, 2 says that the last of them removes it, and 3 holds a
mark by which the set is known as one of ours. The kernel keeps the set of programs that were all killed; the next
program that opens a bus removes it.
"""
from __future__ import annotations

import ctypes
import errno
import os
import zlib
from pathlib import Path

import numpy as np

from plant.errors import RigError

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
