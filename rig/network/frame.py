"""One CAN frame, as nodes see it: bytes and a time, never a socket or a clock."""
from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol


class Frame(NamedTuple):
    """A classical CAN data frame with an 11-bit identifier."""

    t_ns: int  # ns since the run began; virtual in lockstep
    cob_id: int
    data: bytes


Send = Callable[[int, bytes], None]  # (COB-ID, data)


class Node(Protocol):
    """A node on the bus. It learns the time only through the two calls below."""

    def receive(self, frame: Frame) -> None:
        """A frame of another node arrived."""

    def tick(self, t_ns: int) -> None:
        """Run what is due at `t_ns`: heartbeats, timeouts, delayed frames."""
