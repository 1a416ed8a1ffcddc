"""Node 3 on a bus with its cycle in Python, as a process of its own: the soft real-time path, on any bus."""
from __future__ import annotations

import sys

from rig.network.bus import open_can
from rig.network.clock import WallClock
from rig.network.link import Link
from rig.network.wire import serve_node
from rig.nodes.emulator import Emulator
from rig.run.priority import raise_priority


def serve_python_emulator(bus: str) -> None:
    """Run the plant emulator on a bus until the process is ended."""
    clock = WallClock()
    link = Link(open_can(bus), clock.now)
    with raise_priority():
        serve_node(Emulator(link.send), link, clock, lambda: False)


if __name__ == "__main__":
    serve_python_emulator(sys.argv[1])
