"""One CAN frame, as nodes see it: bytes and a time, never a socket or a clock; and the clocks that give the time.

One integer, the COB-ID, says everywhere which frame it is: the identifier, with `EXTENDED` if it has 29 bits and with
`FD` if it is a CAN FD frame. 0x123, 0x123 | EXTENDED and 0x123 | FD are three different frames. A plain
11-bit number is a classical frame.
"""
from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from rig.benches import EXTENDED, FD, SWITCHED

if TYPE_CHECKING:
    import can

IDENTIFIER = 0x1FFFFFFF  # the bits of the identifier itself
FD_LENGTHS = (12, 16, 20, 24, 32, 48, 64)  # bytes of the CAN FD frames that are longer than a classical frame


class Frame(NamedTuple):
    """A CAN data frame: classical or CAN FD, with an identifier of 11 or 29 bits."""

    t_ns: int  # ns since the run began; virtual in lockstep
    cob_id: int  # with EXTENDED and FD
    data: bytes


Send = Callable[[int, bytes], None]  # (COB-ID, data); also with SWITCHED


class Node(Protocol):
    """A node on the bus. It learns the time only through the two calls below."""

    def receive(self, frame: Frame) -> None:
        """A frame of another node arrived."""

    def tick(self, t_ns: int) -> None:
        """Run what is due at `t_ns`: heartbeats, timeouts, delayed frames."""


def has_valid_length(cob_id: int, length: int) -> bool:
    """Whether a frame of this kind can have `length` bytes: 0 to 8, in CAN FD also those of `FD_LENGTHS`."""
    return 0 <= length <= 8 or (cob_id & FD != 0 and length in FD_LENGTHS)


def make_message(cob_id: int, data: bytes, **options: Any) -> can.Message:
    """A frame as python-can's message; `options` are those of can.Message, such as its time."""
    import can  # here: who only reads logs need not load it

    return can.Message(arbitration_id=cob_id & IDENTIFIER, is_extended_id=bool(cob_id & EXTENDED),
                       is_fd=bool(cob_id & FD), bitrate_switch=bool(cob_id & SWITCHED), data=data,
                       **options)


def find_cob_id(message: can.Message) -> int:
    """The COB-ID of a data frame of python-can, with its flags; not the error state indicator of CAN FD."""
    return message.arbitration_id | (
        EXTENDED * message.is_extended_id | FD * message.is_fd | SWITCHED * message.bitrate_switch)


class Clock(Protocol):
    """Time since the run began, ns."""

    def now(self) -> int:
        """The time now, ns."""

    def sleep_until(self, t_ns: int) -> None:
        """Return at `t_ns`; at once if that has passed."""


class VirtualClock:
    """Simulated time: `sleep_until` jumps to its end at once, so a run repeats bit for bit and never waits."""

    def __init__(self) -> None:
        self._t_ns = 0

    def now(self) -> int:
        """The time last jumped to, ns."""
        return self._t_ns

    def sleep_until(self, t_ns: int) -> None:
        """Jump to `t_ns`; never back."""
        self._t_ns = max(self._t_ns, t_ns)


class WallClock:
    """The machine's monotonic clock; 0 when it is created. `origin_ns` is that moment on CLOCK_MONOTONIC."""

    def __init__(self) -> None:
        self.origin_ns = time.monotonic_ns()

    def now(self) -> int:
        """Time since the clock was created, ns."""
        return time.monotonic_ns() - self.origin_ns

    def sleep_until(self, t_ns: int) -> None:
        """Sleep until `t_ns`. CPython sleeps to an absolute deadline, so a long run does not drift."""
        if (remaining_ns := t_ns - self.now()) > 0:
            time.sleep(remaining_ns * 1e-9)
