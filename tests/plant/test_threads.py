"""Work side by side: in order, in this thread where there is nothing to share, and an error is an error."""

import subprocess
import sys
import threading
import time
from collections.abc import Sequence

import pytest

from plant import THREAD_NAME, count_threads, map_in_threads, map_together
from plant.threads import do_together


def test_answers_come_in_the_order_of_the_questions_and_an_error_reaches_who_asked() -> None:
    def slow_first(i: int) -> float:
        time.sleep(0.02 if i == 1 else 0.0)
        return 1 / i

    assert map_in_threads(slow_first, range(1, 8), 3) == [1 / i for i in range(1, 8)]
    assert map_in_threads(slow_first, [], 3) == []
    with pytest.raises(ZeroDivisionError):
        map_in_threads(slow_first, [1, 0, 2], 2)


def test_an_error_leaves_what_is_still_at_work() -> None:
    """Ctrl-C answers at once: work that has begun goes on by itself, work that has not is dropped."""
    start, go_on, done = threading.Event(), threading.Event(), []

    def do(i: int) -> None:
        if i == 0:
            start.wait(120.0)
            raise KeyboardInterrupt
        start.set()
        go_on.wait(120.0)
        done.append(i)

    with pytest.raises(KeyboardInterrupt):
        map_in_threads(do, range(40), 2)
    assert len(done) == 0
    threads = [t for t in threading.enumerate() if t.name.startswith(THREAD_NAME)]
    go_on.set()
    for thread in threads:
        thread.join(120.0)
    assert 1 in done
    assert len(done) < 4  # of 39


def test_requests_of_side_by_side_tasks_are_met_together_until_each_has_ended() -> None:
    batches: list[list[tuple[int, int]]] = []

    def do(requests: Sequence[tuple[int, int]], workers: int) -> None:
        assert workers == 2
        assert len(map_in_threads(lambda _: threading.get_ident(), range(2), 2)) == 2  # it may use threads
        batches.append(sorted(requests))

    def make_requests(task: int) -> int:
        for turn in range(task):
            do_together((turn, task), do, 2)
            assert map_together(lambda x: x, [turn, task], 2) == [turn, task]  # one inside another
        return task

    assert map_together(make_requests, [1, 3, 2], 2) == [1, 3, 2]
    assert batches == [[(0, 1), (0, 2), (0, 3)], [(1, 2), (1, 3)], [(2, 3)]]
    batches.clear()
    assert map_together(make_requests, [2], 2) == [2] and batches == [[(0, 2)], [(1, 2)]]  # nobody to wait for


@pytest.mark.parametrize("fails_in_task", [True, False])
def test_no_task_waits_for_one_that_failed(fails_in_task: bool) -> None:
    def do(requests: Sequence[int], workers: int) -> None:
        assert fails_in_task or len(requests) < 3, "the work fails"

    def make_requests(task: int) -> int:
        do_together(task, do, 1)
        assert not fails_in_task or task, "the task fails"
        do_together(task, do, 1)
        return task

    with pytest.raises(AssertionError, match="the task fails" if fails_in_task else "the work fails"):
        map_together(make_requests, range(3), 1)
    threads = [t for t in threading.enumerate() if t.name.startswith(THREAD_NAME)]
    for thread in threads:
        thread.join(120.0)
        assert not thread.is_alive()


def test_ctrl_c_ends_a_long_simulation_at_once() -> None:
    """In a process of its own: numba does not survive an exception where it hands over a result in the main thread."""
    program = """
import os, signal, threading
import numpy as np
from plant import Model, simulate
simulate(Model(), np.zeros(10))
threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()
try:
    simulate(Model(), np.zeros(2_000_000))  # 4 s
    print("done")
except KeyboardInterrupt:
    print("interrupted", flush=True)
os._exit(0)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "interrupted\n"), done.stderr


def test_a_cluster_tells_its_workers_how_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert count_threads() == 3
    monkeypatch.setenv("OMP_NUM_THREADS", "many")
    assert count_threads() >= 1
