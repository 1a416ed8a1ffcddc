"""Which events of a run report a dead node."""
from __future__ import annotations

from rig.network.node_objects import NAMES


def find_dead_node(level: str, kind: str, text: str) -> int:
    """The node that an event reports as dead: its process ended, or its heartbeat stopped; else 0."""
    for node, name in NAMES.items():
        if level == "ERROR" and kind in ("process", "heartbeat") and text.startswith(f"node {node} {name}"):
            return node
    return 0
