"""The vocabulary of all figures, and how a figure becomes SVG text inside a page, or one of plotly.

A panel is a list of marks, and a mark is a call on matplotlib's axes: `line(t, x, BLUE)`, `band(-floor, floor, GREEN)`,
`axes(ylabel="error [um]")`, `call("barh", ...)` for anything else. `draw_over_time` stacks panels on one time axis,
`draw_panels` sets them in rows. Nothing here loads matplotlib before a figure is drawn.
"""
from __future__ import annotations

import html
import io
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import chain
from operator import methodcaller
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fdi.output import write_text, write_whole
from fdi.report.numbers import choose_unit
from fdi.thresholds import NOISE_BAND_RATIO
from fdi.trace import Floats, Trace, rms
from plant import InputError, Signal, Signals

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure


Mark = Callable[[Any], Any]
Panel = Sequence[Mark]
INK, COMMAND, RED, GREEN = "#24292f", "#8b949e", "#c93c37", "#2b8a3e"
BLUE, ORANGE, AMBER, GREY, TEAL, PINK = "#1f6feb", "#d9730d", "#b7791f", "#57606a", "#0f8b8d", "#bf3989"
BEFORE, AFTER = "#9aa4b1", BLUE  # the model as it was, and as it is found
FAULT = "#ffd8a8"  # an injected fault
VIOLET = "#8250df"
OUTPUT_COLOURS = (BLUE, TEAL, PINK, VIOLET, GREY)  # of the outputs of a plant, in their order
STYLE: Any = {  # matplotlib's types want each key as a literal
    "svg.fonttype": "none", "font.family": "sans-serif", "font.size": 9, "axes.edgecolor": "#b6bcc4",
    "axes.grid": True, "axes.spines.top": False, "axes.spines.right": False, "grid.color": "#e4e7eb", "text.color": INK,
    "text.parse_math": False,  # a name in a log may have a dollar sign
    "path.simplify_threshold": 0.06,  # points; what may be lost shows when a figure is zoomed 20 times
    "axes.labelcolor": INK, "xtick.color": INK, "ytick.color": INK, "axes.axisbelow": True, "axes.titlesize": 9}
LINE_COLUMNS = 7300  # a line is drawn by its extremes in this many columns: each sample of a run of 14 s, for zooming


def choose_drawn_unit(signal: Signal, size: float) -> tuple[str, float]:
    """Unit and scale of an axis for errors of this size of a signal: the unit in which a table prints that size.

    >>> choose_drawn_unit(Signal("x", "X", "m", "position"), 2e-3)
    ('mm', 1000.0)
    """
    scale, unit = choose_unit(signal.unit, size)
    return unit, 1.0 / scale


def choose_colour(signals: Signals, name: str) -> str:
    """The colour of an output by its place; that of anything else is violet."""
    names = [s.name for s in signals.outputs]
    return OUTPUT_COLOURS[names.index(name) % len(OUTPUT_COLOURS)] if name in names else VIOLET


def label_signal(signal: Signal) -> str:
    """The label of an axis: symbol and unit."""
    return f"{signal.symbol} [{signal.shown_unit}]"


def name_controlled(signals: Signals) -> str:
    """What a page calls the controlled signal: the position of a ram, any other by its symbol."""
    return "position" if signals.controlled.unit == "m" else signals.controlled.symbol


call = methodcaller  # of matplotlib's `Axes`


def line(x: Any, y: Any, colour: str, label: str | None = None, width: float = 1.0, **style: Any) -> Mark:
    """A line through points."""
    return call("plot", x, y, color=colour, label=label, lw=width, **style)


def dot(x: float, y: float, colour: str, label: str | None = None, **style: Any) -> Mark:
    """A marker at one point."""
    return line([x], [y], colour, label, ls="", **{"marker": "o", "ms": 6, **style})


def level(y: float, colour: str, label: str | None = None, width: float = 1.0, style: str = "-") -> Mark:
    """A horizontal line through the whole panel."""
    return call("axhline", y, color=colour, label=label, lw=width, ls=style)


