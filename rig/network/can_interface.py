"""The project's UDP bus as a python-can interface, so that any program with python-can or canopen joins in one line.

    bus = can.Bus(interface="eha_rig_udp", channel="239.74.163.2")
    network.connect(interface="eha_rig_udp", channel="239.74.163.2")        # canopen

pyproject.toml registers it in the group of entry points in which python-can looks for interfaces, "can.interface".
python-can's own `udp_multicast` cannot take its place: it hears its own frames, and it needs a route for multicast.
"""
from __future__ import annotations

import time
from typing import Any

import can

from plant.errors import InputError
from rig.network.bus import parse_spec
from rig.network.udp import PORT, LoopbackBus


class UdpBus(LoopbackBus):
    """A bus on one IPv4 multicast group of this machine, with the options that python-can expects of an interface.

    Args:
        channel: the multicast group, as in `rig run --bus udp_multicast:GROUP`; default: that of `--bus udp_multicast`.
        port: UDP port.
        can_filters: as in python-can; frames are filtered in this process.
        options: bit rate and others are accepted and mean nothing here; receive_own_messages and fd must be off.

    Raises:
        can.CanInitializationError: no multicast group, or an option that the bus does not have.
    """

    def __init__(self, channel: str | None = None, port: int = PORT,
                 can_filters: can.typechecking.CanFilters | None = None, **options: Any) -> None:
        for name in ("receive_own_messages", "fd"):
            if options.get(name):
                raise can.CanInitializationError(f"eha_rig_udp: {name} is not possible on this bus")
        try:
            _, group = parse_spec(f"udp_multicast:{channel or ''}", "channel")
        except InputError as error:
            raise can.CanInitializationError(f"eha_rig_udp: {error}") from None
        super().__init__(group, int(port))
        self.set_filters(can_filters)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        message, is_filtered = super()._recv_internal(timeout)
        if message is not None:  # the datagram holds the sender's time, if any
            message.timestamp = time.time()
            message.channel = self.channel_info
        return message, is_filtered
