"""CAN frames between the processes of one machine: UDP multicast that cannot leave it.

The datagrams are those of python-can's `udp_multicast`. Its own bus listens on every interface, sends by the default
route, needs one to exist at all, and hears its own frames; here the group is joined on 127.0.0.1, sent to from there
with a TTL of 0, and a bus does not hear itself, as on a real one. All nodes hear all frames in one order, as on a real
one too: the kernel hands a datagram to one socket after the other, and a node that heard it early could answer before
the others have it. The turn to send (turn.py) keeps the next frame back until this one is everywhere.
"""
from __future__ import annotations

import select
import socket
import struct

import can
from can.interfaces.udp_multicast.utils import pack_message, unpack_message

from plant.errors import RigError
from rig.network.turn import Turn

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

    @property
    def receiver(self) -> socket.socket:
        """The socket that receives."""
        return self._rx

    @property
    def own_port(self) -> int:
        """The UDP port that this bus sends from."""
        return int(self._own[1])

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


def join_group(rx: socket.socket, group: str, port: int) -> None:
    """Let a socket hear the group, on 127.0.0.1 alone. Raises OSError."""
    rx.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    rx.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
    rx.bind((group, port))
    rx.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(group) + _LOOPBACK)