def levels(y: float, colour: str, label: str | None = None, width: float = 1.0, style: str = "-", middle: float = 0.0
           ) -> list[Mark]:
    """Horizontal lines on both sides of `middle`, with one label."""
    return [level(middle + y, colour, label, width, style), level(middle - y, colour, None, width, style)]


def instant(x: float, colour: str, label: str | None = None, width: float = 1.0, style: str = "-") -> Mark:
    """A vertical line through the whole panel."""
    return call("axvline", x, color=colour, label=label, lw=width, ls=style)


def band(low: float, high: float, colour: str, label: str | None = None, alpha: float = 0.25) -> Mark:
    """A shaded range of values through the whole panel."""
    return call("axhspan", low, high, color=colour, alpha=alpha, lw=0, label=label)


def shade(start: float, end: float, colour: str, alpha: float = 1.0) -> Mark:
    """A shaded range of x through the whole panel, behind all else."""
    return call("axvspan", start, end, color=colour, alpha=alpha, lw=0, zorder=-1)


def spans(ends: Sequence[tuple[float, float]], colour: str, height: float = 1.0, **style: Any) -> Mark:
    """Shaded spans of time from the foot of the panel up to a share of its height: one artist for hundreds of them."""
    widths = [(start, end - start) for start, end in ends]
    return lambda ax: ax.broken_barh(widths, (0.0, height), transform=ax.get_xaxis_transform(), color=colour, **style)


def area(x: Floats, low: Floats, high: Floats, colour: str, label: str | None = None, alpha: float = 0.25) -> Mark:
    """The shaded area between two curves."""
    return call("fill_between", x, low, high, color=colour, alpha=alpha, lw=0, label=label)


def axes(**settings: Any) -> Mark:
    """Labels, limits, scales and title, as matplotlib's `Axes.set` takes them."""
    return call("set", **settings)


def legend(columns: int = 1, **place: Any) -> Mark:
    """A legend above the panel, off the data."""
    return call("legend", ncols=columns, frameon=False,
                **place or {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.0})


def name_rows(names: Sequence[str]) -> list[Mark]:
    """Names at y = 0, 1, .. from the top, in place of numbers."""
    return [call("set_yticks", range(len(names)), names), call("grid", False, axis="y"),
            axes(ylim=(len(names) - 0.5, -0.5))]


def shade_sections(trace: Trace) -> list[Mark]:
    """The ramps (blue) and the dynamic sections (violet) of the command."""
    colours = {"ramp": "#f1f3f8", "dynamic": "#f7f1fa"}
    return [shade(float(trace.t[section.start]), float(trace.t[section.stop - 1]), colours[section.kind])
            for section in trace.sections() if section.kind in colours]


def draw_panels(salt: str, rows: Sequence[Sequence[Panel]], height: float, width: float = 11.0,
                common_legend: bool = False, layout: str | None = "constrained", **grid: Any) -> Drawing:
    """A figure of rows of panels, in inches; an empty panel stays blank.

    Args:
        salt: keeps the ids of the figure apart from those of other figures of a page.
        rows: the panels, row by row.
        height: of the figure.
        width: of the figure.
        common_legend: whether one legend, that of the last panel of the first row, stands above all.
        layout: as matplotlib's figures take it.
        grid: further arguments of `Figure.subplots`.
    """
    with start_figure(height, width, layout) as figure:
        places = figure.subplots(len(rows), len(rows[0]), squeeze=False, **grid)
        for ax, panel in zip(places.flat, chain.from_iterable(rows), strict=True):
            _draw_panel(ax, panel)
        if common_legend:
            figure.legend(*places[0, -1].get_legend_handles_labels(), loc="outside upper right", ncols=4, frameon=False)
        return to_svg(figure, salt)


def draw_grid(salt: str, rows: Sequence[Sequence[Panel]], height: float, gap: float) -> Drawing:
    """Rows of panels in a figure of this height, `gap` between those of a row, in inches; the margins are fixed.

    A layout that measures every tick label first takes as long as the drawing.
    """
    return draw_panels(salt, rows, height, 11.0, layout=None, gridspec_kw={
        "left": 0.85 / 11.0, "right": 1.0 - 0.1 / 11.0, "top": 1.0 - 0.25 / height, "bottom": 0.45 / height,
        "wspace": gap * len(rows[0]) / (10.05 - gap * (len(rows[0]) - 1)), "hspace": 0.7 / (height / len(rows) - 0.7)})


