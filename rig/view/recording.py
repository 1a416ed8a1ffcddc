"""What the viewer shows, as data: plots of curves, lanes of states, texts; and the one writer of its recordings."""
from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.output import require_writable
from rig.view.viewer import ShownView, import_rerun

Floats = NDArray[np.float64]
TIMELINE = "run"
# on black and on white
COMMAND, MEASURED, LIMIT, PASS, FAIL, NEUTRAL = 0xA9B2BCFF, 0x3D8FE0FF, 0xE5534BFF, 0x3FA65AFF, 0xE5534BFF, 0x6B7785FF
TEXTS, CHECKS = "Events and checks", "Checks"  # titles of views
NOTHING = np.zeros(0)


class Curve(NamedTuple):
    """A line of a plot: times, s, and values in the unit of the plot."""

    path: str
    name: str
    colour: int
    t: Floats = NOTHING
    values: Floats = NOTHING
    width: float = 1.5


class Plot(NamedTuple):
    """One time-series view. The viewer draws curves in the order of their paths."""

    origin: str
    title: str
    curves: Sequence[Curve]


class Lane(NamedTuple):
    """States over time, each from its time, s, on; "" is no state. `labels` are shown in place of some states."""

    path: str  # group/name
    states: Sequence[tuple[float, str]]
    colours: Mapping[str, int]
    labels: Mapping[str, str] = {}


class LogText(NamedTuple):
    """A line of the events or of the checks."""

    path: str
    t: float  # s
    text: str
    level: str = "INFO"


class Drawing(NamedTuple):
    """A recording for the viewer. Lanes of the group "check" have a view of their own, beside the plots.

    `document` is a title with a text in Markdown, `shown` what a picture must show, `log` the texts of events and
    checks, None where there are no such views.
    """

    name: str
    plots: Sequence[Plot]
    lanes_title: str
    lanes: Sequence[Lane]
    document: tuple[str, str]
    shown: Sequence[ShownView] = ()
    log: Sequence[LogText] | None = None
    verdict: str = ""


class Recording:
    """A stream of the viewer, which takes curves, states and texts of a drawing at once or piece by piece."""

    def __init__(self, stream: Any, drawing: Drawing) -> None:
        """Declare name and colour of each curve and lane of a drawing, and send its document."""
        self._rr, self._stream = import_rerun(), stream
        stream.send_recording_name(drawing.name)
        for plot in drawing.plots:
            for curve in plot.curves:  # where there are more samples than pixels the peaks are kept
                stream.log(f"{plot.origin}/{curve.path}", self._rr.SeriesLines(
                    colors=[curve.colour], widths=[curve.width], names=[curve.name], aggregation_policy="MinMax"),
                    static=True)
        for lane in drawing.lanes:
            self.declare_lane(lane)
        title, text = drawing.document
        stream.log(f"log/{title.lower()}", self._rr.TextDocument(text, media_type="text/markdown"), static=True)

    def declare_lane(self, lane: Lane) -> None:
        """Set the colours of a lane, and what is shown in place of its states."""
        values = [*lane.colours]
        if values:
            self._stream.log(make_lane_path(lane.path), self._rr.StateConfiguration(
                values=values, labels=[lane.labels.get(value, value) for value in values],
                colors=np.array([*lane.colours.values()], np.uint32)), static=True)

    def send_values(self, path: str, t: Floats, values: Floats) -> None:
        """Send samples of a curve."""
        self._rr.send_columns(path, [self._rr.TimeColumn(TIMELINE, duration=t)],
                              self._rr.Scalars.columns(scalars=values), recording=self._stream)

    def send_state(self, lane: str, t: float, state: str) -> None:
        """Send a state of a lane."""
        self._stream.set_time(TIMELINE, duration=t)
        self._stream.log(make_lane_path(lane), self._rr.StateChange(state=state))

    def send_text(self, text: LogText) -> None:
        """Send a line of the log."""
        self._stream.set_time(TIMELINE, duration=text.t)
        self._stream.log(text.path, self._rr.TextLog(text.text, level=text.level))


