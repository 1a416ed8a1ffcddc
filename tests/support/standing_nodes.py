"""Nodes that stay on a bus for the tests of a file, as on a real bench: starting them takes longer than a run."""

import contextlib
import sys
import time
from collections.abc import Iterator

from c_device import run_program

from rig.network.bus import Link, open_can
from rig.network.node_objects import NAMES


@contextlib.contextmanager
def stand_nodes(where: str, *nodes: int) -> Iterator[None]:
    """`rig node` on a bus for each of the node numbers, all started at once."""
    with contextlib.ExitStack() as stack:
        for node in nodes:
            words = ("-m", "rig.cli.main", "node", NAMES[node], "--bus", where, "--quiet")
            stack.enter_context(run_program(sys.executable, *words))
        for node in nodes:
            wait_for_node(where, node)
        yield


def wait_for_node(where: str, node: int, seconds: float = 300.0) -> None:
    """Until a node has sent a heartbeat: the plant may compile its model and its cycle before."""
    link, heard, end = Link(open_can(where), time.monotonic_ns), set[int](), time.monotonic() + seconds
    while 0x700 + node not in heard and time.monotonic() < end:
        heard |= {frame.cob_id for frame in link.poll(0.1)}
    link.close()
    assert 0x700 + node in heard
