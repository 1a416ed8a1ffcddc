"""The canopen library's network on an embedded bus."""

from collections.abc import Callable

import canopen

from rig.network.bus import EmbeddedBus
from rig.network.frame import Frame


class EmbeddedNetwork(canopen.Network):
    """A frame sent is delivered, and answered, before the call returns."""

    def __init__(self, bus: EmbeddedBus, now: Callable[[], int]) -> None:
        super().__init__()
        self._embedded, self._now, self._send = bus, now, bus.attach(self._receive)

    def _receive(self, frame: Frame) -> None:
        self.notify(frame.cob_id, bytearray(frame.data), frame.t_ns / 1e9)

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """As the library calls it."""
        assert not remote
        self._send(can_id, bytes(data))
        self._embedded.deliver(self._now())
