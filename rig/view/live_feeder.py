"""The program that feeds the viewer during a run, in a process of its own: `python -m rig.view.live_feeder NUMBER
PORT FILE`.

NUMBER is the file descriptor of the shared memory. PORT is that of an open viewer on 127.0.0.1, or 0; FILE is a
recording to write, or empty; with neither, a viewer is opened, which stays open after the run. Standard input is as for
`rig.view.live_dashboard`.
"""
from __future__ import annotations

import os
import pickle
import subprocess
import sys
import time
from typing import Any

from rig.view.live_dashboard import follow_run
from rig.view.live_feed import LiveReader
from rig.view.live_run import LivePlan, LiveRun
from rig.view.viewer import find_free_port, is_listening

_EVERY = 0.1  # s between two pieces


def feed_viewer(reader: LiveReader, plan: LivePlan, port: int, file: str) -> None:
    """Send a run piece by piece until it is over, or until the viewer that was opened for it is closed."""
    os.environ["RUST_LOG"] = "off"  # a viewer that is gone is one line of ours, not many of its library
    import rerun as rr

    from rig.view.live_recording import LiveView, build_live_blueprint

    viewer = None if port or file else open_empty_viewer(port := find_free_port())
    stream = rr.RecordingStream("eha-rig", recording_id=f"live-{os.getpid()}")
    blueprint = build_live_blueprint(plan)
    if file:
        stream.save(file, default_blueprint=blueprint)
    else:
        stream.connect_grpc(f"rerun+http://127.0.0.1:{port}/proxy", default_blueprint=blueprint)
    stream.send_recording_name(plan.title)
    view = LiveView(rr, stream, plan)
    reader.say_ready()
    _send_run(reader, plan, view, port, viewer)
    stream.flush()
    stream.disconnect()


def _send_run(reader: LiveReader, plan: LivePlan, view: Any, port: int, viewer: subprocess.Popen[bytes] | None) -> None:
    next_look = time.monotonic()
    for run, messages in follow_run(reader, LiveRun(plan), _EVERY):
        view.update(run, messages, is_last=reader.is_over)
        if port and time.monotonic() >= next_look:
            next_look += 1.0
            if viewer.poll() is not None if viewer else not is_listening(port):
                print("rig run: the viewer was closed; the run goes on", file=sys.stderr, flush=True)
                os._exit(0)  # its library would wait for the viewer


def open_empty_viewer(port: int, patience: float = 20.0) -> subprocess.Popen[bytes]:
    """Open the viewer's window at a port of 127.0.0.1 and wait until it listens."""
    viewer = subprocess.Popen(make_viewer_command(port), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                              stderr=subprocess.DEVNULL, start_new_session=True)
    deadline = time.monotonic() + patience
    while not is_listening(port) and viewer.poll() is None and time.monotonic() < deadline:
        time.sleep(0.1)
    return viewer


def make_viewer_command(port: int) -> list[str]:
    """The viewer as a program that listens at a port of 127.0.0.1 only."""
    return [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", "--port", str(port), "--hide-welcome-screen"]


def main() -> None:
    """Read the plan and feed the viewer."""
    reader = LiveReader(int(sys.argv[1]))
    with open(0, "rb", buffering=0, closefd=False) as stream:  # nothing is read ahead
        plan = pickle.load(stream)
    feed_viewer(reader, plan, int(sys.argv[2]), sys.argv[3])


if __name__ == "__main__":
    main()
