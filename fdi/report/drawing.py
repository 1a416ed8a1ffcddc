"""What all figures share: style, colours, thinning of long lines, and SVG text that stands inside a page.

Nothing here loads matplotlib before a figure is drawn.
"""
from __future__ import annotations

import html
import io
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fdi.report.numbers import SIGNAL_UNITS, choose_unit
from fdi.trace.sections import find_sections
from fdi.trace.trace import Trace

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
INK, COMMAND, RED, GREEN = "#24292f", "#8b949e", "#c93c37", "#2b8a3e"
FAULT = "#ffd8a8"  # an injected fault
STYLE: Any = {  # matplotlib's types want each key as a literal
    "svg.fonttype": "none", "font.family": "sans-serif", "font.size": 9, "axes.edgecolor": "#b6bcc4",
    "axes.grid": True, "axes.spines.top": False, "axes.spines.right": False, "grid.color": "#e4e7eb", "text.color": INK,
    "text.parse_math": False,  # a name in a log may have a dollar sign
    "path.simplify_threshold": 0.06,  # points; what may be lost shows when a figure is zoomed 20 times
    "axes.labelcolor": INK, "xtick.color": INK, "ytick.color": INK, "axes.axisbelow": True}
DRAWN_UNITS = {"xj": ("um", 1e6), "p12": ("bar", 1e-5), "xs": ("um", 1e6)}  # of small differences: unit, scale of SI
LEVELS = {"xj": ("mm", 1e3), "cor": ("mA", 1e3), "load": ("kN", 1e-3), "p12": ("bar", 1e-5), "xs": ("um", 1e6)}
"""Unit and scale of a signal itself."""
ABOVE: Any = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "frameon": False, "borderaxespad": 0.0}
"""Place of a legend above the axes, off the data."""
LINE_COLUMNS = 7300  # a line is drawn by its extremes in this many columns: each sample of a run of 14 s, for zooming
_keeps_all_points = ContextVar("keeps_all_points", default=False)


def choose_drawn_unit(name: str, size: float) -> tuple[str, float]:
    """Unit and scale of an axis for errors of this size of a signal: the unit in which a table prints that size.

    >>> choose_drawn_unit("xj", 2e-3), choose_drawn_unit("p12", 1e4)
    (('mm', 1000.0), ('bar', 1e-05))
    """
    scale, unit = choose_unit(SIGNAL_UNITS[name], size)
    return unit, 1.0 / scale


class Drawing(str):
    """A figure as SVG text, and the matplotlib figure that it was made from."""

    figure: Figure


@contextmanager
def keep_all_points() -> Iterator[None]:
    """Draw lines with all their points: a figure that is zoomed shows more than a page does."""
    token = _keeps_all_points.set(True)
    try:
        yield
    finally:
        _keeps_all_points.reset(token)


