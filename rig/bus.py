"""Buses: the embedded one, that needs nothing from the machine, and python-can's, opened from one line of text."""
from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import TypeVar

from rig.frame import Frame, Node, Send

AnyNode = TypeVar("AnyNode", bound=Node)
Receive = Callable[[Frame], None]


class Embedded:
    """An in-process bus in one thread. Frames wait in one queue and are delivered in the order they were sent.

    There is no arbitration and no bit time: the order is the nodes' doing, which is what makes a lockstep run repeat.
    """

    def __init__(self) -> None:
        self._receivers: list[Receive] = []
        self._others: list[list[Receive]] = []  # for each node, everybody else
        self._queue: deque[tuple[list[Receive], int, bytes]] = deque()

    def attach(self, receive: Receive) -> Send:
        """A node joins: `receive` gets every frame of the others; what is returned sends."""
        others = list(self._receivers)
        for each in self._others:
            each.append(receive)
        self._receivers.append(receive)
        self._others.append(others)
        enqueue = self._queue.append

        def send(cob_id: int, data: bytes) -> None:
            enqueue((others, cob_id, data))

        return send

    def add(self, make: Callable[[Send], AnyNode]) -> AnyNode:
        """Build a node that needs its `send` at birth, and attach it: `add(lambda send: Device(2, EDS[2], send))`."""
        nodes: list[AnyNode] = []
        send = self.attach(lambda frame: nodes[0].receive(frame))
        nodes.append(make(send))
        return nodes[0]

    def deliver(self, t_ns: int) -> int:
        """Hand the queued frames to all nodes but their senders, as of `t_ns`, until no node has more to say.

        Returns the number of frames.
        """
        queue, count = self._queue, 0
        while queue:
            others, cob_id, data = queue.popleft()
            frame = Frame(t_ns, cob_id, data)
            for receive in others:
                receive(frame)
            count += 1
        return count
