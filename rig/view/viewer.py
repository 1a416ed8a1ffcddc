"""Running the rerun viewer: its window, or a picture without a display."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

from plant import RigError


class ViewerError(RigError):
    """The viewer is not installed, or does not show what it should."""

    status = 1


def import_rerun() -> Any:
    """Import the rerun package. Raises ViewerError, which says how to install it."""
    try:
        import rerun as rr
    except ImportError as error:
        raise ViewerError("the viewer is not installed; to get it: pip install 'eha-rig[view]'") from error
    return rr


def open_viewer(rrd: Path) -> None:
    """Open the viewer's window on a recording and leave it open; it listens on 127.0.0.1 only.

    Raises ViewerError without rerun and without a display.
    """
    import_rerun()
    if lacks_display():
        raise ViewerError(f"no display here for a window; {rrd} is written: open it elsewhere, or --out FILE.png")
    subprocess.Popen(make_viewer_command("auto", str(rrd)), start_new_session=True)


def lacks_display() -> bool:
    """Whether there is no display for a window."""
    return sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def make_viewer_command(port: int | str, *words: str) -> list[str]:
    """The viewer as a program that listens at a port of 127.0.0.1 only."""
    return [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", "--port", str(port), "--hide-welcome-screen", *words]


def start_viewer(port: int, *words: str, patience: float = 20.0) -> subprocess.Popen[bytes]:
    """Start a silent viewer in a session of its own and wait until it listens at a port, has ended, or is too slow."""
    viewer = subprocess.Popen(make_viewer_command(port, *words), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                              stderr=subprocess.DEVNULL, start_new_session=True)
    wait_until(lambda: is_listening(port), viewer, patience)
    return viewer


@contextlib.contextmanager
def serve_in_browser(rrd: Path, theme: str, patience: float = 20.0) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Serve the viewer for a web browser on 127.0.0.1; -> the address with `theme` (light, dark) and the server.

    The viewer's own window has no option for its theme. The server ends with this context. Raises ViewerError without
    rerun, and when nothing is served within `patience` s.
    """
    import_rerun()
    data, web = find_free_port(), find_free_port()
    command = [sys.executable, "-m", "rerun", "--serve-web", "--bind", "127.0.0.1", "--port", str(data),
               "--web-viewer-port", str(web), str(rrd)]
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        if not wait_until(lambda: is_listening(web), server, patience):
            raise ViewerError(f"the viewer for the browser does not come up within {patience:g} s")
        source = quote(f"rerun+http://127.0.0.1:{data}/proxy", safe="")
        yield f"http://127.0.0.1:{web}/?url={source}&theme={theme}", server
    finally:
        kill_viewer(server)


def wait_until(is_ready: Callable[[], object], process: subprocess.Popen[Any], patience: float) -> bool:
    """Wait until a process is ready, has ended, or `patience` s have passed; return whether it is ready."""
    deadline = time.monotonic() + patience
    while not (is_done := bool(is_ready())) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    return is_done


def kill_viewer(process: subprocess.Popen[Any]) -> None:
    """End a viewer that was started in a session of its own: the process itself is only a wrapper around it."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def is_listening(port: int) -> bool:
    """Whether something accepts connections at a port of 127.0.0.1."""
    with socket.socket() as probe:
        probe.settimeout(1.0)
        return probe.connect_ex(("127.0.0.1", port)) == 0


def find_free_port() -> int:
    """A port of 127.0.0.1 that nothing uses."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def take_screenshot(rrd: Path, image: Path, patience: float = 60.0) -> None:
    """Draw `rrd` without a display and save the picture.

    Needs a Vulkan driver, lavapipe will do (Debian: mesa-vulkan-drivers libvulkan1). Raises ViewerError when the viewer
    does not come up within `patience` s, and when a view reports a warning or an error.
    """
    import_rerun()
    image.unlink(missing_ok=True)
    port = find_free_port()
    with tempfile.TemporaryFile("w+") as output:
        viewer = subprocess.Popen([*make_viewer_command(port, str(rrd)), "--headless", "--window-size", "1920x1080"],
                                  stdout=output, stderr=output, start_new_session=True)
        try:
            views = _draw_views(viewer, f"rerun+http://127.0.0.1:{port}/proxy", image, patience)
        except (ConnectionError, TimeoutError, RuntimeError) as error:
            output.seek(0)
            last = next((line for line in reversed(output.read().splitlines()) if line.strip()), "it printed nothing")
            raise ViewerError(f"the viewer does not draw: {error}; its last line: {last.strip()}") from error
        finally:
            kill_viewer(viewer)
    if wrong := [f"{view.name}: {report.summary}" for view in views for report in view.reports]:
        raise ViewerError(f"views with errors: {'; '.join(wrong)}")


def _draw_views(viewer: subprocess.Popen[bytes], url: str, image: Path, patience: float) -> list[Any]:
    """Save the picture once everything has arrived and been drawn; -> the states of the views.

    The viewer loads a long recording piece by piece, so a picture is taken again until it is the same.
    """
    from rerun.experimental import ViewerClient

    def is_loaded() -> bool:
        with contextlib.suppress(ConnectionError):
            state = ViewerClient(url).get_state()
            return bool(state.recordings and state.views and not state.loading)
        return False

    if not wait_until(is_loaded, viewer, patience):
        raise RuntimeError(f"not ready after {patience:g} s" if viewer.poll() is None
                           else f"it ended with status {viewer.returncode}")
    time.sleep(7.0)  # the viewer's own greeting covers a corner for that long
    client, deadline, before = ViewerClient(url), time.monotonic() + patience, b""
    client.save_screenshot(str(image.resolve()))
    while (picture := image.read_bytes()) != before and time.monotonic() < deadline:
        before = picture
        time.sleep(3.0)
        client.save_screenshot(str(image.resolve()))
    return list(client.get_state().views)
