"""Fuzz frames, and what each node makes of them: afterwards it answers as before, and its memory has not grown."""

import resource
import tempfile
import traceback
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fdi.progress import Progress, ignore_progress
from plant import load_model
from rig.benches import CIA408
from rig.network import BusError, EmbeddedWire, Frame, Node, Send, VirtualClock
from rig.network.bus import EmbeddedBus
from rig.nodes import Emulator, Firmware
from rig.run import Job, NodeProcesses, Session, attribute_run, judge_run, open_recorder
from rig.sequences import parse_sequence
from studies.shipped_frames import COMMAND, DRIVE, FEEDBACK, SYNC, VALVE_STATE, pack_frame, unpack_frame

NODES = (1, 2, 3)
_OBJECTS = (0x1000, 0x1001, 0x1003, 0x1005, 0x1006, 0x1008, 0x1014, 0x1016, 0x1017, 0x1018, 0x1029, 0x1200, 0x1400,
            0x1600, 0x1800, 0x1A00, 0x2100, 0x2110, 0x2200, 0x2210, 0x2211, 0x2212, 0x6040, 0x6041)
_COMMANDS = (0x40, 0x21, 0x22, 0x23, 0x2B, 0x2F, 0x00, 0x10, 0x01, 0x60, 0x70, 0x80, 0xA0, 0xC2, 0xFF)  # of SDO
_NMT = (1, 1, 1, 1, 2, 128, 129, 130)  # start four times as often: a node that is started has more to do wrong


def invent_frames(count: int, seed: int) -> Iterator[Frame]:
    """`count` frames; time advances by 1 ms at each SYNC.

    One in eight is a SYNC; of the others half are as a node would send them, a third are mutated (identifier, length,
    bits), the rest are random bytes under a random identifier.
    """
    rng = np.random.default_rng(seed)
    t_ns, cycle = 0, 0
    for _ in range(count):
        kind = rng.random()
        if kind < 1.0 / 8.0:
            t_ns, cycle = t_ns + 1_000_000, cycle + 1
            yield Frame(t_ns, SYNC, b"")
            continue
        cob_id, data = _make_valid_frame(rng, cycle)
        if kind > 0.55:
            cob_id, data = _mutate(rng, cob_id, data)
        if kind > 0.85:
            cob_id, data = int(rng.integers(0x800)), rng.bytes(int(rng.integers(9)))
        yield Frame(t_ns, cob_id, data)


def _pack(cob_id: int, cycle: int, **values: float) -> tuple[int, bytes]:
    return cob_id, pack_frame(cob_id, {**values, "cycle": cycle})


def _make_valid_frame(rng: np.random.Generator, cycle: int) -> tuple[int, bytes]:
    """A frame that a node of the bench may send in this cycle."""
    node = int(rng.choice(NODES))
    match int(rng.integers(10)):
        case 0:
            return 0x000, bytes((int(rng.choice(_NMT)), int(rng.integers(4))))
        case 1 | 2:
            return _pack(COMMAND, cycle, position_demand=rng.normal(0.0, 5e-3),
                         control_word=int(rng.choice((0, 1, 3, 7, 15))))
        case 3:
            return _pack(FEEDBACK, cycle, ram_position=rng.normal(0.0, 5e-3), load_pressure=rng.normal(0.0, 1e6))
        case 4:
            return _pack(VALVE_STATE, cycle, spool_position=rng.normal(0.0, 1e-4), flags=int(rng.integers(8)))
        case 5 | 6:
            return _pack(DRIVE, cycle, current=rng.normal(0.0, 5e-3), status_word=int(rng.integers(16)))
        case 7:
            return 0x700 + node, bytes((int(rng.choice((0, 4, 5, 127))),))
        case 8:
            return 0x080 + node, rng.bytes(8)
    return int(rng.choice((0x600, 0x580))) + node, _make_sdo(rng)


def _make_sdo(rng: np.random.Generator) -> bytes:
    """An SDO request or answer: any command specifier, an object of the bench, any content."""
    command = int(rng.choice(_COMMANDS))
    index = int(rng.choice(_OBJECTS))
    return bytes((command, index & 0xFF, index >> 8, int(rng.integers(6)))) + rng.bytes(4)


