"""A run of three processes on a UDP bus that is disturbed at a random moment, and what is left of it.

Each trial is a run of its own: rig, plant and controller are processes on a multicast group of their own. At a random
moment one of them is killed or stopped, the folder of the log is removed, or the disk is full. Required of each trial:
the run ends in time, with a documented exit status and without a traceback; the current is zero in time; the log can be
read or recovered; no process, semaphore or temporary file is left. A run whose node was killed between its cycles must
be ABORTED and name the end of that process. A stop of less than 1 s must not end the run; a node that was stopped for
longer than 3 s must be named.
"""

import contextlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fdi.trace import Trace
from plant import RigError
from rig.benches import Flags
from rig.firmware.build import build_controller
from rig.network import Frame, Link, WallClock, open_can
from rig.network.udp import PORT, Turn
from rig.recorder.recover import recover_log
from studies.robustness.fuzz import PAGE
from studies.shipped_frames import COMMAND, DRIVE, FEEDBACK, SYNC, VALVE_STATE, unpack_frame

PROCESSES = ("rig", "controller", "plant")
ACTIONS = ("kill", "stop", "remove folder", "fill disk", "full tmpfs")
CYCLES = 3200  # of a run of SEQUENCE, without the probes
SEQUENCE = """
title = "Disturbed"
setup = [{ kind = "hold", time = 0.1 }]
main = [{ name = "sine", kind = "sine", amplitude = 2e-3, frequency = 2.0, time = 3.0 }]
cleanup = [{ kind = "ramp", to = 0.0, time = 0.1 }]
checks = [{ name = "position", kind = "never_exceeds", signal = "xj", high = 5.0, unit = "mm" }]
"""


class Trial(NamedTuple):
    """What came of one disturbed run."""

    action: str
    victim: str
    is_effective: bool  # the process or folder was there, and cycles were still to come
    moment: float  # of the disturbance, s after the first SYNC; NaN: before it
    syncs: int  # sent before the disturbance
    pause: float  # s for which a process was stopped
    status: int  # of the rig's process; -9: killed, -1: it hung
    end: float  # s from the disturbance to the end of the last process
    zero: int  # SYNCs from the last frame of the victim to zero current; -1: the run ended before
    cycles: int  # in the log, as read or recovered
    verdict: str  # of the run; "": it wrote none
    cause: str  # first cause that the run names
    message: str  # last line on standard error
    problems: tuple[str, ...]


class _Watcher:
    """Listens to the bus of a run and notes what is needed to judge it.

    Before the disturbance it hears SYNC alone: with all frames it would lag behind a run in lockstep.
    """

    def __init__(self, bus: str, clock: WallClock) -> None:
        self._link = Link(open_can(bus), clock.now)
        self._link.leave_out((COMMAND, FEEDBACK, VALVE_STATE, DRIVE))
        self._is_idle = False  # no frame was waiting
        self._frames = {"plant": 0, "controller": 0}  # cyclic frames heard
        self._stop = threading.Event()
        self.first_sync = 0  # ns
        self.syncs = 0
        self.zeroed = {"plant": -1, "controller": -1}  # SYNCs from the last frame of that node to zero current
        self.driven = {"plant": 0, "controller": 0}  # frames of the other node since, before zero current
        self._heard = {"plant": 0, "controller": 0}  # SYNCs so far when its frame came last
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        while not self._stop.is_set():
            frames = self._link.poll(0.05)
            self._is_idle = not frames
            for frame in frames:
                self._note(frame)

    def hear_nodes(self, node: str, seconds: float = 0.5) -> None:
        """Listen to the nodes as well, and wait for a frame of one of them."""
        self._heard = dict.fromkeys(self._heard, self.syncs)
        before = self._frames[node]
        self._link.leave_out((COMMAND,))
        wait_until(lambda: self._frames[node] > before, seconds, step=0.001)

    def finish(self, seconds: float = 60.0) -> None:
        """Take in what is still waiting."""
        self._is_idle = False
        wait_until(lambda: self._is_idle, seconds)

    def _note(self, frame: Frame) -> None:
        if frame.cob_id == SYNC:
            self.first_sync = self.first_sync or frame.t_ns
            self.syncs += 1
        elif frame.cob_id == FEEDBACK:
            self._hear("plant")
        elif frame.cob_id == DRIVE and len(frame.data) == 8:
            self._note_current("plant", unpack_frame(DRIVE, frame.data)["current"] == 0.0)
            self._hear("controller")
        elif frame.cob_id == VALVE_STATE and len(frame.data) == 8:
            flags = int(unpack_frame(VALVE_STATE, frame.data)["flags"])
            self._note_current("controller", bool(flags & Flags.CURRENT_ZEROED))

    def _hear(self, node: str) -> None:
        self._heard[node], self.zeroed[node], self.driven[node] = self.syncs, -1, 0
        self._frames[node] += 1

    def _note_current(self, silent: str, is_zero: bool) -> None:
        if self.zeroed[silent] < 0:
            if is_zero:
                self.zeroed[silent] = self.syncs - self._heard[silent]
            else:
                self.driven[silent] += 1

    def count_since(self, node: str) -> int:
        """SYNCs since a node was heard."""
        return self.syncs - self._heard[node]

    def close(self) -> None:
        """Stop listening."""
        self._stop.set()
        self._thread.join()
        self._link.close()