@contextmanager
def start_figure(height: float, width: float = 11.0) -> Iterator[Figure]:
    """An empty figure of this size in inches; the style of all reports holds while it is drawn."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        yield Figure(figsize=(width, height), layout="constrained")


def shade_sections(ax: Axes, trace: Trace) -> None:
    """Shade the ramps (blue) and the dynamic sections (violet) of the command."""
    for section in find_sections(trace.com, trace.period):
        if section.kind in ("ramp", "dynamic"):
            ax.axvspan(float(trace.t[section.start]), float(trace.t[section.stop - 1]),
                       color="#f1f3f8" if section.kind == "ramp" else "#f7f1fa", lw=0, zorder=-1)


def label_log_axis(axis: Axis) -> None:
    """Label a logarithmic axis with plain numbers: matplotlib's own labels are formulas, which the style does not draw.

    Where it shows less than two decades, 2 and 5 times the powers of ten have labels too.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = sorted(axis.get_view_interval())
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 100.0 * low else (1.0,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def thin_line(t: Floats, values: Floats) -> tuple[Floats, Floats]:
    """The smallest and largest value in each of `LINE_COLUMNS` pieces, in order of time: looks like the whole line."""
    if len(t) <= 2 * LINE_COLUMNS or _keeps_all_points.get():
        return t, values
    starts = _piece_starts(len(t))
    length = np.diff(starts, append=len(t))
    missing = np.isnan(values)
    low = np.minimum.reduceat(np.where(missing, np.inf, values), starts)
    high = np.maximum.reduceat(np.where(missing, -np.inf, values), starts)
    # the first row of a piece that has its extreme, and the first that is missing
    candidates = (values == np.repeat(low, length), values == np.repeat(high, length), missing)
    pieces = np.repeat(np.arange(len(starts)), length)
    rows = [found[np.unique(pieces[found], return_index=True)[1]] for found in map(np.flatnonzero, candidates)]
    chosen = np.unique(np.concatenate(rows))
    return t[chosen], values[chosen]


def _piece_starts(rows: int) -> NDArray[np.intp]:
    """First row of each of LINE_COLUMNS pieces of nearly equal length, as `numpy.array_split` cuts them."""
    short, longer = divmod(rows, LINE_COLUMNS)
    return np.cumsum([0, *[short + 1] * longer, *[short] * (LINE_COLUMNS - longer - 1)])


def to_svg(figure: Figure, salt: str) -> Drawing:
    """A figure as text that stands inside a page; `salt` keeps its ids apart from those of other figures.

    An attribute data-axes tells the page's script (figure.js) what it needs for zoom and cursor.
    """
    from matplotlib import rc_context

    _name_artists(figure, salt)
    out = io.StringIO()
    with rc_context(STYLE | {"svg.hashsalt": salt}):
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = shorten_svg(out.getvalue(), 2)
    notes = html.escape(json.dumps(_describe_axes(figure, salt), separators=(",", ":")))
    drawing = Drawing(f'<svg data-axes="{notes}"{text[text.index("<svg") + 4:]}')
    drawing.figure = figure
    return drawing


def _name_artists(figure: Figure, salt: str) -> None:
    """Give axes, lines and texts ids that no other figure of a page has."""
    for i, ax in enumerate(figure.axes):
        ax.set_gid(f"{salt}-{i}")
        for kind, artists in (("line", ax.lines), ("text", ax.texts)):
            for j, artist in enumerate(artists):
                artist.set_gid(f"{salt}-{i}-{kind}{j}")


def _describe_axes(figure: Figure, salt: str) -> list[dict[str, Any]]:
    """Box (points from the top left: x0, top, x1, bottom), limits, labels, lines and texts of each axes of a figure.

    Axes with the same `group` have one x axis. Axes that are not drawn are left out.
    """
    width, height = (72.0 * inches for inches in figure.get_size_inches())
    notes = []
    for i, ax in enumerate(figure.axes):
        if not ax.axison:
            continue
        place = ax.get_position()
        joined = ax.get_shared_x_axes().joined
        shared = min(j for j, other in enumerate(figure.axes) if other is ax or joined(ax, other))
        limits = [_find_limits(ax.xaxis, ax.get_xlim()), _find_limits(ax.yaxis, ax.get_ylim())]
        notes.append({
            "id": f"{salt}-{i}", "group": shared, "xlabel": ax.get_xlabel(), "ylabel": ax.get_ylabel(),
            "box": [round(float(x), 3) for x in (place.x0 * width, (1 - place.y1) * height, place.x1 * width,
                                                 (1 - place.y0) * height)],
            "x": limits[0][1], "y": limits[1][1], "kinds": [kind for kind, _ in limits],
            "lines": [[line.get_gid(), "" if str(line.get_label()).startswith("_") else str(line.get_label())]
                      for line in ax.lines if len(np.asarray(line.get_xdata())) > 2],
            "texts": [text.get_gid() for text in ax.texts]})
    return notes


def _find_limits(axis: Axis, limits: tuple[float, float]) -> tuple[str, list[float]]:
    """Kind of an axis (linear, log, date, names) and its limits; decimal logarithms of them on a logarithmic axis."""
    from matplotlib.dates import DateLocator
    from matplotlib.ticker import FixedFormatter

    low, high = (float(x) for x in limits)
    if axis.get_scale() == "log":
        return "log", [float(np.log10(low)), float(np.log10(high))]
    if isinstance(axis.get_major_locator(), DateLocator):
        return "date", [low, high]
    is_named = isinstance(axis.get_major_formatter(), FixedFormatter) or not len(axis.get_majorticklocs())
    return "names" if is_named else "linear", [low, high]


def shorten_svg(drawing: str, decimals: int = 1) -> str:
    """The same drawing with so many decimals of a point in its lines; one is enough for a file that is kept."""
    digits = re.compile(rf"(\.\d{{{decimals}}})\d+")
    return re.sub(r'(?<= d=")[^"]*', lambda line: digits.sub(r"\1", line[0]), drawing)
