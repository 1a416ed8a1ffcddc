"""The report of a trend: growth of both fault sizes, the time left to each limit, the traces behind it."""
from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fdi.diagnosis.faults import FAULTS, Estimate, Level, judge_size
from fdi.prognosis.trend import Break, Curve, Remaining, Trend
from fdi.prognosis.unit_trend import LIMIT_NAMES, Point, UnitTrend, format_day
from fdi.report.numbers import count_nouns, format_digits, format_interval
from fdi.report.report import (
    Cell,
    Column,
    Figure,
    Item,
    Line,
    Listing,
    Medium,
    Mood,
    Report,
    Section,
    Table,
)
from fdi.thresholds import TREND_FEWEST_TRACES, TREND_MOST_TRACES

MOODS: dict[Level, Mood] = {Level.ACCEPTABLE: "good", Level.MAINTENANCE: "doubtful", Level.NON_NOMINAL: "bad"}


def build_trend_report(unit: UnitTrend) -> Report:
    """Report on the trends of a unit; its `data` is the answer of `rig trend --json`."""

    def draw() -> str:
        from fdi.report.trend_figure import draw_trends  # here: matplotlib takes half a second to import

        return draw_trends(unit)

    picture = Figure("Fault sizes with their 95 % intervals, the fitted course and the forecast with its 95 % band. "
                     "Thick bars on the limits: 95 % interval of the time when a limit is reached; diamond: median.",
                     draw)
    return Report(
        command="trend", title=unit.gathered.source, verdict=unit.level.name.replace("_", " "),
        mood=MOODS[unit.level], sentence=_describe_traces(unit), notes=unit.gathered.notes,
        sections=[*(_build_fault_section(trend, unit) for trend in unit.trends),
                  Section("Sizes over time", [picture]),
                  Section("Traces", [_tabulate_traces(unit)], medium=Medium.PAGE)],
        data=collect_data(unit))


def _describe_traces(unit: UnitTrend) -> str:
    points = unit.gathered.points
    first, last = (format_place(point.t, unit) for point in (points[0], points[-1]))
    span = f"{first} to {last}" if first != last else first
    worst = max(unit.trends, key=lambda trend: trend.level)
    return f"{count_nouns(len(points), 'trace').capitalize()}, {span}. {explain_level(worst)}."


def explain_level(trend: Trend) -> str:
    """Why a fault has its level: its size now, beside the limits that decide."""
    fault, level = trend.fault, trend.level
    name, unit = fault.name.replace("_", " ").capitalize(), "" if fault.unit == "1" else f" {fault.unit}"
    words = f"{name} is {level.word.replace('_', '-')}: {_format_size(trend.now, fault.unit)} now"
    if judge_size(fault, trend.now) is None:
        return (f"{words}; the interval holds both a healthy unit ({fault.healthy:g}{unit}) and MidBand "
                f"({fault.middle:g}{unit}), so the value alone decides")
    if level == Level.ACCEPTABLE:
        return f"{words}, below MidBand ({fault.middle:g}{unit})"
    if level == Level.NON_NOMINAL:
        return f"{words}, above MidBand ({fault.middle:g}{unit}) and up to MaxBand ({fault.most:g}{unit}) or more"
    if trend.now.value >= fault.middle:
        return f"{words}, above MidBand ({fault.middle:g}{unit}), not surely at MaxBand ({fault.most:g}{unit})"
    return f"{words}; its interval comes too near MidBand ({fault.middle:g}{unit}) to be acceptable"


def _build_fault_section(trend: Trend, unit: UnitTrend) -> Section:
    items: list[Item] = [Line("level", explain_level(trend))]
    unit_name = "" if trend.fault.unit == "1" else f" {trend.fault.unit}"
    items += [Line("" if i else "size", text) for i, text in enumerate(describe_trend(trend, unit))]
    for level, remaining in trend.remaining.items():
        name = f"{LIMIT_NAMES[level]} ({remaining.limit:g}{unit_name})"
        items.append(Line(name, _describe_arrival(remaining, trend, unit), medium=Medium.TERMINAL))
    if trend.remaining:
        items.append(_tabulate_remaining(trend, unit))
    plot = plot_trend(trend, lambda t: format_date(t, unit))
    if plot:
        items.append(Listing("\n".join(plot), medium=Medium.TERMINAL))
    return Section(trend.fault.name.replace("_", " "), items,
                   badge=Cell(trend.verdict.replace("_", " "), MOODS[trend.level]), title_medium=Medium.BOTH)


