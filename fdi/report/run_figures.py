"""The figures of a run, as SVG text for an HTML page: signals over time, and timing."""
from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator
from numpy.typing import NDArray

from fdi.report.drawing import (
    ABOVE,
    COMMAND,
    FAULT,
    GREEN,
    INK,
    RED,
    STYLE,
    shade_sections,
    start_figure,
    thin_line,
    to_svg,
)
from fdi.trace.trace import Check, Trace

if TYPE_CHECKING:
    from matplotlib.axes import Axes


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


UNIT_SIZES = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "m/s": 1.0, "mm/s": 1e-3, "Pa": 1.0, "bar": 1e5, "MPa": 1e6, "N": 1.0,
              "kN": 1e3, "A": 1.0, "mA": 1e-3, "s": 1.0, "ms": 1e-3}
SHOWN_UNITS = {"com": "mm", "xj": "mm", "error": "um", "speed": "mm/s", "cor": "mA", "p12": "bar", "xs": "um",
               "load": "kN"}
REACTIONS = ("response_within", "shut_off", "recovers")  # kinds of check that measure the time of a reaction
BLUE, LIMIT = "#1f6feb", "#b7791f"


class _View(NamedTuple):
    """The rows of a check, and the span of time that its close-up shows."""

    trace: Trace
    check: Check
    rows: slice

    @property
    def t(self) -> Floats:
        return self.trace.t[self.rows]

    def read(self, name: str) -> Floats:
        """A signal over the window; `error` is Com - XJ, `speed` that of the ram over 20 cycles. SI."""
        if name == "error":
            return (self.trace.com - self.trace.xj)[self.rows]
        if name == "speed":
            return _compute_speed(self.trace.xj, self.trace.period)[self.rows]
        return self.trace.column(name)[self.rows]

    @property
    def target(self) -> tuple[float, float]:
        """Demand before the window and at its end, m."""
        before = self.trace.com[self.rows.start - 1] if self.rows.start else self.trace.xj[0]
        return float(before), float(self.trace.com[self.rows.stop - 1])

    @property
    def has_step(self) -> bool:
        """Whether the demand steps at the window's begin, and there is a measured value or at least a time limit."""
        before, target = self.target
        return abs(target - before) > 1e-6 and not (self.check.kind == "overshoot" and math.isnan(self.check.value))


def draw_failed_check(trace: Trace, check: Check, salt: str = "check") -> str:
    """The window of a check with its limits and what was measured; "" for a check without window or signal.

    `salt` keeps the ids of the figure apart from those of other figures of the page.
    """
    if math.isnan(check.t0):
        return ""
    first, stop = np.searchsorted(trace.t, [check.t0 - 0.5 * trace.period, check.t1 - 0.5 * trace.period])
    draw = DRAWERS.get(check.kind)
    is_reaction = check.kind in REACTIONS
    if draw is None or stop - first < 2 or (check.signal not in (*SHOWN_UNITS, "") and not is_reaction):
        return ""
    view = _View(trace, check, slice(int(first), int(stop)))
    if check.signal and not is_reaction and np.isnan(view.read(check.signal)).all():
        return ""
    if check.kind in ("overshoot", "rise_time", "settling_time") and not view.has_step:
        draw = _draw_response
    with start_figure(2.3) as figure:
        ax = figure.subplots()
        ax.set_xlim(check.t0, check.t1)
        draw(ax, view)
        ax.set_xlabel("time [s]")
        ax.legend(ncols=6, **ABOVE)
        return to_svg(figure, salt)


