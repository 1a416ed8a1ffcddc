"""A batch of independent jobs: done here, in processes or on a cluster, in any order, resumed where it was interrupted.

Each row is a pure function of its job. It therefore does not matter which worker does a job, or when: the rows are the
same. Finished rows are kept in a row file; jobs that have a valid row there are not done again.
"""
from __future__ import annotations

import contextlib
import fcntl
import importlib
import itertools
import json
import logging
import os
import pickle
import signal
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from functools import partial
from multiprocessing import connection, get_context
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from plant import InputError, RigError, report_system_error
from rig.interrupts import describe_exit, end_with, exit_on_signal, ignore_interrupts
from rig.network import WallClock

Job = TypeVar("Job")
Result = TypeVar("Result")


class Workers(NamedTuple):
    """Where jobs are done."""

    processes: int = 1  # on this machine; one is this process itself
    scheduler: str = ""  # address of a Dask scheduler; if given, its workers do the jobs


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
    clock, before, failures = WallClock(), len(rows), 0
    with contextlib.closing(run_jobs(batch.work, missing, workers, batch.describe_failure)) as results:
        for count, (_, row) in enumerate(results, start=1):
            file.append(row)
            rows[row[batch.key]] = row
            failures += batch.is_failed(row)
            time_left = clock.now() * 1e-9 / count * (len(missing) - count)
            report_progress(BatchProgress(before + count, len(batch.jobs), failures, time_left, row))
    return {number: rows[number] for number in batch.jobs}


def run_jobs(work: Callable[[Job], Result], jobs: Sequence[Job], workers: Workers,
             describe_failure: Callable[[Job, str], Result]) -> Generator[tuple[Job, Result], None, None]:
    """Each job with its result as soon as it is finished; see `run_batch` for what it raises."""
    if not jobs:
        return
    remote = partial(_work_single_threaded, work)
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
UNLIMITED = 1e9  # s; no job takes so long


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
    futures = _import_distributed().as_completed(loop=client.loop)

    def submit(count: int) -> None:
        for job in itertools.islice(waiting, count):
            future = client.submit(work, job, pure=False)
            submitted[future] = job
            futures.add(future)

    submit(ahead)
    for future in _wait_for_futures(futures, client):
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


def _wait_for_futures(futures: Any, client: Any, patience: float = 30.0) -> Iterator[Any]:
    """The futures as they are done.

    Raises:
        RigError: nothing has finished for `patience` s, and there is no worker.
    """
    clock, last = WallClock(), 0
    while not futures.is_empty():
        batch = futures.next_batch(block=False)
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
    """The module `distributed`, with its log silenced: errors are reported once, in one line."""
    distributed = import_extra("distributed")  # which sets the level of its log
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    return distributed


