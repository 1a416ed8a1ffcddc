"""Close-ups of failed checks, as SVG text for an HTML page: what was measured, where, and the limits.

Each close-up shows the quantity that the check measures (docs/sequences.md), in the unit of the check.
"""
from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.report.drawing import ABOVE, COMMAND, RED, start_figure, thin_line, to_svg
from fdi.trace.trace import Check, Trace

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]
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