def draw_over_time(salt: str, trace: Trace, panels: Sequence[Panel], heights: Sequence[float], gap: float = 0.22,
                   xlabel: str = "time [s]") -> Drawing:
    """Panels above each other on the time axis of a trace, as high as `heights` says (inches), with its sections.

    The margins are fixed, as those of `draw_grid`.
    """
    width, left, right, top, bottom = 11.0, 0.95, 0.1, 0.3, 0.5
    height = top + sum(heights) + gap * (len(heights) - 1) + bottom
    place = {"left": left / width, "right": 1 - right / width, "top": 1 - top / height, "bottom": bottom / height,
             "hspace": gap * len(heights) / sum(heights)}
    common = [*shade_sections(trace), lambda ax: ax.yaxis.set_label_coords(-0.6 / (width - left - right), 0.5)]
    # a row lasts one period; one alone is no empty axis
    below = [axes(xlabel=xlabel, xlim=(float(trace.t[0]), float(trace.t[-1]) + trace.period)),
             lambda ax: ax.xaxis.set_label_coords(0.5, -0.3 / heights[-1])]
    rows = [[[*common, *panel]] for panel in panels]  # the sections lie behind what a panel shades
    rows[-1][0] += below
    return draw_panels(salt, rows, height, width, layout=None, sharex=True, height_ratios=heights, gridspec_kw=place)


def _draw_panel(ax: Axes, panel: Panel) -> None:
    if not panel:
        ax.set_axis_off()
    for mark in panel:
        mark(ax)
    for axis in (ax.xaxis, ax.yaxis):
        if axis.get_scale() == "log":
            label_log_axis(axis)


def draw_residuals(salt: str, trace: Trace, models: Sequence[tuple[str, str, Floats]], floor: Mapping[str, float],
                   is_cut: bool = False) -> Drawing:
    """The residual, measured minus model, of each signal over time with one or two models, below the command.

    Args:
        salt: as for `draw_panels`.
        trace: the run.
        models: (label, colour, model minus measured (s, n) in SI) of each model.
        floor: RMS of the noise of each signal, SI; dotted lines at twice of it.
        is_cut: whether the last model's residual sets the height of a panel.
    """
    command = trace.declared.command
    panels: list[Panel] = [[line(trace.t, trace.command * command.shown_scale, COMMAND, width=1.6),
                            axes(ylabel=label_signal(command))]]
    for i, name in enumerate(trace.outputs):
        signal = trace.declared.find(name)
        unit, scale = choose_drawn_unit(signal, rms(models[0][2][i]))
        half = scale * max(8.0 * floor[name], 1.2 * float(np.nanmax(np.abs(models[-1][2][i]))))
        panels.append([*(line(trace.t, -misfit[i] * scale, colour, label, 0.9) for label, colour, misfit in models),
                       *levels(NOISE_BAND_RATIO * floor[name] * scale, GREEN, "two noise floors", 1.4, ":"),
                       axes(ylabel=f"{signal.symbol} [{unit}]", **{"ylim": (-half, half)} if is_cut else {}),
                       *([legend(3)] if i == 0 else [])])
    return draw_over_time(salt, trace, panels, [0.8] + [1.3] * len(trace.outputs),
                          xlabel="time [s]; what is beyond an axis is cut off" if is_cut else "time [s]")


class Drawing(str):
    """A figure as SVG text, and the matplotlib figure that it was made from."""

    figure: Figure


