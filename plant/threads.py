"""Work side by side: kernels and numpy let go of Python's lock while they compute."""
from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


def count_threads() -> int:
    """One a core, or as many as OMP_NUM_THREADS says: how a cluster tells its workers to share a machine."""
    said = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, int(said)) if said.isdecimal() else os.cpu_count() or 1


def map_in_threads(do: Callable[[T], R], items: Iterable[T], workers: int) -> list[R]:
    """`do` of each item, in their order, by so many threads; a single item, or one worker, stays in this thread."""
    work = list(items)
    if min(workers, len(work)) < 2:
        return [do(item) for item in work]
    with ThreadPoolExecutor(min(workers, len(work))) as pool:
        return list(pool.map(do, work))
