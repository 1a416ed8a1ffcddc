"""Fuzz frames into each node of the bench: afterwards it answers as before, and its memory has not grown."""

import resource
import tempfile
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from fdi.progress import Progress, ignore_progress
from plant.model import load_model
from rig.benches.profiles import Control, Status
from rig.network.bus import EmbeddedBus, EmbeddedWire
from rig.network.clock import VirtualClock
from rig.network.frame import Frame, Node, Send
from rig.network.master import BusError
from rig.nodes.emulator import Emulator
from rig.nodes.firmware import Firmware
from rig.run.job import Job
from rig.run.participants import NodeProcesses
from rig.run.runner import attribute_run, judge_run, open_recorder
from rig.run.session import Session
from rig.sequences.sequence import parse_sequence
from studies.robustness.frames import invent_frames
from studies.shipped_frames import COMMAND, DRIVE, FEEDBACK, SYNC, VALVE_STATE, pack_frame, unpack_frame

PAGE = resource.getpagesize()


class FuzzCount(NamedTuple):
    """What came of the frames that one node was given."""

    target: str
    frames: int
    answers: int  # frames that the node sent meanwhile
    failures: tuple[str, ...]  # exceptions, each in one line; at most ten
    works: bool  # it answers properly afterwards
    growth: int  # bytes of memory, after the first tenth


