"""Stop one process of the bench at a random moment, and count whom the run blames.

    python -m studies.attribution_trials --trials 100 --pace lockstep --out trials

Each trial is one `rig run` on the UDP bus with plant and controller as processes of their own. At a random cycle one of
the three processes is stopped (SIGSTOP) for 2, 10 or 50 ms, the three in turn. A stall of the rig or of the plant must
never be held against the controller, one of the controller never against the plant. The table has a line per process:
the verdicts, whom the first cause names, and how many trials were attributed wrongly. A trial that came too late, after
the run, is repeated. Killed processes are tried by studies.robustness.
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
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import NamedTuple

from rig.network import Link, open_can
from studies.robustness.disturb import find_processes
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
STALLS = (0.002, 0.010, 0.050)  # s
RUN_LIMIT = 150.0  # s


class Trial(NamedTuple):
    """How one run ended."""

    process: str  # that was stopped
    verdict: str
    blamed: str  # the source of the first cause, "node 2 controller"; "" for nobody
    text: str
    seconds: float  # from the stall to the verdict of the run; negative: the stall came too late

    @property
    def is_wrong(self) -> bool:
        """Whether the run blamed somebody else."""
        if self.process == "controller":
            return self.blamed.startswith("node 3")
        return self.blamed.startswith("node 2") or self.verdict not in ("PASS", "INVALID_TIMING")


def wait_for_cycle(link: Link, cycle: int, run: subprocess.Popen[str]) -> bool:
    """Listen until the rig sends the command of a cycle; False if its run ended before."""
    end = time.monotonic() + RUN_LIMIT
    while run.poll() is None and time.monotonic() < end:
        for frame in link.poll(0.02):
            if frame.cob_id == COMMAND and unpack_frame(COMMAND, frame.data)["cycle"] >= cycle:
                return True
    return False


def stop_process(victim: int, stall: float) -> None:
    """Stop a process for `stall` s."""
    with suppress(ProcessLookupError):  # the run was over before
        os.kill(victim, signal.SIGSTOP)
        time.sleep(stall)
        os.kill(victim, signal.SIGCONT)


def run_trial(process: str, number: int, pace: str, folder: Path, group: str) -> Trial:
    """One run in which a process is stopped at a random cycle."""
    chance = random.Random(f"{process} {number}")
    stall = chance.choice(STALLS)
    (folder / "stall.toml").write_text(SEQUENCE)
    out, bus = folder / f"{process}-{number}", f"udp_multicast:{group}"
    link = Link(open_can(bus), time.monotonic_ns)
    link.leave_out((SYNC, FEEDBACK, VALVE_STATE, DRIVE))  # this program may be slow
    command = [sys.executable, "-m", "rig.cli.main", "run", str(folder / "stall.toml"), "--bus", bus, "--pace", pace,
               "--json", "--out", str(out)]
    run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    is_reached = wait_for_cycle(link, chance.randrange(250, 1500), run)
    link.close()
    begin = time.time()
    for victim in [number for number, name in find_processes(group) if is_reached and name == process]:
        stop_process(victim, stall)
    output, errors = run.communicate(timeout=RUN_LIMIT)
    try:
        answer = json.loads(output)
    except ValueError:
        return Trial(process, f"status {run.returncode}", "", errors.strip()[-200:], time.time() - begin)
    seconds = (out / "verdict.json").stat().st_mtime - begin
    cause = answer.get("cause") or {"source": "", "evidence": ""}
    return Trial(process, answer["verdict"], cause["source"], f"{answer.get('why', '')} {cause['evidence']}", seconds)


def format_trials(title: str, trials: list[Trial]) -> str:
    """One line of the table."""
    verdicts, blamed = Counter(trial.verdict for trial in trials), Counter(trial.blamed or "nobody" for trial in trials)
    words = [", ".join(f"{name} {count}" for name, count in counter.most_common()) for counter in (verdicts, blamed)]
    wrong, longest = sum(trial.is_wrong for trial in trials), max(trial.seconds for trial in trials)
    return (f"{title:24} {words[0]:34} {words[1]:28} wrong {wrong} of {len(trials)}; "
            f"verdict after at most {longest:.2f} s")


def run_trials(trials: int, pace: str, folder: Path, group: str) -> list[Trial]:
    """Stop the three processes in turn, and print a line per process at the end."""
    done: list[Trial] = []
    for number, process in product(range(trials), PROCESSES):
        for attempt in range(3):
            trial = run_trial(process, number + attempt * trials, pace, folder, group)
            if trial.seconds > 0:
                break
        done.append(trial)
        if trial.is_wrong:
            print(f"    {pace}, {process}: {trial.verdict} after {trial.seconds:.2f} s: {trial.text}", flush=True)
    for process in PROCESSES:
        print(format_trials(f"{pace}, {process}", [trial for trial in done if trial.process == process]), flush=True)
    return done


def main() -> int:
    """Run the trials; exit status 1 if a single one was attributed wrongly."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--trials", type=int, default=3, help="trials of each process (default 3)")
    parser.add_argument("--pace", choices=("realtime", "lockstep"), default="realtime")
    parser.add_argument("--group", default="239.74.163.200", help="multicast group of the bus")
    parser.add_argument("--out", type=Path, help="folder for the runs (default: a temporary one)")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.out or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        wrong = [trial.is_wrong for trial in run_trials(args.trials, args.pace, folder, args.group)]
    print(f"{sum(wrong)} of {len(wrong)} trials attributed wrongly")
    return int(any(wrong))


if __name__ == "__main__":
    sys.exit(main())