def import_extra(name: str) -> Any:
    """A module of the extra `fleet`; raises InputError if it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise InputError(name, "", "the extra: pip install 'eha-rig[fleet]'") from None


Row = dict[str, Any]


class RowFile(contextlib.AbstractContextManager["RowFile"]):
    """A row file opened for appending, locked against other processes.

    `rows` are the rows of the file, in the order in which they were written, including those appended since.

    Raises:
        InputError: the file cannot be written, or another process has it open.
    """

    def __init__(self, path: Path) -> None:
        with report_system_error(path.parent, "", "a folder that can be written"):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("a+", encoding="utf-8")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._file.close()
            raise InputError(path.parent, "", "a folder in which no other rig process is at work") from None
        self.rows = read_rows(path)
        if path.read_bytes()[-1:] not in (b"", b"\n"):  # behind an incomplete line
            self._file.write("\n")
            self._file.flush()

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def append(self, row: Row) -> None:
        """Write a row and wait until it is on disk."""
        self._file.write(json.dumps(row) + "\n")
        self._file.flush()
        os.fsync(self._file.fileno())
        self.rows.append(row)


def read_rows(path: Path) -> list[Row]:
    """The rows of a file, without truncated lines; none if there is no such file."""
    if not path.exists():
        return []
    rows = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        with contextlib.suppress(json.JSONDecodeError, RecursionError):
            rows.append(json.loads(line))
    return [row for row in rows if isinstance(row, dict)]


def run_in_processes(work: Callable[[Job], Result], jobs: Sequence[Job], processes: int,
                     describe_failure: Callable[[Job, str], Result], attempts: int = 3,
                     choose_limit: Callable[[Job], float] = lambda _: UNLIMITED,
                     patience: float = 1.0) -> Iterator[tuple[Job, Result]]:
    """Each job with its result as soon as it is finished, in any order.

    Args:
        work: what to do with a job; a new process must be able to import it.
        jobs: the jobs; they and their results travel between processes by pickle.
        processes: number of workers.
        describe_failure: makes the result of a job from the job and the reason why it has none.
        attempts: a job that this many workers have died of has failed.
        choose_limit: the s that a job may take; the worker of one that takes longer is ended, and the job has failed.
        patience: s that the workers together have to end their jobs when they are told to stop. Then they are killed
            with the processes that they started: compiled code may run for seconds before Python sees a signal.

    Raises:
        RigError: a worker process cannot start.
        Exception: whatever `work` raises.
    """
    waiting = deque((job, 1) for job in jobs)
    workers: list[_Worker[Job]] = []
    clock = WallClock()
    try:
        while waiting or workers:
            while waiting and len(workers) < min(processes, len(jobs)):
                workers.append(_Worker(work))
            for worker in _wait_for_messages(workers, clock):
                job, attempt = worker.job, worker.attempt
                state, result = worker.receive()
                if state in (_STARTED, _DONE, _RAISED) and waiting:
                    worker.start_job(*waiting.popleft())
                    worker.due_ns = clock.now() + round(1e9 * choose_limit(worker.job))
                else:
                    workers.remove(worker)
                    worker.stop(patience if state == _LATE else 5.0)
                if state == _STARTED:
                    continue
                if state == _RAISED:
                    raise result
                if state == _DIED and not attempt:
                    raise RigError("a worker process died while it was starting")
                if state == _DIED and attempt < attempts:
                    waiting.append((job, attempt + 1))
                    continue
                if state == _DIED:
                    result = describe_failure(job, describe_exit(worker.process.exitcode or 0) if attempts == 1 else
                                              f"each of {attempts} worker processes that tried it died")
                elif state == _LATE:
                    result = describe_failure(job, f"it took longer than {choose_limit(job):g} s")
                yield job, result
    finally:
        for worker in workers:  # all at once: each may need its time to come to an end
            worker.ask_to_stop()
        deadline = clock.now() + round(1e9 * patience)
        for worker in workers:
            worker.stop(max(0.0, 1e-9 * (deadline - clock.now())))


_STARTED, _DONE, _RAISED, _DIED, _LATE = range(5)  # what becomes of a worker: the first three it says itself


class _Worker(Generic[Job]):
    """A worker process; `job` is the one it has, and `attempt` counts those that have tried it, 0 before the first."""

    def __init__(self, work: Callable[[Job], Any]) -> None:
        context = get_context("spawn")
        self.connection, far_end = context.Pipe()
        self.process = context.Process(target=_serve_jobs, args=(far_end, work, os.getpid()), daemon=True)
        with ignore_interrupts():
            self.process.start()
        far_end.close()
        self.job: Any = None
        self.attempt = 0
        self.due_ns = round(1e9 * UNLIMITED)  # when its job must have ended
        self.is_idle = False  # not before it has said that it has started

    def start_job(self, job: Job, attempt: int) -> None:
        """Send the worker a job, with the number of the attempt."""
        self.job, self.attempt, self.is_idle = job, attempt, False
        with contextlib.suppress(OSError):  # it has died since; `receive` will notice
            self.connection.send(job)

    def receive(self) -> tuple[int, Any]:
        """What has become of the worker, and the result or exception of its job."""
        if not self.connection.poll():
            return _LATE, None
        try:
            message: tuple[int, Any] = self.connection.recv()
        except (EOFError, OSError):
            return _DIED, None
        self.is_idle = True
        return message

    def ask_to_stop(self) -> None:
        """Ask the process to end: an idle one ends by itself, a busy one is terminated. Once is enough."""
        if self.connection.closed:
            return
        self.connection.close()
        if not self.is_idle:
            self.process.terminate()

    def stop(self, patience: float) -> None:
        """End the process; after `patience` s it is killed, with the processes that it started."""
        self.ask_to_stop()
        self.process.join(patience)
        if self.process.is_alive() and self.process.pid is not None:
            for number in list_descendants(self.process.pid):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(number, signal.SIGKILL)
        self.process.kill()
        self.process.join()


def list_descendants(number: int) -> list[int]:
    """The processes that a process and their own ones started, where the kernel lists them (Linux)."""
    children = []
    for file in Path(f"/proc/{number}/task").glob("*/children"):
        with contextlib.suppress(OSError):  # the thread has ended
            children += [int(word) for word in file.read_text().split()]
    return [*children, *(below for child in children for below in list_descendants(child))]


def _wait_for_messages(workers: Sequence[_Worker[Job]], clock: WallClock) -> list[_Worker[Job]]:
    """The workers that have sent something, have died or have taken too long."""
    seconds = 1e-9 * (min(worker.due_ns for worker in workers) - clock.now())
    ready = connection.wait([worker.connection for worker in workers], min(max(seconds, 0.0), 3600.0))
    now = clock.now()
    return [worker for worker in workers if worker.connection in ready or worker.due_ns <= now]


def _serve_jobs(parent: Any, work: Callable[[Any], Any], parent_id: int) -> None:
    """The main function of a worker process: do the jobs that come until the parent closes the connection, or ends."""
    end_with(parent_id)
    signal.signal(signal.SIGTERM, exit_on_signal)
    with contextlib.suppress(EOFError, OSError):  # the parent has closed the connection, or is gone
        parent.send((_STARTED, None))
        while True:
            job = parent.recv()
            try:
                message = _DONE, work(job)
            except Exception as error:
                message = _RAISED, _make_picklable(error)
            parent.send(message)


def _make_picklable(error: Exception) -> Exception:
    """The exception itself, or one with the same text if it cannot travel to another process."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error