def disturb_run(action: str, victim: str, seed: int, pace: str = "lockstep", controller: str = "builtin",
                limit: float = 30.0) -> Trial:
    """Start a run, disturb it at a random moment, and judge what is left.

    Args:
        action: one of ACTIONS.
        victim: one of PROCESSES, for "kill" and "stop".
        seed: decides the moment, the length of a pause and the size of the disk.
        pace: of the run.
        controller: firmware of the run, "builtin" or "c".
        limit: s in which the run must have ended after a kill; four times that where it may go on, and until it begins;
            a third of it until nothing is left of the run.
    """
    rng = np.random.default_rng([seed, ACTIONS.index(action), PROCESSES.index(victim)])
    is_early, delay = rng.random() < 0.15, float(rng.uniform(0.0, 2.0))  # some before the first SYNC
    cycle = int(rng.integers(1, CYCLES))
    pause = float(rng.uniform(0.02, 4.0)) if action == "stop" else 0.0
    group = "239." + ".".join(str(number) for number in rng.integers(1, 255, 3))
    problems: list[str] = []
    with contextlib.ExitStack() as undo:
        place = Path(undo.enter_context(tempfile.TemporaryDirectory(prefix="eha-rig-study-")))
        temporary, folder = place / "tmp", place / "run"
        temporary.mkdir()
        folder.mkdir()
        if action == "full tmpfs":
            undo.enter_context(_mount_small_disk(folder, int(rng.integers(16, 600))))
        clock = WallClock()
        watcher = _Watcher(f"udp_multicast:{group}", clock)
        undo.callback(watcher.close)
        most = int(rng.integers(4_000, 600_000)) if action == "fill disk" else None
        rig = _start_rig(place, group, pace, controller, most)
        if is_early:
            wait_until(lambda: rig.poll() is not None or victim in dict(find_processes(group)).values(), 4.0 * limit)
            threading.Event().wait(delay)
        else:
            wait_until(lambda: watcher.syncs >= cycle or rig.poll() is not None, 4.0 * limit, step=0.002)
        if action == "kill" and victim != "rig" and watcher.syncs:
            watcher.hear_nodes(victim)
        moment = (clock.now() - watcher.first_sync) * 1e-9 if watcher.first_sync else float("nan")
        syncs = watcher.syncs
        is_done = _disturb(action, victim, rig, group, folder, pause)
        disturbed, resumed = clock.now(), watcher.syncs
        patience = limit if is_done and action == "kill" else 4.0 * limit  # else the run may go on as usual
        if not wait_until(lambda: rig.poll() is not None, patience):
            problems.append(f"the rig has not ended {patience:g} s later")
        status = -1 if rig.poll() is None else rig.returncode
        if not wait_until(lambda: not find_processes(group), limit / 3.0):
            problems.append(f"left: {', '.join(name for _, name in find_processes(group))}")
        end = (clock.now() - disturbed) * 1e-9
        for process, _ in find_processes(group):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        rig.wait()
        message = _judge_output(place / "err", status, problems, is_killed=(action, victim) == ("kill", "rig"))
        cycles = _judge_log(action, folder, watcher, problems)
        watcher.finish()
        if action == "stop":
            is_in_time = status != 0 or watcher.syncs > resumed
        else:
            is_in_time = _has_come_in_time(action, victim, cycles, watcher)
        is_effective = is_done and is_in_time
        zero = _judge_current(victim, watcher, problems) if action == "kill" and victim != "rig" else -1
        verdict, cause = _read_verdict(folder / "verdict.json")
        if is_effective and syncs and not (action == "kill" and victim == "rig"):
            problems += judge_verdict(action, victim, pause, status, f"{verdict} {cause} {message}")
        if not wait_until(lambda: not _find_heirs(temporary), limit / 3.0):
            problems.append(f"left: {', '.join(_find_heirs(temporary))}")
        problems += [f"temporary file {path.name}" for path in sorted(temporary.iterdir())[:3]]
    return Trial(action, victim, is_effective, moment, syncs, pause, status, end, zero, cycles, verdict, cause, message,
                 tuple(problems))


