"""Stall or kill one process of the bench at a random moment, and count whom the run blames.

    python -m studies.attribution_trials --trials 100 --out trials
    python -m studies.attribution_trials --trials 100 --mixed --out trials
    python -m studies.attribution_trials --trials 100 --mixed --stay --controller c --pace lockstep

Each trial is one `rig run` on the UDP bus with plant and controller as processes of their own. At a random cycle one of
the three processes is stopped (SIGSTOP) for 2, 10 or 50 ms, or one of the nodes is killed (SIGKILL). A stall of the rig
or of the plant must never be held against the controller; a killed node must be named, and its run must end within 2 s.
The table has a line per case: the verdicts, whom the first cause names, and how many trials were attributed wrongly.
With `--mixed` the three processes are stopped alternately in one pace, each time for one of the three times at random,
and the table has a line per process. A trial that came too late, after the run, is repeated. With `--stay` plant and
controller are started once and stay for all trials.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from rig.network.bus import Link, open_can
from studies.robustness.disturb import start_nodes
from studies.shipped_frames import COMMAND, DRIVE, FEEDBACK, SYNC, VALVE_STATE, unpack_frame

SEQUENCE = """
title = "A process of the bench stalls"
setup = [{ kind = "hold", time = 0.2 }]
main = [{ name = "sine", kind = "sine", amplitude = 1e-3, frequency = 1.0, time = 1.6 }]
cleanup = [{ kind = "hold", time = 0.2 }]
checks = [
  { name = "tracking", kind = "rms_error", high = 150, unit = "um" },
  { name = "no emergency", kind = "event_never", event = "EMCY" },
]
"""
PROCESSES = ("rig", "plant", "controller")
RUN_LIMIT = 150.0  # s
KILLED_LIMIT = 2.0  # s, from the kill to the end of the run


class Case(NamedTuple):
    """What is done to which process, in which pace; `stall` in s, 0 for a kill."""

    pace: str
    process: str
    stall: float

    def __str__(self) -> str:
        what = f"stopped for {1000 * self.stall:g} ms" if self.stall else "killed"
        return f"{self.pace}, {self.process} {what}"


class Trial(NamedTuple):
    """How one run ended."""

    case: Case
    verdict: str
    blamed: str  # "node 1", "node 2", "node 3", or "" for nobody
    text: str
    seconds: float  # from the stall or kill to the verdict of the run
    exit_seconds: float  # until its process has ended: the page of the run is drawn in between

    @property
    def is_wrong(self) -> bool:
        """Whether the run blamed somebody else, or took too long to end."""
        if not self.case.stall:
            node = "node 2" if self.case.process == "controller" else "node 3"
            return self.blamed != node or self.verdict != "ABORTED" or self.seconds > KILLED_LIMIT
        if self.case.process == "controller":
            return self.blamed == "node 3"
        return self.blamed == "node 2" or self.verdict not in ("PASS", "INVALID_TIMING")


def list_cases() -> list[Case]:
    """Every stall and kill in both paces."""
    stalls = [Case(pace, process, stall) for pace in ("realtime", "lockstep") for process in PROCESSES
              for stall in (0.002, 0.010, 0.050)]
    return stalls + [Case(pace, node, 0.0) for pace in ("realtime", "lockstep") for node in PROCESSES[1:]]


def find_children(parent: int) -> dict[str, int]:
    """The node processes that a rig started: name to process id."""
    found = {}
    for entry in Path("/proc").iterdir():
        with suppress(OSError, ValueError, IndexError):
            words = (entry / "cmdline").read_bytes().decode(errors="replace").split("\0")
            is_child = int((entry / "stat").read_text().rpartition(")")[2].split()[1]) == parent
            if is_child and "node" in words:
                found[words[words.index("node") + 1]] = int(entry.name)
    return found


def wait_for_cycle(link: Link, cycle: int, run: subprocess.Popen[str]) -> bool:
    """Listen until the rig sends the command of a cycle; False if its run ended before."""
    end = time.monotonic() + RUN_LIMIT
    while run.poll() is None and time.monotonic() < end:
        for frame in link.poll(0.02):
            if frame.cob_id == COMMAND and unpack_frame(COMMAND, frame.data)["cycle"] >= cycle:
                return True
    return False


def read_blame(answer: dict[str, Any]) -> tuple[str, str]:
    """Whom a run blames, and in which words; runs before `cause` existed are read by their sentence."""
    cause = answer.get("cause")
    if cause:
        return str(cause["source"])[:6], f"{answer['why']} {cause['evidence']}"
    text = str(answer.get("why", "")) if answer["verdict"] == "ABORTED" else ""
    blamed = "node 2" if text.startswith("node 2") else "node 3" if text.startswith("node 3") else ""
    return "bench" if answer["verdict"] == "INVALID_TIMING" else blamed, str(answer.get("why", ""))


def disturb(victim: int, stall: float) -> None:
    """Stop a process for `stall` s, or kill it if that is 0."""
    with suppress(ProcessLookupError):  # the run was over before
        os.kill(victim, signal.SIGSTOP if stall else signal.SIGKILL)
        time.sleep(stall)
        os.kill(victim, signal.SIGCONT)


def run_trial(case: Case, number: int, sequence: Path, folder: Path, group: str,
              standing: dict[str, int] | None = None) -> Trial:
    """One run with one stall or kill at a random cycle. `standing`: processes of the nodes, if they stay."""
    chance = random.Random(f"{case} {number}")
    out = folder / f"{PROCESSES.index(case.process)}-{case.stall:g}-{case.pace}-{number}"
    command = [sys.executable, "-m", "rig.cli.main", "run", str(sequence), "--bus", f"udp_multicast:{group}", "--pace",
               case.pace, "--json", "--plant", "external" if standing else "builtin", "--out", str(out)]
    command += ["--controller", "external"] if standing else []
    link = Link(open_can(f"udp_multicast:{group}"), time.monotonic_ns)
    link.leave_out((SYNC, FEEDBACK, VALVE_STATE, DRIVE))  # this program may be slow
    run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    is_reached = wait_for_cycle(link, 1, run)
    victim = run.pid if case.process == "rig" else (standing or find_children(run.pid)).get(case.process, 0)
    is_reached &= victim != 0 and wait_for_cycle(link, chance.randrange(250, 1500), run)
    link.close()
    begin, begin_time = time.monotonic(), time.time()
    if is_reached:
        disturb(victim, case.stall)
    output, errors = run.communicate(timeout=RUN_LIMIT)
    exit_seconds = time.monotonic() - begin
    try:
        answer = json.loads(output)
    except ValueError:
        return Trial(case, f"status {run.returncode}", "", errors.strip()[-200:], exit_seconds, exit_seconds)
    seconds = (out / "verdict.json").stat().st_mtime - begin_time
    return Trial(case, answer["verdict"], *read_blame(answer), seconds, exit_seconds)


def format_case(case: object, trials: list[Trial]) -> str:
    """One line of the table."""
    verdicts, blamed = (Counter(values) for values in zip(*((t.verdict, t.blamed or "nobody") for t in trials),
                                                          strict=True))
    wrong = sum(trial.is_wrong for trial in trials)
    words = [", ".join(f"{name} {count}" for name, count in counter.most_common()) for counter in (verdicts, blamed)]
    longest, last = max(trial.seconds for trial in trials), max(trial.exit_seconds for trial in trials)
    return (f"{case!s:48} {words[0]:34} {words[1]:28} wrong {wrong} of {len(trials)}; verdict after at most "
            f"{longest:.2f} s, exit {last:.2f} s")


def run_mixed(trials: int, pace: str, folder: Path, group: str,
              standing: dict[str, int] | None = None) -> Iterator[Trial]:
    """Stop the three processes alternately, for random times, and print a line per process at the end."""
    sequence = folder / "stall.toml"
    sequence.write_text(SEQUENCE)
    done: dict[str, list[Trial]] = {process: [] for process in PROCESSES}
    for number, process in product(range(trials), PROCESSES):
        stall = random.Random(f"{process} {number}").choice((0.002, 0.010, 0.050))
        case = Case(pace, process, stall)
        for attempt in range(3):
            trial = run_trial(case, number + attempt * trials, sequence, folder, group, standing)
            if trial.seconds > 0:
                break
        done[process].append(trial)
        if trial.is_wrong:
            print(f"    {case}: {trial.verdict} after {trial.seconds:.2f} s: {trial.text}", flush=True)
        if sum(map(len, done.values())) % 30 == 0:
            for name, so_far in done.items():
                print(format_case(f"so far: {pace}, {name}", so_far), flush=True)
        yield trial
    for process, group_of_trials in done.items():
        print(format_case(f"{pace}, {process} stopped for 2, 10 or 50 ms", group_of_trials), flush=True)


def run_cases(cases: list[Case], trials: int, folder: Path, group: str) -> Iterator[Trial]:
    """Run all trials of all cases, and print a line per case."""
    sequence = folder / "stall.toml"
    sequence.write_text(SEQUENCE)
    for case in cases:
        done = [run_trial(case, number, sequence, folder, group) for number in range(trials)]
        print(format_case(case, done), flush=True)
        for trial in done:
            if trial.is_wrong:
                print(f"    {trial.verdict} after {trial.seconds:.2f} s: {trial.text}", flush=True)
        yield from done


def main() -> int:
    """Run the trials; exit status 1 if a single one was attributed wrongly."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--trials", type=int, default=3, help="trials per case (default 3)")
    parser.add_argument("--mixed", action="store_true", help="stop the processes alternately for random times")
    parser.add_argument("--pace", choices=("realtime", "lockstep"), default="realtime", help="of --mixed")
    parser.add_argument("--stay", action="store_true", help="--mixed: start the nodes once for all trials")
    parser.add_argument("--controller", choices=("builtin", "c"), default="builtin", help="of --stay")
    parser.add_argument("--case", default="", help="only the cases whose description has these words")
    parser.add_argument("--group", default="239.74.163.200", help="multicast group of the bus")
    parser.add_argument("--out", type=Path, help="folder for the runs (default: a temporary one)")
    args = parser.parse_args()
    cases = [case for case in list_cases() if all(word in str(case).split() for word in args.case.split())]
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.out or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        with start_nodes(f"udp_multicast:{args.group}", args.controller) if args.stay else nullcontext() as standing:
            runs = (run_mixed(args.trials, args.pace, folder, args.group, standing) if args.mixed
                    else run_cases(cases, args.trials, folder, args.group))
            wrong = [trial.is_wrong for trial in runs]
    print(f"{sum(wrong)} of {len(wrong)} trials attributed wrongly")
    return int(any(wrong))


if __name__ == "__main__":
    sys.exit(main())
