"""The whole study: fuzz frames and datagrams, disturbed runs, long operation."""
from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fdi.progress import Progress, ignore_progress
from plant.model import load_model
from rig.run.job import Job
from rig.run.runner import run_job
from rig.sequences.sequence import parse_sequence
from rig.studies.robustness.datagrams import fuzz_datagrams
from rig.studies.robustness.disturb import ACTIONS, PROCESSES, SEQUENCE, Trial, disturb_run
from rig.studies.robustness.fuzz import fuzz_node, fuzz_rig
from rig.studies.robustness.logs import LogCount, fuzz_logs
from rig.studies.robustness.soak import soak_bench


def run_study(frames: int, trials: int, minutes: float, seed: int, controller: str,
              progress: Progress) -> dict[str, Any]:
    """Run the study; its figures, with all that went wrong as "problems".

    Args:
        frames: fuzz frames for each node; a tenth as many datagrams, a thousandth as many changed logs.
        trials: disturbed runs of each kind in which the disturbance came before the last cycle; at most twice as
            many are made.
        minutes: of long operation; 0 for none.
        seed: of frames and moments.
        controller: firmware of the disturbed runs and of the long operation, "builtin" or "c".
        progress: called with the stage and the share done.
    """
    problems: list[str] = []
    counts = [fuzz_node("plant", frames, seed, progress), fuzz_node("controller", frames, seed, progress),
              fuzz_rig(frames, seed, progress)] if frames else []
    most_growth = 16 << 20  # bytes of memory that fuzz frames may cost
    for count in counts:
        problems += [f"fuzz frames, {count.target}: {failure}" for failure in count.failures]
        if not count.works:
            problems.append(f"fuzz frames, {count.target}: does not work afterwards")
        if count.growth > most_growth:
            problems.append(f"fuzz frames, {count.target}: {count.growth >> 20} MiB more memory")
    datagrams = fuzz_datagrams(frames // 10, seed, _sample_group(seed, 1), controller, progress) if frames else None
    if datagrams and datagrams.verdict != "PASS":
        problems.append(f"fuzz datagrams: a run afterwards is {datagrams.verdict or 'impossible'}")
    problems += [f"fuzz datagrams: {problem}" for problem in (datagrams.problems if datagrams else ())]
    logs = _study_logs(frames // 1000, seed, progress) if frames >= 1000 else None
    problems += [f"changed logs: {failure}" for failure in (logs.failures if logs else ())]
    rows = []
    kinds = list(_list_kinds())
    for i, (action, victim) in enumerate(kinds):
        done: list[Trial] = []
        while trials and (effective := sum(one.is_effective for one in done)) < trials and len(done) < 2 * trials:
            progress(f"{action} {victim}", (i + effective / trials) / len(kinds))
            done.append(disturb_run(action, victim, seed + len(done), controller=controller))
        problems += [f"{action} {victim}, seed {seed + n}: {problem}" for n, one in enumerate(done)
                     for problem in one.problems]
        if done:
            rows.append(_summarise_trials(done))
    soak = soak_bench(minutes, _sample_group(seed, 2), controller=controller, progress=progress) if minutes else None
    if soak:
        problems += [f"long operation: {problem}" for problem in (*soak.problems, *soak.find_growth())]
    return {"frames": [count._asdict() for count in counts], "datagrams": datagrams._asdict() if datagrams else None,
            "logs": logs._asdict() if logs else None, "disturbed": rows,
            "soak": _describe_soak(soak._asdict()) if soak else None, "problems": problems}


def _study_logs(count: int, seed: int, progress: Progress) -> LogCount:
    """Changed logs of a short run on the embedded bus."""
    job = Job(sequence=parse_sequence(SEQUENCE.replace("time = 3.0", "time = 0.3"), "s.toml", lambda name: b""),
              model=load_model())
    with tempfile.TemporaryDirectory(prefix="eha-rig-study-") as place:
        run_job(job, Path(place) / "run", ignore_progress, lambda: False)
        return fuzz_logs(Path(place) / "run" / "trace.mcap", Path(place), count, seed, progress)


def _list_kinds() -> Iterator[tuple[str, str]]:
    """(action, victim) of all kinds of disturbance that this user can make."""
    for action in ACTIONS:
        if action in ("kill", "stop"):
            yield from ((action, victim) for victim in PROCESSES)
        elif action != "full tmpfs" or os.geteuid() == 0:  # mounting needs root
            yield action, "rig"


def _sample_group(seed: int, what: int) -> str:
    return "239." + ".".join(str(number) for number in np.random.default_rng([seed, what]).integers(1, 255, 3))


def _summarise_trials(trials: list[Trial]) -> dict[str, Any]:
    """One row of the table: counts over the trials of a kind."""
    ends = [trial.end for trial in trials]
    zeros = [trial.zero for trial in trials if trial.zero >= 0]
    statuses: dict[str, int] = {}
    for trial in trials:
        statuses[str(trial.status)] = statuses.get(str(trial.status), 0) + 1
    return {"action": trials[0].action, "victim": trials[0].victim, "trials": len(trials),
            "effective": sum(trial.is_effective for trial in trials),
            "sound": sum(not trial.problems for trial in trials), "statuses": statuses,
            "end_p50": float(np.median(ends)), "end_max": max(ends), "zero_max": max(zeros, default=None),
            "logs": sum(trial.cycles >= 0 for trial in trials)}


def _describe_soak(soak: dict[str, Any]) -> dict[str, Any]:
    usage = {when: {name: held._asdict() for name, held in soak[when].items()} for when in ("start", "end")}
    return {**soak, **usage}
