"""A batch of independent jobs: done here, in processes or on a cluster, in any order, resumed where it was interrupted.

Each row is a pure function of its job. It therefore does not matter which worker does a job, or when: the rows are the
same. Finished rows are kept in a row file; jobs that have a valid row there are not done again.
"""
from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Generator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar

from rig.network.clock import WallClock
from rig.studies.resumable.dask_cluster import connect_to_cluster, run_on_cluster
from rig.studies.resumable.row_file import Row, RowFile
from rig.studies.resumable.worker_processes import run_in_processes

Job = TypeVar("Job")
Result = TypeVar("Result")


class Workers(NamedTuple):
    """Where jobs are done."""

    processes: int = 1  # on this machine; one is this process itself
    scheduler: str = ""  # address of a Dask scheduler; if given, its workers do the jobs
    single_threaded: bool = False  # limit each worker process to one thread (see `plant.threads`)


class Batch(NamedTuple):
    """Jobs, and how to make and recognise their rows."""

    jobs: Mapping[int, Any]  # number of the job to its description
    work: Callable[[Any], Row]  # from a description to its row; importable by other processes
    key: str  # field of a row that holds the number of its job
    describe_failure: Callable[[Any, str], Row]  # the row of a job whose workers died, from description and reason
    is_valid: Callable[[Row], bool]  # whether a row in the file still counts; if not, its job is done again
    is_failed: Callable[[Row], bool]


class BatchProgress(NamedTuple):
    """How far a batch is, after each finished job."""

    done: int  # jobs with a row, earlier ones included
    total: int
    failed: int  # of the jobs done since the start
    left: float  # s, estimated from the pace since the start
    row: Row  # of the job that has just finished


def run_batch(batch: Batch, file: RowFile, workers: Workers, report_progress: Callable[[BatchProgress], None]
              ) -> dict[int, Row]:
    """Do the jobs that have no valid row in the file; the rows of all jobs by number, in the batch's order.

    Raises:
        InputError: no cluster at the scheduler's address, or Dask is not installed.
        RigError: the cluster is gone, or a worker process cannot start.
        Exception: whatever the batch's `work` raises.
    """
    rows = {row[batch.key]: row for row in file.rows if row.get(batch.key) in batch.jobs and batch.is_valid(row)}
    missing = [job for number, job in batch.jobs.items() if number not in rows]
    clock, before, failed = WallClock(), len(rows), 0
    with contextlib.closing(run_jobs(batch.work, missing, workers, batch.describe_failure)) as results:
        for finished, (_, row) in enumerate(results, start=1):
            file.append(row)
            rows[row[batch.key]] = row
            failed += batch.is_failed(row)
            left = clock.now() * 1e-9 / finished * (len(missing) - finished)
            report_progress(BatchProgress(before + finished, len(batch.jobs), failed, left, row))
    return {number: rows[number] for number in batch.jobs}


def run_jobs(work: Callable[[Job], Result], jobs: Sequence[Job], workers: Workers,
             describe_failure: Callable[[Job, str], Result]) -> Generator[tuple[Job, Result], None, None]:
    """Each job with its result as soon as it is finished; see `run_batch` for what it raises."""
    if not jobs:
        return
    remote = partial(_work_single_threaded, work) if workers.single_threaded else work
    if workers.scheduler:
        with connect_to_cluster(workers.scheduler) as client:
            yield from run_on_cluster(client, remote, jobs, describe_failure)
    elif min(workers.processes, len(jobs)) > 1:
        yield from run_in_processes(remote, jobs, workers.processes, describe_failure)
    else:
        for job in jobs:
            yield job, work(job)


def _work_single_threaded(work: Callable[[Job], Result], job: Job) -> Result:
    """Do a job in a process that shares its machine with other workers."""
    os.environ["OMP_NUM_THREADS"] = "1"
    return work(job)
