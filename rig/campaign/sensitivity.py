"""`rig explain --sensitivity`: many simulated runs on many cores, in rounds, resumed where they were interrupted."""

import hashlib
import pickle
from dataclasses import replace
from functools import partial
from pathlib import Path

from fdi.discovery.explain_runs import Answer
from fdi.discovery.sensitivity import (
    Claim,
    Injection,
    Unit,
    choose_injections,
    find_first_rungs,
    judge_injection,
    summarise_injections,
)
from fdi.progress import Progress
from fdi.sources import hash_sources
from rig.campaign.batch import Batch, BatchProgress, Row, RowFile, Workers, run_batch
from rig.network import WallClock

TYPICAL_RUNS = 8  # of an effect on one more rung: what is left is estimated with it
CRASHED = "CRASHED"  # the verdict of a run whose workers died


def measure_sensitivity(unit: Unit, answer: Answer, file: Path, workers: Workers, report_progress: Progress
                        ) -> list[Claim]:
    """The claim of each effect to hide. Runs that have a row of the same unit in `file` are not made again.

    Args:
        unit: of the measured runs.
        answer: their explanation, which says where to begin.
        file: rows, one for each simulated run.
        workers: where the runs are made and explained.
        report_progress: called with what is under way and the share done.

    Raises:
        InputError: the file cannot be written, or no cluster is there.
        RigError: the cluster is gone, or a worker process cannot start.
    """
    report_progress("where the sizes begin", 0.0)
    first, key, clock, before = find_first_rungs(answer, unit.effects), hash_unit(unit), WallClock(), 0

    def show(progress: BatchProgress, is_open: int, before: int) -> None:
        run_count, decided = before + progress.done, len(unit.effects) - is_open
        runs_left = progress.total - progress.done + TYPICAL_RUNS * is_open
        minutes = 1e-9 * clock.now() / run_count * runs_left / 60.0
        report_progress(f"{decided} of {len(unit.effects)} effects decided, runs explained: {run_count}, "
                        f"about {minutes:.0f} min left", decided / len(unit.effects))

    with RowFile(file) as rows:
        while True:
            unit_rows = [row for row in rows.rows if row.get("key") == key]
            jobs = choose_injections(unit, first, unit_rows)
            if not jobs:
                return summarise_injections(unit, unit_rows)
            is_open = len({job.effect for job in jobs})
            batch = Batch({job.number: job for job in jobs}, partial(_make_row, unit=unit, key=key), "number",
                          partial(_describe_failure, key=key), lambda row: row.get("key") == key,
                          lambda row: row["verdict"] == CRASHED)
            run_batch(batch, rows, workers, partial(show, is_open=is_open, before=before))
            before += len(jobs)


def hash_unit(unit: Unit) -> str:
    """What tells the rows of a unit from those of another, or of other code, whichever effects are hidden."""
    return hash_sources("plant", "fdi") + hashlib.sha256(pickle.dumps(replace(unit, effects=()))).hexdigest()[:16]


def _make_row(job: Injection, unit: Unit, key: str) -> Row:
    return judge_injection(job, unit) | {"key": key}


def _describe_failure(job: Injection, reason: str, key: str) -> Row:
    return {**job._asdict(), "key": key, "verdict": CRASHED, "effects": [], "is_named": False, "reason": reason}
