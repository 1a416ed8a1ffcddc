"""Who does the cases: this process, worker processes of our own, or those of a Dask cluster. The same work, any order.

Our own workers are a Dask cluster as well, on 127.0.0.1: one way for both, and a worker that dies is replaced and its
case done again.
"""
from __future__ import annotations

import contextlib
import itertools
import logging
import os
import signal
import threading
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from plant.errors import InputError, RigError
from rig.network.clock import WallClock
from rig.studies.campaign.case import Row, one, told
from rig.studies.campaign.matrix import Case

HOST = "127.0.0.1"
IN_FLIGHT = 400  # cases that a cluster is given ahead of time
ANSWER = 20  # s, within which a scheduler answers and has a worker
LOST = 30  # s without a result, after which it is asked whether there is still a worker
NS = 1_000_000_000


def here(cases: Iterable[Case], spec: Mapping[str, Any], code: str) -> Iterator[Row]:
    """Rows, one after the other, by this process alone."""
    return (one(case, spec, code) for case in cases)


@contextlib.contextmanager
def own(jobs: int) -> Iterator[Any]:
    """A Dask client of `jobs` worker processes on this machine, reachable from it alone.

    Raises:
        InputError: Dask is not installed.
    """
    distributed = _distributed()
    with _no_interrupt():
        cluster = distributed.LocalCluster(n_workers=jobs, threads_per_worker=1, host=HOST, memory_limit=0,
                                           dashboard_address=f"{HOST}:0", silence_logs=logging.CRITICAL)
    with cluster, distributed.Client(cluster) as client:
        yield client


@contextlib.contextmanager
def _no_interrupt() -> Iterator[None]:
    """What is started now never hears of Ctrl-C: that is for this process, which ends the others."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def at(address: str) -> Iterator[Any]:
    """A Dask client of the scheduler at an address, tcp://HOST:PORT.

    Raises:
        InputError: Dask is not installed, nobody answers there, or there is no worker.
    """
    distributed = _distributed()
    try:
        client = distributed.Client(address, timeout=ANSWER)
    except (OSError, ValueError, TypeError) as error:
        raise InputError("--scheduler", address, f"the address of a Dask scheduler, such as tcp://{HOST}:8786 "
                         f"({type(error).__name__})") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=ANSWER)
        except TimeoutError:
            raise InputError("--scheduler", address, "a scheduler that has workers (dask worker ADDRESS)") from None
        yield client


def by(client: Any, cases: Iterable[Case], spec: Mapping[str, Any], code: str) -> Iterator[Row]:
    """Rows as they come from a cluster's workers; the case of a worker that died is done by another.

    Raises:
        RigError: the cluster is gone.
    """
    distributed = _distributed()
    left, ordered = iter(cases), {}
    shared = {key: value for key, value in spec.items() if key not in ("case", "files")}  # small: not scattered,
    # since what is scattered dies with the worker that holds it
    coming = distributed.as_completed(loop=client.loop)

    def order(count: int) -> None:
        for case in itertools.islice(left, count):
            future = client.submit(_on_worker, case, shared, code, pure=False)
            ordered[future] = case
            coming.add(future)

    order(IN_FLIGHT)
    for future in _arrived(coming, client):
        yield _row(future, ordered.pop(future), shared)
        order(1)


def _arrived(coming: Any, client: Any) -> Iterator[Any]:
    """The futures as they are done. Raises RigError when all workers have gone and none comes back."""
    clock, seen = WallClock(), 0
    while not coming.is_empty():
        batch = coming.next_batch(block=False)
        yield from batch
        if batch:
            seen = clock.now()
        elif clock.now() - seen < LOST * NS:
            clock.sleep_until(clock.now() + NS // 50)
        elif client.nthreads():
            seen = clock.now()
        else:
            raise RigError(f"the cluster has had no worker for {LOST} s; what is finished is kept, the same command "
                           "goes on")


def _row(future: Any, case: Case, spec: Mapping[str, Any]) -> Row:
    """What came of a case; one that has cost several workers their lives has failed."""
    try:
        row: Row = future.result()
    except RigError:
        raise
    except Exception as error:
        if future.cancelled() or future.status == "lost":
            raise RigError("the cluster is gone; what is finished is kept, the same command goes on") from None
        killed = type(error).__name__ == "KilledWorker"
        why = "every worker that tried it died" if killed else " ".join(str(error).split())
        row = told(case, spec) | {"reason": f"{type(error).__name__}: {why}"}
    return row


def _on_worker(case: Case, spec: Mapping[str, Any], code: str) -> Row:
    """One of several processes on its machine: no threads beside its own (see `plant.threads.threads`)."""
    os.environ["OMP_NUM_THREADS"] = "1"
    return one(case, spec, code)


def _distributed() -> Any:
    try:
        import distributed
    except ImportError:
        raise InputError("distributed", "", "the extra: pip install 'eha-rig[fleet]'") from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what goes wrong is told once, in one line
    return distributed
