"""The program that shows a run in the terminal, in a process of its own: `python -m rig.view.live_dashboard NUMBER`.

NUMBER is the file descriptor of the shared memory. The plan of the run comes on standard input, which stays open as
long as the rig runs: when it ends, however it ends, this program restores the terminal and ends too.
"""
from __future__ import annotations

import os
import pickle
import select
import sys
import time
from collections.abc import Iterator

from rich.console import Console
from rich.live import Live

from rig.view.live_feed import LiveReader, Message
from rig.view.live_run import LivePlan, LiveRun
from rig.view.live_screen import describe_line, draw_screen

_FRAME = 0.1  # s between two frames


def show_run(reader: LiveReader, plan: LivePlan) -> None:
    """Show a run on standard error until it is over: as a screen, or without a terminal as a line every 2 s."""
    console = Console(stderr=True, highlight=False)
    reason = find_obstacle(console)
    if reason:
        print_lines(reader, LiveRun(plan), reason)
        return
    with Live(console=console, screen=True, auto_refresh=False, redirect_stdout=False, redirect_stderr=False) as live:
        reader.say_ready()
        last, heard = -1, time.monotonic()
        for run, _ in follow_run(reader, LiveRun(plan), _FRAME):
            if run.cycles != last:
                last, heard = run.cycles, time.monotonic()
            width, height = console.size
            live.update(draw_screen(run, width, height, time.monotonic() - heard), refresh=True)


def find_obstacle(console: Console) -> str:
    """Why there can be no screen; empty if there can."""
    if not console.is_terminal:
        return "standard error is no terminal"
    if os.environ.get("TERM", "dumb") in ("dumb", "unknown"):
        return f"TERM={os.environ.get('TERM', '')} has no screen"
    if "utf" not in console.encoding.lower():
        return f"the terminal's encoding is {console.encoding}, not UTF-8"
    return ""


def print_lines(reader: LiveReader, run: LiveRun, reason: str) -> None:
    """One line every 2 s and one at the end."""
    print(f"live: {reason}: a line every 2 s instead of the screen", file=sys.stderr, flush=True)
    reader.say_ready()
    next_line = time.monotonic() + 2.0
    for known, _ in follow_run(reader, run, _FRAME):
        if time.monotonic() >= next_line:
            next_line += 2.0
            print(f"live: {describe_line(known)}", file=sys.stderr, flush=True)
    print(f"live: {describe_line(run)}", file=sys.stderr, flush=True)


def follow_run(reader: LiveReader, run: LiveRun, every: float) -> Iterator[tuple[LiveRun, list[Message]]]:
    """The run again and again, `every` so many s, with what is new, until it is over or the rig has gone."""
    is_there = True
    while is_there:
        began = time.monotonic()
        is_there = not (reader.is_over or _has_ended(sys.stdin.fileno()))
        run.add_rows(reader.read_rows())
        messages = reader.read_messages()
        for message in messages:
            run.add_message(message)
        run.judge_checks()
        yield run, messages
        if is_there:
            time.sleep(max(every - (time.monotonic() - began), 0.02))


def _has_ended(number: int) -> bool:
    """Whether the other end of a pipe is closed."""
    return bool(select.select([number], [], [], 0)[0]) and not os.read(number, 1)


def main() -> None:
    """Read the plan and show the run."""
    reader = LiveReader(int(sys.argv[1]))
    with open(0, "rb", buffering=0, closefd=False) as stream:  # nothing is read ahead
        plan = pickle.load(stream)
    show_run(reader, plan)


if __name__ == "__main__":
    main()