def _describe_arrival(remaining: Remaining, trend: Trend, unit: UnitTrend) -> str:
    """Time left to a limit, and the dates of the median and of the interval."""
    text = describe_time_left(remaining, trend, unit)
    if trend.verdict != "TREND" or remaining.high <= 0.0 or not math.isfinite(remaining.low):
        return text
    low, value, high = (format_date(t, unit) for t in (remaining.low, remaining.value, remaining.high))
    return f"{text}: {value} ({low} .. {high})"


def _tabulate_remaining(trend: Trend, unit: UnitTrend) -> Table:
    columns = [Column("reaches"), Column("time left", align="right"), Column("not before (97.5 %)", align="right"),
               Column("median", align="right"), Column("not after (97.5 %)", align="right"),
               Column("probability", align="right")]
    rows: list[list[Cell | str]] = []
    for level, remaining in trend.remaining.items():
        times = (remaining.low, remaining.value, remaining.high)
        dates = ["–"] * 3 if remaining.high == 0.0 else [format_date(t, unit) for t in times]
        soon = f"{100 * remaining.compute_probability_within(trend.t[-1] - trend.t[0]):.0f} %"
        left = Cell(describe_time_left(remaining, trend, unit), is_strong=True)
        rows.append([LIMIT_NAMES[level], left, *dates, soon])
    return Table(columns, rows, "Probability: that the limit is reached within a time as long as the traces cover.",
                 medium=Medium.PAGE)


def _tabulate_traces(unit: UnitTrend) -> Table:
    columns = [Column("trace"), Column("when"), *(Column(fault.symbol.upper() if fault.unit == "N" else "Kintas")
                                                  for fault in FAULTS), Column("remark")]
    rows: Sequence[Sequence[Cell | str]] = [
        [point.trace, format_place(point.t, unit), *(_format_size(point.sizes[f.name], f.unit) for f in FAULTS),
         Cell(point.note, "muted")] for point in unit.gathered.points]
    return Table(columns, rows, "Fault sizes of each trace with their 95 % intervals.")


def describe_trend(trend: Trend, unit: UnitTrend) -> list[str]:
    """What the traces say about one fault, a sentence each, the most important first."""
    sentences = [_describe_growth(trend, unit)]
    points = unit.gathered.points[-len(trend.t):]
    sentences += [_describe_break(b, points[b.row], trend.fault.unit, unit) for b in trend.breaks]
    if len(unit.gathered.points) > TREND_MOST_TRACES:
        sentences.append(f"only the latest {TREND_MOST_TRACES} traces are used")
    if trend.verdict == "TREND" and trend.laws:
        ranked = sorted(trend.laws.items(), key=lambda item: -item[1])
        sentences.append("growth law: " + ", ".join(f"{law} {100 * p:.0f} %" for law, p in ranked if p >= 0.005))
    return sentences


def _describe_growth(trend: Trend, unit: UnitTrend) -> str:
    symbol = "Kintas" if trend.fault.symbol == "kintas" else trend.fault.symbol.upper()
    state = f"{symbol} {_format_size(trend.now, trend.fault.unit)} now"
    if trend.verdict == "TOO_FEW":
        return f"{state}; no trend: {_explain_too_few(int(trend.used.sum()))}"
    if trend.verdict == "NO_TREND":
        return f"{state}; no trend: the probability that nothing grows is {100 * trend.laws['none']:.0f} %"
    assert trend.rate is not None
    period, length = {"days": ("month", 30.44), "h": ("100 h", 100.0), "flights": ("100 flights", 100.0)}[unit.unit]
    rate = Estimate(*(length * x for x in trend.rate))
    return f"{state}; grows by {_format_size(rate, trend.fault.unit)} per {period}"


def _explain_too_few(used: int) -> str:
    if used >= TREND_FEWEST_TRACES:
        reason = "all traces have the same date"
    elif used == 1:
        reason = "one trace shows no growth"
    else:
        reason = "two traces fit every growth law"
    return f"{reason}; at least {TREND_FEWEST_TRACES} traces of different dates are needed"


