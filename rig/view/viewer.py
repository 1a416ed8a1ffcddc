"""Running the rerun viewer: its window, or a picture without a display that is checked for errors and empty views."""
from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from rig.view.recording import ShownView, ViewerError, import_rerun


def open_viewer(rrd: Path) -> None:
    """Open the viewer's window on a recording and leave it open; it listens on 127.0.0.1 only.

    Raises ViewerError without rerun and without a display.
    """
    import_rerun()
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ViewerError(f"no display here for a window; {rrd} is written: open it elsewhere, or ask for --screenshot")
    subprocess.Popen(_build_command(rrd, "auto"), start_new_session=True)


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
        deadline = time.monotonic() + patience
        while not is_listening(web):
            if server.poll() is not None or time.monotonic() > deadline:
                raise ViewerError(f"the viewer for the browser does not come up within {patience:g} s")
            time.sleep(0.1)
        source = quote(f"rerun+http://127.0.0.1:{data}/proxy", safe="")
        yield f"http://127.0.0.1:{web}/?url={source}&theme={theme}", server
    finally:
        kill_viewer(server)


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


def take_screenshot(shown: Sequence[ShownView], rrd: Path, image: Path, patience: float = 60.0) -> dict[str, int]:
    """Draw `rrd` without a display and save the picture; -> pixels of what each view is to show.

    Needs a Vulkan driver, lavapipe will do (Debian: mesa-vulkan-drivers libvulkan1). Raises ViewerError when the viewer
    does not come up within `patience` s, when a view reports a warning or an error, and when one shows no line, no
    lane or no text.
    """
    import_rerun()
    views, pixels = _draw_views(shown, rrd, image, patience)
    wrong = [f"{view.name}: {report.summary}" for view in views for report in view.reports]
    if wrong:
        raise ViewerError(f"views with errors: {'; '.join(wrong)}")
    empty = _list_empty_views(shown, pixels)
    if empty:
        raise ViewerError(f"{image}: empty views: {', '.join(empty)}")
    return pixels


def _list_empty_views(shown: Sequence[ShownView], pixels: dict[str, int]) -> list[str]:
    return [view.title for view in shown if pixels[view.title] < view.fewest]


def _count_view_pixels(shown: Sequence[ShownView], image: Path) -> dict[str, int]:
    """View -> how many pixels have the colour of one of its lines, lanes or words."""
    from matplotlib.image import imread

    shades = (imread(str(image))[..., :3] * 255).astype(int)
    lane_weight = 0.784  # the viewer draws a lane's colour over black with this weight (rerun 0.41)
    return {view.title: sum(_count_pixels(shades, colour, *((lane_weight, 6) if view.is_lanes else ()))
                            for colour in view.colours) for view in shown}


def _count_pixels(shades: NDArray[np.int64], colour: int, weight: float = 1.0, off: int = 24) -> int:
    """Pixels whose channels are all within `off` of a colour."""
    wanted = weight * np.array([colour >> shift & 0xFF for shift in (24, 16, 8)])
    return int((np.abs(shades - wanted).max(axis=2) < off).sum())


def _draw_views(shown: Sequence[ShownView], rrd: Path, image: Path,
                patience: float) -> tuple[list[Any], dict[str, int]]:
    """Save the picture; -> the views' states, and the pixels of each view."""
    from rerun.experimental import ViewerClient

    port = find_free_port()
    image.unlink(missing_ok=True)
    with tempfile.TemporaryFile("w+") as output:
        viewer = subprocess.Popen([*_build_command(rrd, str(port)), "--headless", "--window-size", "1920x1080"],
                                  stdout=output, stderr=output, start_new_session=True)
        try:
            views = _wait_until_loaded(viewer, f"rerun+http://127.0.0.1:{port}/proxy", patience)
            pixels = _save_picture(ViewerClient(f"rerun+http://127.0.0.1:{port}/proxy"), shown, image, patience)
        except (ConnectionError, TimeoutError, RuntimeError) as error:
            output.seek(0)
            last = next((line for line in reversed(output.read().splitlines()) if line.strip()), "it printed nothing")
            raise ViewerError(f"the viewer does not draw: {error}; its last line: {last.strip()}") from error
        finally:
            kill_viewer(viewer)
    return views, pixels


def _save_picture(client: Any, shown: Sequence[ShownView], image: Path, patience: float) -> dict[str, int]:
    """Save the picture; -> the pixels of each view.

    The viewer loads a long recording piece by piece, so a picture with empty views is taken again until it is the same.
    """
    deadline = time.monotonic() + patience
    client.save_screenshot(str(image.resolve()))
    pixels = _count_view_pixels(shown, image)
    while _list_empty_views(shown, pixels) and time.monotonic() < deadline:
        before = pixels
        time.sleep(3.0)
        client.save_screenshot(str(image.resolve()))
        pixels = _count_view_pixels(shown, image)
        if pixels == before:
            break
    return pixels


def _wait_until_loaded(viewer: subprocess.Popen[bytes], url: str, patience: float) -> list[Any]:
    """The views once everything has arrived, been drawn, and the greeting has faded."""
    from rerun.experimental import ViewerClient

    deadline = time.monotonic() + patience
    greeting_time = 7.0  # s; the viewer's own greeting covers a corner for that long
    while time.monotonic() < deadline:
        time.sleep(0.5)
        if viewer.poll() is not None:
            raise RuntimeError(f"it ended with status {viewer.returncode}")
        try:
            state = ViewerClient(url).get_state()
        except ConnectionError:
            continue
        if state.recordings and state.views and not state.loading:
            time.sleep(greeting_time)
            return list(ViewerClient(url).get_state().views)
    raise TimeoutError(f"not ready after {patience:g} s")


def _build_command(rrd: Path, port: str) -> list[str]:
    return [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", "--port", port, "--hide-welcome-screen", str(rrd)]


def find_free_port() -> int:
    """A port of 127.0.0.1 that nothing uses."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
