"""Which nodes have stopped sending, in lockstep between processes, where a node may take its time over a cycle."""
from __future__ import annotations

from collections.abc import Collection, Mapping


class SilenceWatch:
    """Adds up for each node how long the rig has listened without a heartbeat of it.

    A look that comes late counts for `step` at most: then the rig stood still, and perhaps the node with it.
    """

    def __init__(self, limit_ns: int, step_ns: int = 100_000_000) -> None:
        """`limit_ns`: silence after which a node counts as gone if it does not take part in the cycles either."""
        self._limit, self._step = limit_ns, step_ns
        self._looked_ns = 0
        self._heard_ns: dict[int, int] = {}
        self._silent_ns: dict[int, int] = {}

    def look(self, now_ns: int, heard_ns: Mapping[int, int]) -> None:
        """Take note of the last heartbeats.

        Args:
            now_ns: time.
            heard_ns: when the last heartbeat of each node came that is to be watched.
        """
        passed = min(now_ns - self._looked_ns, self._step)
        self._looked_ns = now_ns
        self._silent_ns = {node: self._silent_ns.get(node, 0) + passed if heard == self._heard_ns.get(node) else 0
                           for node, heard in heard_ns.items()}
        self._heard_ns = dict(heard_ns)

    def find_silent(self, answering: Collection[int] = ()) -> dict[int, float]:
        """Nodes that are silent and not `answering`, with the time for which the rig has listened in vain, s."""
        return {node: silent * 1e-9 for node, silent in self._silent_ns.items()
                if silent >= self._limit and node not in answering}