def read_memory() -> int:
    """Memory of this process that is in RAM, bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE


def fuzz_node(target: str, frames: int, seed: int, progress: Progress = ignore_progress) -> FuzzCount:
    """Give a node alone on a bus fuzz frames.

    Args:
        target: "plant" or "controller".
        frames: how many.
        seed: of the frames.
        progress: called with the target and the share done.
    """
    make: Callable[[Send], Emulator | Firmware] = Emulator if target == "plant" else Firmware
    bus, heard = EmbeddedBus(), 0

    def count(frame: Frame) -> None:
        nonlocal heard
        heard += 1

    send = bus.attach(count)
    node = bus.add(make)
    node.tick(0)
    bus.deliver(0)
    failures: list[str] = []
    start, last = 0, -1
    for number, frame in enumerate(invent_frames(frames, seed)):
        try:
            if frame.t_ns != last:
                last = frame.t_ns
                node.tick(last)
            send(frame.cob_id, frame.data)
            bus.deliver(last)
        except Exception as error:
            if len(failures) < 10:
                where = traceback.extract_tb(error.__traceback__)[-1]
                failures.append(f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno}) at "
                                f"frame {number}: 0x{frame.cob_id:03X} {frame.data.hex()}")
        if number == frames // 10:
            start = read_memory()
        if number % 10_000 == 0:
            progress(target, number / frames)
    growth = read_memory() - start
    return FuzzCount(target, frames, heard, tuple(failures), _is_answering(target, node, bus, last), growth)


def _is_answering(target: str, node: Node, bus: EmbeddedBus, t_ns: int) -> bool:
    """Whether a node boots, answers SDO, starts and takes part in a cycle as after power-on."""
    number = 3 if target == "plant" else 2
    heard: list[tuple[int, bytes]] = []
    send = bus.attach(lambda frame: heard.append((frame.cob_id, frame.data)))

    def ask(cob_id: int, data: bytes) -> list[tuple[int, bytes]]:
        heard.clear()
        send(cob_id, data)
        bus.deliver(t_ns)
        return list(heard)

    boots = (0x700 + number, b"\0") in ask(0x000, bytes((129, number)))
    identity = [data[:4] for cob_id, data in ask(0x600 + number, b"\x40\x00\x10\0\0\0\0\0") if cob_id == 0x580 + number]
    ask(0x000, bytes((1, number)))
    ask(COMMAND, pack_frame(COMMAND, {"position_demand": 1e-3, "control_word": Control.ACTIVE, "cycle": 7}))
    at_sync = [cob_id for cob_id, _ in ask(SYNC, b"")]
    if target == "plant":
        return boots and identity == [b"\x43\x00\x10\0"] and at_sync[:2] == [FEEDBACK, VALVE_STATE]
    answers = [data for cob_id, data in ask(FEEDBACK, pack_frame(FEEDBACK, {})) if cob_id == DRIVE]
    drive = unpack_frame(DRIVE, answers[0]) if len(answers) == 1 and len(answers[0]) == 8 else None
    return (boots and identity == [b"\x43\x00\x10\0"] and drive is not None
            and (drive["cycle"], drive["status_word"]) == (7, Status.ACTIVE) and 0.0 < drive["current"] < 0.02)


class _Stranger:
    """A node that sends fuzz frames in every cycle: NMT commands, SYNCs and answers for others among them."""

    def __init__(self, send: Send, frames: int, each: int, seed: int) -> None:
        self._send, self._each = send, each
        self._frames = invent_frames(frames, seed)
        self.sent = 0

    def receive(self, frame: Frame) -> None:
        """Send some when a SYNC comes."""
        if frame.cob_id == SYNC and not frame.data:
            for _, (_, cob_id, data) in zip(range(self._each), self._frames, strict=False):
                self.sent += 1
                if cob_id != SYNC or data:  # its own SYNC would start cycles within a cycle without end
                    self._send(cob_id, data)

    def tick(self, t_ns: int) -> None:
        """Nothing is due."""


_SEQUENCE = """
title = "fuzz frames"
setup = [{{ kind = "hold", time = 0.05 }}]
main = [{{ name = "sine", kind = "sine", amplitude = 1e-3, frequency = 1.0, time = {time} }}]
cleanup = [{{ kind = "ramp", to = 0.0, time = 0.05 }}]
ends = "{ends}"
checks = [{{ name = "error", kind = "never_exceeds", signal = "xj", high = 5.0, unit = "mm" }}]
"""


def fuzz_rig(frames: int, seed: int, progress: Progress = ignore_progress, each: int = 50) -> FuzzCount:
    """Run a sequence on the embedded bus with a stranger that sends `each` fuzz frames in every cycle.

    The rig must end each run with a verdict, and a run without the stranger passes afterwards.
    """
    failures: list[str] = []
    sent = runs = start = 0
    with tempfile.TemporaryDirectory(prefix="eha-rig-fuzz-") as folder:
        while sent < frames:
            stranger: list[_Stranger] = []
            seconds = min(4.0, max(0.1, (frames - sent) / each / 1000))
            failure = _play(_make_job(f"{seconds:.3f}", "safe_state"), Path(folder) / "run",
                            [partial(_join, stranger, frames, each, seed + runs)])
            if failure and len(failures) < 10:
                failures.append(failure)
            if not stranger or not stranger[0].sent:
                failures.append("the run ended before a frame was sent")
                break
            sent, runs = sent + stranger[0].sent, runs + 1
            start = start or read_memory()
            progress("rig", sent / frames)
        growth = read_memory() - start
        works = not _play(_make_job("0.5", "completed"), Path(folder) / "run")
    return FuzzCount("rig", sent, runs, tuple(failures), works, growth)


def _join(found: list[_Stranger], frames: int, each: int, seed: int, send: Send) -> Node:
    found.append(_Stranger(send, frames, each, seed))
    return found[0]


def _make_job(time: str, ends: str) -> Job:
    text = _SEQUENCE.format(time=time, ends=ends)
    return Job(sequence=parse_sequence(text, "fuzz.toml", lambda name: b""), model=load_model(), seed=0)


def _play(job: Job, folder: Path, strangers: Sequence[Callable[[Send], Node]] = ()) -> str:
    """Run a job with strangers on the embedded bus; what went wrong in one line, "" if nothing did.

    Without strangers it must complete and every check must pass.
    """
    try:
        with open_recorder(job, folder) as recorder:
            makers: list[Callable[[Send], Node]] = [Emulator, Firmware, *strangers]
            session = Session(job, EmbeddedWire(VirtualClock(), makers), NodeProcesses(), recorder,
                              ignore_progress, lambda: False)
            session.bring_up()
            session.run_phases()
            checks, _ = judge_run(job, session, attribute_run(job, session).judged)
            failed = [check.name for check in checks if not check.passed]
    except BusError:
        return "" if strangers else "the nodes did not start"  # a stranger may send the very frame that forbids it
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"
    if strangers:
        return ""
    return session.safety.aborted or "; ".join(failed)
