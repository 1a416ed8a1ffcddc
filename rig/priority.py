"""Real-time rights for the thread that runs the loop, as far as the machine grants them."""
from __future__ import annotations

import contextlib
import gc
import os
from collections.abc import Iterator

PRIORITY = 20  # of 99: above the desktop, below the kernel's own threads


@contextlib.contextmanager
def elevated() -> Iterator[None]:
    """The calling thread under SCHED_FIFO where that is allowed; as before afterwards.

    Threads that are there already (the recorder) keep their scheduling: the loop must not wait for the disk.
    """
    granted = _fifo()
    try:
        yield
    finally:
        if granted:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@contextlib.contextmanager
def uncollected() -> Iterator[None]:
    """No garbage collection: going through a long run's rows takes ms, and the loop makes no cycles to collect."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


def _fifo() -> bool:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except (AttributeError, OSError):
        return False
    return True


def scheduler() -> str:
    """How the kernel schedules this thread."""
    names = {os.SCHED_OTHER: "SCHED_OTHER", os.SCHED_FIFO: "SCHED_FIFO", os.SCHED_RR: "SCHED_RR"}
    return names.get(os.sched_getscheduler(0), "unknown") if hasattr(os, "sched_getscheduler") else "unknown"