def _describe_break(found: Break, point: Point, size_unit: str, unit: UnitTrend) -> str:
    at = f"{point.trace}, {_collect_place(point.t, unit.gathered.axis)}"
    size = format_digits(abs(found.size), 2) + ("" if size_unit == "1" else f" {size_unit}")
    is_up = found.size > 0
    if found.kind == "outlier":
        return f"outlier, left out: {at}, {size} {'above' if is_up else 'below'} the other traces"
    if found.kind == "step":
        return f"step: from {at} on, the size is {size} larger"
    if found.kind == "repair":
        return f"repair: at {at} the size drops by {size}; the trend starts there"
    if is_up:
        return (f"the last trace is {size} above the others: an outlier, a step or faster growth; each gets a "
                "probability of one third; another trace would decide")
    return (f"the last trace is {size} below the others: an outlier or a repair; it is left out; another trace would "
            "decide")


def describe_time_left(remaining: Remaining, trend: Trend, unit: UnitTrend) -> str:
    """Time left to a limit, with its 95 % interval."""
    if remaining.high == 0.0:
        return "reached"
    if remaining.low == math.inf:
        return "not foreseeable"
    low, value, high = (_format_time(x, unit) for x in (remaining.low, remaining.value, remaining.high))
    if trend.verdict != "TREND" or remaining.value == math.inf:
        return "may be reached already" if remaining.low == 0.0 else f"not before {low} (97.5 %)"
    return f"{value} ({low} .. {high})" if math.isfinite(remaining.high) else f"{value} ({low} .. never)"


def format_date(t: float, unit: UnitTrend) -> str:
    """A date, or hours or flights; `t` counts from the last trace."""
    if not math.isfinite(t):
        return "never"
    end = unit.gathered.points[-1].t
    return format_day(end + t) if unit.gathered.axis == "date" else f"{end + t:.0f} {unit.unit}"


def format_place(t: float, unit: UnitTrend) -> str:
    """A date, or hours or flights; `t` is on the axis of the traces."""
    return format_day(t) if unit.gathered.axis == "date" else f"{t:g} {unit.unit}"


def _format_time(t: float, unit: UnitTrend) -> str:
    return f"{t:.2g} {unit.unit}" if t < 10 else f"{t:.0f} {unit.unit}"


def _format_size(size: Estimate, unit: str) -> str:
    return format_interval(size.value, size.low, size.high, unit)


def collect_data(unit: UnitTrend) -> dict[str, Any]:
    """The answer of `rig trend --json`; infinity: not within 50 times the time covered by the traces.

    Its points can be read back, see `fdi.prognosis.unit_trend.read_points`.
    """
    g = unit.gathered
    return {"level": {trend.fault.name: trend.level.word for trend in unit.trends}, "axis": g.axis, "unit": unit.unit,
            "source": g.source, "last": _collect_place(g.points[-1].t, g.axis), "notes": list(g.notes),
            "points": [{"trace": p.trace, g.axis: _collect_place(p.t, g.axis), "t": p.t, "note": p.note,
                        **{f.symbol: p.sizes[f.name]._asdict() for f in FAULTS}} for p in g.points],
            "trends": {trend.fault.name: _collect_trend(trend, unit) for trend in unit.trends}}


def _collect_trend(trend: Trend, unit: UnitTrend) -> dict[str, Any]:
    end, axis = float(trend.t[-1]), unit.gathered.axis
    points = unit.gathered.points[-len(trend.t):]
    return {"verdict": trend.verdict, "size": trend.fault.symbol, "unit": trend.fault.unit,
            "now": trend.now._asdict(), "rate": None if trend.rate is None else trend.rate._asdict(),
            "laws": {law: round(p, 4) for law, p in trend.laws.items()},
            "breaks": [{"kind": b.kind, "trace": points[b.row].trace, "t": points[b.row].t, "size": b.size}
                       for b in trend.breaks],
            "used": int(trend.used.sum()),
            "remaining": {level: _collect_remaining(left, end, axis) for level, left in trend.remaining.items()},
            "forecast": None if trend.future is None else trend.future._asdict(),
            "reason": explain_level(trend), "says": describe_trend(trend, unit)}


def _collect_remaining(left: Remaining, end: float, axis: str) -> dict[str, Any]:
    span = {"value": left.value, "low": left.low, "high": left.high}
    at = {f"{name}_at": _collect_place(end + t, axis) if math.isfinite(t) else None for name, t in span.items()}
    return {"limit": left.limit, **span, **at, "ever": left.compute_probability_within(1e300)}


