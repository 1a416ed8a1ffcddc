"""Stations on one bus of any back end, with the same few calls: what the bus tests are written in."""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import count
from typing import Protocol

from rig.network.bus import EmbeddedBus, Link, open_can
from rig.network.frame import Frame

_SERIAL = count()


class Station(Protocol):
    """One place on a bus: `Link` as it is, or a port of the embedded bus."""

    def send(self, cob_id: int, data: bytes) -> None: ...

    def poll(self, timeout: float = 0.0) -> list[Frame]: ...


class Port:
    """A port of the embedded bus; polling delivers, as there is nobody else to do it."""

    def __init__(self, bus: EmbeddedBus, clock: Callable[[], int]) -> None:
        self._bus, self._clock = bus, clock
        self._frames: list[Frame] = []
        self.send = bus.attach(lambda frame: self._frames.append(frame))

    def poll(self, timeout: float = 0.0) -> list[Frame]:
        self._bus.deliver(self._clock())
        frames, self._frames = self._frames, []
        return frames


def spec(kind: str) -> str:
    """A bus nobody else uses, as far as the back end allows."""
    serial = next(_SERIAL)
    group = f"239.{os.getpid() >> 8 & 255}.{os.getpid() & 255}.{serial % 255 + 1}"
    return {"virtual": f"virtual:test-{serial}", "udp_multicast": f"udp_multicast:{group}"}.get(kind, "socketcan:vcan0")


@contextmanager
def stations(kind: str, number: int = 3, fd: bool = False) -> Iterator[list[Station]]:
    """`number` stations on one new bus, all on one clock that starts at 0; `fd`: also for CAN FD frames."""
    begin = time.monotonic_ns()

    def clock() -> int:
        return time.monotonic_ns() - begin

    if kind == "embedded":
        bus = EmbeddedBus()
        yield [Port(bus, clock) for _ in range(number)]
        return
    where = spec(kind)
    with ExitStack() as stack:
        links = [Link(open_can(where, fd=fd), clock) for _ in range(number)]
        for link in links:
            stack.callback(link.close)
        yield list(links)


def gather(station: Station, number: int, timeout: float = 60.0) -> list[Frame]:
    """Poll until `number` frames came, or the time is over."""
    frames: list[Frame] = []
    end = time.monotonic() + timeout
    while len(frames) < number and time.monotonic() < end:
        frames += station.poll(0.05)
    return frames
