"""Running the rerun viewer: its window, or a picture without a display that is checked for errors and empty views."""
from __future__ import annotations

import contextlib
import math
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from fdi.output import require_writable
from plant.errors import RigError

if TYPE_CHECKING:
    import rerun as rr


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


Floats = NDArray[np.float64]
TIMELINE = "run"
# on black and on white
COMMAND, MEASURED, LIMIT, PASS, FAIL, NEUTRAL = 0xA9B2BCFF, 0x3D8FE0FF, 0xE5534BFF, 0x3FA65AFF, 0xE5534BFF, 0x6B7785FF
FEWEST_LINE_PIXELS = 500  # the marks in a legend have some 60 each


class ViewerError(RigError):
    """The viewer is not installed, or does not show what it should."""

    status = 1


class Line(NamedTuple):
    """One line of a plot."""

    path: str
    name: str
    colour: int
    width: float = 1.5


class Plot(NamedTuple):
    """One time-series view."""

    origin: str
    title: str
    lines: tuple[Line, ...]


class ShownView(NamedTuple):
    """What a picture of a view must show: at least `fewest` pixels of these colours."""

    title: str
    colours: tuple[int, ...]
    fewest: int = FEWEST_LINE_PIXELS
    is_lanes: bool = False


class Lane(NamedTuple):
    """States over time, each from its time, s, on; "" is no state. `labels` are shown in place of some states."""

    path: str  # group/name
    states: Sequence[tuple[float, str]]
    colours: Mapping[str, int]
    labels: Mapping[str, str] = {}


def import_rerun() -> Any:
    """Import the rerun package. Raises ViewerError, which says how to install it."""
    try:
        import rerun as rr
    except ImportError as error:
        raise ViewerError("the viewer is not installed; to get it: pip install 'eha-rig[view]'") from error
    return rr


@contextmanager
def open_recording(path: Path, name: str, blueprint: Any) -> Iterator[rr.RecordingStream]:
    """A recording that is written to a file. Raises InputError for a place that cannot be written."""
    rr = import_rerun()
    require_writable(path, "the recording")
    with rr.RecordingStream("eha-rig", recording_id=str(path.stem)) as stream:
        stream.save(path, default_blueprint=blueprint)
        stream.send_recording_name(name)
        yield stream
        stream.flush()


def make_lane_path(lane: str) -> str:
    """Path of a lane, which the viewer shows as its name; other characters would be shown with backslashes.

    >>> make_lane_path("check/pass/lag, 1 Hz / unloaded")
    'check/pass/lag_1_Hz_unloaded'
    """
    return re.sub(r"[^A-Za-z0-9./-]+", "_", lane.replace(" / ", " "))


def send_line(rr: Any, stream: rr.RecordingStream, path: str, line: Line, t: Floats, values: Floats) -> None:
    """Send a line of a plot with its name and colour."""
    send_line_style(rr, stream, path, line)
    rr.send_columns(path, [rr.TimeColumn(TIMELINE, duration=t)], rr.Scalars.columns(scalars=values), recording=stream)


def send_line_style(rr: Any, stream: rr.RecordingStream, path: str, line: Line) -> None:
    """Name and colour of a line; where there are more samples than pixels the peaks are kept."""
    stream.log(path, rr.SeriesLines(colors=[line.colour], widths=[line.width], names=[line.name],
                                    aggregation_policy="MinMax"), static=True)


def send_lane(rr: Any, stream: rr.RecordingStream, lane: Lane) -> None:
    """Send a lane."""
    send_lane_style(rr, stream, lane)
    for t, state in lane.states:
        stream.set_time(TIMELINE, duration=t)
        stream.log(make_lane_path(lane.path), rr.StateChange(state=state))


def send_lane_style(rr: Any, stream: rr.RecordingStream, lane: Lane) -> None:
    """Colours of a lane and what is shown in place of its states."""
    if lane.colours:
        values = list(lane.colours)
        style = rr.StateConfiguration(values=values, labels=[lane.labels.get(value, value) for value in values],
                                      colors=np.array([*lane.colours.values()], np.uint32))
        stream.log(make_lane_path(lane.path), style, static=True)


def make_time_axis() -> Any:
    """The time axis of all views: what one shows, all show."""
    import rerun.blueprint as rrb

    return rrb.TimeAxis(link="LinkToGlobal")


def make_plot_view(plot: Plot, axis_y: Any = None) -> Any:
    """A view of the lines of a plot."""
    import rerun.blueprint as rrb

    return rrb.TimeSeriesView(origin=f"/{plot.origin}", name=plot.title, axis_x=make_time_axis(), axis_y=axis_y,
                              plot_legend=rrb.PlotLegend("RightTop"))


def make_value_axis(columns: Sequence[Floats]) -> Any:
    """The value axis of a plot of these columns; None, the viewer's own choice, where it prints enough numbers."""
    import rerun.blueprint as rrb

    known = [column[~np.isnan(column)] for column in columns]
    ends = [(float(column.min()), float(column.max())) for column in known if len(column)]
    wider = widen_range(min(low for low, _ in ends), max(high for _, high in ends)) if ends else None
    return rrb.ScalarAxis(range=wider) if wider else None


def widen_range(low: float, high: float) -> tuple[float, float] | None:
    """A wider range of an axis on which the viewer would print only one number; None if it prints more.

    The viewer prints powers of ten and their multiples, and a range such as -8 to 8 is too wide for the multiples of 1.

    >>> widen_range(-8.0, 8.0), widen_range(-6.0, 6.0), widen_range(0.0, 800.0), widen_range(0.0, 0.0)
    ((-10.0, 10.0), None, None, None)
    """
    span = high - low
    if not 0.0 < span < math.inf:
        return None
    step = 10.0 ** math.floor(math.log10(span))
    below, above = math.floor(low / step), math.ceil(high / step)
    is_sparse = 1.3 * step < span and math.floor(high / step) <= math.ceil(low / step)
    return (below * step, above * step) if is_sparse else None


def make_lanes_view(title: str, groups: Sequence[str]) -> Any:
    """A view of all lanes whose paths begin with one of these groups, sorted by path."""
    import rerun.blueprint as rrb

    return rrb.StateTimelineView(origin="/", contents=[f"/{group}/**" for group in groups], name=title,
                                 time_view=make_time_axis())


def measure_lanes_view(lanes: int) -> float:
    """Height of a view of so many lanes over that of the window, 1080 pixels: a lane has 40, title and axis 75."""
    return (75 + 40 * lanes) / 1080


def build_blueprint(views: Any, play_state: Literal["paused", "following"] = "paused") -> Any:
    """The window around these views, with none of the viewer's own panels."""
    import rerun.blueprint as rrb

    return rrb.Blueprint(views, rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state=play_state),
                         rrb.BlueprintPanel(state="hidden"), rrb.SelectionPanel(state="hidden"))
