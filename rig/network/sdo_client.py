"""SDO client (CiA 301, 7.2.4.3): expedited and segmented transfers, of which every response is checked.

The transfers ask for no more than an `exchange`: it sends a request of 8 bytes and returns the response to it.
"""

import contextlib
import struct
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from plant import RigError, count_nouns

R = TypeVar("R")
Exchange = Callable[[bytes], bytes]
HEAD = struct.Struct("<BHB")  # command, index, sub-index
ABORT, TOGGLE = 0x80, 0x10
LARGEST = 1 << 24  # bytes; a server that never ends an upload must not fill the memory
_SEGMENT_DOWNLOAD, _DOWNLOAD, _UPLOAD, _SEGMENT_UPLOAD = range(4)  # client command specifiers
_CONFIRMATION = {_SEGMENT_DOWNLOAD: 1, _DOWNLOAD: 3, _UPLOAD: 2, _SEGMENT_UPLOAD: 0}  # the server's answer to each
_TIMED_OUT, _TOGGLE_WRONG, _COMMAND_INVALID, _LENGTH_WRONG = 0x05040000, 0x05030000, 0x05040001, 0x06070010
_BROKEN_OFF = (_TOGGLE_WRONG, _TIMED_OUT, _COMMAND_INVALID)  # aborts of a server that has lost a transfer


class SdoProblem(Exception):
    """What is wrong with a response, in words. `code`: of the abort to send; 0 where the transfer is over."""

    def __init__(self, text: str, code: int = 0) -> None:
        super().__init__(text)
        self.code = code


def require_confirmation(request: bytes, response: bytes) -> None:
    """Raises SdoProblem unless a response, which may be an abort, is one to this request.

    >>> require_confirmation(bytes.fromhex("4000100000000000"), bytes.fromhex("4300100092010000"))
    >>> require_confirmation(bytes.fromhex("4000100000000000"), bytes.fromhex("4301100092010000"))
    Traceback (most recent call last):
    rig.network.sdo_client.SdoProblem: confirmation of object 0x1001 sub 0
    """
    command, answer, is_abort = request[0] >> 5, response[0] >> 5, response[0] == ABORT
    is_initiate, confirmation = command in (_DOWNLOAD, _UPLOAD), _CONFIRMATION[command]
    if not is_abort and answer != confirmation:
        raise SdoProblem(f"command specifier {answer} (0x{response[0]:02X}), expected {confirmation}", _COMMAND_INVALID)
    if is_initiate and response[1:4] != request[1:4]:
        _, index, sub = HEAD.unpack_from(response)
        raise SdoProblem(f"{'abort' if is_abort else 'confirmation'} of object 0x{index:04X} sub {sub}",
                         _COMMAND_INVALID)
    if not is_abort and not is_initiate and (response[0] ^ request[0]) & TOGGLE:
        raise SdoProblem("wrong toggle bit", _TOGGLE_WRONG)


def upload_object(exchange: Exchange, index: int, sub: int, largest: int = LARGEST) -> tuple[bytes, bool]:
    """The bytes of an object, and whether the server gave their number; else an expedited upload has four.

    Raises:
        SdoProblem: they are not as many as announced, or more than `largest`.
    """
    response = exchange(HEAD.pack(_UPLOAD << 5, index, sub) + bytes(4))
    is_sized, size = bool(response[0] & 1), int.from_bytes(response[4:], "little")
    if response[0] & 2:  # expedited
        return response[4:8 - (response[0] >> 2 & 3 if is_sized else 0)], is_sized
    data, toggle, is_last = b"", 0, False
    while not is_last:
        response = exchange(bytes((_SEGMENT_UPLOAD << 5 | toggle,)) + bytes(7))
        data += response[1:8 - (response[0] >> 1 & 7)]
        toggle ^= TOGGLE
        is_last = bool(response[0] & 1)
        if len(data) > (size if is_sized else largest):
            most = f"the {size} bytes announced" if is_sized else f"{largest} bytes"
            raise SdoProblem(f"more than {most}", _LENGTH_WRONG)
    if is_sized and len(data) != size:
        raise SdoProblem(f"{count_nouns(len(data), 'byte')}, {size} were announced")
    return data, True


