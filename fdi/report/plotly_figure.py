"""A drawn figure as a plotly figure, which can be zoomed and read off in a notebook or a browser."""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from plant.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
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
    shown = [ax for ax in figure.axes if ax.axison]
    for number, ax in enumerate(shown):
        end, place, joined = str(number + 1) if number else "", ax.get_position(), ax.get_shared_x_axes().joined
        first = next(k for k, other in enumerate(shown) if other is ax or joined(ax, other))
        matches = {"matches": f"x{first + 1 if first else ''}"} if first < number else {}
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
    out = {"title": {"text": axis.get_label_text().replace("\n", "<br>")}, "type": "log" if is_log else "linear",
           "range": (np.log10(limits) if is_log else limits).tolist(), "gridcolor": "#e4e7eb", "zeroline": False,
           "domain": np.clip(domain, 0.0, 1.0).tolist(), "anchor": anchor,
           "showticklabels": any(sides.get(f"label{side}") for side in ("bottom", "top", "left", "right"))}
    if isinstance(axis.get_major_locator(), FixedLocator):
        out |= {"tickvals": [float(tick) for tick in axis.get_ticklocs()],
                "ticktext": [label.get_text() for label in axis.get_ticklabels()]}
    return out


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
    found: Floats = (artist.get_transform() - ax.transData).transform(points)
    return found


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
