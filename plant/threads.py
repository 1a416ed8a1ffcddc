"""Runs work in threads: kernels and NumPy release the interpreter lock while they compute.

A kernel makes a block of runs in the time of one. Fits that go on side by side each ask for a few, so
`map_together` has them wait for each other, and what they ask for is made in common blocks.
"""

import contextlib
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

THREAD_NAME = "side_by_side"  # how the names of these threads begin
T = TypeVar("T")
R = TypeVar("R")


def count_threads() -> int:
    """One thread per core, or OMP_NUM_THREADS, by which a cluster tells its workers to share a machine."""
    setting = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, int(setting)) if setting.isdecimal() else os.cpu_count() or 1


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
    """`do(item)` of each item, in order, in `workers` threads; a single item or one worker uses the calling thread.

    Of a thread of `map_together`, the threads take its place: what they ask for is made with what others ask for.
    """
    work = list(items)
    if min(workers, len(work)) < 2:
        return [do(item) for item in work]
    if _is_in_meeting():
        meeting: _Meeting = _thread.meeting
        return meeting.take_places(do, work)
    with _open_pool(min(workers, len(work))) as pool:
        return list(pool.map(do, work))


MOST_TOGETHER = 16  # threads of one `map_together`
_thread = threading.local()  # `.meeting`: of a thread of `map_together`


# work that a thread waits for, and what tells it that the work is running or done
Request = tuple[Any, Future[None]]


class _Meeting:
    """Threads whose requests are met together, by one of them, as soon as each of them has made one."""

    def __init__(self, tasks: int, workers: int) -> None:
        self._tasks, self._workers = tasks, workers
        self._waiting = list[Request]()
        self._change = threading.Condition()

    def meet_request(self, work: Any, do: Callable[[Sequence[Any], int], None]) -> None:
        """Return when the work is done: `do` gets that of several threads and the number of workers."""
        mine, together = Future[None](), list[Request]()

        def is_taken() -> bool:
            return mine.running() or mine.done()

        with self._change:
            self._waiting.append((work, mine))
            self._change.wait_for(lambda: is_taken() or len(self._waiting) >= min(self._tasks, MOST_TOGETHER))
            if not is_taken():
                together, self._waiting = self._waiting, together
                for _, each in together:
                    each.set_running_or_notify_cancel()
                self._change.notify_all()
        if together:
            self._meet(together, do)
        mine.result()

    def _meet(self, together: Sequence[Request], do: Callable[[Sequence[Any], int], None]) -> None:
        error: BaseException | None = None
        _thread.meeting = None  # what is done together may use threads
        try:
            do([work for work, _ in together], self._workers)
        except BaseException as raised:
            error = raised
        finally:
            _thread.meeting = self
        for _, each in together:
            each.set_exception(error)  # None: it is done

    def end_task(self, tasks: int = 1) -> None:
        """So many tasks make no further requests."""
        with self._change:
            self._tasks -= tasks
            self._change.notify_all()

    def take_part(self, do: Callable[[T], R], work: Sequence[T]) -> list[R]:
        """`do(item)` of each item, each in a thread that is one task."""
        def do_item(item: T) -> R:
            _thread.meeting = self
            try:
                return do(item)
            finally:
                _thread.meeting = None
                self.end_task()

        with _open_pool(min(len(work), MOST_TOGETHER)) as pool:
            try:
                return list(pool.map(do_item, work))
            except BaseException:
                self.end_task(len(work))  # nobody waits for a task that does not begin
                raise

    def take_places(self, do: Callable[[T], R], work: Sequence[T]) -> list[R]:
        """The same from a thread of this meeting, which makes no request of its own meanwhile."""
        with self._change:
            self._tasks += len(work) - 1
        try:
            return self.take_part(do, work)
        finally:
            with self._change:
                self._tasks += 1


def map_together(do: Callable[[T], R], items: Iterable[T], workers: int) -> list[R]:
    """`do(item)` of each item, in order, in threads of their own, whose calls of `do_together` wait for each other.

    A thread of such a map does another map itself. `workers` is for the work that is done together.
    """
    work = list(items)
    if len(work) < 2 or _is_in_meeting():
        return [do(item) for item in work]
    return _Meeting(len(work), workers).take_part(do, work)


def do_together(work: Any, do: Callable[[Sequence[Any], int], None], workers: int) -> None:
    """`do([work, ..], workers)`: in a thread of `map_together` with the work of the others, else at once."""
    if _is_in_meeting():
        _thread.meeting.meet_request(work, do)
    else:
        do([work], workers)


def _is_in_meeting() -> bool:
    return getattr(_thread, "meeting", None) is not None


def run_beside(do: Callable[[], R]) -> R:
    """`do()` in a thread beside the main one, so that Ctrl-C ends the wait for compiled code at once.

    In the main thread, Python notices Ctrl-C only where compiled code hands over its result, and numba 0.6x does not
    survive an exception there. Called from another thread, `do` runs in it.
    """
    if threading.current_thread() is not threading.main_thread():
        return do()
    with _open_pool(1) as pool:
        return pool.submit(do).result()
