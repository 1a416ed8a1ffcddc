"""The figures of a run, as SVG text for an HTML page: signals over time, and timing."""
from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator
from numpy.typing import NDArray

from fdi.report.drawing import COMMAND, FAULT, GREEN, INK, RED, STYLE, shade_sections, thin_line, to_svg
from fdi.trace.trace import Trace

Floats = NDArray[np.float64]
BRIDGED = 5  # cycles
PANELS = (("xj", "position [mm]", 1e3, "#1f6feb"), ("error", "error [um]", 1e6, "#d9730d"),
          ("close", "error, close up [um]", 1e6, "#d9730d"), ("cor", "current [mA]", 1e3, "#8250df"),
          ("p12", "P12 [bar]", 1e-5, "#0f8b8d"), ("xs", "XS [um]", 1e6, "#bf3989"),
          ("load", "load [kN]", 1e-3, "#57606a"))


def draw_signals(trace: Trace) -> str:
    """Command and position, error, current, pressure and spool over one time axis, with sections and checks."""
    error, calm = trace.com - trace.xj, _choose_close_up(trace)
    values: dict[str, Floats] = {"xj": trace.xj, "error": error, "cor": trace.cor, "p12": trace.p12, "xs": trace.xs}
    if np.nan_to_num(trace.load).any():
        values["load"] = trace.load
    if calm:
        values["close"] = error
    panels = [panel for panel in PANELS if panel[0] in values and not np.isnan(values[panel[0]]).all()]
    heights = [1.7] * len(panels) + [0.15 * len(trace.sequence_checks) + 0.25] * bool(trace.sequence_checks)
    with rc_context(STYLE):
        figure, axes = _stack_panels(heights)
        for ax, (name, label, scale, colour) in zip(axes, panels, strict=False):
            if name == "xj":
                ax.plot(*thin_line(trace.t, trace.com * scale), color=COMMAND, lw=2.4, label="Com, command")
            line = thin_line(trace.t, _bridge_short_gaps(values[name]) * scale)
            ax.plot(*line, color=colour, lw=1.0, label="XJ, ram" if name == "xj" else None)
            _mark_missing(ax, trace, values[name])
            ax.set_ylabel(label)
            if name == "close":
                ax.set_ylim(-calm * scale, calm * scale)
            shade_sections(ax, trace)
            for fault, t0, t1 in list_faults(trace):
                ax.axvspan(t0, t1, color=FAULT, lw=0, alpha=0.5, zorder=-1)
                if ax is axes[0]:
                    foot = ax.get_xaxis_transform()
                    ax.text(t0, 0.07, f" {fault}", transform=foot, color=INK, fontsize=7, clip_on=True)
        axes[0].legend(loc="lower right", bbox_to_anchor=(1, 0.97), ncols=2, frameon=False)  # above, not on the line
        if trace.sequence_checks:
            _draw_checks(axes[-1], trace)
        axes[-1].set_xlabel("time from the start of the main phase [s]")
        axes[-1].set_xlim(trace.t[0], trace.t[-1] + trace.period)  # a row lasts one period; one alone is no empty axis
        return to_svg(figure, "signals")


def _stack_panels(heights: Sequence[float]) -> tuple[Figure, Sequence[Axes]]:
    """A figure of panels above each other, each as high as `heights` says (inches), on one time axis.

    The margins are fixed: a layout that measures every tick label first takes as long as the drawing.
    """
    width, left, right, top, bottom, gap = 11.0, 0.85, 0.1, 0.3, 0.5, 0.12
    height = top + sum(heights) + gap * (len(heights) - 1) + bottom
    figure = Figure(figsize=(width, height))
    mean = sum(heights) / len(heights)
    axes = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights, gridspec_kw={
        "left": left / width, "right": 1 - right / width, "top": 1 - top / height, "bottom": bottom / height,
        "hspace": gap / mean})[:, 0]
    for panel in axes:
        panel.yaxis.set_label_coords(-0.6 / (width - left - right), 0.5)
    axes[-1].xaxis.set_label_coords(0.5, -0.3 / heights[-1])
    return figure, list(axes)


def list_faults(trace: Trace) -> list[tuple[str, float, float]]:
    """The faults that the run injected: name, begin and end in s; one that never ends lasts to the end of the trace."""
    begun: dict[str, float] = {}
    spans = []
    for event in trace.events:
        name, _, word = event.text.rpartition(" ")
        if event.kind == "fault" and word == "begins":
            begun[name] = event.t
        elif event.kind == "fault" and name in begun:
            spans.append((name, begun.pop(name), event.t))
    return spans + [(name, t0, float(trace.t[-1])) for name, t0 in begun.items()]


