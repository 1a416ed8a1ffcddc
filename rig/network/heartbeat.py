"""Heartbeat producer (0x1017) and consumer (0x1016), CiA 301, 7.2.8.3.2. The rig and the nodes have both."""

from collections.abc import Callable

from rig.network.frame import Frame, Send

COB_ID = 0x700  # + node
NEVER = 2**63 - 1  # ns
_MS = 1_000_000  # ns


class HeartbeatProducer:
    """Sends the NMT state every 0x1017 ms; due time += period, so a late tick does not shift the ones after it."""

    def __init__(self, node_id: int, send: Send) -> None:
        self._cob_id, self._send = COB_ID + node_id, send
        self._period = self._due = 0

    def configure(self, period_ms: int, t_ns: int) -> None:
        """A new producer time takes effect at once, the first heartbeat is one period away; 0 stops it."""
        self._period = period_ms * _MS
        self._due = t_ns + self._period

    @property
    def due(self) -> int:
        """When the next heartbeat is due, ns."""
        return self._due if self._period else NEVER

    def send_boot_up(self) -> None:
        self._send(self._cob_id, b"\0")

    def tick(self, t_ns: int, state: int) -> None:
        if self._period and t_ns >= self._due:
            self._send(self._cob_id, bytes((state,)))
            self._due += self._period
            if self._due <= t_ns:  # more than a period behind: skip, never pile up
                self._due = t_ns + self._period


class HeartbeatConsumer:
    """Watches the nodes of 0x1016: lost when nothing was heard for the consumer time.

    Watching a node begins with its first heartbeat, as the standard has it; a boot-up counts as a sign of life.
    """

    def __init__(self, on_lost: Callable[[int], None], on_back: Callable[[int], None]) -> None:
        """`on_lost(node)` when one falls silent, `on_back(node)` when it is heard for the first time or again."""
        self._on_lost, self._on_back = on_lost, on_back
        self._limits: dict[int, int] = {}  # node -> ns
        self._deadlines: dict[int, int] = {}  # of the nodes heard

    def configure(self, entries: list[int]) -> None:
        """`entries` of 0x1016: bits 16..23 node, bits 0..15 consumer time in ms; a zero in either disables."""
        pairs = [(entry >> 16 & 0xFF, entry & 0xFFFF) for entry in entries]
        limits = {node: time * _MS for node, time in pairs if node and time}
        self._deadlines = {node: deadline for node, deadline in self._deadlines.items()
                           if self._limits[node] == limits.get(node)}
        self._limits = limits

    @property
    def cob_ids(self) -> list[int]:
        return [COB_ID + node for node in self._limits]

    def receive(self, frame: Frame) -> None:
        node = frame.cob_id - COB_ID
        if node not in self._deadlines:
            self._on_back(node)
        self._deadlines[node] = frame.t_ns + self._limits[node]

    def find_due(self) -> int:
        """When the first of the nodes would be lost, ns."""
        return min(self._deadlines.values(), default=NEVER - 1) + 1

    def tick(self, t_ns: int) -> None:
        for node in [node for node, deadline in self._deadlines.items() if t_ns > deadline]:
            del self._deadlines[node]
            self._on_lost(node)
