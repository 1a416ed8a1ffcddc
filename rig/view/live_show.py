"""The program that shows a run, in a process of its own: `python -m rig.view.live_show LOG [PORT FILE]`.

LOG is the log of the run. Without more words this program shows the run in the terminal. PORT is that of
an open viewer on 127.0.0.1, or 0; FILE is a recording for the viewer to write, or empty; with neither, a viewer is
opened, which stays open after the run.

The plan of the run comes on standard input, and a byte when the log is there. Standard input stays open as long as the
rig runs: when it ends, however it ends, this program restores the terminal and ends too. It closes its standard output
when it is ready.
"""
from __future__ import annotations

import os
import pickle
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from rich.console import Console
from rich.live import Live

from rig.recorder import Record
from rig.view.live_log import follow_log
from rig.view.live_run import LivePlan, LiveRun
from rig.view.live_screen import describe_line, draw_screen
from rig.view.viewer import find_free_port, is_listening, make_viewer_command, wait_until

_EVERY = 0.1  # s between two frames, or pieces


Batches = Iterator[list[tuple[int, Record]]]


def follow_run(log: Path, run: LiveRun) -> Batches:
    """Add what is new in the log to the run again and again, and give it too, until the rig has ended."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # the run may begin
    records: Batches = iter(())
    is_there = True
    while is_there:
        began = time.monotonic()
        if select.select([0], [], [], 0)[0]:
            is_there = bool(os.read(0, 1))
            records = follow_log(log) if is_there else records
        new = next(records, [])
        for t_ns, record in new:
            run.add(t_ns, record)
        run.judge_checks()
        yield new
        if is_there:
            time.sleep(max(_EVERY - (time.monotonic() - began), 0.02))


def show_on_terminal(log: Path, plan: LivePlan) -> None:
    """Show a run on standard error until it is over: as a screen, or without a terminal as a line every 2 s."""
    console, run = Console(stderr=True, highlight=False), LiveRun(plan)
    obstacle = find_obstacle(console)
    if obstacle:
        print(f"live: {obstacle}: a line every 2 s instead of the screen", file=sys.stderr, flush=True)
        print_lines(log, run)
        return
    with Live(console=console, screen=True, auto_refresh=False, redirect_stdout=False, redirect_stderr=False) as live:
        last, heard = -1, time.monotonic()
        for _ in follow_run(log, run):
            if run.cycles != last:
                last, heard = run.cycles, time.monotonic()
            live.update(draw_screen(run, *console.size, time.monotonic() - heard), refresh=True)


def find_obstacle(console: Console) -> str:
    """Why there can be no screen; empty if there can."""
    if not console.is_terminal:
        return "standard error is no terminal"
    if os.environ.get("TERM", "dumb") in ("dumb", "unknown"):
        return f"TERM={os.environ.get('TERM', '')} has no screen"
    if "utf" not in console.encoding.lower():
        return f"the terminal's encoding is {console.encoding}, not UTF-8"
    return ""


def print_lines(log: Path, run: LiveRun) -> None:
    """One line every 2 s and one at the end."""
    next_line = time.monotonic() + 2.0
    for _ in follow_run(log, run):
        if time.monotonic() >= next_line:
            next_line += 2.0
            print(f"live: {describe_line(run)}", file=sys.stderr, flush=True)
    print(f"live: {describe_line(run)}", file=sys.stderr, flush=True)


def show_in_viewer(log: Path, plan: LivePlan, port: int, file: str) -> None:
    """Send a run piece by piece until it is over, or until the viewer that was opened for it is closed."""
    os.environ["RUST_LOG"] = "off"  # a viewer that is gone is one line of ours, not many of its library
    import rerun as rr

    from rig.view.live_recording import LiveView, draw_plan
    from rig.view.recording import Recording, build_blueprint

    drawing, viewer = draw_plan(plan), None
    blueprint = build_blueprint(drawing, "following")
    stream = rr.RecordingStream("eha-rig", recording_id=f"live-{os.getpid()}")
    if file:
        stream.save(file, default_blueprint=blueprint)
    else:
        if not port:
            port = find_free_port()
            viewer = open_viewer(port)
        stream.connect_grpc(f"rerun+http://127.0.0.1:{port}/proxy", default_blueprint=blueprint)
    view = LiveView(Recording(stream, drawing), plan)
    run, next_look = LiveRun(plan), time.monotonic()
    for new in follow_run(log, run):
        view.update(run, new)
        if port and time.monotonic() >= next_look:
            next_look += 1.0
            if viewer.poll() is not None if viewer else not is_listening(port):
                print("rig run: the viewer was closed; the run goes on", file=sys.stderr, flush=True)
                os._exit(0)  # its library would wait for the viewer
    view.finish(run)
    stream.flush()
    stream.disconnect()


def open_viewer(port: int, patience: float = 20.0) -> subprocess.Popen[bytes]:
    """Open the viewer's window at a port of 127.0.0.1 and wait until it listens."""
    viewer = subprocess.Popen(make_viewer_command(port), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                              stderr=subprocess.DEVNULL, start_new_session=True)
    wait_until(lambda: is_listening(port), viewer, patience)
    return viewer


def main() -> None:
    """Read the plan and show the run."""
    log, *place = sys.argv[1:]
    with open(0, "rb", buffering=0, closefd=False) as stream:  # nothing is read ahead
        plan = pickle.load(stream)
    if place:
        show_in_viewer(Path(log), plan, int(place[0]), place[1])
    else:
        show_on_terminal(Path(log), plan)


if __name__ == "__main__":
    main()
