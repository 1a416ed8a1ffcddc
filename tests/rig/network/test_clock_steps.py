"""The clock is set while frames come: the kernel stamps with the wall clock, a run goes by the monotonic one."""

import struct
from typing import Any

import can
import pytest

from rig.network import bus as bus_module
from rig.network.bus import Link

HOUR = 3600 * 10**9  # ns
SECOND = 10**9


class Kernel:
    """A CAN socket whose frames carry wall-clock stamps, and both clocks."""

    def __init__(self) -> None:
        self.monotonic, self.wall = 50 * SECOND, 1_700_000_000 * SECOND
        self.waiting: list[int] = []

    def receive(self) -> None:
        """A frame comes in now."""
        self.waiting.append(self.wall)

    def advance(self, ns: int, step: int = 0) -> None:
        """Time goes on; the wall clock is set by `step` as well."""
        self.monotonic, self.wall = self.monotonic + ns, self.wall + ns + step

    def recvmsg(self, *_: int) -> tuple[bytes, list[tuple[int, int, bytes]], int, Any]:
        if not self.waiting:
            raise BlockingIOError
        stamp = struct.pack("@qq", *divmod(self.waiting.pop(0), SECOND))
        return struct.pack("=IB3x8s", 0x182, 8, bytes(8)), [(1, 35, stamp)], 0, None


@pytest.mark.parametrize("step", [0, HOUR, -HOUR, 3 * SECOND, -3 * SECOND])
def test_a_frame_is_never_from_the_future_nor_older_than_the_one_before(step: int,
                                                                       monkeypatch: pytest.MonkeyPatch) -> None:
    kernel = Kernel()
    monkeypatch.setattr(bus_module.time, "time_ns", lambda: kernel.wall)
    link = Link(can.Bus(interface="virtual", channel="clock steps"), lambda: kernel.monotonic)
    link._socket = kernel  # type: ignore[assignment]
    times, true = [], []
    for k in range(10):
        kernel.receive()
        true.append(kernel.monotonic)
        kernel.advance(200_000, step if k == 5 else 0)  # set between the arrival of a frame and its reading
        times += [frame.t_ns for frame in link.poll()]
        kernel.advance(800_000)
    link.close()
    assert times == sorted(times) and len(times) == 10
    late = [t - expected for t, expected in zip(times, true, strict=True)]
    assert all(-1_000_000 <= error <= 200_000 for error in late)  # of the one frame; all others are exact
    assert [error for k, error in enumerate(late) if k != 5] == [0] * 9