def _start_rig(place: Path, group: str, pace: str, controller: str, most: int | None) -> subprocess.Popen[bytes]:
    """The rig as a process; `most`: bytes of its largest file."""
    (place / "s.toml").write_text(SEQUENCE)

    def limit_files(size: int) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    words = [sys.executable, "-m", "rig.cli.main", "run", str(place / "s.toml"), "--bus", f"udp_multicast:{group}",
             "--pace", pace, "--controller", controller, "--quiet", "--out", str(place / "run")]
    with (place / "err").open("wb") as errors:
        return subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=errors,
                                env={**os.environ, "TMPDIR": str(place / "tmp")}, start_new_session=True,
                                preexec_fn=None if most is None else partial(limit_files, most))


def _disturb(action: str, victim: str, rig: subprocess.Popen[bytes], group: str, folder: Path, pause: float) -> bool:
    """Do it; False where the process is not there yet, or not any more, or holds the turn to send.

    A stop with the turn stops the whole bus for that time: then no node is at fault, and the run goes on afterwards.
    """
    if action == "remove folder":
        shutil.rmtree(folder, ignore_errors=True)
    if action not in ("kill", "stop"):
        return action == "remove folder"
    victims = [process for process, name in find_processes(group) if name == victim and process != rig.pid]
    processes = [rig.pid] if victim == "rig" else victims[:1]
    for process in processes if rig.poll() is None else ():
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL if action == "kill" else signal.SIGSTOP)
            if action == "stop":
                with closing(Turn(group, PORT)) as turn:
                    has_turn = process in turn.find_holders()
                threading.Event().wait(pause)
                os.kill(process, signal.SIGCONT)
                return not has_turn
            return True
    return False


def _judge_output(file: Path, status: int, problems: list[str], *, is_killed: bool) -> str:
    """The last line on standard error; a traceback or an unknown status is a problem."""
    lines = file.read_text(errors="replace").splitlines()
    if any(line.startswith("Traceback") for line in lines):
        problems.append(f"traceback: {lines[-1]}")
    elif not all(line.startswith("rig ") for line in lines) or len(lines) > len(PROCESSES):
        problems.append(f"{len(lines)} lines on standard error: {lines[0]}")
    if status not in (0, 1, 2, 3) and not (is_killed and status == -signal.SIGKILL) and status != -1:
        problems.append(f"exit status {status}")
    return lines[-1] if lines else ""


