"""Runs work in threads: kernels and NumPy release the interpreter lock while they compute."""
from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

THREAD_NAME = "side_by_side"  # how the names of these threads begin
T = TypeVar("T")
R = TypeVar("R")


def count_threads() -> int:
    """One thread per core, or OMP_NUM_THREADS, by which a cluster tells its workers to share a machine."""
    said = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, int(said)) if said.isdecimal() else os.cpu_count() or 1


def map_in_threads(do: Callable[[T], R], items: Iterable[T], workers: int) -> list[R]:
    """`do(item)` of each item, in order, in `workers` threads; a single item or one worker uses the calling thread."""
    work = list(items)
    if min(workers, len(work)) < 2:
        return [do(item) for item in work]
    pool = ThreadPoolExecutor(min(workers, len(work)), THREAD_NAME)
    try:
        found = list(pool.map(do, work))
    except BaseException:  # Ctrl-C: nobody waits for what is still at work
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    pool.shutdown()
    return found
