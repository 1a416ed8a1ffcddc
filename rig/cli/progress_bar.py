"""The progress bar of every command, on standard error."""
from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from threading import Timer

from fdi.progress import Progress, ignore_progress


@contextlib.contextmanager
def show_progress(*, is_silent: bool, is_realtime: bool = False) -> Iterator[Progress]:
    """Give a `Progress` whose calls move a bar on standard error; the bar disappears at the end.

    Args:
        is_silent: show nothing.
        is_realtime: show a plain line without a refreshing thread, which would delay a real-time loop.

    Nothing is shown where standard error is no terminal.
    """
    if is_silent or not sys.stderr.isatty():
        yield ignore_progress
        return
    with _show_line() if is_realtime else _show_bar() as update:
        yield update


@contextlib.contextmanager
def _show_bar(delay: float = 2.0) -> Iterator[Progress]:
    """A bar that appears after `delay` s: shorter work needs none."""
    from rich.console import Console  # here: 0.1 s that a command without a bar does not spend
    from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    bar = Bar(SpinnerColumn("line"), TextColumn("{task.description:<14}", markup=False), BarColumn(20),
              TextColumn("{task.percentage:>3.0f} %"), TimeElapsedColumn(),
              console=Console(stderr=True), transient=True)
    task = bar.add_task("starting", total=None)

    def update(stage: str, share: float) -> None:
        bar.update(task, description=stage, completed=share, total=1.0 if share > 0.0 else None)

    starter = Timer(delay, bar.start)
    starter.daemon = True
    starter.start()
    try:
        yield update
    finally:
        starter.cancel()
        starter.join()
        bar.stop()


@contextlib.contextmanager
def _show_line() -> Iterator[Progress]:
    shown = ("", -1)

    def update(stage: str, share: float) -> None:
        nonlocal shown
        now = (stage, int(20 * share))  # each write may cost the loop some microseconds: only every 5 %
        if now != shown:
            shown = now
            print(f"\r\033[K{stage:<14} {100 * share:3.0f} %", end="", file=sys.stderr, flush=True)

    try:
        yield update
    finally:  # the headline begins a line, also in a capture
        print("\r\033[K", end="\n" if shown[0] else "", file=sys.stderr, flush=True)
