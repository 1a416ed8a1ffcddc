"""SDO client (CiA 301, 7.2.4.3): upload and download, expedited or segmented, with every confirmation checked.

Its interface is that of the `canopen` library's client. The library itself accepts the confirmation of another object,
does not compare the length of an upload with the length announced, and sends one more segment after an abort.
Block transfer is never used: a small server need not have it, and a client that tries it first costs a round trip.
"""
from __future__ import annotations

import struct
from typing import Any

from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from plant.errors import RigError
from rig.network.wire import Wire

_HEAD = struct.Struct("<BHB")
_SEGMENT_DOWNLOAD, _DOWNLOAD, _UPLOAD, _SEGMENT_UPLOAD = range(4)  # client command specifiers
_CONFIRMATION = {_SEGMENT_DOWNLOAD: 1, _DOWNLOAD: 3, _UPLOAD: 2, _SEGMENT_UPLOAD: 0}  # the server's answer to each
_ABORT = 0x80
_TOGGLE = 0x10
_TIMED_OUT, _TOGGLE_WRONG, _COMMAND_INVALID, _LENGTH_WRONG = 0x05040000, 0x05030000, 0x05040001, 0x06070010


class ConfirmationError(RigError):
    """A node confirms something other than the SDO request. One line: node, what came, what was expected.

    It is neither a refusal nor silence, which a master may take for "not implemented": such a node cannot be used.
    """


class CheckedSdoClient(SdoClient):
    """An SDO client on a wire; while it waits, the wire delivers frames.

    A confirmation with a wrong command specifier, index, sub-index, toggle bit or length ends the transfer: the client
    sends an abort and raises ConfirmationError. No response within RESPONSE_TIMEOUT raises SdoCommunicationError, an
    abort by the server SdoAbortedError.
    """

    RESPONSE_TIMEOUT = 1.0  # s: the node may run on the same, busy machine
    _object = bytes(3)  # index and sub-index of the transfer, as the frames carry them
    largest_upload = 1 << 24  # bytes; a server that never ends an upload must not fill the memory

    def request_response(self, sdo_request: bytes) -> bytes:
        """Send a request and return its confirmation, 8 bytes. Raises as the class says."""
        while not self.responses.empty():  # left over from a transfer that was given up
            self.responses.get_nowait()
        if sdo_request[0] >> 5 in (_DOWNLOAD, _UPLOAD):
            self._object = bytes(sdo_request[1:4])
        self.send_request(sdo_request)
        network: Any = self.network
        wire: Wire = network.wire
        if not wire.wait(lambda: not self.responses.empty(), self.RESPONSE_TIMEOUT):
            self._send_abort(_TIMED_OUT)
            raise SdoCommunicationError("No SDO response received")
        response: bytes = self.responses.get_nowait()
        code, problem = find_problem(sdo_request, response)
        if problem:
            self._send_abort(code)
            raise ConfirmationError(f"{self._describe_transfer()}: {problem}")
        if response[0] == _ABORT:
            raise SdoAbortedError(int.from_bytes(response[4:], "little"))
        return response

    def upload(self, index: int, subindex: int) -> bytes:
        """Read an object's bytes. Raises as the class says."""
        response = self.request_response(_HEAD.pack(_UPLOAD << 5, index, subindex) + bytes(4))
        size = int.from_bytes(response[4:], "little")
        if response[0] & 2:  # expedited
            data = response[4:8 - (response[0] >> 2 & 3)] if response[0] & 1 else response[4:]
        else:
            announced = size if response[0] & 1 else None
            data = self._upload_segments(announced)
        expected = self._find_size(index, subindex)
        if expected and response[0] & 3 == 2 and len(data) > expected:
            data = data[:expected]  # expedited without a length: the object's own length counts
        if expected and len(data) != expected:
            raise ConfirmationError(f"{self._describe_transfer()}: {len(data)} bytes, expected {expected}")
        return data

    def _upload_segments(self, announced: int | None) -> bytes:
        data = bytearray()
        toggle = last = 0
        while not last:
            response = self.request_response(bytes((_SEGMENT_UPLOAD << 5 | toggle,)) + bytes(7))
            data += response[1:8 - (response[0] >> 1 & 7)]
            toggle ^= _TOGGLE
            last = response[0] & 1
            if len(data) > (self.largest_upload if announced is None else announced):
                self._send_abort(_LENGTH_WRONG)
                most = f"{self.largest_upload} bytes" if announced is None else f"the {announced} bytes announced"
                raise ConfirmationError(f"{self._describe_transfer()}: more than {most}")
        if announced is not None and len(data) != announced:
            raise ConfirmationError(f"{self._describe_transfer()}: {len(data)} bytes, {announced} were announced")
        return bytes(data)

    def download(self, index: int, subindex: int, data: bytes, force_segment: bool = False) -> None:
        """Write an object's bytes. Raises as the class says."""
        size = len(data)
        if 0 < size <= 4 and not force_segment:
            head = _HEAD.pack(_DOWNLOAD << 5 | (4 - size) << 2 | 3, index, subindex)
            self.request_response(head + data.ljust(4, b"\0"))
            return
        self.request_response(_HEAD.pack(_DOWNLOAD << 5 | 1, index, subindex) + size.to_bytes(4, "little"))
        toggle = 0
        for start in range(0, max(size, 1), 7):
            part = data[start:start + 7]
            command = toggle | (7 - len(part)) << 1 | (start + 7 >= size)
            self.request_response(bytes((command,)) + part.ljust(7, b"\0"))
            toggle ^= _TOGGLE

    def open(self, *args: Any, **options: Any) -> Any:
        """Refuse the library's streams, and with them block transfer: `upload` and `download` do all.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError("SDO by upload and download only")

    def _find_size(self, index: int, sub: int) -> int:
        """Length in bytes of an object of the node's EDS, 0 if it has no fixed one or is not in the EDS."""
        variable = self.od.get_variable(index, sub)
        return len(variable) // 8 if variable is not None and variable.fixed_size else 0

    def _send_abort(self, code: int) -> None:
        self.send_request(bytes((_ABORT,)) + self._object + code.to_bytes(4, "little"))

    def _describe_transfer(self) -> str:
        """Node and object, as a message begins."""
        index, sub = struct.unpack("<HB", self._object)
        return f"node {self.rx_cobid - 0x600}, SDO of object 0x{index:04X} sub {sub}"


def find_problem(request: bytes, response: bytes) -> tuple[int, str]:
    """Why a response does not confirm a request: the abort code to send and one line; (0, "") if it does.

    >>> find_problem(bytes.fromhex("4000100000000000"), bytes.fromhex("4300100092010000"))
    (0, '')
    >>> find_problem(bytes.fromhex("4000100000000000"), bytes.fromhex("4301100092010000"))[1]
    'confirmation of object 0x1001 sub 0'
    """
    asked = request[0] >> 5
    is_initiate = asked in (_DOWNLOAD, _UPLOAD)
    expected = _CONFIRMATION[asked]
    if response[0] != _ABORT and response[0] >> 5 != expected:
        return _COMMAND_INVALID, f"command specifier {response[0] >> 5} (0x{response[0]:02X}), expected {expected}"
    if is_initiate and response[1:4] != request[1:4]:
        _, index, sub = _HEAD.unpack_from(response)
        what = "abort" if response[0] == _ABORT else "confirmation"
        return _COMMAND_INVALID, f"{what} of object 0x{index:04X} sub {sub}"
    if response[0] != _ABORT and not is_initiate and (response[0] ^ request[0]) & _TOGGLE:
        return _TOGGLE_WRONG, "wrong toggle bit"
    return 0, ""
