"""Jobs on the workers of a Dask cluster. Dask is optional: the extra `fleet`."""
from __future__ import annotations

import contextlib
import itertools
import logging
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from plant.errors import InputError, RigError
from rig.network.clock import WallClock

Job = TypeVar("Job")
Result = TypeVar("Result")

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
