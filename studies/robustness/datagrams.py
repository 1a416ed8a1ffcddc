"""Fuzz datagrams on the UDP bus, on which every program of the machine can send anything."""

import socket
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from can import Message
from can.interfaces.udp_multicast.utils import pack_message

from fdi.progress import Progress, ignore_progress
from plant.errors import RigError
from plant.model import load_model
from rig.network.udp import PORT, open_sender
from rig.run.job import Job
from rig.run.runner import run_job
from rig.sequences.sequence import parse_sequence
from studies.robustness.disturb import SEQUENCE, has_semaphores
from studies.robustness.frames import invent_frames
from studies.robustness.nodes import read_usage, start_nodes

_NESTED, _HUGE = b"\x91" * 2000, b"\xdd\xff\xff\xff\xff"  # msgpack: arrays in arrays; an array of 4 billion


class DatagramCount(NamedTuple):
    """What came of the datagrams."""

    datagrams: int
    verdict: str  # of a run on the same nodes afterwards
    growth: dict[str, int]  # bytes of memory, by process
    problems: tuple[str, ...]


def fuzz_datagrams(count: int, seed: int, group: str, controller: str = "builtin",
                   progress: Progress = ignore_progress) -> DatagramCount:
    """Send fuzz datagrams to the nodes of a UDP bus; afterwards a run on these nodes passes.

    A third are random bytes, a third frames with changed bytes, a third fuzz frames in proper datagrams.

    Raises:
        RigError: the nodes do not start.
    """
    rng, problems = np.random.default_rng(seed), []
    verdict, growth = "", {}
    with (tempfile.TemporaryDirectory(prefix="eha-rig-study-") as place,
          start_nodes(f"udp_multicast:{group}", controller) as nodes):
        own = {name: number for name, number in nodes.items() if name != "rig"}
        try:
            _play(group, Path(place))
            before = read_usage(own)
            with open_sender() as sender:
                for number, frame in enumerate(invent_frames(count, seed)):
                    message = Message(arbitration_id=frame.cob_id, data=frame.data, is_extended_id=False)
                    _send(sender, _change(rng, pack_message(message)), group)
                    if number % 1000 == 0:
                        progress("datagrams", number / count)
            verdict = _play(group, Path(place))
            after = read_usage(own)
            growth = {name: after[name].memory - before[name].memory for name in own}
        except (RigError, OSError) as error:  # OSError: a node has ended, its /proc entry is gone
            problems.append(f"{type(error).__name__}: {error}")
    if has_semaphores(group):
        problems.append("semaphores are left")
    return DatagramCount(count, verdict, growth, tuple(problems))


def _change(rng: np.random.Generator, datagram: bytes) -> bytes:
    kind = rng.random()
    if kind < 1.0 / 3.0:
        return datagram
    if kind < 2.0 / 3.0:
        changed = bytearray(datagram)
        for _ in range(int(rng.integers(1, 6))):
            changed[int(rng.integers(len(changed)))] = int(rng.integers(256))
        return bytes(changed[:int(rng.integers(len(changed) + 1))] if rng.random() < 0.3 else changed)
    if kind < 0.68:
        return (_NESTED, _HUGE)[int(rng.integers(2))] + rng.bytes(int(rng.integers(60_000)))
    return rng.bytes(int(rng.integers(100)))


def _send(sender: socket.socket, datagram: bytes, group: str) -> None:
    sender.sendto(datagram, (group, PORT))


def _play(group: str, folder: Path) -> str:
    job = Job(sequence=parse_sequence(SEQUENCE, "s.toml", lambda name: b""), model=load_model(),
              bus=f"udp_multicast:{group}", controller="external", plant="external")
    return run_job(job, folder / "run", ignore_progress, lambda: False).verdict