@contextmanager
def start_figure(height: float, width: float = 11.0, layout: Any = "constrained") -> Iterator[Figure]:
    """An empty figure of this size in inches; the style of all reports holds while it is drawn."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        yield Figure(figsize=(width, height), layout=layout)


def label_log_axis(axis: Axis) -> None:
    """Label a logarithmic axis with plain numbers: matplotlib's own labels are formulas, which the style does not draw.

    Where it shows less than two decades, 2 and 5 times the powers of ten have labels too.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    low, high = sorted(axis.get_view_interval())
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 100.0 * low else (1.0,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def thin_line(t: Floats, values: Floats) -> tuple[Floats, Floats]:
    """The smallest and largest value in each of `LINE_COLUMNS` pieces, in order of time: looks like the whole line."""
    if len(t) <= 2 * LINE_COLUMNS:
        return t, values
    width = -(-len(t) // LINE_COLUMNS)
    rows = np.minimum(np.arange(width * LINE_COLUMNS), len(t) - 1).reshape(-1, width)
    missing = np.isnan(values)[rows]
    # of each piece the first row that has its extreme, and the first that is missing
    positions = (np.where(missing, np.inf, values[rows]).argmin(1), np.where(missing, -np.inf, values[rows]).argmax(1),
                 missing.argmax(1))
    thinned_rows = np.unique(np.concatenate([rows[np.arange(len(rows)), at] for at in positions]))
    return t[thinned_rows], values[thinned_rows]


def to_svg(figure: Figure, salt: str) -> Drawing:
    """A figure as text that stands inside a page; `salt` keeps its ids apart from those of other figures.

    Long lines are thinned in the text alone. An attribute data-axes tells the page's script (figure.js) what it needs
    for zoom and cursor.
    """
    from matplotlib import rc_context

    _name_artists(figure, salt)
    lines = [(artist, artist.get_data(orig=False)) for ax in figure.axes for artist in ax.lines]
    for artist, points in lines:
        artist.set_data(*thin_line(*map(np.asarray, points)))
    out = io.StringIO()
    with rc_context(STYLE | {"svg.hashsalt": salt}):
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    for artist, points in lines:
        artist.set_data(*points)
    text = shorten_svg(out.getvalue(), 2)
    notes = html.escape(json.dumps([*_describe_axes(figure, salt)], separators=(",", ":")))
    drawing = Drawing(f'<svg data-axes="{notes}"{text[text.index("<svg") + 4:]}')
    drawing.figure = figure
    return drawing


def save_drawing(drawing: Drawing, path: Path, option: str) -> None:
    """Write a figure: .svg as a page shows it; .png, .pdf and what else matplotlib writes.

    Raises:
        InputError: a path that cannot be written, or a format that matplotlib does not know; it names `option`.
    """
    if path.suffix in ("", ".svg"):
        write_text(path, drawing, option)
        return
    try:
        with write_whole(path) as part:
            drawing.figure.savefig(part, dpi=150)
    except (OSError, ValueError) as error:
        raise InputError(option, str(path), f"a file of a known kind that can be written ({error})") from error


def _name_artists(figure: Figure, salt: str) -> None:
    """Give axes, lines and texts ids that no other figure of a page has."""
    for i, ax in enumerate(figure.axes):
        ax.set_gid(f"{salt}-{i}")
        for kind, artists in (("line", ax.lines), ("text", ax.texts)):
            for j, artist in enumerate(artists):
                artist.set_gid(f"{salt}-{i}-{kind}{j}")


def _describe_axes(figure: Figure, salt: str) -> Iterator[dict[str, Any]]:
    """Box (points from the top left: x0, top, x1, bottom), limits, labels, lines and texts of each axes of a figure.

    Axes with the same `group` have one x axis. Axes that are not drawn are left out.
    """
    width, height = (72.0 * inches for inches in figure.get_size_inches())
    for i, ax in enumerate(figure.axes):
        if not ax.axison:
            continue
        place = ax.get_position()
        is_joined = ax.get_shared_x_axes().joined
        group = min(j for j, other in enumerate(figure.axes) if other is ax or is_joined(ax, other))
        limits = [_find_limits(ax.xaxis, ax.get_xlim()), _find_limits(ax.yaxis, ax.get_ylim())]
        yield {
            "id": f"{salt}-{i}", "group": group, "xlabel": ax.get_xlabel(), "ylabel": ax.get_ylabel(),
            "box": [round(float(x), 3) for x in (place.x0 * width, (1 - place.y1) * height, place.x1 * width,
                                                 (1 - place.y0) * height)],
            "x": limits[0][1], "y": limits[1][1], "kinds": [kind for kind, _ in limits],
            "lines": [[line.get_gid(), "" if str(line.get_label()).startswith("_") else str(line.get_label())]
                      for line in ax.lines if len(np.asarray(line.get_xdata())) > 2],
            "texts": [text.get_gid() for text in ax.texts]}


def _find_limits(axis: Axis, limits: tuple[float, float]) -> tuple[str, list[float]]:
    """Kind of an axis (linear, log, date, names) and its limits; decimal logarithms of them on a logarithmic axis."""
    from matplotlib.dates import DateLocator
    from matplotlib.ticker import FixedLocator

    if axis.get_scale() == "log":
        return "log", np.log10(limits).tolist()
    kinds = {DateLocator: "date", FixedLocator: "names"}  # ticks at fixed places have names, or there are none
    kind = next((word for locator, word in kinds.items() if isinstance(axis.get_major_locator(), locator)), "linear")
    return kind, [float(x) for x in limits]


def shorten_svg(drawing: str, decimals: int = 1) -> str:
    """The same drawing with so many decimals of a point in its lines; one is enough for a file that is kept."""
    digits = re.compile(rf"(?<=\.\d{{{decimals}}})\d+")
    return re.sub(r'(?<= d=")[^"]*', lambda line: digits.sub("", line[0]), drawing)


MARKERS = {"|": "line-ns-open", "_": "line-ew-open", "s": "square", "D": "diamond", "x": "x-thin-open",
           "^": "triangle-up", "v": "triangle-down"}  # matplotlib's to plotly's
DASHES = {"--": "dash", ":": "dot", "-.": "dashdot"}


def convert_figure(figure: Figure) -> Any:
    """A matplotlib figure as one of plotly: lines, areas, bars, shaded bands, maps and texts.

    Panels of one time axis are zoomed together. Contours and places of legends are left out; a band through the whole
    panel ends at the limits of the figure.

    Raises:
        InputError: plotly is not installed.
    """
    try:
        from plotly.graph_objects import Figure as PlotlyFigure
    except ImportError:
        raise InputError("plotly", "", "the library plotly: pip install 'eha-rig[plots]'") from None
    figure.draw_without_rendering()  # places the axes
    out = PlotlyFigure()
    panels = [ax for ax in figure.axes if ax.axison]
    ends = ["", *map(str, range(2, len(panels) + 1))]  # of the names that plotly gives axes
    for number, (end, ax) in enumerate(zip(ends, panels, strict=False)):
        place, is_joined = ax.get_position(), ax.get_shared_x_axes().joined
        first = next(k for k, other in enumerate(panels) if other is ax or is_joined(ax, other))
        matches = {"matches": f"x{ends[first]}"} if first < number else {}
        out.layout[f"xaxis{end}"] = _describe_axis(ax.xaxis, place.intervalx, f"y{end}") | matches
        out.layout[f"yaxis{end}"] = _describe_axis(ax.yaxis, place.intervaly, f"x{end}")
        title = {"text": ax.get_ylabel().replace("\n", " ")}
        for trace in _list_traces(ax):
            out.add_trace({"showlegend": False, **trace, "xaxis": f"x{end}", "yaxis": f"y{end}",
                           "legendgroup": str(number), "legendgrouptitle": title})
        for text in [text for text in ax.texts if text.get_text()]:
            x, y = text.get_position()
            out.add_annotation(text=text.get_text().replace("\n", "<br>"), x=x, y=y, xref=f"x{end}", yref=f"y{end}",
                               showarrow=False, font={"size": 10})
        out.add_annotation(text=ax.get_title(), x=0.5, y=1.0, xref=f"x{end} domain", yref=f"y{end} domain",
                           yanchor="bottom", showarrow=False)
    inch = 96  # pixels
    out.update_layout(width=round(figure.get_figwidth() * inch), height=round(figure.get_figheight() * inch),
                      plot_bgcolor="white", margin={"l": 20, "r": 20, "t": 20, "b": 20}, hovermode="x")
    return out


def _describe_axis(axis: Axis, domain: Any, anchor: str) -> dict[str, Any]:
    from matplotlib.ticker import FixedLocator

    is_log, sides = axis.get_scale() == "log", axis.get_tick_params()
    limits = np.asarray(axis.get_view_interval(), float)
    ticks = {"tickvals": [float(tick) for tick in axis.get_ticklocs()],
             "ticktext": [label.get_text() for label in axis.get_ticklabels()]}
    return {"title": {"text": axis.get_label_text().replace("\n", "<br>")}, "type": "log" if is_log else "linear",
            "range": (np.log10(limits) if is_log else limits).tolist(), "gridcolor": "#e4e7eb", "zeroline": False,
            "domain": np.clip(domain, 0.0, 1.0).tolist(), "anchor": anchor,
            "showticklabels": any(sides.get(f"label{side}") for side in ("bottom", "top", "left", "right")),
            **(ticks if isinstance(axis.get_major_locator(), FixedLocator) else {})}


def _list_traces(ax: Axes) -> Iterator[dict[str, Any]]:
    """Maps, areas and bars, then lines; all in the coordinates of the data."""
    from matplotlib.collections import LineCollection

    for image in ax.images:
        left, right, bottom, top = image.get_extent()
        values = np.asarray(image.get_array(), float)
        rows, columns = values.shape[:2]
        yield {"type": "heatmap", "z": values, "x": left + (right - left) * (np.arange(columns) + 0.5) / columns,
               "y": bottom + (top - bottom) * (np.arange(rows) + 0.5) / rows, "showscale": False}
    for patch in sorted(ax.patches, key=lambda patch: patch.get_zorder()):
        yield _make_area(_find_points(ax, patch, [patch.get_path()]), patch.get_facecolor())
    for collection in ax.collections:
        paths, colours = collection.get_paths(), collection.get_facecolor()
        if isinstance(collection, LineCollection):
            yield _make_line(_find_points(ax, collection, paths), collection.get_color()[0], 1.0)
        for k, path in enumerate(paths) if len(colours) else ():
            yield _make_area(_find_points(ax, collection, [path]), colours[k % len(colours)])
    for line in ax.lines:
        trace = _make_line(_find_points(ax, line, [line.get_path()]), line.get_color(), line.get_linewidth(),
                           DASHES.get(str(line.get_linestyle()), "solid"))
        if line.get_marker() not in ("None", "none", "", None):
            is_bare = line.get_linestyle() in ("None", "none", "")
            symbol = MARKERS.get(str(line.get_marker()), "circle")
            trace |= {"mode": "markers" if is_bare else "lines+markers",
                      "marker": {"color": _format_colour(line.get_color()), "size": 6, "symbol": symbol}}
        if not str(line.get_label()).startswith("_"):
            trace |= {"name": str(line.get_label()), "showlegend": True}
        yield trace


def _find_points(ax: Axes, artist: Any, paths: Sequence[Any]) -> Floats:
    """The corners of paths, (n, 2), with a gap after each but the last; spans end at the limits of the panel."""
    gap = [[np.nan, np.nan]]
    points = np.vstack([rows for path in paths for rows in (path.vertices, gap)][:-1])
    return np.asarray((artist.get_transform() - ax.transData).transform(points))


def _make_line(points: Floats, colour: Any, width: float, dash: str = "solid") -> dict[str, Any]:
    return {"type": "scatter", "mode": "lines", "x": points[:, 0], "y": points[:, 1],
            "line": {"color": _format_colour(colour), "width": width, "dash": dash}}


def _make_area(points: Floats, colour: Any) -> dict[str, Any]:
    return {"type": "scatter", "mode": "lines", "x": points[:, 0], "y": points[:, 1], "fill": "toself",
            "fillcolor": _format_colour(colour), "line": {"width": 0}, "hoverinfo": "skip"}


def _format_colour(colour: Any) -> str:
    from matplotlib.colors import to_rgba

    red, green, blue, alpha = to_rgba(colour)
    return f"rgba({round(255 * red)},{round(255 * green)},{round(255 * blue)},{alpha:.3g})"