def _collect_place(t: float, axis: str) -> str | float:
    """A place on the axis: an ISO date, or the number itself."""
    return format_day(t) if axis == "date" else round(t, 3)


WIDTH, HEIGHT = 72, 11  # characters


@dataclass
class _Canvas:
    """A grid of characters over time (from the left) and fault size (from the bottom)."""

    start: float
    until: float
    top: float
    cells: list[list[str]] = field(default_factory=lambda: [[" "] * WIDTH for _ in range(HEIGHT)])

    def column(self, t: float) -> int:
        """Column of a time."""
        return round((t - self.start) / (self.until - self.start) * (WIDTH - 1))

    def row(self, size: float) -> int:
        """Row of a size, within the canvas."""
        return HEIGHT - 1 - min(max(round(size / self.top * (HEIGHT - 1)), 0), HEIGHT - 1)

    def draw_column(self, x: int, low: float, high: float, character: str) -> None:
        """Fill one column between two sizes."""
        for y in range(self.row(high), self.row(low) + 1):
            self.cells[y][x] = character


def plot_trend(trend: Trend, format_date: Callable[[float], str], future_share: float = 0.35) -> list[str]:
    """Lines of text with the sizes (● and their intervals │), the course (·) and the forecast (░); [] for one date.

    Args:
        trend: of one fault.
        format_date: the text of a time that counts from the last trace.
        future_share: smallest share of the width that shows the future.
    """
    start, end = float(trend.t[0]), float(trend.t[-1])
    if end == start:
        return []
    canvas = _Canvas(start, _choose_end(trend, start, end, future_share),
                     1.15 * max(trend.fault.most, max(size.value for size in trend.sizes)))
    for limit in (trend.fault.middle, trend.fault.most):
        canvas.cells[canvas.row(limit)] = ["-"] * WIDTH
    if trend.past is not None:
        _draw_curve(canvas, trend.past)
    if trend.future is not None:
        _draw_curve(canvas, trend.future, shaded_from=canvas.column(end) + 1)
    for t, size, is_used in zip(trend.t, trend.sizes, trend.used, strict=True):
        x = canvas.column(float(t))
        canvas.draw_column(x, size.low, size.high, "│")
        canvas.cells[canvas.row(size.value)][x] = "●" if is_used else "○"
    return [*_label_rows(canvas, trend), _label_columns(canvas, end, format_date)]


def _choose_end(trend: Trend, start: float, end: float, future_share: float) -> float:
    until = end + future_share / (1.0 - future_share) * (end - start)
    if trend.future is None:
        return until
    return min(max(until, float(trend.future.t[-1])), end + 1.5 * (end - start))


def _draw_curve(canvas: _Canvas, curve: Curve, shaded_from: int = WIDTH) -> None:
    """The middle of a curve, and from one column on its interval."""
    columns = [canvas.column(float(t)) for t in curve.t]
    for x in range(max(columns[0], 0), min(columns[-1], WIDTH - 1) + 1):
        low, middle, high = (float(np.interp(x, columns, line)) for line in (curve.low, curve.middle, curve.high))
        if x >= shaded_from:
            canvas.draw_column(x, low, high, "░")
        canvas.cells[canvas.row(middle)][x] = "·"


def _label_rows(canvas: _Canvas, trend: Trend) -> list[str]:
    names = {canvas.row(trend.fault.middle): "MidBand", canvas.row(trend.fault.most): "MaxBand"}
    lines = []
    for y, cells in enumerate(canvas.cells):
        size = canvas.top * (HEIGHT - 1 - y) / (HEIGHT - 1)
        lines.append(f"{size:>6.3g} {''.join(cells)} {names.get(y, '')}".rstrip())
    return lines


def _label_columns(canvas: _Canvas, end: float, format_date: Callable[[float], str]) -> str:
    """Dates of the first trace, of the last one and of the end of the plot, each below its column."""
    first, last, final = (format_date(t - end) for t in (canvas.start, end, canvas.until))
    margin = 7  # characters of a row's label
    line = list(" " * margin + first.ljust(WIDTH - len(final)) + final)
    at = margin + min(max(canvas.column(end) - len(last) // 2, len(first) + 1), WIDTH - len(final) - len(last) - 1)
    line[at:at + len(last)] = last
    return "".join(line)
