"""The picture of a trend: sizes with their intervals, the course through them, what may come, the two limits."""
from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fdi.prognosis.trend import Trend
from fdi.prognosis.unit_trend import NAMES, Answer
from fdi.report.drawing import COMMAND, INK, RED, STYLE, to_svg
from plant.errors import InputError

COURSE, AHEAD, MIDDLE = "#1f6feb", "#d9730d", "#b7791f"
LABELS = {"kintas": "filter clogging, Kintas", "fss": "spool friction, FSS"}


def drawing(found: Answer) -> str:
    """Both faults as SVG text that stands inside a page."""
    with rc_context(STYLE):
        return to_svg(_figure(found), "trend")


def save(found: Answer, out: Path) -> None:
    """Both faults as .png or .svg.

    Raises:
        InputError: a file that cannot be written.
    """
    with rc_context(STYLE):
        try:
            undated = {"Date": None} if out.suffix == ".svg" else None
            _figure(found).savefig(out, dpi=130, facecolor="white", metadata=undated)
        except OSError as error:
            raise InputError("--out", str(out), f"a file that can be written ({error.strerror})") from error


def _figure(found: Answer) -> Figure:
    figure = Figure(figsize=(11, 7.2), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True)
    for ax, trend in zip(axes, found.trends, strict=True):
        _panel(ax, trend, found)
    axes[0].legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=5, frameon=False)
    if found.gathered.axis != "date":
        axes[-1].set_xlabel(f"{found.gathered.axis} [{found.unit}]")
    return figure


def _panel(ax: Axes, trend: Trend, found: Answer) -> None:
    t = _axis(np.array([p.t for p in found.gathered.points[-len(trend.t):]]), found)
    value, low, high = np.array(trend.sizes).T
    limits = {"maintenance": (trend.fault.middle, MIDDLE), "non_nominal": (trend.fault.most, RED)}
    if trend.past is not None and trend.future is not None:
        curves = (trend.past, COURSE, "course so far"), (trend.future, AHEAD, "what may come, 95 %")
        for curve, colour, name in curves:
            at = _axis(curve.t, found)
            ax.fill_between(at, curve.low, curve.high, color=colour, alpha=0.15, lw=0)
            ax.plot(at, curve.middle, color=colour, lw=1.4, label=name, ls="-" if curve is trend.past else "--")
    for used, colour, name in ((trend.used, INK, "traces"), (~trend.used, COMMAND, "not part of the trend")):
        if used.any():
            ax.errorbar(t[used], value[used], [(value - low)[used], (high - value)[used]], fmt="o", ms=4, lw=1,
                        color=colour, label=name)
    top = 1.25 * max(trend.fault.most, float(value.max()))
    last = _axis(np.array([max(trend.t[-1], trend.future.t[-1] if trend.future else -np.inf)]), found)[0]
    for level, (limit, colour) in limits.items():
        ax.axhline(limit, color=colour, lw=1.0, ls=":")
        ax.text(t[0], limit, f"{NAMES[level]} ", color=colour, va="bottom", ha="left", fontsize=8)
        _when(ax, trend, level, limit, colour, last, found)
    for b in trend.breaks:
        ax.annotate("not in line" if b.kind == "last" else b.kind, (t[b.row], value[b.row]), (0, 9),
                    textcoords="offset points", ha="center", fontsize=8, color=RED)
    ax.set_ylim(min(0.0, float(low.min())), top)
    ax.set_ylabel(LABELS[trend.fault.symbol] + ("" if trend.fault.unit == "1" else f" [{trend.fault.unit}]"))


def _when(ax: Axes, trend: Trend, level: str, limit: float, colour: str, last: Any, found: Answer) -> None:
    """The 95 % interval of when a limit is reached, as a bar on its line; an arrow where it leaves the picture."""
    left = trend.remaining.get(level)
    if left is None or trend.verdict != "TREND" or left.high == 0.0 or left.low == math.inf:
        return
    end = float(trend.t[-1])
    a, b = (_axis(np.array([end + x if math.isfinite(x) else 1e9]), found)[0] if math.isfinite(x) else last
            for x in (left.low, left.high))
    a, b = min(a, last), min(b, last)
    ax.plot([a, b], [limit, limit], color=colour, lw=4, alpha=0.6, solid_capstyle="butt")
    if math.isfinite(left.value) and (at := _axis(np.array([end + left.value]), found)[0]) <= last:
        ax.plot([at], [limit], "D", color=colour, ms=6)


def _axis(t: Any, found: Answer) -> Any:
    """Times as matplotlib takes them."""
    if found.gathered.axis != "date":
        return t
    return np.array(np.asarray(t) * 86400, dtype="datetime64[s]")
