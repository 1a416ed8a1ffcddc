"""The nodes that the rig started, each in a process of its own, and how they ended."""
from __future__ import annotations

import contextlib
import select
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
        self._silent: set[int] = set()  # nodes that are to say when they are on the bus, and have not yet

    def start(self, node: int, command: Sequence[str], *, announces: bool = False) -> None:
        """Start a node as a new process. `announces`: it writes a line as soon as it is on the bus, see `is_ready`."""
        output = subprocess.PIPE if announces else subprocess.DEVNULL
        self._children[node] = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output,
                                                start_new_session=True)
        if announces:
            self._silent.add(node)

    def is_ready(self, node: int) -> bool:
        """Whether the node has said that it is on the bus, if it is one that says so."""
        if node in self._silent:
            output = self._children[node].stdout
            assert output is not None
            if select.select([output], [], [], 0)[0] and output.readline():
                self._silent.discard(node)
        return node not in self._silent

    def forget(self, node: int) -> None:
        """Leave out a node whose process has ended: another one has taken its place on the bus."""
        child = self._children.pop(node)
        if child.stdout is not None:
            child.stdout.close()

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
            if child.stdout is not None:
                child.stdout.close()


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