def _draw_overshoot(ax: Axes, view: _View) -> None:
    """Beyond the target, % of the step; from 20 ms before the step until four times the time to the peak."""
    before, target = view.target
    beyond = 100.0 * (_filter_median(view.read("xj")) - target) / (target - before)
    peak = int(np.nanargmax(beyond))
    ax.plot(*thin_line(view.t, beyond), color=BLUE, lw=1.2, label="XJ beyond the target")
    _draw_limits(ax, view.check)
    ax.plot([view.t[peak]], [view.check.value], "o", color=RED, ms=6, label=f"measured {view.check.value:.4g} %")
    high = 1.5 * max(view.check.value, np.nan_to_num(view.check.high))
    ax.set_ylim(-high, high)
    ax.set_xlim(view.t[0], min(view.t[-1], view.t[0] + max(0.06, 4.0 * (view.t[peak] - view.t[0]))))
    ax.set_ylabel("beyond the\ntarget [%]")


def _draw_rise_time(ax: Axes, view: _View) -> None:
    """Share of the step that is done, with the times of 10 % and 90 %."""
    before, target = view.target
    done = 100.0 * (_filter_median(view.read("xj")) - before) / (target - before)
    ax.plot(*thin_line(view.t, done), color=BLUE, lw=1.2, label="XJ, share of the step")
    for level in (10.0, 90.0):
        ax.axhline(level, color=COMMAND, lw=0.8, ls=":")
    reached = np.flatnonzero(done >= 10.0)
    ax.set_ylim(-10.0, 125.0)
    ax.set_ylabel("done [%]")
    if len(reached):
        start = float(view.t[reached[0]])
        _draw_times(ax, view.check, start)
        ax.axvline(start, color=COMMAND, lw=0.8, ls=":")
        _show_time(ax, view, start)


def _draw_settling_time(ax: Axes, view: _View) -> None:
    """Distance from the target; the position has to stay near it after the time limit."""
    before, target = view.target
    beyond = 100.0 * (_filter_median(view.read("xj")) - target) / abs(target - before)
    ax.plot(*thin_line(view.t, beyond), color=BLUE, lw=1.2, label="XJ less the target")
    start = float(view.t[0])
    _draw_times(ax, view.check, start)
    size = 110.0
    if not math.isnan(view.check.value) and view.check.value > 0.0:
        last_outside = round(_to_seconds(view.check, view.check.value) / view.trace.period) - 1
        band = abs(float(beyond[min(max(last_outside, 0), len(beyond) - 1)]))
        for side in (-1.0, 1.0):
            ax.axhline(side * band, color=COMMAND, lw=0.8, ls=":", label="band" if side > 0 else None)
        size = min(6.0 * band, 110.0)
    ax.set_ylim(-size, size)
    ax.set_ylabel("off the target\n[% of the step]")
    _show_time(ax, view, start)


def _draw_times(ax: Axes, check: Check, start: float) -> None:
    """Vertical lines at the time limits and at the measured time, s after `start`."""
    for limit, word in ((check.low, "least"), (check.high, "most")):
        if not math.isnan(limit):
            ax.axvline(start + _to_seconds(check, limit), color=LIMIT, lw=1.4, ls="--",
                       label=f"{word} {limit:g} {check.unit}")
    if not math.isnan(check.value):
        ax.axvline(start + _to_seconds(check, check.value), color=RED, lw=1.4,
                   label=f"measured {check.value:.4g} {check.unit}")


def _show_time(ax: Axes, view: _View, start: float) -> None:
    """Show three times the longest of measured value and limit, or the whole window if nothing was measured."""
    times = [_to_seconds(view.check, x) for x in (view.check.value, view.check.high, view.check.low)]
    if not math.isnan(times[0]):
        ax.set_xlim(view.t[0], min(float(view.t[-1]), start + 3.0 * max(x for x in times if not math.isnan(x))))


def _to_seconds(check: Check, value: float) -> float:
    return value * UNIT_SIZES.get(check.unit, 1.0)


