"""Ctrl-C and SIGTERM: a run is asked to stop, so that its clean-up can bring the machine to rest."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any


@contextlib.contextmanager
def ignore_interrupts() -> Iterator[None]:
    """Processes started inside ignore Ctrl-C, which the terminal sends to them as well; who starts them ends them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def repeat_lost_interrupts() -> None:
    """Ctrl-C comes once more where Python ignores exceptions, as in the locks of imports: a command would go on."""
    report = sys.unraisablehook

    def hear(lost: Any) -> None:
        if issubclass(lost.exc_type, KeyboardInterrupt):  # later: an exception in here is ignored as well
            threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()
        else:
            report(lost)

    sys.unraisablehook = hear


@contextlib.contextmanager
def catch_signals() -> Iterator[Callable[[], bool]]:
    """Give a function that says whether the run is to stop.

    The first Ctrl-C or SIGTERM asks the run to stop, the second ends the program.

    Before that function is called for the first time nothing moves that must be brought to rest: until then the first
    signal ends the program.

    Raises:
        KeyboardInterrupt: in the main thread, by the signal that ends the program.
    """
    is_asked, is_listening = False, False

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal is_asked
        if is_asked or not is_listening:
            raise KeyboardInterrupt
        is_asked = True

    def is_to_stop() -> bool:
        nonlocal is_listening
        is_listening = True
        return is_asked

    if threading.current_thread() is not threading.main_thread():  # Python delivers signals to the main thread only
        yield lambda: False
        return
    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield is_to_stop
    finally:
        for number, old in before.items():
            signal.signal(number, old)
