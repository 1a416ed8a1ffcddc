"""Nodes that answer SYNC with feedback and valve state: the plant emulator, compiled and in Python, and one in C."""
from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from importlib.resources import files
from pathlib import Path

import can
from can.interfaces.udp_multicast.utils import pack_message

from plant.errors import RigError
from rig.bench.stopwatch import find_gcc
from rig.network import codec
from rig.network.bus import open_can
from rig.network.clock import WallClock
from rig.network.link import Link, serve_node
from rig.network.node_objects import PLANT
from rig.network.raw_bus import open_raw_bus
from rig.nodes.emulator import Emulator
from rig.run.priority import LOOP_PRIORITY, list_cpus, raise_priority

_NMT, _BOOT_UP = 0x000, 0x700 + PLANT
_START, _RESET = 1, 130  # NMT commands, CiA 301 section 7.2.8.3.1


def build_responder(folder: Path) -> Path:
    """The responder in C, compiled into `folder`."""
    out = folder / "responder"
    source = str(files(__package__) / "responder.c")
    subprocess.run([find_gcc(), "-O2", "-Wall", "-Wextra", "-Werror", "-o", str(out), source], check=True)
    return out


@contextlib.contextmanager
def run_c_responder(bus: str) -> Iterator[None]:
    """Run the responder in C on a bus while the context lasts, on the CPU and with the priority of the emulator."""
    with tempfile.TemporaryDirectory() as folder, open_raw_bus(bus, [codec.SYNC]) as raw:
        receive, send, turn = raw.descriptors
        feedback, valve = _pack(bus, codec.FEEDBACK), _pack(bus, codec.VALVE_STATE)
        cycle_at = valve.index(_PAYLOAD) + 6
        cpu = list_cpus()[-min(2, len(list_cpus()))]
        words = [str(build_responder(Path(folder))), *map(str, (receive, send, turn, cpu, LOOP_PRIORITY, cycle_at)),
                 feedback.hex(), valve.hex()]
        with _run_process(words, receive, send) as process:
            assert process.stdout is not None
            process.stdout.readline()
            yield


_PAYLOAD = bytes(range(0x11, 0x19))


def _pack(bus: str, cob_id: int) -> bytes:
    """A frame as it goes out on a bus, with `_PAYLOAD`."""
    if bus.startswith("udp_multicast"):
        return bytes(pack_message(can.Message(arbitration_id=cob_id, is_extended_id=False, data=_PAYLOAD)))
    return cob_id.to_bytes(4, sys.byteorder) + bytes([8, 0, 0, 0]) + _PAYLOAD  # struct can_frame


@contextlib.contextmanager
def run_emulator(bus: str, is_compiled: bool) -> Iterator[None]:
    """Run the plant emulator on a bus while the context lasts, alone and OPERATIONAL.

    Raises:
        RigError: it does not boot.
    """
    module = ["rig.cli.main", "node", "plant", "--quiet", "--bus"] if is_compiled else [
        "rig.bench.responders"]
    with _run_process([sys.executable, "-m", *module, bus]) as process:
        link = Link(open_can(bus), time.monotonic_ns)
        try:
            _wait_for(link, lambda: link.send(_NMT, bytes([_RESET, PLANT])), bytes([0]), process)
            link.send(_NMT, bytes([_START, PLANT]))
            time.sleep(0.3)
        finally:
            link.close()
        yield


def _wait_for(link: Link, ask: Callable[[], None], answer: bytes, process: subprocess.Popen[bytes],
              limit: float = 120.0) -> None:
    """Ask the emulator every second until its NMT error control says `answer`."""
    end = time.monotonic() + limit
    while time.monotonic() < end and process.poll() is None:
        ask()
        again = time.monotonic() + 1.0
        while time.monotonic() < again:
            if any(frame.cob_id == _BOOT_UP and frame.data == answer for frame in link.poll(0.1)):
                return
    raise RigError("the plant emulator does not boot")


@contextlib.contextmanager
def _run_process(words: list[str], *descriptors: int) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, pass_fds=descriptors)
    try:
        yield process
    finally:
        process.terminate()
        process.communicate()


def serve_python_emulator(bus: str) -> None:
    """Run the plant emulator on a bus until the process is ended."""
    clock = WallClock()
    link = Link(open_can(bus), clock.now)
    with raise_priority():
        serve_node(Emulator(link.send), link, clock, lambda: False)


if __name__ == "__main__":
    serve_python_emulator(sys.argv[1])