def _has_come_in_time(action: str, victim: str, cycles: int, watcher: _Watcher) -> bool:
    """Whether cycles were still to come at the disturbance. This process may be late, so the bus and the log say it."""
    if action == "kill" and victim != "rig" and watcher.syncs:
        return watcher.count_since(victim) > 0
    return cycles < CYCLES


def _read_verdict(file: Path) -> tuple[str, str]:
    """Verdict and first cause of a run; empty where it wrote none."""
    try:
        answer = json.loads(file.read_text())
    except (OSError, ValueError):
        return "", ""
    return str(answer["verdict"]), str((answer.get("cause") or {}).get("text", ""))


def judge_verdict(action: str, victim: str, pause: float, status: int, message: str) -> list[str]:
    """What is wrong with the verdict of a run in lockstep that was disturbed between its cycles.

    Args:
        action, victim: what was done to which process.
        pause: s for which it was stopped.
        status: of the rig's process.
        message: verdict, first cause and error of the run.
    """
    node = {"controller": "node 2 controller", "plant": "node 3 plant"}.get(victim, "the rig")
    is_named = status == 1 and message.startswith(f"ABORTED {node}")
    if action == "kill" and not (is_named and "SIGKILL" in message):
        return [f"the end of the process is not named: status {status}: {message}"]
    if action != "stop":
        return []
    if pause < 1.0 and status != 0:
        return [f"a stop of {pause:.2f} s ended the run: status {status}: {message}"]
    if pause > 3.0 and victim != "rig" and not is_named:
        return [f"{node} was stopped for {pause:.2f} s, and the run says: status {status}: {message}"]
    return []


def _judge_log(action: str, folder: Path, watcher: _Watcher, problems: list[str]) -> int:
    """Cycles in the log, as it is or recovered; -1 if there is none. A log that cannot be read is a problem."""
    log = folder / "trace.mcap"
    if not log.exists() or not log.stat().st_size:
        if action in ("kill", "stop") and watcher.syncs:
            problems.append("there is no log")
        return -1
    try:
        return len(Trace.read(log, all=True))
    except RigError:
        pass
    try:
        return recover_log(log, folder.parent / "recovered.mcap").cycles
    except RigError as error:
        problems.append(f"the log cannot be recovered: {error}")
        return -1


def _judge_current(victim: str, watcher: _Watcher, problems: list[str], most: int = 5) -> int:
    """SYNCs from the last frame of a killed node until the other one had set the current to zero.

    It is judged by the frames of the other one: a busy machine may hold it while some SYNCs pass.
    """
    is_silent = watcher.zeroed[victim] < 0 and watcher.count_since(victim) > 10 * most
    if watcher.driven[victim] > most or is_silent:
        problems.append(f"current not zero within {most} frames after the last one of the {victim}")
    return watcher.zeroed[victim]


@contextlib.contextmanager
def _mount_small_disk(folder: Path, kilobytes: int) -> Iterator[None]:
    """A disk of that size in a folder; needs root."""
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "study", str(folder)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def wait_until(done: Callable[[], bool], seconds: float, step: float = 0.02) -> bool:
    """Wait until `done()`, asked every `step` s; False if that takes longer than `seconds`."""
    clock = WallClock()
    while not done():
        if clock.now() > seconds * 1e9:
            return False
        threading.Event().wait(step)
    return True


def _find_heirs(temporary: Path) -> list[str]:
    """Processes that a run started whose folder for temporary files is `temporary`."""
    heirs = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                if f"TMPDIR={temporary}".encode() in (entry / "environ").read_bytes().split(b"\0"):
                    heirs.append((entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")[:60])
    return heirs


def find_processes(group: str) -> list[tuple[int, str]]:
    """(process, "rig", "plant" or "controller") of the processes of a run on a multicast group."""
    processes = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                words = (entry / "cmdline").read_bytes().split(b"\0")
                if any(word.endswith(group.encode()) for word in words):
                    name = "plant" if b"plant" in words else "rig" if b"run" in words else "controller"
                    processes.append((int(entry.name), name))
    return processes


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
