"""The showing process, as the rig starts and ends it."""

import contextlib
import importlib.util
import os
import pickle
import select
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

from fdi.output import require_writable
from plant import require
from rig.interrupts import ignore_interrupts
from rig.view.live_run import LivePlan
from rig.view.viewer import is_listening, lacks_display


class ViewerPlace(NamedTuple):
    """Neither a port nor a file: a window of its own."""

    port: int = 0  # of a viewer on 127.0.0.1
    file: Path | None = None


@contextlib.contextmanager
def show_live(plan: LivePlan, log: Path, last_cpu_is_taken: bool, place: ViewerPlace | None = None,
              patience: float = 30.0) -> Iterator[Callable[[], None]]:
    """Start the showing process, wait until it is ready, and give the function to call as soon as the log is there.

    The process has normal priority. It ignores Ctrl-C, which ends the run and through it the process; what it leaves of
    the screen if it is killed is cleared here.

    Args:
        plan: of the run.
        log: of the run; the process gets the absolute path, because the plan's Python may change its folder.
        place: of the viewer; None: the screen in the terminal.
        last_cpu_is_taken: the loop runs on the last CPU; the process gets the others, where there are any.
        patience: s to wait for the process; without it the run begins anyway.
    """
    words = [str(log.absolute()), *([str(place.port), str(place.file or "")] if place is not None else [])]
    with ignore_interrupts():
        process = subprocess.Popen([sys.executable, "-m", "rig.view.live_show", *words], stdin=subprocess.PIPE,
                                   stdout=subprocess.PIPE)
    assert process.stdin is not None and process.stdout is not None
    stdin = process.stdin

    def send(data: bytes) -> None:
        with contextlib.suppress(BrokenPipeError):  # it has ended
            stdin.write(data)
            stdin.flush()

    @cache  # only once
    def begin() -> None:
        send(b"\n")

    try:
        cpus = sorted(os.sched_getaffinity(0))
        if last_cpu_is_taken and len(cpus) > 1:
            with contextlib.suppress(OSError):  # it has ended
                os.sched_setaffinity(process.pid, cpus[:-1])
        send(pickle.dumps(plan))
        select.select([process.stdout], [], [], patience)  # it closes its output when it is ready, or ends
        yield begin
    finally:
        _end_process(process, is_on_screen=place is None)


def _end_process(process: subprocess.Popen[bytes], *, is_on_screen: bool) -> None:
    """Let the process end by itself, kill it if it does not, and restore the screen if it could not."""
    for pipe in (process.stdin, process.stdout):
        with contextlib.suppress(BrokenPipeError):
            pipe.close()  # type: ignore[union-attr]
    try:
        process.wait(3.0 if is_on_screen else 20.0)  # a file is to be whole
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if is_on_screen and process.returncode != 0 and sys.stderr.isatty():
        sys.stderr.write("\033[?1049l\033[?25h")  # leave the second screen, show the cursor
        sys.stderr.flush()


def find_viewer_place(text: str) -> ViewerPlace:
    """The place that --live names: rerun, rerun:PORT or rerun:FILE.rrd.

    Raises:
        InputError: the viewer is not installed, there is no display for its window, nothing listens at the port, or the
            file cannot be written.
    """
    require(importlib.util.find_spec("rerun") is not None, "--live", "rerun",
            "the viewer, which is not installed: pip install 'eha-rig[view]'")
    word = text.partition(":")[2]
    if word.endswith(".rrd"):
        return ViewerPlace(file=Path(require_writable(word, "--live")).absolute())
    if word.isdecimal() and 0 < int(word) < 65536:
        require(is_listening(int(word)), "--live", text,
                f"a viewer that listens on 127.0.0.1:{word} (rerun --bind 127.0.0.1 --port {word})")
        return ViewerPlace(port=int(word))
    require(text == "rerun", "--live", text, "rerun, rerun:PORT of an open viewer, or rerun:FILE.rrd")
    require(not lacks_display(), "--live", text,
            "a display for the viewer's window; without one rerun:FILE.rrd writes a file, "
            "and rerun:PORT uses a viewer that is open")
    return ViewerPlace()
