"""SDO server (CiA 301, 7.2.4.3): expedited and segmented upload and download, with the abort codes.

Block transfer is optional for a server; it is refused with "command specifier not valid".
Rejected alternative: canopen's SdoServer, which notices a read-only or absent object only after the last segment of
a download, accepts any number of bytes against the size announced, and answers a stray first request with an exception.
"""

from collections.abc import Callable
from enum import IntEnum

from rig.network import HEAD, Frame, Send

_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = range(5)  # client command specifiers
_LARGEST = 1 << 20  # bytes in one download: a scenario is a few kB


class Abort(IntEnum):
    """SDO abort codes (CiA 301, table 22), as far as this server uses them."""

    TOGGLE = 0x05030000
    TIMEOUT = 0x05040000
    COMMAND = 0x05040001
    MEMORY = 0x05040005
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    INCOMPATIBLE = 0x06040043
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    VALUE = 0x06090030
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    GENERAL = 0x08000000
    STATE = 0x08000022
    NO_DATA = 0x08000024


class SdoAbort(Exception):
    """Refuses a transfer; the code goes to the client."""

    def __init__(self, code: int = Abort.GENERAL) -> None:
        self.code = int(code)
        super().__init__(f"SDO abort 0x{self.code:08X}")


def abort_unless(holds: object, code: Abort) -> None:
    """Raises SdoAbort with this code unless what the server demands `holds`."""
    if not holds:
        raise SdoAbort(code)


class SdoServer:
    """One transfer at a time.

    `upload(index, sub)` gives an object's bytes; `size(index, sub)` refuses a download that cannot succeed before its
    segments are sent and gives the object's length in bytes, 0 if it has no fixed one; `download(index, sub, data)`
    stores. All three may raise SdoAbort.
    """

    def __init__(
        self,
        tx_cob_id: int,
        send: Send,
        upload: Callable[[int, int], bytes],
        size: Callable[[int, int], int],
        download: Callable[[int, int, bytes], None],
    ) -> None:
        self._tx, self._send = tx_cob_id, send
        self._upload, self._size, self._download = upload, size, download
        self._object = (0, 0)
        self._last_ns = 0
        self.reset()

    @property
    def is_busy(self) -> bool:
        """Whether a transfer is open."""
        return self._open is not None

    def reset(self) -> None:
        """Forget an open transfer."""
        self._open: int | None = None  # command specifier of the segments expected
        self._buffer = bytearray()
        self._announced: int | None = None  # bytes
        self._fixed = 0  # bytes of the object, 0: any number
        self._toggle = 0

    def receive(self, frame: Frame) -> None:
        """Handle a request. A frame that is not 8 bytes long is not an SDO and is ignored."""
        if len(frame.data) != 8:
            return
        self._last_ns = frame.t_ns
        try:
            reply = self._answer(frame.data)
        except SdoAbort as abort:
            self._abort(abort.code)
        else:
            if reply:
                self._send(self._tx, reply.ljust(8, b"\0"))

    def tick(self, t_ns: int) -> None:
        """Abort a transfer whose client stopped sending."""
        longest_pause = 5_000_000_000  # ns: a client on a busy machine may stand still
        if self._open is not None and t_ns - self._last_ns > longest_pause:
            self._abort(Abort.TIMEOUT)

    def _abort(self, code: int) -> None:
        self.reset()
        self._send(self._tx, HEAD.pack(0x80, *self._object) + code.to_bytes(4, "little"))

    def _answer(self, data: bytes) -> bytes:
        """The reply to one request, empty for none; raises SdoAbort."""
        command, index, sub = HEAD.unpack_from(data)
        specifier = command >> 5
        if specifier == _ABORT:
            self.reset()
            return b""
        if specifier in (_DOWNLOAD_SEGMENT, _UPLOAD_SEGMENT):
            return self._segment(command, data)
        self.reset()  # a new request takes the place of an unfinished one
        self._object = index, sub
        if specifier == _DOWNLOAD:
            self._begin_download(command, data)
            return HEAD.pack(0x60, index, sub)
        if specifier == _UPLOAD:
            return self._begin_upload()
        raise SdoAbort(Abort.COMMAND)  # block transfer, or nothing the standard knows

    def _begin_download(self, command: int, data: bytes) -> None:
        size = self._size(*self._object)
        is_expedited, is_announced = command & 2, command & 1
        if is_expedited:
            length = 4 - (command >> 2 & 3) if is_announced else size or 4
            self._download(*self._object, data[4 : 4 + length])
            return
        self._fixed = size
        if is_announced:
            self._announced = int.from_bytes(data[4:], "little")
            abort_unless(not size or self._announced >= size, Abort.TOO_SHORT)
            abort_unless(not size or self._announced <= size, Abort.TOO_LONG)
            abort_unless(self._announced <= _LARGEST, Abort.MEMORY)
        self._open = _DOWNLOAD_SEGMENT

    def _begin_upload(self) -> bytes:
        value = self._upload(*self._object)
        if 0 < len(value) <= 4:
            return HEAD.pack(0x43 | (4 - len(value)) << 2, *self._object) + value
        self._buffer += value
        self._open = _UPLOAD_SEGMENT
        return HEAD.pack(0x41, *self._object) + len(value).to_bytes(4, "little")

    def _segment(self, command: int, data: bytes) -> bytes:
        abort_unless(self._open == command >> 5, Abort.COMMAND)
        abort_unless(command & 0x10 == self._toggle, Abort.TOGGLE)
        toggle, self._toggle = self._toggle, self._toggle ^ 0x10
        if self._open == _DOWNLOAD_SEGMENT:
            self._buffer += data[1 : 8 - (command >> 1 & 7)]
            self._check_length(last=bool(command & 1))
            if command & 1:
                value = bytes(self._buffer)
                self.reset()
                self._download(*self._object, value)
            return bytes((0x20 | toggle,))
        part = bytes(self._buffer[:7])
        del self._buffer[:7]
        last = not self._buffer
        if last:
            self.reset()
        return bytes((toggle | (7 - len(part)) << 1 | last,)) + part

    def _check_length(self, last: bool) -> None:
        length, limit = len(self._buffer), self._fixed or self._announced
        abort_unless(limit is None or length <= limit, Abort.TOO_LONG)
        abort_unless(length <= _LARGEST, Abort.MEMORY)
        abort_unless(not last or self._announced is None or length >= self._announced, Abort.TOO_SHORT)
