"""Ctrl-C in every long command: how soon it ends, with which exit status, and what it leaves behind."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from fdi.trace.trace import Trace

LONG_COMMANDS = {  # run2.csv repeats run.csv, held.csv has another command, long.csv has 13 minutes
    "run": "run --out run",
    "run in real time": "run --pace realtime --out run",
    "run, C firmware": "run --controller c --bus udp_multicast:{group} --out run",
    "simulate": "simulate --command long_command.csv --out simulated.csv",
    "diff": "diff run.csv run2.csv --out page.html",
    "compare": "compare run.csv --repeat run2.csv --out page.html",
    "explain": "explain run.csv --repeat run2.csv --holdout held.csv --out page.html",
    "add": "add null_bias jack_friction run.csv --repeat run2.csv --holdout held.csv --out model.toml",
    "identify": "identify run.csv run2.csv --out model.toml",
    "fdi": "fdi run.csv --out page.html",
    "fdi --learn-bands": "fdi --learn-bands --out bands.toml",
    "trend": "trend unit --out trend.html",
    "campaign": "campaign --fault healthy --seeds 2 --out campaign",
    "conformance": "conformance controller --out conformance",
    "bench": "bench --out bench.json",
    "effects --test": "effects --test --out effects.json",
    "import": "import long.csv --out imported.mcap",
    "report, 13 minutes": "report long.csv --out page.html",
    "compare, 13 minutes": "compare long.csv --out page.html",
    "explain, 13 minutes": "explain long.csv --out page.html",
    "fdi, 13 minutes": "fdi long.csv --out page.html",
}
MOMENTS = (0.7, 2.0, 5.0)  # s of CPU time after the start: at Ctrl-C
MOST_CPU, MOST_WALL = 2.0, 60.0  # s of CPU time, and of time, from Ctrl-C to the end


class Interrupted(NamedTuple):
    """What became of a command; times in s."""

    name: str
    moment: float  # CPU time of the command at Ctrl-C
    status: int | None  # None: it was done before Ctrl-C
    wall: float  # from Ctrl-C to the end
    cpu: float  # of the command and its processes, meanwhile
    faults: tuple[str, ...]


def interrupt_command(name: str, words: str, moment: float, folder: Path, environment: Mapping[str, str]
                      ) -> Interrupted:
    """Start a command in a folder, send SIGINT after so many seconds of CPU time, and wait for its end."""
    before = {path for path in folder.rglob("*") if path.is_file()}
    process = subprocess.Popen([sys.executable, "-m", "rig.cli.main", *words.split()], cwd=folder, text=True,
                               env=dict(environment), stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    started = time.monotonic()
    while process.poll() is None and read_cpu_time(process.pid) < moment and time.monotonic() < started + 20 * moment:
        time.sleep(0.02)
    if process.poll() is not None:
        process.communicate()
        remove_new_files(folder, before)
        return Interrupted(name, moment, None, 0.0, 0.0, ())
    used, asked = read_cpu_time(process.pid), time.monotonic()
    process.send_signal(signal.SIGINT)
    errors = process.stderr.read() if process.stderr else ""
    if process.stdout:
        process.stdout.close()
    _, state, usage = os.wait4(process.pid, 0)
    wall = time.monotonic() - asked
    process.returncode = os.waitstatus_to_exitcode(state)
    cpu = max(0.0, usage.ru_utime + usage.ru_stime - used)
    if process.returncode in (0, 1, 3) and wall <= MOST_CPU:  # Ctrl-C came when the answer was already printed
        remove_new_files(folder, before)
        return Interrupted(name, moment, None, wall, cpu, ())
    faults = [*judge_end(process.returncode, errors), *judge_time(wall, cpu)]
    faults += [f"{path.name}: {fault}" for path in sorted(folder.rglob("*")) if path.is_file() and path not in before
               and (fault := find_damage(path))]
    remove_new_files(folder, before)
    return Interrupted(name, moment, process.returncode, wall, cpu, tuple(faults))


def read_cpu_time(pid: int) -> float:
    """CPU time of a process and of all processes below it, s; proc(5): ppid, and utime, stime, cutime, cstime."""
    parents, ticks = {}, {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
                parents[int(entry.name)] = int(fields[1])
                ticks[int(entry.name)] = sum(map(int, fields[11:15]))
    family = [pid]
    for member in family:
        family += [child for child, parent in parents.items() if parent == member]
    return sum(ticks.get(member, 0) for member in family) / os.sysconf("SC_CLK_TCK")


def judge_end(status: int, errors: str) -> list[str]:
    """What is wrong with exit status and messages after Ctrl-C; empty if nothing is."""
    faults = [] if status == 130 else [f"status {status}"]
    if "Traceback" in errors:
        faults.append("a traceback")
    if len(errors.strip().splitlines()) > 1:
        faults.append(f"{len(errors.strip().splitlines())} lines of error")
    return faults


def judge_time(wall: float, cpu: float) -> list[str]:
    """Whether the end took more than 2 s of CPU time, or the command hung."""
    if cpu > MOST_CPU:
        return [f"{cpu:.1f} s of CPU time to the end"]
    return [f"{wall:.1f} s to the end"] if wall > MOST_WALL else []


def find_damage(path: Path) -> str:
    """What is wrong with a file that an interrupted command left; empty for a whole one."""
    if path.name.startswith(".part-"):
        return "a part of a file"
    try:
        if path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".toml":
            tomllib.loads(path.read_text())
        elif path.suffix == ".mcap":
            Trace.read(path, all=True)
        elif path.suffix == ".csv":
            return "" if path.read_bytes().endswith(b"\n") else "no whole last line"
        elif path.suffix == ".html":
            return "" if path.read_text().rstrip().endswith("</html>") else "no end"
    except Exception as error:  # whatever a reader finds
        if "at least one cycle" in str(error):  # a whole log: the run had not begun
            return ""
        return f"{type(error).__name__}: {error}"
    return ""


def remove_new_files(folder: Path, before: set[Path]) -> None:
    """Remove the files that a command made."""
    for path in folder.rglob("*"):
        if path.is_file() and path not in before:
            path.unlink()
