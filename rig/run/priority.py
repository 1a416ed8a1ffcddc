"""Real-time rights for the thread that runs the loop, as far as the machine grants them."""
from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import struct
import sys
import threading
from collections.abc import Collection, Iterator

SWITCH_INTERVAL = 50e-6  # s
LOOP_PRIORITY = 20  # of 99: above the desktop, below the kernel's own threads


@contextlib.contextmanager
def raise_priority(priority: int = LOOP_PRIORITY) -> Iterator[None]:
    """Run the calling thread under SCHED_FIFO where that is allowed; restore its priority afterwards.

    The process's other threads (the recorder) get the lowest real-time priority: while one of them holds the
    interpreter lock, other programs must not keep it from going on, for the loop would wait with it. A thread that has
    a real-time priority keeps it: a compiled loop that runs already (`enter_loop_thread`) is not to be slowed down.
    """
    others = [thread.native_id for thread in threading.enumerate() if thread is not threading.current_thread()]
    raised = [thread for thread in others if thread is not None and _is_ordinary(thread) and _set_fifo(thread, 1)]
    raised += [0] if _set_fifo(0, priority) else []
    try:
        yield
    finally:
        for thread in raised:
            with contextlib.suppress(OSError):  # it has ended meanwhile
                os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))


@contextlib.contextmanager
def enter_loop_thread(from_last: int = 2) -> Iterator[str]:
    """Give the calling thread the loop's priority and, where there are two CPUs or more, one of them for itself.

    The process's other threads get the other CPUs until the end. `from_last`: 1 is the last CPU, which the rig takes; 2
    the one before, for a node on the same machine. Yields the name of the scheduler that was granted.
    """
    _set_fifo(0, LOOP_PRIORITY)
    cpus = list_cpus()
    others = [thread.native_id for thread in threading.enumerate() if thread is not threading.current_thread()]
    moved = []
    if len(cpus) > 1:
        own = cpus[-min(from_last, len(cpus))]
        rest = [cpu for cpu in cpus if cpu != own]
        moved = [thread for thread in others if thread is not None and _set_cpus(thread, rest)]
        _set_cpus(0, [own])
    try:
        yield name_scheduler()
    finally:
        for thread in [0, *moved]:
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
    try:
        request = os.open("/dev/cpu_dma_latency", os.O_WRONLY)  # holds as long as it is open
    except OSError:
        yield
        return
    try:
        with contextlib.suppress(OSError):
            os.write(request, struct.pack("=i", 0))  # us
        yield
    finally:
        os.close(request)


def list_cpus() -> list[int]:
    """The CPUs that this thread may use."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))


@contextlib.contextmanager
def suspend_garbage_collection() -> Iterator[None]:
    """Switch garbage collection off, which takes ms, and make threads release the interpreter lock within 50 us.

    By default it may keep the lock for 5 ms, five cycles, while the loop waits for it.
    """
    collecting, interval = gc.isenabled(), sys.getswitchinterval()
    gc.disable()
    sys.setswitchinterval(SWITCH_INTERVAL)
    try:
        yield
    finally:
        sys.setswitchinterval(interval)
        if collecting:
            gc.enable()


def _is_ordinary(thread: int) -> bool:
    """Whether the kernel schedules a thread without real-time priority."""
    try:
        return os.sched_getscheduler(thread) == os.SCHED_OTHER
    except (AttributeError, OSError):  # not Linux; or the thread has ended
        return False


def _set_fifo(thread: int, priority: int) -> bool:
    try:
        os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
    except (AttributeError, OSError):
        return False
    return True


def _set_cpus(thread: int, cpus: Collection[int]) -> bool:
    try:
        os.sched_setaffinity(thread, cpus)
    except (AttributeError, OSError):  # not Linux; or the thread has ended
        return False
    return True


def name_scheduler() -> str:
    """How the kernel schedules this thread."""
    names = {os.SCHED_OTHER: "SCHED_OTHER", os.SCHED_FIFO: "SCHED_FIFO", os.SCHED_RR: "SCHED_RR"}
    return names.get(os.sched_getscheduler(0), "unknown") if hasattr(os, "sched_getscheduler") else "unknown"
