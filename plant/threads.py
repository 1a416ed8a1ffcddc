"""Runs work in threads: kernels and NumPy release the interpreter lock while they compute."""
from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

THREAD_NAME = "side_by_side"  # how the names of these threads begin
T = TypeVar("T")
R = TypeVar("R")


def count_threads() -> int:
    """One thread per core, or OMP_NUM_THREADS, by which a cluster tells its workers to share a machine."""
    said = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, int(said)) if said.isdecimal() else os.cpu_count() or 1


@contextlib.contextmanager
def _open_pool(workers: int) -> Iterator[ThreadPoolExecutor]:
    """Threads for a while. On Ctrl-C nobody waits for what is still at work, and what has not begun is dropped."""
    pool = ThreadPoolExecutor(workers, THREAD_NAME)
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    pool.shutdown()


def map_in_threads(do: Callable[[T], R], items: Iterable[T], workers: int) -> list[R]:
    """`do(item)` of each item, in order, in `workers` threads; a single item or one worker uses the calling thread."""
    work = list(items)
    if min(workers, len(work)) < 2:
        return [do(item) for item in work]
    with _open_pool(min(workers, len(work))) as pool:
        return list(pool.map(do, work))


def run_beside(do: Callable[[], R]) -> R:
    """`do()` in a thread beside the main one, so that Ctrl-C ends the wait for compiled code at once.

    In the main thread, Python notices Ctrl-C only where compiled code hands over its result, and numba 0.6x does not
    survive an exception there. Called from another thread, `do` runs in it.
    """
    if threading.current_thread() is not threading.main_thread():
        return do()
    with _open_pool(1) as pool:
        return pool.submit(do).result()