def _draw_error_level(ax: Axes, view: _View) -> None:
    """Position error with the measured mean, RMS or largest size and the limits, on both sides where size counts."""
    check, size = view.check, UNIT_SIZES[view.check.unit]
    error = view.read("error") / size
    ax.set_ylabel(f"error [{check.unit}]")
    ax.plot(*thin_line(view.t, error), color=BLUE, lw=0.9, label="error, Com - XJ")
    way = 1.0
    if check.kind == "steady_error":
        way = float(np.sign(np.nanmean(error)))
    if check.kind == "ramp_error":
        com = view.read("com")
        way = float(np.sign(com[-1] - com[0]))
    both = check.kind in ("max_error", "rms_error")
    _draw_limits(ax, check, sides=(1.0, -1.0) if both else (way,))
    if check.kind == "max_error":
        filtered = _filter_median(error)
        row = int(np.nanargmax(np.abs(filtered)))
        ax.plot([view.t[row]], [filtered[row]], "o", color=RED, ms=6, label=_name_value(check))
        return
    _draw_value(ax, check, (1.0, -1.0) if both else (way,))


def _draw_break_away(ax: Axes, view: _View) -> None:
    """Position error with the measured band and the widest one allowed, around its middle."""
    check, size = view.check, UNIT_SIZES[view.check.unit]
    error = _filter_median(view.read("error")) / size
    low, high = np.nanpercentile(error, (1, 99))
    ax.plot(*thin_line(view.t, error), color=BLUE, lw=0.9, label="error, Com - XJ")
    _draw_limits(ax, check, (1.0, -1.0), middle=0.5 * float(low + high))
    _draw_value(ax, check, (1.0, -1.0), middle=0.5 * float(low + high))
    ax.set_ylabel(f"error [{check.unit}]")


def _draw_largest(ax: Axes, view: _View) -> None:
    """The signal with limits on both sides and its largest value."""
    check, size = view.check, UNIT_SIZES[view.check.unit]
    values = view.read(check.signal) / size
    ax.plot(*thin_line(view.t, values), color=BLUE, lw=0.9, label=check.signal)
    _draw_limits(ax, check, (1.0, -1.0))
    row = int(np.nanargmax(np.abs(values)))
    ax.plot([view.t[row]], [values[row]], "o", color=RED, ms=6, label=_name_value(check))
    ax.set_ylabel(f"{check.signal} [{check.unit}]")


def _draw_response(ax: Axes, view: _View) -> None:
    """Demand and position; for a gain also the amplitudes that the limits allow."""
    com, xj = 1e3 * view.read("com"), 1e3 * view.read("xj")
    ax.plot(*thin_line(view.t, com), color=COMMAND, lw=1.6, label="Com")
    ax.plot(*thin_line(view.t, xj), color=BLUE, lw=1.0, label="XJ")
    middle, amplitude = 0.5 * (np.nanmax(com) + np.nanmin(com)), 0.5 * (np.nanmax(com) - np.nanmin(com))
    if view.check.kind == "amplitude_ratio":
        for limit in (view.check.low, view.check.high):
            if not math.isnan(limit):
                for side in (1.0, -1.0):
                    ax.axhline(middle + side * limit * amplitude, color=LIMIT, lw=1.2, ls="--",
                               label=f"{limit:g} of Com" if side > 0 else None)
    ax.plot([], [], " ", label=_name_value(view.check))
    ax.set_ylabel("position [mm]")