def _mutate(rng: np.random.Generator, cob_id: int, data: bytes) -> tuple[int, bytes]:
    """The frame with another identifier, another length or other bits."""
    mutant = bytearray(data)
    match int(rng.integers(4)):
        case 0:
            cob_id ^= 1 << int(rng.integers(11))
        case 1:
            mutant = mutant[:int(rng.integers(9))]
        case 2:
            mutant = (mutant + rng.bytes(8))[:int(rng.integers(9))]
        case _:
            for _ in range(int(rng.integers(1, 5)) if mutant else 0):
                mutant[int(rng.integers(len(mutant)))] ^= 1 << int(rng.integers(8))
    return cob_id, bytes(mutant)


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
    bus, answers = EmbeddedBus(), 0

    def count(frame: Frame) -> None:
        nonlocal answers
        answers += 1

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
    return FuzzCount(target, frames, answers, tuple(failures), _is_answering(target, node, bus, last), growth)


def _is_answering(target: str, node: Node, bus: EmbeddedBus, t_ns: int) -> bool:
    """Whether a node boots, answers SDO, starts and takes part in a cycle as after power-on."""
    number = 3 if target == "plant" else 2
    frames: list[tuple[int, bytes]] = []
    send = bus.attach(lambda frame: frames.append((frame.cob_id, frame.data)))

    def ask(cob_id: int, data: bytes) -> list[tuple[int, bytes]]:
        frames.clear()
        send(cob_id, data)
        bus.deliver(t_ns)
        return list(frames)

    boots = (0x700 + number, b"\0") in ask(0x000, bytes((129, number)))
    identity = [data[:4] for cob_id, data in ask(0x600 + number, b"\x40\x00\x10\0\0\0\0\0") if cob_id == 0x580 + number]
    ask(0x000, bytes((1, number)))
    ask(COMMAND, pack_frame(COMMAND, {"position_demand": 1e-3, "control_word": CIA408.ladder[-1], "cycle": 7}))
    at_sync = [cob_id for cob_id, _ in ask(SYNC, b"")]
    if target == "plant":
        return boots and identity == [b"\x43\x00\x10\0"] and at_sync[:2] == [FEEDBACK, VALVE_STATE]
    answers = [data for cob_id, data in ask(FEEDBACK, pack_frame(FEEDBACK, {})) if cob_id == DRIVE]
    drive = unpack_frame(DRIVE, answers[0]) if len(answers) == 1 and len(answers[0]) == 8 else None
    return (boots and identity == [b"\x43\x00\x10\0"] and drive is not None
            and (drive["cycle"], drive["status_word"]) == (7, CIA408.mask) and 0.0 < drive["current"] < 0.02)


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
    total = runs = start = 0
    with tempfile.TemporaryDirectory(prefix="eha-rig-fuzz-") as folder:
        while total < frames:
            strangers: list[_Stranger] = []
            seconds = min(4.0, max(0.1, (frames - total) / each / 1000))
            failure = _play(_make_job(f"{seconds:.3f}", "safe_state"), Path(folder) / "run",
                            [partial(_join, strangers, frames, each, seed + runs)])
            if failure and len(failures) < 10:
                failures.append(failure)
            if not strangers or not strangers[0].sent:
                failures.append("the run ended before a frame was sent")
                break
            total, runs = total + strangers[0].sent, runs + 1
            start = start or read_memory()
            progress("rig", total / frames)
        growth = read_memory() - start
        works = not _play(_make_job("0.5", "completed"), Path(folder) / "run")
    return FuzzCount("rig", total, runs, tuple(failures), works, growth)


def _join(strangers: list[_Stranger], frames: int, each: int, seed: int, send: Send) -> Node:
    strangers.append(_Stranger(send, frames, each, seed))
    return strangers[0]


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
            failures = [check.name for check in checks if not check.passed]
    except BusError:
        return "" if strangers else "the nodes did not start"  # a stranger may send the very frame that forbids it
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"
    if strangers:
        return ""
    return session.safety.aborted or "; ".join(failures)
