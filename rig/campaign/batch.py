"""A batch of independent jobs: done here, in processes or on a cluster, in any order, resumed where it was interrupted.

Each row is a pure function of its job. It therefore does not matter which worker does a job, or when: the rows are the
same. Finished rows are kept in a row file; jobs that have a valid row there are not done again.
"""
from __future__ import annotations

import contextlib
import itertools
import logging
import os
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar

from plant.errors import InputError, RigError
from rig.campaign.row_file import Row, RowFile
from rig.campaign.worker_processes import run_in_processes
from rig.network.clock import WallClock

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



SECOND = 1_000_000_000  # ns


@contextlib.contextmanager
def connect_to_cluster(address: str, timeout: float = 20.0) -> Iterator[Any]:
    """A Dask client of the scheduler at `address`, tcp://HOST:PORT; `timeout` in s.

    Raises:
        InputError: Dask is not installed, no scheduler answers at the address, or it has no worker.
    """
    distributed = _import_distributed()
    try:
        client = distributed.Client(address, timeout=timeout)
    except (OSError, ValueError, TypeError) as error:
        raise InputError("--scheduler", address, "the address of a Dask scheduler, such as tcp://127.0.0.1:8786 "
                         f"({type(error).__name__})") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=timeout)
        except TimeoutError:
            raise InputError("--scheduler", address, "a scheduler that has workers (dask worker ADDRESS)") from None
        yield client


def run_on_cluster(client: Any, work: Callable[[Job], Result], jobs: Sequence[Job],
                   describe_failure: Callable[[Job, str], Result], ahead: int = 400) -> Iterator[tuple[Job, Result]]:
    """Each job with its result as soon as it is finished, in any order; Dask retries the job of a worker that died.

    `work` travels with every job: data scattered in advance would be lost with the worker that holds it. At most
    `ahead` jobs are submitted and not finished.

    Raises:
        RigError: the cluster is gone, or `work` raises it.
    """
    waiting, submitted = iter(jobs), {}
    finished = _import_distributed().as_completed(loop=client.loop)

    def submit(count: int) -> None:
        for job in itertools.islice(waiting, count):
            future = client.submit(work, job, pure=False)
            submitted[future] = job
            finished.add(future)

    submit(ahead)
    for future in _wait_for_futures(finished, client):
        job = submitted.pop(future)
        yield job, take_result(future, job, describe_failure)
        submit(1)


def take_result(future: Any, job: Job, describe_failure: Callable[[Job, str], Result]) -> Result:
    """The result of a finished future, or the description of its failure.

    Raises:
        RigError: the cluster is gone, or the job raised it.
    """
    try:
        result: Result = future.result()
    except RigError:
        raise
    except Exception as error:
        if future.cancelled() or future.status == "lost":
            raise RigError("the cluster is gone; finished cases are kept, and the same command resumes") from None
        if type(error).__name__ == "KilledWorker":
            return describe_failure(job, "KilledWorker: every worker that tried it died")
        return describe_failure(job, f"{type(error).__name__}: {' '.join(str(error).split())}")
    return result


def _wait_for_futures(finished: Any, client: Any, patience: float = 30.0) -> Iterator[Any]:
    """The futures as they are done.

    Raises:
        RigError: nothing has finished for `patience` s, and there is no worker.
    """
    clock, last = WallClock(), 0
    while not finished.is_empty():
        batch = finished.next_batch(block=False)
        yield from batch
        if batch:
            last = clock.now()
        elif clock.now() - last < patience * SECOND:
            clock.sleep_until(clock.now() + SECOND // 50)
        elif client.nthreads():
            last = clock.now()
        else:
            raise RigError(f"the cluster has had no worker for {patience:g} s; finished cases are kept, and the same "
                           "command resumes")


def _import_distributed() -> Any:
    """The module `distributed`, with its log silenced: errors are reported once, in one line.

    Raises:
        InputError: it is not installed.
    """
    try:
        import distributed
    except ImportError:
        raise InputError("distributed", "", "the extra: pip install 'eha-rig[fleet]'") from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    return distributed
