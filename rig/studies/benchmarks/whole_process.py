"""The time of whole `rig` processes, from the start of Python to their end: what a user waits for."""
from __future__ import annotations

import subprocess
import sys
import tempfile

from rig.run.outcome import INTERRUPTED
from rig.sequences import load_sequence
from rig.studies.benchmarks.stopwatch import measure_median_duration


def measure_run_process_speed(rounds: int = 3) -> float:
    """The speed of a whole `rig run preflight` process with its log and report, as a multiple of real time."""
    with tempfile.TemporaryDirectory() as folder:
        seconds = measure_median_duration(lambda: run_rig("run", "preflight", "--quiet", "--out", folder), rounds)
    return load_sequence("preflight").duration / seconds


def measure_help_time(rounds: int = 5) -> float:
    """The time that `rig --help` takes as a process, s."""
    return measure_median_duration(lambda: run_rig("--help"), rounds)


def run_rig(*words: str) -> None:
    """Run `rig` with these words in a process of its own.

    Raises:
        subprocess.CalledProcessError: it ended with a status other than 0.
        KeyboardInterrupt: Ctrl-C in the terminal ended it, before this process heard of it.
    """
    done = subprocess.run([sys.executable, "-m", "rig.cli.main", *words], check=False, stdout=subprocess.DEVNULL)
    if done.returncode == INTERRUPTED:
        raise KeyboardInterrupt
    done.check_returncode()
