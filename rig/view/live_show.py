"""The program that shows a run, in a process of its own: `python -m rig.view.live_show NUMBER [PORT FILE]`.

NUMBER is the file descriptor of the shared memory. Without more words it shows the run in the terminal. PORT is that of
an open viewer on 127.0.0.1, or 0; FILE is a recording for the viewer to write, or empty; with neither, a viewer is
opened, which stays open after the run.

The plan of the run comes on standard input, which stays open as long as the rig runs: when it ends, however it ends,
this program restores the terminal and ends too.
"""
from __future__ import annotations

import os
import pickle
import select
import subprocess
import sys
import time
from collections.abc import Iterator

from rich.console import Console
from rich.live import Live

from rig.view.live_feed import LiveReader, Message
from rig.view.live_run import LivePlan, LiveRun
from rig.view.live_screen import describe_line, draw_screen
from rig.view.viewer import find_free_port, is_listening, make_viewer_command, wait_until

_EVERY = 0.1  # s between two frames, or pieces


def follow_run(reader: LiveReader, run: LiveRun) -> Iterator[list[Message]]:
    """Add what is new to the run again and again, and give the messages, until it is over or the rig has gone."""
    is_there = True
    while is_there:
        began = time.monotonic()
        is_there = not (reader.is_over or _has_ended(sys.stdin.fileno()))
        run.add_rows(reader.read_rows())
        messages = reader.read_messages()
        for message in messages:
            run.add_message(message)
        run.judge_checks()
        yield messages
        if is_there:
            time.sleep(max(_EVERY - (time.monotonic() - began), 0.02))


def _has_ended(number: int) -> bool:
    """Whether the other end of a pipe is closed."""
    return bool(select.select([number], [], [], 0)[0]) and not os.read(number, 1)


def show_on_terminal(reader: LiveReader, plan: LivePlan) -> None:
    """Show a run on standard error until it is over: as a screen, or without a terminal as a line every 2 s."""
    console, run = Console(stderr=True, highlight=False), LiveRun(plan)
    obstacle = find_obstacle(console)
    if obstacle:
        print(f"live: {obstacle}: a line every 2 s instead of the screen", file=sys.stderr, flush=True)
        print_lines(reader, run)
        return
    with Live(console=console, screen=True, auto_refresh=False, redirect_stdout=False, redirect_stderr=False) as live:
        reader.say_ready()
        last, heard = -1, time.monotonic()
        for _ in follow_run(reader, run):
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


def print_lines(reader: LiveReader, run: LiveRun) -> None:
    """One line every 2 s and one at the end."""
    reader.say_ready()
    next_line = time.monotonic() + 2.0
    for _ in follow_run(reader, run):
        if time.monotonic() >= next_line:
            next_line += 2.0
            print(f"live: {describe_line(run)}", file=sys.stderr, flush=True)
    print(f"live: {describe_line(run)}", file=sys.stderr, flush=True)


def show_in_viewer(reader: LiveReader, plan: LivePlan, port: int, file: str) -> None:
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
    reader.say_ready()
    run, next_look = LiveRun(plan), time.monotonic()
    for messages in follow_run(reader, run):
        view.update(run, messages, is_last=reader.is_over)
        if port and time.monotonic() >= next_look:
            next_look += 1.0
            if viewer.poll() is not None if viewer else not is_listening(port):
                print("rig run: the viewer was closed; the run goes on", file=sys.stderr, flush=True)
                os._exit(0)  # its library would wait for the viewer
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
    number, *place = sys.argv[1:]
    reader = LiveReader(int(number))
    with open(0, "rb", buffering=0, closefd=False) as stream:  # nothing is read ahead
        plan = pickle.load(stream)
    if place:
        show_in_viewer(reader, plan, int(place[0]), place[1])
    else:
        show_on_terminal(reader, plan)


if __name__ == "__main__":
    main()
