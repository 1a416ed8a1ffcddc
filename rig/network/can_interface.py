"""The project's UDP bus as a python-can interface, so that any program with python-can or canopen joins in one line.

    bus = can.Bus(interface="eha_rig_udp", channel="239.74.163.2")
    network.connect(interface="eha_rig_udp", channel="239.74.163.2")        # canopen

pyproject.toml registers it in the group of entry points in which python-can looks for interfaces, "can.interface".
python-can's own `udp_multicast` cannot take its place: it hears its own frames, and it needs a route for multicast.
"""

import contextlib
import select
import socket
import struct
import time
from collections.abc import Collection
from typing import Any

import can
from can.interfaces.udp_multicast.utils import pack_message, unpack_message

from plant import RigError
from rig.network.udp import GROUP, PORT, SO_RXQ_OVFL, attach_filter, is_group, open_sockets

_ANCILLARY = socket.CMSG_SPACE(16) + socket.CMSG_SPACE(4)  # the kernel's time, and its count of lost datagrams


class UdpBus(can.BusABC):
    """A bus on one IPv4 multicast group of this machine, with the options that python-can expects of an interface.

    `overflows` counts the frames that the kernel dropped.

    Args:
        channel: the multicast group, as in `rig run --bus udp_multicast:GROUP`; default: that of `--bus udp_multicast`.
        port: UDP port.
        can_filters: as in python-can; frames are filtered in this process.
        options: bit rate, fd and others are accepted and mean nothing here: the bus carries classical frames and CAN FD
            frames. receive_own_messages must be off.

    Raises:
        can.CanInitializationError: no multicast group, an option that the bus does not have, or no sockets.
    """

    _can_protocol = can.CanProtocol.CAN_FD

    def __init__(self, channel: str | None = None, port: int = PORT,
                 can_filters: can.typechecking.CanFilters | None = None, **options: Any) -> None:
        group = channel or GROUP
        if options.get("receive_own_messages"):
            raise can.CanInitializationError("eha_rig_udp: receive_own_messages is not possible on this bus")
        if not is_group(group):
            raise can.CanInitializationError(f"eha_rig_udp: channel: {group}: expected an IPv4 multicast group")
        self.channel_info = f"udp_multicast {group}:{port} on the loopback interface"
        self.overflows = 0
        self._is_filtered = False
        self._destination = group, int(port)
        try:
            with contextlib.ExitStack() as stack:
                self._rx, self._tx, self._turn = open_sockets(*self._destination, stack)
                self._opened = stack.pop_all()
        except OSError as error:
            raise can.CanInitializationError(f"{group}: {error.strerror}") from error
        self._own = self._tx.getsockname()
        super().__init__(group, can_filters)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        while select.select([self._rx], [], [], timeout)[0]:
            with contextlib.suppress(BlockingIOError):  # another thread was quicker
                if (message := self._take_message()) is not None:
                    return message, False
            timeout = 0.0  # what is behind our own frame has come already; recv() waits again if nothing has
        return None, False

    def _take_message(self) -> can.Message | None:
        """The next datagram as a message, None for one of our own; one without a valid frame is an error frame.

        Raises BlockingIOError when none is waiting.
        """
        data, ancillary, _, sender = self._rx.recvmsg(4096, _ANCILLARY, socket.MSG_DONTWAIT)
        for level, kind, value in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, SO_RXQ_OVFL) and not self._is_filtered:
                (self.overflows,) = struct.unpack("=I", value)
        if sender == self._own:
            return None
        try:
            message = unpack_message(data, check=True)
        except Exception:  # msgpack and can.Message raise various exceptions on foreign bytes
            message = can.Message(is_error_frame=True)
        message.timestamp, message.channel = time.time(), self.channel_info  # the datagram has the sender's, if any
        return message

    def leave_out(self, cob_ids: Collection[int]) -> None:
        """Let the kernel drop the frames with these COB-IDs: one that Python decodes costs 30 us.

        `overflows` is not counted any more: to the kernel a frame that was filtered out is one that was lost.
        """
        self._is_filtered = True
        attach_filter(self._rx, self._own[1], cob_ids, left_out=True)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Put a message on the bus. Raises can.CanOperationError when the bus is gone or its turn does not come."""
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
        """The socket that becomes readable when a message comes."""
        return self._rx.fileno()

    def shutdown(self) -> None:
        """Give the bus back."""
        super().shutdown()
        self._opened.close()