def _draw_reaction(ax: Axes, view: _View) -> None:
    """The signal, or the current where the check is about none, around the instant from which the reaction counts.

    Vertical lines: that instant, the latest time that the limits allow, and when the reaction came. Of a log without
    the instant, which earlier versions wrote, the window is drawn.
    """
    check = view.check
    name = check.signal if check.signal in SHOWN_UNITS else "cor"
    unit = SHOWN_UNITS[name]
    if not math.isnan(check.after):
        view = view._replace(rows=_find_reaction_rows(view))
    ax.plot(*thin_line(view.t, view.read(name) / UNIT_SIZES[unit]), color=BLUE, lw=1.2, label=name)
    ax.set_ylabel(f"{name} [{unit}]")
    if math.isnan(check.after):
        ax.plot([], [], " ", label=f"{_name_value(check)}; limits in the table")
        return
    ax.set_xlim(view.t[0], view.t[-1])
    ax.axvline(check.after, color=COMMAND, lw=1.2, ls=":",
               label="clean-up begins" if check.kind == "recovers" else f"from {check.after:g} s")
    for level, word in ((check.above, "above"), (check.below, "below")):
        if not math.isnan(level):
            ax.axhline(level / UNIT_SIZES[unit], color=COMMAND, lw=1.2, ls="--",
                       label=f"{word} {level / UNIT_SIZES[unit]:g} {unit}")
    _draw_times(ax, check, check.after)
    if math.isnan(check.value):
        ax.plot([], [], " ", label=_name_value(check))


def _find_reaction_rows(view: _View, least: float = 0.02) -> slice:
    """The rows around a reaction: from half its longest time before the instant to three times that after it.

    Where it did not come, ten times the limit is shown. `least`: s after the instant.
    """
    check, trace = view.check, view.trace
    times = [_to_seconds(check, x) for x in (check.value, check.high, check.low) if not math.isnan(x)]
    longest = max([abs(t) for t in times], default=0.0)
    after = max((10.0 if math.isnan(check.value) else 3.0) * longest, least)
    first, stop = np.searchsorted(trace.t, [check.after - max(0.5 * longest, 0.5 * least), check.after + after])
    return slice(int(first), int(stop)) if stop - first > 1 else view.rows


def _draw_limits(ax: Axes, check: Check, sides: tuple[float, ...] = (1.0,), middle: float = 0.0) -> None:
    for limit, word in ((check.low, "least"), (check.high, "most")):
        if not math.isnan(limit):
            for i, side in enumerate(sides):
                ax.axhline(middle + side * limit, color=LIMIT, lw=1.4, ls="--",
                           label=None if i else f"{word} {limit:g} {_shorten_unit(check)}".rstrip())


def _draw_value(ax: Axes, check: Check, sides: tuple[float, ...], middle: float = 0.0) -> None:
    if not math.isnan(check.value):
        for i, side in enumerate(sides):
            ax.axhline(middle + side * check.value, color=RED, lw=1.4, label=None if i else _name_value(check))


def _name_value(check: Check) -> str:
    if math.isnan(check.value):
        return "not measurable"
    return f"measured {check.value:.4g} {_shorten_unit(check)}".rstrip()


def _shorten_unit(check: Check) -> str:
    return "" if check.unit == "1" else check.unit


def _filter_median(signal: Floats) -> Floats:
    """Centred moving median of five samples, the ends repeated, as the checks take it (docs/sequences.md)."""
    filtered: Floats = np.median(np.lib.stride_tricks.sliding_window_view(np.pad(signal, 2, mode="edge"), 5), axis=1)
    return filtered


def _compute_speed(position: Floats, period: float, span: int = 20) -> Floats:
    """Difference over `span` cycles, one-sided at the ends, m/s, as the checks take it."""
    rows = np.arange(len(position))
    ahead, behind = np.minimum(rows + span // 2, len(rows) - 1), np.maximum(rows - span // 2, 0)
    speed: Floats = (position[ahead] - position[behind]) / (period * (ahead - behind))
    return speed


DRAWERS: Mapping[str, Callable[[Axes, _View], None]] = {
    "overshoot": _draw_overshoot, "rise_time": _draw_rise_time, "settling_time": _draw_settling_time,
    "steady_error": _draw_error_level, "ramp_error": _draw_error_level, "max_error": _draw_error_level,
    "rms_error": _draw_error_level, "break_away": _draw_break_away, "never_exceeds": _draw_largest,
    "amplitude_ratio": _draw_response, "phase_lag": _draw_response, "response_within": _draw_reaction,
    "shut_off": _draw_reaction, "recovers": _draw_reaction}
