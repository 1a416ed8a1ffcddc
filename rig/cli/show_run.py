"""What `rig run` shows a person: a progress bar, a table, a verdict in plain words."""
from __future__ import annotations

import contextlib
import json
import math
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

from rich.markup import escape
from rich.table import Table

from fdi.progress import Progress
from rig.cli.progress_bar import show_progress
from rig.cli.terminal import console
from rig.run.job import Job
from rig.run.outcome import Outcome

EVENTS = 12  # shown in the terminal
COLOURS = {"PASS": "green", "FAIL": "red", "ABORTED": "red", "INVALID_TIMING": "yellow"}


@contextlib.contextmanager
def progress(job: Job, why: str, silent: bool) -> Iterator[Progress]:
    """The progress bar of a run, and a line on standard output that says what runs; nothing at all if `silent`."""
    announced = silent
    with show_progress(is_silent=silent, is_realtime=job.realtime) as update:
        def announce(stage: str, share: float) -> None:
            nonlocal announced
            if not announced:  # not before there is a bus and a place for the results: an error is one line
                announced = True
                console().print(f"[bold]{escape(job.sequence.title)}[/], {job.sequence.duration:g} s, "
                                f"{job.pace}, seed {job.seed}, {escape(why)}", soft_wrap=True)
            update(stage, share)

        yield announce


@contextlib.contextmanager
def stoppable() -> Iterator[Callable[[], bool]]:
    """Ctrl-C and SIGTERM end main and let clean-up run; a second one ends the program.

    As long as nobody has asked, nothing moves that would have to be brought to rest: then the first ends the program.
    """
    asked: list[int] = []
    listening = False

    def handler(number: int, frame: FrameType | None) -> None:
        if asked or not listening:
            raise KeyboardInterrupt
        asked.append(number)

    def stop() -> bool:
        nonlocal listening
        listening = True
        return bool(asked)

    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def as_json(outcome: Outcome) -> None:
    """One object on standard output."""
    print(json.dumps(outcome.to_json()))


def outcome(o: Outcome) -> None:
    """The table of checks, the timing and the verdict."""
    out = console()
    table = Table(box=None, pad_edge=False)
    table.add_column("check")
    table.add_column("measured", justify="right")
    table.add_column("limits", justify="right")
    table.add_column("unit")
    table.add_column("")
    table.add_column("", overflow="fold")
    for c in o.checks:
        mark = "[green]pass[/]" if c.passed else "[bold red]FAIL[/]"
        table.add_row(escape(c.name), number(c.value), limits(c.low, c.high), c.unit, mark,
                      f"[dim]{escape(c.detail)}[/]")
    out.print(table)
    timing = o.timing
    late = timing["lateness_us"]
    if o.job.realtime:
        out.print(f"\ntiming    {timing['cycles']} cycles, {timing['overruns']} overruns; lateness "
                      f"p50 {late['p50']:g}, p99 {late['p99']:g}, max {late['max']:g} us ({timing['scheduler']})")
    else:
        out.print(f"\ntiming    {timing['cycles']} cycles in lockstep, {o.speed:.1f} times real time")
    missing = {name: count for name, count in o.counters.items() if count}
    if missing:
        out.print("missing   " + ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in missing.items()))
    notable = [event for event in o.events if event.level != "INFO"]
    for event in notable[:EVENTS]:
        out.print(f"[yellow]{event.t:8.3f} s[/]  {event.kind}: {escape(event.text)}", soft_wrap=True)
    if len(notable) > EVENTS:
        out.print(f"            and {len(notable) - EVENTS} more in the report")
    if o.fdi:
        out.print(f"servovalve {escape(o.fdi['sentence'])}", highlight=False)
    out.print(f"results   {escape(str(o.folder))}/ trace.mcap, verdict.json, report.html")
    words = o.why or "every check passed"
    out.print(f"[bold {COLOURS[o.verdict]}]{o.verdict}[/]  {escape(words)}", soft_wrap=True)


def number(value: float) -> str:
    """Four digits, or a dash for what could not be measured.

    >>> number(0.123456), number(float("nan"))
    ('0.1235', '-')
    """
    return "-" if math.isnan(value) else f"{value:.4g}"


def limits(low: float, high: float) -> str:
    """The limits of a check in words.

    >>> limits(float("nan"), 5.0), limits(1.0, 2.0)
    ('<= 5', '1 .. 2')
    """
    if math.isnan(low):
        return f"<= {high:g}"
    return f">= {low:g}" if math.isnan(high) else f"{low:g} .. {high:g}"
