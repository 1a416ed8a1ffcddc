"""What all figures share: style, colours, thinning of long lines, and SVG text that stands inside a page.

Nothing here loads matplotlib before a figure is drawn.
"""
from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fdi.trace.sections import find_sections
from fdi.trace.trace import Trace

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
INK, COMMAND, RED, GREEN = "#24292f", "#8b949e", "#c93c37", "#2b8a3e"
STYLE: Any = {  # matplotlib's types want each key as a literal
    "svg.fonttype": "none", "font.family": "sans-serif", "font.size": 9, "axes.edgecolor": "#b6bcc4",
    "axes.grid": True, "axes.spines.top": False, "axes.spines.right": False, "grid.color": "#e4e7eb", "text.color": INK,
    "text.parse_math": False,  # a name in a log may have a dollar sign
    "axes.labelcolor": INK, "xtick.color": INK, "ytick.color": INK, "axes.axisbelow": True}
DRAWN_UNITS = {"xj": ("um", 1e6), "p12": ("bar", 1e-5), "xs": ("um", 1e6)}  # unit of an axis, and SI value to it
LINE_COLUMNS = 1400  # a line is drawn by its extremes in this many columns; a page shows no more


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

    Where it shows less than a decade and a half, 2 and 5 times the powers of ten have labels too.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = sorted(axis.get_view_interval())
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 30.0 * low else (1.0,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def thin_line(t: Floats, values: Floats) -> tuple[Floats, Floats]:
    """The smallest and largest value in each of `LINE_COLUMNS` pieces, in order of time: looks like the whole line."""
    if len(t) <= 2 * LINE_COLUMNS:
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


def to_svg(figure: Figure, salt: str) -> str:
    """A figure as text that stands inside a page; `salt` keeps its ids apart from those of other figures."""
    from matplotlib import rc_context

    out = io.StringIO()
    with rc_context(STYLE | {"svg.hashsalt": salt}):
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = out.getvalue()
    return text[text.index("<svg"):]


def shorten_svg(drawing: str) -> str:
    """The same drawing with one decimal of a point in its lines, for a file that is kept; its texts stay."""
    return re.sub(r'(?<= d=")[^"]*', lambda line: re.sub(r"(\d+\.\d)\d+", r"\1", line[0]), drawing)
