"""`rig run --live` in a pseudo-terminal and without one, and the line about a node that dies."""
from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
from collections.abc import Callable
from pathlib import Path

COMMAND = [sys.executable, "-m", "rig.cli.main", "run"]
WATCHED = """
title = "Watched"
main = [
  { name = "step", kind = "step", to = 1e-3, time = 0.2 },
  { name = "sine", kind = "sine", amplitude = 1e-3, frequency = 1.0, time = 600 },
]
checks = [
  { name = "overshoot", kind = "overshoot", window = "step", high = 100.0 },
  { name = "position", kind = "never_exceeds", signal = "xj", high = 20, unit = "mm" },
]
"""
LONG = 'title = "Long"\nmain = [{ name = "rest", kind = "hold", time = 600 }]\n'


def run_in_terminal(words: list[str], watch: Callable[[str, int], None] = lambda *_: None) -> tuple[str, int]:
    """Everything that `rig run` writes to a terminal of 80 x 24, and its exit status."""
    number, fd = pty.fork()
    if number == 0:  # pragma: no cover
        os.environ["TERM"] = "xterm-256color"
        os.execv(sys.executable, [*COMMAND, *words])
    fcntl.ioctl(fd, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    text = b""
    while True:
        if select.select([fd], [], [], 1.0)[0]:
            try:
                data = os.read(fd, 65536)
            except OSError:
                break
            text += data
        watch(text[-200_000:].decode(errors="replace"), number)
    return text.decode(errors="replace"), os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])


def split_frames(text: str) -> list[str]:
    """The screens that were drawn, without colours."""
    return [re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", frame).replace("\r", "") for frame in text.split("\x1b[H")]


def test_screen_of_a_run(tmp_path: Path) -> None:
    text, status = run_in_terminal(["--live", "--out", str(tmp_path / "run")])
    frames = split_frames(text)
    assert status == 0 and "PASS  Every check passed." in frames[-1]
    assert text.index("\x1b[?1049h") < text.index("\x1b[?1049l") < text.index("Every check passed")
    assert text.rindex("\x1b[?25h") > text.rindex("\x1b[?25l")  # the cursor is shown again
    assert any("Position [mm]" in frame for frame in frames[1:])
    assert "lockstep" in frames[-1]


def test_screen_follows_the_run(tmp_path: Path) -> None:
    """A run that lasts until all of it was seen, however slowly the screen is drawn."""
    sequence = tmp_path / "watched.toml"
    sequence.write_text(WATCHED)
    seen: dict[str, set[str]] = {"plot": set(), "nodes": set(), "measures": set(), "passed": set(), "response": set()}
    stopped: list[int] = []

    def look(text: str, number: int) -> None:
        for frame in split_frames(text)[1:]:
            if "Position [mm]" not in frame:
                continue
            seen["plot"].add("".join(letter for letter in frame if 0x2800 < ord(letter) < 0x2900))
            seen["nodes"] |= set(re.findall(r"node 2 controller operational|node 3 plant      operational", frame))
            seen["measures"] |= set(re.findall(r"measures +([a-z]+)", frame))
            seen["passed"] |= set(re.findall(r"PASS {2,}([a-z]+)", frame))
            seen["response"] |= set(re.findall(r"response p50 \d+ p99 \d+ max \d+ us", frame))
        is_complete = len(seen["plot"]) >= 3 and len(seen["nodes"]) == 2 and all(seen.values())
        if is_complete and not stopped:
            stopped.append(number)
            os.kill(number, signal.SIGINT)

    _, status = run_in_terminal([str(sequence), "--live", "--out", str(tmp_path / "run")], look)
    assert stopped and status == 130, {name: sorted(each)[:2] for name, each in seen.items()}
    assert "overshoot" in seen["passed"] and "position" in seen["measures"] and "position" not in seen["passed"]


def test_ctrl_c_restores_the_terminal(tmp_path: Path) -> None:
    sequence = tmp_path / "long.toml"
    sequence.write_text(LONG)
    stopped: list[int] = []

    def stop(text: str, number: int) -> None:
        if not stopped and "rest  " in text:
            stopped.append(number)
            os.kill(number, signal.SIGINT)

    text, status = run_in_terminal([str(sequence), "--live", "--out", str(tmp_path / "run")], stop)
    assert stopped and status == 130
    assert text.rindex("\x1b[?1049l") > text.rindex("\x1b[?1049h")
    assert text.rindex("\x1b[?25h") > text.rindex("\x1b[?25l")
    assert (tmp_path / "run" / "verdict.json").exists()


def test_lines_without_a_terminal(tmp_path: Path) -> None:
    words = ["--live", "--json", "--out", str(tmp_path / "run")]
    done = subprocess.run([*COMMAND, *words], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith("{") and "live" not in done.stdout
    lines = done.stderr.splitlines()
    assert lines[0] == "live: standard error is no terminal: a line every 2 s instead of the screen"
    assert re.search(r"checks 29 pass, 0 fail of 29; lockstep: no cycle is late; nodes: 2 operational", lines[-1])


def test_dead_node_is_announced_before_the_run_ends(tmp_path: Path) -> None:
    """The plant's process is killed; the line comes while the rig is still at work on its clean-up of 4000 cycles."""
    sequence = tmp_path / "long.toml"
    sequence.write_text(LONG + 'cleanup = [{ kind = "hold", time = 4 }]\n')
    group = f"udp_multicast:239.74.{os.getpid() >> 8 & 255}.{os.getpid() & 255}"
    rig = subprocess.Popen([*COMMAND, str(sequence), "--bus", group, "--out", str(tmp_path / "run")],
                           stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert rig.stdout is not None and rig.stderr is not None
    rig.stdout.readline()  # the nodes are there
    log = tmp_path / "run" / "trace.mcap"
    while rig.poll() is None and not (log.exists() and log.stat().st_size > 300_000):  # well into main
        select.select([], [], [], 0.05)
    nodes = [int(word) for word in Path(f"/proc/{rig.pid}/task/{rig.pid}/children").read_text().split()]
    plant = next(number for number in nodes if b"plant" in Path(f"/proc/{number}/cmdline").read_bytes())
    os.kill(plant, signal.SIGKILL)
    assert rig.stderr.readline() == "rig run: node 3 plant: its process was ended by SIGKILL\n"
    assert rig.poll() is None  # its report is still to come
    assert "ABORTED" in rig.communicate()[0] and rig.returncode == 1


def test_a_suite_is_not_shown(tmp_path: Path) -> None:
    done = subprocess.run([*COMMAND, "preflight", "lost_sync", "--live"], capture_output=True, text=True, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "rig run: --live: expected one sequence; runs of a suite run side by side\n"