def write_recording(drawing: Drawing, path: Path) -> None:
    """Write a drawing with its blueprint as a recording of the viewer.

    Raises:
        ViewerError: rerun is not installed.
        InputError: a place that cannot be written.
    """
    rr = import_rerun()
    require_writable(path, "the recording")
    with rr.RecordingStream("eha-rig", recording_id=path.stem) as stream:
        stream.save(path, default_blueprint=build_blueprint(drawing))
        recording = Recording(stream, drawing)
        for plot in drawing.plots:
            for curve in plot.curves:
                recording.send_values(f"{plot.origin}/{curve.path}", curve.t, curve.values)
        for lane in drawing.lanes:
            for t, state in lane.states:
                recording.send_state(lane.path, t, state)
        for text in drawing.log or ():
            recording.send_text(text)
        stream.flush()


def make_lane_path(lane: str) -> str:
    """Path of a lane, which the viewer shows as its name; other characters would be shown with backslashes.

    >>> make_lane_path("check/pass/lag, 1 Hz / unloaded")
    'check/pass/lag_1_Hz_unloaded'
    """
    return re.sub(r"[^A-Za-z0-9./-]+", "_", lane.replace(" / ", " "))


def build_blueprint(drawing: Drawing, play_state: Literal["paused", "following"] = "paused") -> Any:
    """The window: plots in columns and the checks beside them, below them the other lanes and the texts.

    What one view shows of the time, all show. The viewer stands at the beginning, "paused", or follows new data.
    """
    import rerun.blueprint as rrb
    from rerun.blueprint.encodings import TextLogColumn, TimelineColumn

    time_axis = rrb.TimeAxis(link="LinkToGlobal")
    views = [rrb.TimeSeriesView(origin=f"/{plot.origin}", name=plot.title, axis_x=time_axis, axis_y=_choose_axis(plot),
                                plot_legend=rrb.PlotLegend("RightTop")) for plot in drawing.plots]
    columns: list[Any] = [rrb.Vertical(*views[k:k + 2]) for k in range(0, len(views), 2)]  # lower ones lack numbers
    groups = [make_lane_path(lane.path).partition("/")[0] for lane in drawing.lanes]

    def view_lanes(title: str, names: Sequence[str]) -> Any:
        return rrb.StateTimelineView(origin="/", contents=[f"/{name}/**" for name in names], name=title,
                                     time_view=time_axis)

    others = [group for group in groups if group != "check"]
    shares = [1.0] * len(columns)
    if len(others) < len(groups):
        columns.append(view_lanes(CHECKS, ["check"]))
        shares.append(1.3)
    title, _ = drawing.document
    text: Any = rrb.TextDocumentView(origin=f"/log/{title.lower()}", name=title)
    if drawing.log is not None:
        shown = rrb.TextLogColumns(timeline_columns=[TimelineColumn(TIMELINE, visible=False)],
                                   text_log_columns=[TextLogColumn("LogLevel"), TextLogColumn("Body")])
        text = rrb.Tabs(rrb.TextLogView(contents=["/log/events", "/log/checks"], name=TEXTS, columns=shown), text)
    below = rrb.Horizontal(view_lanes(drawing.lanes_title, [*dict.fromkeys(others)]), text)
    height = min(max((75 + 40 * len(others)) / 1080, 0.3), 0.45)  # a lane has 40 of the window's 1080 pixels
    window = rrb.Vertical(rrb.Horizontal(*columns, column_shares=shares), below,
                          row_shares=[1 - height, height]) if columns else below
    return rrb.Blueprint(window, rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state=play_state),
                         rrb.BlueprintPanel(state="hidden"), rrb.SelectionPanel(state="hidden"))


def _choose_axis(plot: Plot) -> Any:
    """The value axis of a plot; None is the viewer's own choice, for where it prints enough numbers.

    The timing view ends where nearly all cycles do: one long pause of the machine must not flatten the rest.
    """
    import rerun.blueprint as rrb

    known = [found for curve in plot.curves if len(found := curve.values[~np.isnan(curve.values)])]
    if not known:
        return None
    if plot.origin == "timing":
        return rrb.ScalarAxis(range=(0.0, 1.5 * max(float(np.percentile(values, 99.5)) for values in known)))
    wider = widen_range(min(float(values.min()) for values in known), max(float(values.max()) for values in known))
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
