"""The nodes that the rig started, each in a process of its own, and how they ended."""
from __future__ import annotations

import contextlib
import signal
import subprocess
from collections.abc import Iterable, Sequence

Child = subprocess.Popen[bytes]


class NodeProcesses:
    """Processes of this run, by node number. Each has its own session, so that Ctrl-C reaches the rig alone: clean-up
    needs its plant.
    """

    def __init__(self) -> None:
        self._children: dict[int, Child] = {}

    def start(self, node: int, command: Sequence[str]) -> None:
        """Start a node as a new process."""
        self._children[node] = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                                                start_new_session=True)

    def find_ended(self) -> dict[int, int]:
        """Nodes whose process has ended, with its exit status; negative: the signal that ended it."""
        found = {node: child.poll() for node, child in self._children.items()}
        return {node: status for node, status in found.items() if status is not None}

    def wait(self, nodes: Iterable[int], seconds: float = 1.0) -> None:
        """Wait until the processes of these nodes end, for so long each; other nodes are left out.

        On a busy machine a process takes some time from the signal that kills it to its end.
        """
        for child in (self._children[node] for node in nodes if node in self._children):
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(seconds)

    def stop(self) -> None:
        """Terminate all processes; kill those that do not end within 5 s."""
        children = self._children.values()
        for child in children:
            child.terminate()
        for child in children:
            try:
                child.wait(5)
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()


def describe_exit(status: int) -> str:
    """An exit status in words.

    >>> describe_exit(-9)
    'its process was ended by SIGKILL'
    >>> describe_exit(1)
    'its process ended with exit status 1'
    """
    if status >= 0:
        return f"its process ended with exit status {status}"
    known = {number.value: number.name for number in signal.Signals}
    return f"its process was ended by {known.get(-status, f'signal {-status}')}"
