"""Nodes that stay for many runs, and what their processes hold."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from rig.firmware.build import build_controller
from rig.network.bus import Link, open_can
from rig.network.clock import WallClock
from studies.robustness.disturb import wait_until
from studies.robustness.fuzz import PAGE


class Usage(NamedTuple):
    """What a process holds."""

    memory: int  # bytes in RAM
    files: int
    threads: int


@contextlib.contextmanager
def start_nodes(bus: str, controller: str) -> Iterator[dict[str, int]]:
    """Plant and controller as processes; their numbers, and that of this process, by name."""
    commands = [[sys.executable, "-m", "rig.cli.main", "node", name, "--bus", bus, "--quiet"]
                for name in (("plant", "controller") if controller == "builtin" else ("plant",))]
    if controller == "c":
        commands.append([str(build_controller()), bus])
    booted: set[int] = set()
    link = Link(open_can(bus), WallClock().now)

    def is_ready() -> bool:
        booted.update(frame.cob_id for frame in link.poll() if frame.data == b"\0")
        return {0x702, 0x703} <= booted

    children = [subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL) for words in commands]
    try:
        wait_until(is_ready, 120.0)
        link.close()
        yield {"rig": os.getpid(), "plant": children[0].pid, "controller": children[1].pid}
    finally:
        for child in children:
            child.terminate()
        for child in children:
            child.wait(10)


def read_usage(processes: dict[str, int]) -> dict[str, Usage]:
    """What each process holds; the numbers by name."""
    usage = {}
    for name, number in processes.items():
        entry = Path("/proc") / str(number)
        usage[name] = Usage(int((entry / "statm").read_text().split()[1]) * PAGE, len(list((entry / "fd").iterdir())),
                            len(list((entry / "task").iterdir())))
    return usage