def download_object(exchange: Exchange, index: int, sub: int, data: bytes, segmented: bool = False) -> None:
    """Write the bytes of an object."""
    size = len(data)
    if 0 < size <= 4 and not segmented:
        exchange(HEAD.pack(_DOWNLOAD << 5 | (4 - size) << 2 | 3, index, sub) + data.ljust(4, b"\0"))
        return
    exchange(HEAD.pack(_DOWNLOAD << 5 | 1, index, sub) + size.to_bytes(4, "little"))
    for number, start in enumerate(range(0, max(size, 1), 7)):
        exchange(pack_segment(data[start:start + 7], start + 7 >= size, TOGGLE * (number % 2)))


def pack_segment(part: bytes, is_last: bool, toggle: int = 0) -> bytes:
    """A segment of a download with up to 7 bytes."""
    return bytes((toggle | (7 - len(part)) << 1 | is_last,)) + part.ljust(7, b"\0")


class ConfirmationError(RigError):
    """A node confirms something other than the SDO request. One line: node, what came, what was expected.

    It is neither a refusal nor silence, which a master may take for "not implemented": such a node cannot be used.
    """


class CheckedSdoClient(SdoClient):
    """The library's SDO client on a wire; while it waits, the wire delivers frames.

    A response that does not confirm the request ends the transfer: the client sends an abort and raises
    ConfirmationError. No response within RESPONSE_TIMEOUT raises SdoCommunicationError, an abort by the server
    SdoAbortedError.
    """

    RESPONSE_TIMEOUT = 1.0  # s: the node may run on the same, busy machine
    largest_upload = LARGEST

    def request_response(self, sdo_request: bytes) -> bytes:
        """Send a request and return its confirmation, 8 bytes. Raises SdoProblem, and as the class says."""
        while not self.responses.empty():  # left over from a transfer that was given up
            self.responses.get_nowait()
        self.send_request(sdo_request)
        network: Any = self.network
        if not network.wire.wait(lambda: not self.responses.empty(), self.RESPONSE_TIMEOUT):
            raise SdoCommunicationError("No SDO response received")
        response: bytes = self.responses.get_nowait()
        require_confirmation(sdo_request, response)
        if response[0] == ABORT:
            raise SdoAbortedError(int.from_bytes(response[4:], "little"))
        return response

    def upload(self, index: int, subindex: int) -> bytes:
        """Read an object's bytes. Raises as the class says."""
        with self._name_problem(index, subindex):
            data, is_sized = upload_object(self.request_response, index, subindex, self.largest_upload)
            variable = self.od.get_variable(index, subindex)
            if variable is not None and variable.fixed_size:
                size = len(variable) // 8
                data = data if is_sized else data[:size]
                if len(data) != size:
                    raise SdoProblem(f"{count_nouns(len(data), 'byte')}, expected {size}")
        return data

    def download(self, index: int, subindex: int, data: bytes, force_segment: bool = False) -> None:
        """Write an object's bytes. Raises as the class says."""
        with self._name_problem(index, subindex):
            download_object(self.request_response, index, subindex, data, force_segment)

    @contextlib.contextmanager
    def _name_problem(self, index: int, sub: int) -> Iterator[None]:
        """Send an abort for a transfer that ends within, unless it is over; its problem names node and object."""
        try:
            yield
        except (SdoProblem, SdoCommunicationError) as error:
            if code := error.code if isinstance(error, SdoProblem) else _TIMED_OUT:
                self.send_request(HEAD.pack(ABORT, index, sub) + code.to_bytes(4, "little"))
            if isinstance(error, SdoCommunicationError):
                raise
            raise ConfirmationError(f"node {self.rx_cobid - 0x600}, SDO of object 0x{index:04X} sub {sub}: {error}"
                                    ) from None


def repeat_transfer(transfer: Callable[[], R], attempts: int = 3) -> R:
    """Make an SDO transfer, and repeat it when the server has lost it: one of the two may have stood still meanwhile.

    Raises:
        SdoAbortedError: the server refuses, or has lost the last attempt too.
        SdoCommunicationError: no answer.
    """
    for _ in range(attempts - 1):
        try:
            return transfer()
        except SdoAbortedError as error:
            if error.code not in _BROKEN_OFF:
                raise
    return transfer()
