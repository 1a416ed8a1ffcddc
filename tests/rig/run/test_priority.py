"""Real-time rights: taken where they are granted, given back, and taken for all threads of the process."""

import contextlib
import ctypes
import gc
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from rig.run import LOOP_PRIORITY, enter_loop_thread, list_cpus, lock_memory, raise_priority
from rig.run.priority import SWITCH_INTERVAL, name_scheduler, suspend_garbage_collection


def allowed() -> bool:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except OSError:
        return False
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return True


@pytest.mark.skipif(not allowed(), reason="SCHED_FIFO is not allowed here; as root, or with an rtprio limit, it is")
def test_all_threads_are_raised_and_lowered() -> None:
    done = threading.Event()
    helper = threading.Thread(target=done.wait)
    helper.start()
    other = helper.native_id or 0
    try:
        with raise_priority():
            assert name_scheduler() == "SCHED_FIFO" and os.sched_getparam(0).sched_priority == LOOP_PRIORITY
            assert os.sched_getscheduler(other) == os.SCHED_FIFO and os.sched_getparam(other).sched_priority == 1
        assert name_scheduler() == "SCHED_OTHER" and os.sched_getscheduler(other) == os.SCHED_OTHER
    finally:
        done.set()
        helper.join()


@contextlib.contextmanager
def run_loop(from_last: int = 2) -> Iterator[tuple[threading.Thread, list[int]]]:
    """A thread that is in `enter_loop_thread` until the end, and the CPUs that it may use."""
    loop_cpus: list[int] = []
    entered, done = threading.Event(), threading.Event()

    def run() -> None:
        with enter_loop_thread(from_last):
            loop_cpus.extend(list_cpus())
            entered.set()
            done.wait()

    loop = threading.Thread(target=run)
    loop.start()
    try:
        assert entered.wait(120)
        yield loop, loop_cpus
    finally:
        done.set()
        loop.join()


@pytest.mark.skipif(not allowed(), reason="SCHED_FIFO is not allowed here; as root, or with an rtprio limit, it is")
def test_a_loop_that_runs_already_keeps_its_priority() -> None:
    with run_loop() as (loop, _), raise_priority(1):
        assert os.sched_getparam(loop.native_id or 0).sched_priority == LOOP_PRIORITY


@pytest.mark.skipif(len(list_cpus()) < 2, reason="one CPU is not divided")
@pytest.mark.parametrize("from_last", [1, 2])
def test_the_thread_of_a_loop_has_a_cpu_for_itself(from_last: int) -> None:
    cpus = list_cpus()
    with run_loop(from_last) as (_, loop_cpus):
        assert loop_cpus == [cpus[-from_last]] and list_cpus() == [cpu for cpu in cpus if cpu not in loop_cpus]
    assert list_cpus() == cpus


def test_memory_is_locked_and_unlocked() -> None:
    """Meanwhile the kernel does not collect pages into huge ones: a loop that touches them waits for milliseconds."""
    library = ctypes.CDLL(None)
    before = library.prctl(42, 0, 0, 0, 0)  # PR_GET_THP_DISABLE
    with lock_memory() as is_locked:
        assert (read_locked_kilobytes() > 0) == is_locked and library.prctl(42, 0, 0, 0, 0) == 1
    assert read_locked_kilobytes() == 0 and library.prctl(42, 0, 0, 0, 0) == before == 0


def read_locked_kilobytes() -> int:
    return int(Path("/proc/self/status").read_text().partition("VmLck:")[2].split()[0])


@pytest.mark.parametrize("collecting", [True, False])
def test_collection_comes_back_as_it_was(collecting: bool) -> None:
    if not collecting:
        gc.disable()
    try:
        before = sys.getswitchinterval()
        with suspend_garbage_collection():
            assert not gc.isenabled() and sys.getswitchinterval() == pytest.approx(SWITCH_INTERVAL)
        assert gc.isenabled() == collecting and sys.getswitchinterval() == before
    finally:
        gc.enable()
