"""Stations on one bus of any back end, with the same few calls; nodes that stay on a bus for the tests of a file."""

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from itertools import count
from typing import Protocol

import pytest
from c_device import run_program

from rig.network import NAMES, Frame, Link, open_can
from rig.network.bus import EmbeddedBus

_SERIAL = count()
raw_kinds = pytest.mark.parametrize("bus_kind", ["udp_multicast", "socketcan"], indirect=True)  # between programs
only_udp = pytest.mark.parametrize("bus_kind", ["udp_multicast"], indirect=True)  # what the bus is does not matter


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


def find_group() -> str:
    """A multicast group that nobody else uses."""
    return spec("udp_multicast").partition(":")[2]


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
        yield [stack.enter_context(closing(Link(open_can(where, fd=fd), clock))) for _ in range(number)]


def gather(station: Station, number: int, timeout: float = 60.0) -> list[Frame]:
    """Poll until `number` frames came, or the time is over."""
    frames: list[Frame] = []
    end = time.monotonic() + timeout
    while len(frames) < number and time.monotonic() < end:
        frames += station.poll(0.05)
    return frames


@contextmanager
def stand_nodes(where: str, *nodes: int) -> Iterator[None]:
    """`rig node` on a bus for each of the node numbers, all started at once."""
    with ExitStack() as stack:
        for node in nodes:
            words = ("-m", "rig.cli.main", "node", NAMES[node], "--bus", where, "--quiet")
            stack.enter_context(run_program(sys.executable, *words))
        for node in nodes:
            wait_for_node(where, node)
        yield


def wait_for_node(where: str, node: int, seconds: float = 300.0) -> None:
    """Until a node has sent a heartbeat: the plant may compile its model and its cycle before."""
    cob_ids, end = set[int](), time.monotonic() + seconds
    with closing(Link(open_can(where), time.monotonic_ns)) as link:
        while 0x700 + node not in cob_ids and time.monotonic() < end:
            cob_ids |= {frame.cob_id for frame in link.poll(0.1)}
    assert 0x700 + node in cob_ids
