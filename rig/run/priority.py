"""Real-time rights for the thread that runs the loop, as far as the machine grants them."""

import contextlib
import ctypes
import gc
import os
import resource
import struct
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

SWITCH_INTERVAL = 50e-6  # s
LOOP_PRIORITY = 20  # of 99: above the desktop, below the kernel's own threads
PERCENTILES = ("p50", "p99", "p99_9", "max")


@contextlib.contextmanager
def enter_real_time(priority: int) -> Iterator[None]:
    """What a run in real time takes of the machine: priority, memory, awake CPUs, no garbage collection."""
    with raise_priority(priority), lock_memory(), prevent_deep_sleep(), suspend_garbage_collection():
        yield


@contextlib.contextmanager
def raise_priority(priority: int = LOOP_PRIORITY) -> Iterator[None]:
    """Run the calling thread under SCHED_FIFO where that is allowed; restore its priority afterwards.

    The process's other threads (the recorder) get the lowest real-time priority: while one of them holds the
    interpreter lock, other programs must not keep it from going on, for the loop would wait with it. A thread that has
    a real-time priority keeps it: a compiled loop that runs already (`enter_loop_thread`) is not to be slowed down.
    """
    threads = [*(thread for thread in _list_other_threads() if _is_ordinary(thread) and _set_fifo(thread, 1)),
               *([0] if _set_fifo(0, priority) else [])]
    try:
        yield
    finally:
        for thread in threads:
            _is_granted(os.sched_setscheduler, thread, os.SCHED_OTHER, os.sched_param(0))


@contextlib.contextmanager
def enter_loop_thread(from_last: int = 2) -> Iterator[str]:
    """Give the calling thread the loop's priority and, where there are two CPUs or more, one of them for itself.

    The process's other threads get the other CPUs until the end. `from_last`: 1 is the last CPU, which the rig takes; 2
    the one before, for a node on the same machine. Yields the name of the scheduler that was granted.
    """
    _set_fifo(0, LOOP_PRIORITY)
    cpus = list_cpus()
    threads = []
    if len(cpus) > 1:
        loop_cpu = cpus[-min(from_last, len(cpus))]
        rest = [cpu for cpu in cpus if cpu != loop_cpu]
        threads = [thread for thread in _list_other_threads() if _set_cpus(thread, rest)]
        _set_cpus(0, [loop_cpu])
    try:
        yield name_scheduler()
    finally:
        for thread in [0, *threads]:
            _set_cpus(thread, cpus)


@contextlib.contextmanager
def lock_memory() -> Iterator[bool]:
    """Keep the pages of this process in memory once they are there, and as they are: the loop meets no page fault.

    The kernel otherwise collects pages of large arrays into huge ones every ten seconds, and a thread that touches them
    meanwhile waits: 6 ms were measured, six cycles. Yields whether the machine allows the lock (root, or RLIMIT_MEMLOCK
    unlimited).
    """
    library = ctypes.CDLL(None)
    current, future, on_fault = 1, 2, 4  # sys/mman.h
    keep_small_pages = 41  # PR_SET_THP_DISABLE, linux/prctl.h; needs no rights
    library.prctl(keep_small_pages, 1, 0, 0, 0)
    is_locked = library.mlockall(current | future | on_fault) == 0
    try:
        yield is_locked
    finally:
        if is_locked:
            library.munlockall()
        library.prctl(keep_small_pages, 0, 0, 0, 0)


@contextlib.contextmanager
def prevent_deep_sleep() -> Iterator[None]:
    """Keep idle CPUs in states that they leave at once, where the machine allows it (root); as cyclictest does."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):
            request = os.open("/dev/cpu_dma_latency", os.O_WRONLY)  # holds as long as it is open
            stack.callback(os.close, request)
            os.write(request, struct.pack("=i", 0))  # us
        yield


def list_cpus() -> list[int]:
    """The CPUs that this thread may use."""
    return sorted(os.sched_getaffinity(0))


@contextlib.contextmanager
def suspend_garbage_collection() -> Iterator[None]:
    """Switch garbage collection off, which takes ms, and make threads release the interpreter lock within 50 us.

    By default it may keep the lock for 5 ms, five cycles, while the loop waits for it.
    """
    is_collecting, interval = gc.isenabled(), sys.getswitchinterval()
    gc.disable()
    sys.setswitchinterval(SWITCH_INTERVAL)
    try:
        yield
    finally:
        sys.setswitchinterval(interval)
        if is_collecting:
            gc.enable()


def _is_ordinary(thread: int) -> bool:
    """Whether the kernel schedules a thread without real-time priority."""
    try:
        return os.sched_getscheduler(thread) == os.SCHED_OTHER
    except OSError:  # the thread has ended
        return False


def _set_fifo(thread: int, priority: int) -> bool:
    return _is_granted(os.sched_setscheduler, thread, os.SCHED_FIFO, os.sched_param(priority))


def _set_cpus(thread: int, cpus: Collection[int]) -> bool:
    return _is_granted(os.sched_setaffinity, thread, cpus)


def _is_granted(ask: Callable[..., None], *arguments: object) -> bool:
    """Ask the kernel for something; False without the right to it, and for a thread that has ended."""
    try:
        ask(*arguments)
    except OSError:
        return False
    return True


def _list_other_threads() -> list[int]:
    return [thread.native_id for thread in threading.enumerate()
            if thread is not threading.current_thread() and thread.native_id is not None]


def name_scheduler() -> str:
    """How the kernel schedules this thread."""
    names = {os.SCHED_OTHER: "SCHED_OTHER", os.SCHED_FIFO: "SCHED_FIFO", os.SCHED_RR: "SCHED_RR"}
    return names.get(os.sched_getscheduler(0), "unknown")


def compute_percentiles(seconds: NDArray[np.floating]) -> dict[str, float]:
    """p50, p99, p99.9 and the largest of the times that are not missing, us; nothing if all are."""
    times = seconds[~np.isnan(seconds)] * 1e6
    if not len(times):
        return {}
    return dict(zip(PERCENTILES, np.percentile(times, (50, 99, 99.9, 100)).tolist(), strict=True))


def is_fifo_granted() -> bool:
    """Whether a thread may run under SCHED_FIFO."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(_set_fifo, 0, 1).result()  # 0: this thread only


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
