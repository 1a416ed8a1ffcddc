"""What all recordings for the viewer share: lines and lanes, colours, and what a picture of each view must show."""
from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.output import require_writable
from plant.errors import RigError

if TYPE_CHECKING:
    import rerun as rr

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
