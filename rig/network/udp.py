"""CAN frames between the processes of one machine: UDP multicast that cannot leave it.

The datagrams are those of python-can's `udp_multicast`. Its own bus listens on every interface, sends by the default
route, needs one to exist at all, and hears its own frames; here the group is joined on 127.0.0.1, sent to from there
with a TTL of 0, and a bus does not hear itself, as on a real one. All nodes hear all frames in one order, as on a real
one too: the kernel hands a datagram to one socket after the other, and a node that heard it early could answer before
the others have it. A lock between the processes keeps the next frame back until this one is everywhere.
"""
from __future__ import annotations

import fcntl
import select
import socket
import struct
import tempfile
from pathlib import Path
from typing import IO

import can
from can.interfaces.udp_multicast.utils import pack_message, unpack_message

PORT = 43113  # python-can's
_LOOPBACK = socket.inet_aton("127.0.0.1")
_IP_MULTICAST_ALL = 49  # linux/in.h; without it a socket hears the groups other programs joined
_SO_RXQ_OVFL = 40  # asm-generic/socket.h: count of datagrams the kernel dropped
_BUFFER = 4 << 20  # bytes asked for; a burst beyond the buffer is lost


class LoopbackBus(can.BusABC):
    """A python-can bus on one IPv4 multicast group, loopback only. `overflows` counts the frames the kernel dropped."""

    def __init__(self, group: str, port: int = PORT) -> None:
        self.channel_info = f"udp_multicast {group}:{port} on the loopback interface"
        self.overflows = 0
        self._destination = group, port
        self._rx = _make_socket()
        self._tx = _make_socket()
        try:
            self._rx.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._rx.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
            self._rx.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
            self._rx.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
            self._rx.bind((group, port))
            membership = socket.inet_aton(group) + _LOOPBACK
            self._rx.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
            self._tx.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, _LOOPBACK)
            self._tx.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            self._tx.bind(("127.0.0.1", 0))
            self._turn = _open_lock_file(f"eha-rig-{group}-{port}.lock")
        except OSError as error:
            self._rx.close()
            self._tx.close()
            raise can.CanInitializationError(f"{group}: {error.strerror}") from error
        self._own = self._tx.getsockname()
        super().__init__(channel=group)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        while select.select([self._rx], [], [], timeout)[0]:
            data, ancillary, _, sender = self._rx.recvmsg(4096, socket.CMSG_SPACE(4))
            for level, kind, value in ancillary:
                if (level, kind) == (socket.SOL_SOCKET, _SO_RXQ_OVFL):
                    (self.overflows,) = struct.unpack("=I", value)
            if sender != self._own:
                return _decode_message(data), False
            timeout = 0.0  # what is behind our own frame has come already; recv() waits again if nothing has
        return None, False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        data = pack_message(msg)
        try:
            fcntl.flock(self._turn, fcntl.LOCK_EX)
            try:
                self._tx.sendto(data, self._destination)
            finally:
                fcntl.flock(self._turn, fcntl.LOCK_UN)
        except OSError as error:
            raise can.CanOperationError(f"{self.channel_info}: {error.strerror}") from error

    def fileno(self) -> int:
        return self._rx.fileno()

    def shutdown(self) -> None:
        super().shutdown()
        self._rx.close()
        self._tx.close()
        self._turn.close()


def _open_lock_file(name: str) -> IO[bytes]:
    """A file of this name that processes of all users may lock."""
    path = Path(tempfile.gettempdir()) / name
    if not path.exists():
        path.touch()
        path.chmod(0o444)  # whatever the umask
    return path.open("rb")


def _decode_message(data: bytes) -> can.Message:
    """The frame in a datagram; a datagram without a valid frame becomes an error frame."""
    try:
        return unpack_message(data, check=True)
    except Exception:  # msgpack and can.Message raise various exceptions on foreign bytes
        return can.Message(is_error_frame=True)


def _make_socket() -> socket.socket:
    return socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
