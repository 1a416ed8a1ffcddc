"""Ctrl-C and SIGTERM: a run is asked to stop, so that its clean-up can bring the machine to rest. Ends of processes."""

import contextlib
import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from types import FrameType
from typing import Any


@contextlib.contextmanager
def handle_signals(handlers: Mapping[int, Any]) -> Iterator[None]:
    """Handle signals so within, and as before afterwards; in another thread than the main one nothing changes."""
    is_main = threading.current_thread() is threading.main_thread()  # Python delivers signals to that one only
    before = {number: signal.signal(number, handler) for number, handler in handlers.items() if is_main}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def ignore_interrupts() -> contextlib.AbstractContextManager[None]:
    """Processes started inside ignore Ctrl-C, which the terminal sends to them as well; who starts them ends them."""
    return handle_signals({signal.SIGINT: signal.SIG_IGN})


def repeat_lost_interrupts() -> None:
    """Ctrl-C comes once more where Python ignores exceptions, as in the locks of imports: a command would go on."""
    report = sys.unraisablehook

    def hear(unraisable: Any) -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):  # later: an exception in here is ignored as well
            threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()
        else:
            report(unraisable)

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

    with handle_signals({signal.SIGINT: handle, signal.SIGTERM: handle}):
        yield is_to_stop


def exit_on_signal(number: int, frame: FrameType | None) -> None:
    """End by an exception, so that `subprocess.run` ends its own process, too.

    It is raised again and again until the process has ended: Python drops an exception that comes in a destructor or in
    a function that compiled code calls, as the compiler does. What it prints then is of no use to anybody.
    """
    sys.unraisablehook = lambda unraisable: None
    signal.signal(signal.SIGALRM, exit_on_signal)
    signal.setitimer(signal.ITIMER_REAL, 0.3)
    raise SystemExit(128 + signal.SIGTERM)


_prctl = ctypes.CDLL(None).prctl  # here: a new process may not load a library any more
_KILL_AT_END = 1  # PR_SET_PDEATHSIG, linux/prctl.h


def end_with(parent: int) -> None:
    """Let the kernel kill this process when the thread of `parent` that has started it ends.

    So a program of any kind ends with a rig that is killed: it runs this first (`preexec_fn`) and need not look.
    """
    _prctl(_KILL_AT_END, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it ended before the kernel knew
        os._exit(1)


def describe_exit(status: int) -> str:
    """An exit status in words.

    >>> describe_exit(-9)
    'its process was ended by SIGKILL'
    >>> describe_exit(1)
    'its process ended with exit status 1'
    """
    if status >= 0:
        return f"its process ended with exit status {status}"
    names = {number.value: number.name for number in signal.Signals}
    return f"its process was ended by {names.get(-status, f'signal {-status}')}"
