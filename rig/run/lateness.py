"""Wake-up lateness of a periodic task on this machine, and the real-time rights it grants."""
from __future__ import annotations

import os
import resource
import threading
import time
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np

R = TypeVar("R")


class Lateness(NamedTuple):
    """Wake-up lateness of a periodic task, us: percentiles over all periods, and periods missed altogether."""

    p50: float
    p99: float
    p99_9: float
    max: float
    periods: int
    missed: int  # periods whose whole time was over at the wake-up


def summarise_lateness(late_ns: np.ndarray, period_ns: int) -> Lateness:
    """Summarise wake-ups that came `late_ns` (n,) after they were due."""
    p50, p99, p99_9 = (float(value) for value in np.percentile(late_ns, [50, 99, 99.9]) / 1e3)
    missed = int(np.count_nonzero(late_ns >= period_ns))
    return Lateness(p50, p99, p99_9, float(late_ns.max()) / 1e3, late_ns.size, missed)


def measure_timer_lateness(seconds: float, period_ns: int = 1_000_000) -> Lateness:
    """Sleep until t0 + k * period, as the real-time loop does, and note how late each wake-up is.

    Due times never move: a late wake-up does not push the next one, so lateness is not hidden by the sum of sleeps.
    """
    late = np.empty(max(1, round(seconds * 1e9 / period_ns)), dtype=np.int64)
    due = time.monotonic_ns()
    for k in range(late.size):
        due += period_ns
        if (rest := due - time.monotonic_ns()) > 0:
            time.sleep(rest / 1e9)
        late[k] = time.monotonic_ns() - due
    return summarise_lateness(late, period_ns)


def run_under_fifo(function: Callable[[], R], priority: int = 1) -> R | None:
    """`function()` in a thread of its own under SCHED_FIFO; None where the right to it is not granted."""
    result: list[R] = []

    def work() -> None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))  # 0: this thread only
        except OSError:
            return
        result.append(function())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    return result[0] if result else None


def read_clock_resolution_ns() -> float:
    """Resolution of the monotonic clock, ns."""
    return time.clock_getres(time.CLOCK_MONOTONIC) * 1e9


def read_memory_lock_limit() -> int:
    """Bytes that may be locked in memory; -1 means no limit (also for root, who is exempt)."""
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    return -1 if soft == resource.RLIM_INFINITY or os.geteuid() == 0 else soft


def read_priority_limit() -> int:
    """Highest real-time priority that may be asked for (RLIMIT_RTPRIO); 99 for root; 0 means none."""
    soft, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
    return 99 if os.geteuid() == 0 or soft == resource.RLIM_INFINITY else soft