def draw_timing(trace: Trace) -> str:
    """Histograms of lateness, response and work; "" for a trace without timing."""
    columns = (("SYNC lateness", trace.timing.lateness, "#1f6feb"),
               ("controller's response", trace.timing.response, "#d9730d"),
               ("bench's own work", trace.timing.work, "#57606a"))
    shortest_time = 0.1  # us, the left end of a histogram: the resolution of the clock
    drawn = [(name, np.maximum(values[~np.isnan(values)] * 1e6, shortest_time), colour)
             for name, values, colour in columns if (values > 0).any()]
    if not drawn:
        return ""
    with rc_context(STYLE):
        figure = Figure(figsize=(11, 2.5))
        axes = figure.subplots(1, len(drawn), squeeze=False, gridspec_kw={
            "left": 0.08, "right": 0.99, "top": 0.96, "bottom": 0.2, "wspace": 0.16})[0]
        for ax, (name, values, colour) in zip(axes, drawn, strict=True):
            low, high = math.log10(values.min()), math.log10(max(float(values.max()), 1.0))
            ax.hist(values, bins=np.logspace(low, high + 0.02, 60).tolist(), color=colour, log=True)
            ax.set_xscale("log")
            for axis in (ax.xaxis, ax.yaxis):  # plain numbers: the powers of ten take longer to set than to draw
                axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
                axis.set_minor_locator(NullLocator())
            ax.xaxis.set_label_coords(0.5, -0.14)
            ax.axvline(float(np.percentile(values, 99)), color=INK, lw=0.8, ls=":")
            ax.set_xlabel(f"{name} [us]")
        axes[0].set_ylabel("cycles (dotted: p99)")
        axes[0].yaxis.set_label_coords(-0.06 * len(drawn), 0.5)
        return to_svg(figure, "timing")


def _bridge_short_gaps(values: Floats) -> Floats:
    """Straight lines over up to BRIDGED missing samples: single samples between gaps would be invisible."""
    known = np.flatnonzero(~np.isnan(values))
    if not len(known):
        return values
    rows = np.arange(len(values))
    after = known[np.minimum(np.searchsorted(known, rows), len(known) - 1)]
    before = known[np.maximum(np.searchsorted(known, rows, side="right") - 1, 0)]
    near = (after >= rows) & (before <= rows) & (after - before <= BRIDGED + 1)
    return np.where(near, np.interp(rows, known, values[known]), values)


def _mark_missing(ax: Axes, trace: Trace, values: Floats, columns: int = 1400) -> None:
    """A red mark at the foot of the panel in each of so many columns in which samples are missing."""
    pieces = np.array_split(np.isnan(values), min(columns, len(values)))
    lost = np.array([piece.any() for piece in pieces])
    starts = np.cumsum([0, *map(len, pieces)])
    edges = np.flatnonzero(np.diff(lost, prepend=False, append=False)).reshape(-1, 2)
    spans = [(float(trace.t[starts[a]]), float(starts[b] - starts[a]) * trace.period) for a, b in edges]
    if spans:
        ax.broken_barh(spans, (0.0, 0.04), transform=ax.get_xaxis_transform(), color=RED, lw=0.5, zorder=3)


def _choose_close_up(trace: Trace) -> float:
    """Half the height, in m, that shows the error on the ramps well; 0 without ramps. Steps dwarf it."""
    ramps = [np.arange(s.start, s.stop) for s in trace.sections() if s.kind == "ramp"]
    error = np.abs(trace.com - trace.xj)[np.concatenate(ramps)] if ramps else np.empty(0)
    error = error[~np.isnan(error)]
    return 2.0 * float(np.percentile(error, 99)) if len(error) else 0.0


def _draw_checks(ax: Axes, trace: Trace) -> None:
    """A bar for each check over its window, green or red, with its name beside it; only a name where there is none."""
    first, last = float(trace.t[0]), float(trace.t[-1])
    room, span = 0.005 * (last - first), last - first
    for row, check in enumerate(trace.sequence_checks):
        t0, t1 = (first, last) if math.isnan(check.t0) else (check.t0, check.t1)
        if math.isnan(check.t0) and math.isnan(check.value):
            x, side, colour, name = first + room, "left", RED, f"{check.name}: not measured"
        else:
            ax.barh(row, t1 - t0, left=t0, height=0.7, color=GREEN if check.passed else RED)
            name = check.name
            if last - t1 > 0.25 * span:
                x, side, colour = t1 + room, "left", INK
            elif t0 - first > 0.25 * span:
                x, side, colour = t0 - room, "right", INK
            else:
                x, side, colour = t0 + room, "left", "white"
        ax.text(x, row, name, va="center", ha=side, color=colour, fontsize=7, clip_on=True).set_in_layout(False)
    ax.set_ylim(len(trace.sequence_checks) - 0.4, -0.6)
    ax.set_yticks([])
    ax.set_ylabel("checks")
