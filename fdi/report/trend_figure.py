"""The figure of a trend: sizes with their intervals, the fitted course, the forecast, and the two limits."""
from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fdi.prognosis.trend import Trend
from fdi.prognosis.unit_trend import LIMIT_NAMES, UnitTrend
from fdi.report.drawing import COMMAND, INK, RED, STYLE, to_svg
from plant.errors import InputError

COURSE, AHEAD, MIDDLE = "#1f6feb", "#d9730d", "#b7791f"
LABELS = {"kintas": "filter clogging, Kintas", "fss": "spool friction, FSS"}


def draw_trends(unit: UnitTrend) -> str:
    """Both faults as SVG text that stands inside a page."""
    with rc_context(STYLE):
        return to_svg(_build_figure(unit), "trend")


def save_trends(unit: UnitTrend, out: Path) -> None:
    """Both faults as .png or .svg.

    Raises:
        InputError: a file that cannot be written.
    """
    with rc_context(STYLE):
        try:
            undated = {"Date": None} if out.suffix == ".svg" else None
            _build_figure(unit).savefig(out, dpi=130, facecolor="white", metadata=undated)
        except OSError as error:
            raise InputError("--out", str(out), f"a file that can be written ({error.strerror})") from error


def _build_figure(unit: UnitTrend) -> Figure:
    figure = Figure(figsize=(11, 7.2), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True)
    for ax, trend in zip(axes, unit.trends, strict=True):
        _draw_fault(ax, trend, unit)
    axes[0].legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=5, frameon=False)
    if unit.gathered.axis != "date":
        axes[-1].set_xlabel(f"{unit.gathered.axis} [{unit.unit}]")
    return figure


def _draw_fault(ax: Axes, trend: Trend, unit: UnitTrend) -> None:
    t = _convert_times(np.array([p.t for p in unit.gathered.points[-len(trend.t):]]), unit)
    value, low, high = np.array(trend.sizes).T
    limits = {"maintenance": (trend.fault.middle, MIDDLE), "non_nominal": (trend.fault.most, RED)}
    if trend.past is not None and trend.future is not None:
        curves = (trend.past, COURSE, "fitted course"), (trend.future, AHEAD, "forecast, 95 %")
        for curve, colour, name in curves:
            at = _convert_times(curve.t, unit)
            ax.fill_between(at, curve.low, curve.high, color=colour, alpha=0.15, lw=0)
            ax.plot(at, curve.middle, color=colour, lw=1.4, label=name, ls="-" if curve is trend.past else "--")
    for used, colour, name in ((trend.used, INK, "traces"), (~trend.used, COMMAND, "traces left out")):
        if used.any():
            ax.errorbar(t[used], value[used], [(value - low)[used], (high - value)[used]], fmt="o", ms=4, lw=1,
                        color=colour, label=name)
    top = 1.25 * max(trend.fault.most, float(value.max()))
    last = _convert_times(np.array([max(trend.t[-1], trend.future.t[-1] if trend.future else -np.inf)]), unit)[0]
    for level, (limit, colour) in limits.items():
        ax.axhline(limit, color=colour, lw=1.0, ls=":")
        ax.text(t[0], limit, f"{LIMIT_NAMES[level]} ", color=colour, va="bottom", ha="left", fontsize=8)
        _mark_arrival(ax, trend, level, limit, colour, last, unit)
    for b in trend.breaks:
        ax.annotate("outlier?" if b.kind == "last" else b.kind, (t[b.row], value[b.row]), (0, 9),
                    textcoords="offset points", ha="center", fontsize=8, color=RED)
    ax.set_ylim(min(0.0, float(low.min())), top)
    ax.set_ylabel(LABELS[trend.fault.symbol] + ("" if trend.fault.unit == "1" else f" [{trend.fault.unit}]"))


def _mark_arrival(ax: Axes, trend: Trend, level: str, limit: float, colour: str, last: Any, unit: UnitTrend) -> None:
    """The 95 % interval of when a limit is reached, as a bar on its line; it ends at the edge of the figure."""
    left = trend.remaining.get(level)
    if left is None or trend.verdict != "TREND" or left.high == 0.0 or left.low == math.inf:
        return
    end = float(trend.t[-1])

    def place(time_left: float) -> Any:
        if not math.isfinite(time_left):
            return last
        return min(_convert_times(np.array([end + time_left]), unit)[0], last)

    ax.plot([place(left.low), place(left.high)], [limit, limit], color=colour, lw=4, alpha=0.6, solid_capstyle="butt")
    if math.isfinite(left.value) and (at := _convert_times(np.array([end + left.value]), unit)[0]) <= last:
        ax.plot([at], [limit], "D", color=colour, ms=6)


def _convert_times(t: Any, unit: UnitTrend) -> Any:
    """Times as matplotlib takes them."""
    if unit.gathered.axis != "date":
        return t
    return np.array(np.asarray(t) * 86400, dtype="datetime64[s]")
