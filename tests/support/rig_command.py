"""The `rig` command in a test: in this process (fast), or as a user's process that can be interrupted and killed; and
short sequences that are played without it.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from answer_schemas import check_answer

from fdi.progress import ignore_progress
from fdi.trace import Trace
from plant import load_model
from rig.cli.main import main
from rig.network import master
from rig.run import Job, Outcome, run_job
from rig.sequences import parse_sequence


@dataclass(frozen=True)
class CommandResult:
    """What a command left behind."""

    status: int
    out: str
    err: str
    words: Sequence[object] = field(compare=False)  # of the command line

    @property
    def json(self) -> dict[str, Any]:
        """Standard output as exactly one JSON object, without NaN or Infinity, as the schema of the command says."""
        def refuse(word: str) -> None:
            raise AssertionError(f"{word} is not JSON")

        value = json.loads(self.out, parse_constant=refuse)
        assert isinstance(value, dict)
        if self.words:
            check_answer(tuple(map(str, self.words)), value)
        return value


def rig(*words: object) -> CommandResult:
    """The command in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = main([str(word) for word in words])
        except SystemExit as end:
            status = int(end.code or 0)
    return CommandResult(status, out.getvalue(), err.getvalue(), words)


def refuse(*words: object) -> str:
    """What the command says about words that it must refuse: one line, exit status 2, nothing on standard output."""
    result = rig(*words)
    assert (result.status, result.out, result.err.count("\n")) == (2, "", 1), (words, result)
    return result.err


def answer(*words: object, status: int = 0) -> dict[str, Any]:
    """The JSON answer of a command that must end with this status, with nothing on standard error."""
    result = rig(*words, "--json")
    assert (result.status, result.err) == (status, ""), (words, result)
    return result.json


def write_file(path: Path, text: str) -> Path:
    """A file of a user with this text; its path, to be a word of a command."""
    path.write_text(text)
    return path


STARTED: list[subprocess.Popen[str]] = []  # of this test


def started(*words: object, **options: Any) -> subprocess.Popen[str]:
    """The command as a process of its own, which ends with the test at the latest, and what it has started with it."""
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True} | options
    STARTED.append(subprocess.Popen([sys.executable, "-m", "rig.cli.main", *map(str, words)], **streams))
    return STARTED[-1]


def finished(process: subprocess.Popen[str], timeout: float = 300.0) -> CommandResult:
    """Wait for it."""
    out, err = process.communicate(timeout=timeout)
    typed = process.args[3:] if isinstance(process.args, list) else ()  # after python -m rig.cli.main
    return CommandResult(process.returncode, out or "", err or "", typed)


def interrupted(process: subprocess.Popen[str]) -> CommandResult:
    """Press Ctrl-C, and wait for the end."""
    process.send_signal(signal.SIGINT)
    return finished(process)


def grown(path: Path, size: int, process: subprocess.Popen[Any], timeout: float = 300.0) -> bool:
    """Whether a file has that many bytes within `timeout` s, and before the process ends that writes it."""
    end = time.monotonic() + timeout
    while time.monotonic() < end and process.poll() is None:
        with contextlib.suppress(OSError):
            if path.stat().st_size >= size:
                return True
        time.sleep(0.02)
    return False


def nodes_on(where: str) -> list[int]:
    """Processes that run a node on that bus."""
    processes = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                words = (entry / "cmdline").read_bytes().split(b"\0")
                is_node = b"node" in words or b"/controller-" in words[0]  # in Python, or the C firmware
                if is_node and where.encode() in words and entry.name != str(os.getpid()):
                    processes.append(int(entry.name))
    return processes


def is_running(pid: int) -> bool:
    """Whether a process runs; one that has ended and that nobody has waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def gone(where: str, timeout: float = 60.0) -> bool:
    """Whether no node is left on that bus, within `timeout` s."""
    end = time.monotonic() + timeout
    while nodes_on(where) and time.monotonic() < end:
        time.sleep(0.05)
    return not nodes_on(where)


SHORT = """
title = "A short one"
setup = [{ kind = "hold", time = 0.05 }]
main = [
  { name = "rest", kind = "hold", time = 0.05 },
  { name = "step", kind = "step", to = 1e-3, time = 0.2 },
  { name = "back", kind = "ramp", to = 0.0, time = 0.1 },
]
cleanup = [{ kind = "ramp", to = 0.0, time = 0.05 }]
checks = [
  { name = "overshoot", kind = "overshoot", window = "step", high = 30.0 },
  { name = "no emergency", kind = "event_never", event = "EMCY" },
]
"""

SLOW_START = "\n[timing]\noperational = 20\n"  # s


def never() -> bool:
    """Nobody stops the run."""
    return False


def job(text: str = SHORT, seed: int = 0, set_: dict[str, float] | None = None, **settings: object) -> Job:
    """A job of a sequence's text. On a bus between programs the nodes have 20 s to start: the machine may be busy."""
    if "bus" in settings and "[timing]" not in text:
        text += SLOW_START
    sequence = parse_sequence(text, "short.toml", lambda name: b"")
    model = load_model(sequence.model.name).replace(dict(sequence.model.overrides)).replace(set_ or {})
    return Job(sequence=sequence, model=model, seed=seed, **settings)  # type: ignore[arg-type]


def play(one: Job, folder: Path, stop: Callable[[], bool] = never) -> Outcome:
    """Run a job; its results lie in `folder`. On a bus between programs a boot-up may take 20 s."""
    with pytest.MonkeyPatch.context() as patch:
        if one.bus != "embedded":
            patch.setattr(master, "BOOT_TIMEOUT", 20.0)
        return run_job(one, folder, ignore_progress, stop)


def stop_after(questions: int) -> Callable[[], bool]:
    """An operator who presses Ctrl-C after the run has asked for it so often, each time cycles are over."""
    counter = iter(range(10**9))
    return lambda: next(counter) >= questions


def act_at(question: int, act: Callable[[], object]) -> Callable[[], bool]:
    """Nobody stops the run, but when it asks for that time something happens."""
    counter = iter(range(10**9))
    return lambda: bool(next(counter) == question and act())


def read_signals(folder: Path) -> np.ndarray:
    """Com, XJ, Cor, P12, XS and load of all cycles in the log of a run, (6, n)."""
    trace = Trace.read(folder, all=True)
    return np.array([trace.column(name) for name in ("com", "xj", "cor", "p12", "xs", "load")])


def kinds(outcome: Outcome) -> list[tuple[str, str]]:
    """Kind and text of the events, in order."""
    return [(event.kind, event.text) for event in outcome.events]
