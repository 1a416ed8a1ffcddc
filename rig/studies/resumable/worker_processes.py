"""Jobs in worker processes of this machine.

Workers are spawned, because a fork of a process that has threads may deadlock. When a worker dies (killed by the kernel
for its memory, crashed in a library), a new worker takes its place and its job is tried again.
"""
from __future__ import annotations

import contextlib
import pickle
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from multiprocessing import connection, get_context
from types import FrameType
from typing import Any, Generic, NamedTuple, TypeVar

from plant.errors import RigError

Job = TypeVar("Job")
Result = TypeVar("Result")


def run_in_processes(work: Callable[[Job], Result], jobs: Sequence[Job], processes: int,
                     describe_failure: Callable[[Job, str], Result], attempts: int = 3) -> Iterator[tuple[Job, Result]]:
    """Each job with its result as soon as it is finished, in any order.

    Args:
        work: what to do with a job; a new process must be able to import it.
        jobs: the jobs; they and their results travel between processes by pickle.
        processes: number of workers.
        describe_failure: makes the result of a job from the job and the reason why it has none.
        attempts: a job that this many workers have died of has failed.

    Raises:
        RigError: a worker process cannot start.
        Exception: whatever `work` raises.
    """
    waiting = deque((job, 1) for job in jobs)
    workers: list[_Worker[Job]] = []
    try:
        workers += [_Worker(work) for _ in range(min(processes, len(jobs)))]
        while workers:
            for worker in _wait_for_messages(workers):
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
                        yield job, describe_failure(job, f"each of {attempts} worker processes that tried it died")
                    if waiting:
                        workers.append(_Worker(work))
                    continue
                if waiting:
                    worker.assign(waiting.popleft())
                else:
                    workers.remove(worker)
                    worker.stop()
                if finished is not None:
                    yield finished[0], message.unpack()
    finally:
        for worker in workers:
            worker.stop()


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
        with _ignore_interrupts():
            self.process.start()
        far_end.close()
        self.job: tuple[Job, int] | None = None
        self.is_idle = False  # not before it has said that it has started

    def assign(self, job: tuple[Job, int]) -> None:
        """Give the worker a job and the number of the attempt."""
        self.job, self.is_idle = job, False
        with contextlib.suppress(OSError):  # it has died since; `receive` will notice
            self.connection.send(job[0])

    def receive(self) -> _Message:
        """The worker's message. Raises _WorkerDiedError."""
        try:
            message: _Message = self.connection.recv()
        except (EOFError, OSError):
            raise _WorkerDiedError from None
        self.job, self.is_idle = None, True
        return message

    def stop(self, patience: float = 5.0) -> None:
        """End the process: an idle one ends by itself, a busy one is terminated, and killed after `patience` s."""
        self.connection.close()
        if not self.is_idle:
            self.process.terminate()
        self.process.join(patience)
        self.process.kill()
        self.process.join()


def _wait_for_messages(workers: Sequence[_Worker[Job]]) -> list[_Worker[Job]]:
    """The workers that have sent something or have died, at least one."""
    ready = connection.wait([worker.connection for worker in workers])
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
    """End by an exception, so that `subprocess.run` in a job ends its own process, too."""
    raise SystemExit(128 + number)


def _make_picklable(error: Exception) -> Exception:
    """The exception itself, or one with the same text if it cannot travel to another process."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


@contextlib.contextmanager
def _ignore_interrupts() -> Iterator[None]:
    """Processes started inside ignore Ctrl-C, which the terminal sends to them as well; this process ends them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
