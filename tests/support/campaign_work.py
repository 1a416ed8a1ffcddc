"""Judgements and jobs for the tests of rig campaign: quick, deadly, or held up where the environment says."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from fdi.trace import Trace
from plant import InputError, Model, count_threads


def count_rows(trace: Trace, model: Model) -> dict[str, Any]:
    """Next to nothing, of any plant; it has no precursors."""
    return {"rows": len(trace), "precursors": {}}


def judge_quickly(trace: Trace, model: Model) -> dict[str, Any]:
    """Some numbers that depend on every bit of the trace; each call leaves its mark in $CAMPAIGN_CALLS.

    After the first $CAMPAIGN_FREE calls each one waits until the file $CAMPAIGN_GATE is gone.
    """
    source = f"{trace.provenance['source']} {trace.provenance.get('seed')}"
    if "CAMPAIGN_CALLS" in os.environ:
        with (Path(os.environ["CAMPAIGN_CALLS"])).open("a") as out:
            out.write(f"{os.getpid()} {source}\n")
        if len(Path(os.environ["CAMPAIGN_CALLS"]).read_text().splitlines()) > int(os.environ.get("CAMPAIGN_FREE", 0)):
            while Path(os.environ.get("CAMPAIGN_GATE", "")).is_file():
                time.sleep(0.02)
    if source == "filter_clogging=0.9 1":
        raise ZeroDivisionError("nothing\nleft to divide")
    error = trace.com - trace.xj
    return {"rms": float(np.sqrt((error**2).mean())), "sum": float(trace.p12.sum()), "last": float(trace.xs[-1]),
            "events": [{"t": float(t)} for t in np.flatnonzero(error > 2e-3)[:3]]}


def square_of_deadly_job(job: tuple[int, str]) -> tuple[int, int]:
    """The square and the number of this process. The job's process dies first, if a file is named and not there yet.

    The file name "always" kills every process.
    """
    number, marker = job
    if marker and not Path(marker).exists():
        if marker != "always":
            Path(marker).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number**2, os.getpid()


def refuse(job: int) -> int:
    """Refuses the job 3."""
    if job == 3:
        raise InputError("job", "3", "another job")
    return job


def count_usable_threads(job: int) -> int:
    """The number of threads that a computation may use here."""
    return count_threads()


def run_sleeping_process(folder: str) -> None:
    """Start a process that sleeps, as `rig explain` in a trial, and write both process numbers to a file."""
    command = [sys.executable, "-c", "import os, sys, time; print(os.getpid(), flush=True); time.sleep(1200)"]
    with Path(folder, "pids").open("a") as out:
        out.write(f"{os.getpid()}\n")
        out.flush()
        subprocess.run(command, stdout=out, check=False)


def run_process_without_signals(folder: str) -> None:
    """The same in a worker that no longer sees SIGTERM, like one in compiled code that does not come to an end."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM, signal.SIGALRM})
    run_sleeping_process(folder)


def exit_at_import() -> None:
    """Ends a process that unpickles it."""
    raise SystemExit(3)


class Unpicklable:
    """A function that ends the process that unpickles it."""

    def __call__(self, job: int) -> int:
        """Never called in a worker."""
        return job

    def __reduce__(self) -> tuple[object, tuple[()]]:
        return exit_at_import, ()


if __name__ == "__main__":  # a user's process, to be interrupted: campaign_work.py WORK FOLDER
    from rig.campaign.batch import Workers, run_jobs

    def name_failure(job: str, reason: str) -> None:
        raise AssertionError(reason)

    try:
        for _ in run_jobs(globals()[sys.argv[1]], [sys.argv[2]] * 2, Workers(2), name_failure):
            pass
    except KeyboardInterrupt:
        print("interrupted")
