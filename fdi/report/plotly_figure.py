"""A drawn figure as a plotly figure, which can be zoomed and read off in a notebook or a browser."""
from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from plant.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
MARKERS = {"|": "line-ns-open", "_": "line-ew-open", "s": "square", "D": "diamond", "x": "x-thin-open",
           "^": "triangle-up", "v": "triangle-down"}  # matplotlib's to plotly's


def convert_figure(figure: Figure) -> Any:
    """A matplotlib figure as one of plotly: lines, areas, bars, shaded bands, maps and texts.

    Lines that are shared by all plots of a column stay shared when zoomed. Contours and legends' places are left out.

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
    for number, ax in enumerate(shown, 1):
        shared = next((k for k, other in enumerate(shown[:number - 1], 1) if ax.get_shared_x_axes().joined(ax, other)),
                      None)
        suffix = "" if number == 1 else str(number)
        out.layout[f"xaxis{suffix}"], out.layout[f"yaxis{suffix}"] = _describe_axes(ax, suffix, shared)
        title = ax.get_ylabel().replace("\n", " ")
        for trace in _list_traces(ax):
            out.add_trace({**trace, "xaxis": f"x{suffix}", "yaxis": f"y{suffix}", "legendgroup": str(number),
                           "legendgrouptitle": {"text": title}})
        for shape in _list_spans(ax, suffix):
            out.add_shape(shape)
        for text in _list_texts(ax, suffix):
            out.add_annotation(text)
    inch = 96  # pixels
    out.update_layout(width=round(figure.get_figwidth() * inch), height=round(figure.get_figheight() * inch),
                      plot_bgcolor="white", margin={"l": 20, "r": 20, "t": 20, "b": 20}, hovermode="x")
    return out


def _describe_axes(ax: Axes, suffix: str, shared: int | None) -> tuple[dict[str, Any], dict[str, Any]]:
    """The layout of both axes; `shared` is the number of the axes whose x axis this one follows."""
    place = ax.get_position()
    x: dict[str, Any] = {"domain": _clip(place.x0, place.x1), "anchor": f"y{suffix}"}
    y: dict[str, Any] = {"domain": _clip(place.y0, place.y1), "anchor": f"x{suffix}"}
    for out, axis, limits, scale, sides in (
            (x, ax.xaxis, ax.get_xlim(), ax.get_xscale(), ("labelbottom", "labeltop")),
            (y, ax.yaxis, ax.get_ylim(), ax.get_yscale(), ("labelleft", "labelright"))):
        is_log = scale == "log"
        out |= {"title": {"text": axis.get_label_text().replace("\n", "<br>")}, "type": "log" if is_log else "linear",
                "range": [math.log10(limit) if is_log else float(limit) for limit in limits], "gridcolor": "#e4e7eb",
                "zeroline": False, "showticklabels": any(axis.get_tick_params()[side] for side in sides)}
        words = [label.get_text() for label in axis.get_ticklabels()]
        if any(word and not _is_number(word) for word in words):
            out |= {"tickvals": [float(tick) for tick in axis.get_ticklocs()], "ticktext": words}
    if shared is not None:
        x["matches"] = "x" if shared == 1 else f"x{shared}"
    return x, y


def _clip(low: float, high: float) -> list[float]:
    return [min(max(low, 0.0), 1.0), min(max(high, 0.0), 1.0)]


def _is_number(word: str) -> bool:
    try:
        float(word.replace("−", "-"))
    except ValueError:
        return False
    return True


def _list_traces(ax: Axes) -> Iterator[dict[str, Any]]:
    """Lines, areas, bars and maps, those below first."""
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.patches import Rectangle

    for patch in ax.patches:
        if isinstance(patch, Rectangle) and not _is_span(ax, patch):
            corners = patch.get_patch_transform().transform(patch.get_path().vertices)
            yield _make_area(corners, patch.get_facecolor())
    for image in ax.images:
        left, right, bottom, top = image.get_extent()
        values = np.asarray(image.get_array(), float)
        rows, columns = values.shape[:2]
        y = bottom + (top - bottom) * (np.arange(rows) + 0.5) / rows
        yield {"type": "heatmap", "z": values, "x": left + (right - left) * (np.arange(columns) + 0.5) / columns,
               "y": y if image.origin == "lower" else y[::-1], "showscale": False}
    for collection in ax.collections:
        if isinstance(collection, PolyCollection):
            colours = collection.get_facecolor()
            for k, path in enumerate(collection.get_paths()):
                yield _make_area(np.asarray(path.vertices), colours[k % len(colours)])
        elif isinstance(collection, LineCollection):
            parts = [np.vstack([segment, [np.nan, np.nan]]) for segment in collection.get_segments()]
            if parts:
                yield _make_line(np.vstack(parts), collection.get_color()[0], 1.0)
    for line in ax.lines:
        if line.get_transform() == ax.transData:
            label = str(line.get_label())
            style = {"--": "dash", ":": "dot", "-.": "dashdot"}.get(str(line.get_linestyle()), "solid")
            points = np.column_stack([np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)])
            trace = _make_line(points, line.get_color(), line.get_linewidth(), style)
            if line.get_marker() not in ("None", "none", "", None):
                is_bare = line.get_linestyle() in ("None", "none", "")
                symbol = MARKERS.get(str(line.get_marker()), "circle")
                trace |= {"mode": "markers" if is_bare else "lines+markers",
                          "marker": {"color": _format_colour(line.get_color()), "size": 6, "symbol": symbol}}
            if label and not label.startswith("_"):
                trace |= {"name": label, "showlegend": True}
            yield trace


def _make_line(points: Floats, colour: Any, width: float, dash: str = "solid") -> dict[str, Any]:
    return {"type": "scatter", "mode": "lines", "x": points[:, 0], "y": points[:, 1], "showlegend": False,
            "line": {"color": _format_colour(colour), "width": width, "dash": dash}}


def _make_area(points: Floats, colour: Any) -> dict[str, Any]:
    return {"type": "scatter", "mode": "lines", "x": points[:, 0], "y": points[:, 1], "fill": "toself",
            "fillcolor": _format_colour(colour), "line": {"width": 0}, "showlegend": False, "hoverinfo": "skip"}


def _format_colour(colour: Any) -> str:
    from matplotlib.colors import to_rgba

    red, green, blue, alpha = to_rgba(colour)
    return f"rgba({round(255 * red)},{round(255 * green)},{round(255 * blue)},{alpha:.3g})"


def _is_span(ax: Axes, patch: Any) -> bool:
    """Whether a rectangle goes through the whole axes, in one direction."""
    return bool(patch.get_transform() != patch.get_patch_transform() + ax.transData)


def _list_spans(ax: Axes, suffix: str) -> Iterator[dict[str, Any]]:
    """Bands and lines that go through the whole axes."""
    from matplotlib.patches import Rectangle

    for patch in sorted(ax.patches, key=lambda patch: patch.get_zorder()):
        if isinstance(patch, Rectangle) and _is_span(ax, patch):
            (x0, y0), (x1, y1) = patch.get_xy(), (patch.get_x() + patch.get_width(), patch.get_y() + patch.get_height())
            is_upright = (y0, y1) == (0.0, 1.0)
            yield {"type": "rect", **_span(suffix, is_upright), "x0": x0, "x1": x1, "y0": y0, "y1": y1,
                   "fillcolor": _format_colour(patch.get_facecolor()), "line": {"width": 0}, "layer": "below"}
    for line in ax.lines:
        if line.get_transform() != ax.transData:
            x, y = np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)
            is_upright = (y[0], y[-1]) == (0.0, 1.0) and x[0] == x[-1]
            yield {"type": "line", **_span(suffix, is_upright), "x0": x[0], "x1": x[-1], "y0": y[0], "y1": y[-1],
                   "line": {"color": _format_colour(line.get_color()), "width": line.get_linewidth()}}


def _span(suffix: str, is_upright: bool) -> dict[str, str]:
    """The references of a shape that goes through the whole axes from bottom to top, or from left to right."""
    whole = " domain"
    return {"xref": f"x{suffix}" + ("" if is_upright else whole), "yref": f"y{suffix}" + (whole if is_upright else "")}


def _list_texts(ax: Axes, suffix: str) -> Iterator[dict[str, Any]]:
    """The texts and the title of the axes."""
    if ax.get_title():
        yield {"text": ax.get_title(), "x": 0.5, "y": 1.0, "xref": f"x{suffix} domain", "yref": f"y{suffix} domain",
               "yanchor": "bottom", "showarrow": False}
    for text in ax.texts:
        if text.get_text() and text.get_transform() == ax.transData:
            x, y = text.get_position()
            yield {"text": text.get_text().replace("\n", "<br>"), "x": x, "y": y, "xref": f"x{suffix}",
                   "yref": f"y{suffix}", "showarrow": False, "font": {"size": 10}}
