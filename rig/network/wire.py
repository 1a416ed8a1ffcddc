"""The rig's end of a bus: send, let frames come in, wait. One kind with the nodes inside, one for a real bus."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from rig.network.bus import EmbeddedBus
from rig.network.clock import Clock, WallClock
from rig.network.frame import Frame, Node, Send
from rig.network.link import Link

MS = 1_000_000  # ns
_STALL = 100 * MS  # twice the longest pause of the cycle in lockstep
Done = Callable[[], bool]


class Wire(Protocol):
    """What the master and the loop need of a bus."""

    clock: Clock
    send: Send
    receive: Callable[[Frame], None]  # where incoming frames go; set by the master
    is_node_gone: Done  # whether a node will not answer any more; set by the session
    blind_ns: int  # how long at most the frames that come in now have waited to be taken in
    stalled_ns: int  # how long in all frames were not taken in, pauses of the cycle left out

    def wait(self, done: Done, seconds: float) -> bool:
        """Let frames come in until `done()`; False when it took longer than `seconds`."""

    def wait_for_answers(self, t_ns: int, done: Done) -> None:
        """Lockstep: let the frames of the cycle at `t_ns` come in, until `done()` or nothing more can come."""

    def run_until(self, t_ns: int) -> None:
        """Real time: let frames come in until the clock says `t_ns`."""

    def hear_all(self) -> None:
        """Let the frames of nodes that are not of the bench in, for the log; during bring-up they stay out."""

    def close(self) -> None:
        """Give the bus back."""


def _ignore_frame(frame: Frame) -> None:
    """Nobody listens yet."""


def _is_false() -> bool:
    """Nobody watches the nodes yet."""
    return False


class EmbeddedWire:
    """All nodes in this process and thread. With a virtual clock a run repeats bit for bit."""

    def __init__(self, clock: Clock, makers: Sequence[Callable[[Send], Node]], period_ns: int = MS) -> None:
        self.clock, self._period = clock, period_ns
        self.receive: Callable[[Frame], None] = _ignore_frame
        self.is_node_gone: Done = _is_false
        self.blind_ns = self.stalled_ns = 0
        self._bus = EmbeddedBus()
        self.send = self._bus.attach(lambda frame: self.receive(frame))
        self._nodes = [self._bus.add(make) for make in makers]

    def wait(self, done: Done, seconds: float) -> bool:
        """See `Wire`; the time waited is the clock's."""
        end = self.clock.now() + round(seconds * 1e9)
        while True:
            self._deliver(self.clock.now())
            if done():
                return True
            if self.clock.now() >= end:
                return False
            self.clock.sleep_until(self.clock.now() + MS)

    def wait_for_answers(self, t_ns: int, done: Done) -> None:
        """See `Wire`; what is late by less than a cycle comes in too."""
        self.clock.sleep_until(t_ns)
        self._deliver(t_ns)
        self._deliver(t_ns + self._period - 1)

    def run_until(self, t_ns: int) -> None:
        """See `Wire`."""
        self._deliver(self.clock.now())
        while self.clock.now() < t_ns:
            self.clock.sleep_until(min(t_ns, self.clock.now() + MS))
            self._deliver(self.clock.now())

    def hear_all(self) -> None:
        """See `Wire`; all frames come in here."""

    def close(self) -> None:
        """See `Wire`; nothing to give back."""

    def _deliver(self, t_ns: int) -> None:
        """Deliver what is there, run the nodes' timers, deliver what came of them."""
        self._bus.deliver(t_ns)
        for node in self._nodes:
            node.tick(t_ns)
        self._bus.deliver(t_ns)


class LinkWire:
    """A bus between programs or machines. Waiting is in wall time, whatever the pace."""

    def __init__(self, link: Link, clock: WallClock, grace: float = 0.2, patience: int = 5) -> None:
        """`grace`: how late an answer may be in lockstep, s; a tenth of it after `patience` cycles without all answers.

        A node that is gone must not make clean-up last minutes.
        """
        self.clock: Clock = clock
        self._wall = clock
        self.link, self._grace, self._patience = link, grace, patience
        self._missed = 0  # cycles in a row without all frames
        self.receive: Callable[[Frame], None] = _ignore_frame
        self.is_node_gone: Done = _is_false
        self.blind_ns = self.stalled_ns = 0
        self._looked_ns = clock.now()  # when the link was last seen to be empty
        self.send: Send = link.send

    def wait(self, done: Done, seconds: float) -> bool:
        """See `Wire`. What has come when the time is over counts: this program may have stood still meanwhile."""
        end = self.clock.now() + round(seconds * 1e9)
        while not done():
            left = end - self.clock.now()
            self.poll(min(max(left, 0) * 1e-9, 0.05))
            if left <= 0:
                return done()
        return True

    def wait_for_answers(self, t_ns: int, done: Done) -> None:
        """See `Wire`; a frame that does not come within the grace time is missing; after several, it waits less.

        When a node is gone, a cycle takes its 1 ms, in which the other nodes can answer.
        """
        is_patient = self._missed < self._patience
        grace = self._grace if is_patient else 0.1 * self._grace
        is_answered = not self.is_node_gone() and self.wait(lambda: done() or self.is_node_gone(), grace)
        if self.is_node_gone():
            self.wait(done, 1e-3)
        self._missed = 0 if is_answered else self._missed + 1

    def run_until(self, t_ns: int) -> None:
        """See `Wire`."""
        self.poll(0.0)
        while (left := t_ns - self.clock.now()) > 0:
            self.poll(left * 1e-9)

    def hear_all(self) -> None:
        """See `Wire`."""
        self.link.select_nodes(None)

    def close(self) -> None:
        """See `Wire`."""
        self.link.close()

    @property
    def origin_ns(self) -> int:
        """Zero of the wire's clock on CLOCK_MONOTONIC, ns."""
        return self._wall.origin_ns

    @property
    def grace_ns(self) -> int:
        """How late an answer may be in lockstep, ns."""
        return round(self._grace * 1e9)

    def poll(self, timeout: float) -> None:
        """Pass on the frames that are waiting; if there are none, wait up to `timeout` seconds for the first."""
        begin = self.clock.now()
        frames = self.link.poll(timeout)
        end = self.clock.now()
        self.blind_ns = begin - self._looked_ns + max(0, end - begin - round(timeout * 1e9))
        self._looked_ns = end
        if self.blind_ns > _STALL:
            self.stalled_ns += self.blind_ns
        for frame in frames:
            self.receive(frame)


def serve_node(node: Node, link: Link, clock: Clock, stop: Done) -> None:
    """Run one node on a link until `stop()`, which is asked every millisecond: the whole of `rig node`."""
    tick = clock.now() + MS
    while True:
        for frame in link.poll(max(0.0, (tick - clock.now()) * 1e-9)):
            node.receive(frame)
        now = clock.now()
        if now >= tick:
            if stop():
                return
            node.tick(now)
            tick = max(tick + MS, now)
