"""EMCY producer (CiA 301, 7.2.7): emergency frames, error register 0x1001 and error history 0x1003."""

import struct
from collections.abc import Callable
from enum import IntEnum, IntFlag
from functools import reduce
from operator import or_

from rig.benches import INVALID
from rig.device.dictionary import Dictionary

_FRAME = struct.Struct("<HB5s")
REGISTER, HISTORY, COB_ID = 0x1001, 0x1003, 0x1014


class EmcyCode(IntEnum):
    """Error codes the core itself raises, and those the bench needs."""

    RESET = 0x0000
    SOFTWARE = 0x6000
    COMMUNICATION = 0x8100
    HEARTBEAT_LOST = 0x8130
    PDO_TOO_SHORT = 0x8210
    PDO_TOO_LONG = 0x8220
    SYNC_LENGTH = 0x8240
    RPDO_TIMEOUT = 0x8250


class ErrorRegister(IntFlag):
    """Bits of 0x1001 that are used here."""

    GENERIC = 0x01
    COMMUNICATION = 0x10


class Emcy:
    """The errors in force. One frame as an error comes, one as it goes; repeats of a standing error say nothing new.

    An error is its code and its first information byte (which PDO, which node), so that two nodes lost are two errors.
    `is_permitted()` says whether the NMT state lets EMCY through; register and history are kept in any state.
    """

    def __init__(self, od: Dictionary, send: Callable[[int, bytes], None], is_permitted: Callable[[], bool]) -> None:
        self._od, self._send, self._is_permitted = od, send, is_permitted
        self._active: dict[tuple[int, bytes], int] = {}  # (code, information) -> register bits

    @property
    def active(self) -> list[int]:
        """Codes in force, oldest first."""
        return [code for code, _ in self._active]

    def reset(self) -> None:
        """Forget all without a word, as at power-on."""
        self._active.clear()

    def raise_error(self, code: int, register: int = ErrorRegister.GENERIC, info: bytes = b"") -> None:
        """An error came: `code` as in CiA 301 table 26, its `register` bits, up to 5 bytes of `info`."""
        key = code, info[:1]
        if key in self._active:
            return
        self._active[key] = register | ErrorRegister.GENERIC
        self._record(code, info)
        self._transmit(code, info)

    def clear(self, code: int | None = None, info: bytes = b"") -> None:
        """All errors of that code (and information) are gone, without `code` every error; says so if there were any."""
        keys = [key for key in self._active if code in (None, key[0]) and info[:1] in (b"", key[1])]
        for key in keys:
            del self._active[key]
        if keys:
            self._transmit(EmcyCode.RESET, b"")

    def erase_history(self) -> None:
        """Master wrote 0 to 0x1003 sub 0."""
        for sub in (0, *self._od.list_subs(HISTORY)):
            self._od.values[HISTORY, sub] = 0

    def _record(self, code: int, info: bytes) -> None:
        subs = self._od.list_subs(HISTORY)
        values = self._od.values
        for sub in reversed(subs[1:]):  # newest first: sub 1
            values[HISTORY, sub] = values[HISTORY, sub - 1]
        if subs:
            values[HISTORY, 1] = code | int.from_bytes(info[:2], "little") << 16
            values[HISTORY, 0] = min(self._od.read_number(HISTORY, 0) + 1, len(subs))

    def _transmit(self, code: int, info: bytes) -> None:
        register = reduce(or_, self._active.values(), 0)
        self._od.values[REGISTER, 0] = register
        cob_id = self._od.read_number(COB_ID, 0, INVALID)
        if self._is_permitted() and not cob_id & INVALID:
            self._send(cob_id & 0x7FF, _FRAME.pack(code, register, info[:5]))
