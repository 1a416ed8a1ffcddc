"""Jobs in worker processes of this machine.

Workers are spawned, because a fork of a process that has threads may deadlock. When a worker dies (killed by the kernel
for its memory, crashed in a library), a new worker takes its place and its job is tried again.
"""
from __future__ import annotations

import contextlib
import os
import pickle
import signal
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from multiprocessing import connection, get_context
from pathlib import Path
from types import FrameType
from typing import Any, Generic, NamedTuple, TypeVar

from plant.errors import RigError
from rig.interrupts import ignore_interrupts
from rig.network.clock import WallClock

Job = TypeVar("Job")
Result = TypeVar("Result")


def run_in_processes(work: Callable[[Job], Result], jobs: Sequence[Job], processes: int,
                     describe_failure: Callable[[Job, str], Result], attempts: int = 3,
                     choose_limit: Callable[[Job], float] | None = None,
                     patience: float = 1.0) -> Iterator[tuple[Job, Result]]:
    """Each job with its result as soon as it is finished, in any order.

    Args:
        work: what to do with a job; a new process must be able to import it.
        jobs: the jobs; they and their results travel between processes by pickle.
        processes: number of workers.
        describe_failure: makes the result of a job from the job and the reason why it has none.
        attempts: a job that this many workers have died of has failed.
        choose_limit: the s that a job may take; the worker of one that takes longer is ended, and the job has failed.
            None: no limit.
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
        workers += [_Worker(work) for _ in range(min(processes, len(jobs)))]
        while workers:
            for worker in _find_overdue(workers, clock.now()):
                workers.remove(worker)
                worker.stop(patience)
                assert worker.job is not None and choose_limit is not None
                late = worker.job[0]
                if waiting:
                    workers.append(_Worker(work))
                yield late, describe_failure(late, f"it took longer than {choose_limit(late):g} s")
            for worker in _wait_for_messages(workers, clock.now()) if workers else []:
                finished = worker.job
                try:
                    message = worker.receive()
                except _WorkerDiedError:
                    workers.remove(worker)
                    worker.stop()
                    if finished is None:
                        raise RigError("a worker process died while it was starting") from None
                    job, attempt = finished
                    if attempt < attempts:
                        waiting.append((job, attempt + 1))
                    else:
                        yield job, describe_failure(job, describe_deaths(attempts, worker.process.exitcode))
                    if waiting:
                        workers.append(_Worker(work))
                    continue
                if waiting:
                    job, attempt = waiting.popleft()
                    limit = None if choose_limit is None else clock.now() + round(1e9 * choose_limit(job))
                    worker.assign((job, attempt), limit)
                else:
                    workers.remove(worker)
                    worker.stop()
                if finished is not None:
                    yield finished[0], message.unpack()
    finally:
        for worker in workers:  # all at once: each may need its time to come to an end
            worker.ask_to_stop()
        deadline = clock.now() + round(1e9 * patience)
        for worker in workers:
            worker.stop(max(0.0, 1e-9 * (deadline - clock.now())))


def describe_deaths(attempts: int, exit_code: int | None) -> str:
    """Why a job has no result whose workers died; `exit_code` is that of the last one, negative for a signal."""
    if attempts > 1:
        return f"each of {attempts} worker processes that tried it died"
    if exit_code is not None and exit_code < 0:
        return f"its process was ended by signal {-exit_code} ({signal.Signals(-exit_code).name})"
    return f"its process ended with status {exit_code}"


class _Message(NamedTuple):
    """What a worker sends: the result of its job, or the exception; neither when it has just started."""

    result: Any = None
    error: Exception | None = None

    def unpack(self) -> Any:
        """The result. Raises the exception if there is one."""
        if self.error is not None:
            raise self.error
        return self.result


class _WorkerDiedError(Exception):
    """The process at the other end of a connection has ended."""


class _Worker(Generic[Job]):
    """A worker process; `job` is the job it has, with the number of the attempt, or None when it has none."""

    def __init__(self, work: Callable[[Job], Any]) -> None:
        context = get_context("spawn")
        self.connection, far_end = context.Pipe()
        self.process = context.Process(target=_serve_jobs, args=(far_end, work), daemon=True)
        with ignore_interrupts():
            self.process.start()
        far_end.close()
        self.job: tuple[Job, int] | None = None
        self.due_ns: int | None = None  # when its job must have ended
        self.is_idle = False  # not before it has said that it has started

    def assign(self, job: tuple[Job, int], due_ns: int | None) -> None:
        """Give the worker a job and the number of the attempt, and the time when it must have ended."""
        self.job, self.is_idle, self.due_ns = job, False, due_ns
        with contextlib.suppress(OSError):  # it has died since; `receive` will notice
            self.connection.send(job[0])

    def receive(self) -> _Message:
        """The worker's message. Raises _WorkerDiedError."""
        try:
            message: _Message = self.connection.recv()
        except (EOFError, OSError):
            raise _WorkerDiedError from None
        self.job, self.is_idle, self.due_ns = None, True, None
        return message

    def ask_to_stop(self) -> None:
        """Ask the process to end: an idle one ends by itself, a busy one is terminated. Once is enough."""
        if self.connection.closed:
            return
        self.connection.close()
        if not self.is_idle:
            self.process.terminate()

    def stop(self, patience: float = 5.0) -> None:
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
    found = []
    for file in Path(f"/proc/{number}/task").glob("*/children"):
        with contextlib.suppress(OSError):  # the thread has ended
            found += [int(word) for word in file.read_text().split()]
    return [*found, *(below for child in found for below in list_descendants(child))]


def _find_overdue(workers: Sequence[_Worker[Job]], now_ns: int) -> list[_Worker[Job]]:
    """The workers whose job has taken too long."""
    return [worker for worker in workers
            if worker.due_ns is not None and now_ns >= worker.due_ns and not worker.connection.poll()]


def _wait_for_messages(workers: Sequence[_Worker[Job]], now_ns: int) -> list[_Worker[Job]]:
    """The workers that have sent something or have died; none if a job takes too long before that."""
    due = [worker.due_ns for worker in workers if worker.due_ns is not None]
    seconds = max(0.0, 1e-9 * (min(due) - now_ns)) if due else None
    ready = connection.wait([worker.connection for worker in workers], seconds)
    return [worker for worker in workers if worker.connection in ready]


def _serve_jobs(parent: Any, work: Callable[[Any], Any]) -> None:
    """The main function of a worker process: do the jobs that come until the parent closes the connection."""
    signal.signal(signal.SIGTERM, _exit_on_signal)
    with contextlib.suppress(EOFError, OSError):  # the parent has closed the connection, or is gone
        parent.send(_Message())
        while True:
            job = parent.recv()
            try:
                message = _Message(work(job))
            except Exception as error:
                message = _Message(error=_make_picklable(error))
            parent.send(message)


def _exit_on_signal(number: int, frame: FrameType | None) -> None:
    """End by an exception, so that `subprocess.run` in a job ends its own process, too.

    It is raised again and again until the process has ended: Python drops an exception that comes in a destructor or in
    a function that compiled code calls, as the compiler does.
    """
    signal.signal(signal.SIGALRM, _exit_on_signal)
    signal.setitimer(signal.ITIMER_REAL, 0.3)
    raise SystemExit(128 + signal.SIGTERM)


def _make_picklable(error: Exception) -> Exception:
    """The exception itself, or one with the same text if it cannot travel to another process."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error
