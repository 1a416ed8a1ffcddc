"""The report of a trend: growth of both fault sizes, the time left to each limit, the traces behind it."""

import math
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from fdi.diagnosis.faults import Estimate, Fault, Level, judge_size
from fdi.prognosis.trend import Break, Remaining, Trend
from fdi.prognosis.unit_trend import LIMIT_NAMES, Point, UnitTrend, format_day
from fdi.report.drawing import (
    AMBER,
    BLUE,
    COMMAND,
    INK,
    ORANGE,
    RED,
    Drawing,
    Mark,
    Panel,
    area,
    axes,
    call,
    dot,
    draw_panels,
    legend,
    level,
    line,
)
from fdi.report.numbers import format_amount, format_interval, format_limit
from fdi.report.report import Cell, Column, Figure, Item, Line, Medium, Mood, Report, Section, tabulate
from fdi.thresholds import TREND_FEWEST_TRACES, TREND_MOST_TRACES
from plant import count_nouns

MOODS: dict[Level, Mood] = {Level.ACCEPTABLE: "good", Level.MAINTENANCE: "doubtful", Level.NON_NOMINAL: "bad"}


def build_trend_report(unit: UnitTrend) -> Report:
    """Report on the trends of a unit; its `data` is the answer of `rig trend --json`."""
    g = unit.gathered
    points = g.points
    ends = dict.fromkeys(_format_place(point.t, unit) for point in (points[0], points[-1]))
    worst = max(unit.trends, key=lambda trend: trend.level)

    def show_size(fault: Fault) -> tuple[Column, Callable[[Point], str]]:
        return Column(fault.symbol), lambda point: format_interval(*point.sizes[fault.name], fault.unit)

    sections = [
        *(_build_fault_section(trend, unit) for trend in unit.trends),
        Section("Sizes over time", [Figure(
            "Fault sizes with their 95 % intervals, the fitted course and the forecast with its 95 % band. Thick bars "
            "on the limits: 95 % interval of the time when a limit is reached; diamond: median.",
            partial(draw_trends, unit))]),
        Section("Traces", [tabulate(
            points, (Column("trace"), lambda point: point.trace),
            (Column("when"), lambda point: _format_place(point.t, unit)), *map(show_size, g.faults),
            (Column("remark"), lambda point: Cell(point.note, "muted")),
            caption="Fault sizes of each trace with their 95 % intervals.")], medium=Medium.PAGE)]
    return Report("trend", unit.gathered.source, unit.level.name, MOODS[unit.level],
                  f"{count_nouns(len(points), 'trace').capitalize()}, {' to '.join(ends)}. {explain_level(worst)}.",
                  notes=unit.gathered.notes, sections=sections, data=_collect_data(unit))


def explain_level(trend: Trend) -> str:
    """Why a fault has its level: its size now, beside the limits that decide."""
    (fault, now), level = trend.stated, trend.level
    size = max(filter(math.isfinite, map(abs, now)), default=0.0)
    healthy, middle, most = (format_limit(x, fault.unit, size)
                             for x in (fault.healthy, fault.acceptable, fault.maintenance))
    within, beyond = ("above", "below") if fault.falls else ("below", "above")
    words = (f"{fault.title.capitalize()} {'requires' if level == Level.MAINTENANCE else 'is'} "
             f"{level.word.replace('_', '-')}: {format_interval(*now, fault.unit)} now")
    reasons = (
        (judge_size(trend.fault, trend.now) is None,
         f"; the interval holds both a healthy unit ({healthy}) and MidBand ({middle}), so the value alone decides"),
        (level == Level.ACCEPTABLE, f", {within} MidBand ({middle})"),
        (level == Level.NON_NOMINAL, f", {beyond} MidBand ({middle}) and at MaxBand ({most}) or {beyond}"),
        (trend.now.value >= trend.fault.acceptable,
         f", {beyond} MidBand ({middle}), not surely at MaxBand ({most})"),
        (True, f"; its interval comes too near MidBand ({middle}) to be acceptable"))
    return words + next(reason for holds, reason in reasons if holds)


def _build_fault_section(trend: Trend, unit: UnitTrend) -> Section:
    fault, _ = trend.stated
    remaining_times, span = trend.remaining, float(trend.t[-1] - trend.t[0])

    def show_date(level: str, limit: str) -> str:
        return "–" if remaining_times[level].high == 0.0 else _format_date(getattr(remaining_times[level], limit), unit)

    items: list[Item] = [
        Line("level", explain_level(trend)),
        *(Line("" if i else "size", text) for i, text in enumerate(_describe_trend(trend, unit))),
        *(Line(f"{LIMIT_NAMES[level]} ({format_limit(fault.place_size(remaining.limit), fault.unit)})",
               _describe_arrival(remaining, trend, unit), medium=Medium.TERMINAL)
          for level, remaining in remaining_times.items()),
        tabulate(
            remaining_times, (Column("reaches"), lambda level: LIMIT_NAMES[level]),
            (Column("time left (95 % interval)", align="right"),
             lambda level: Cell(_describe_time_left(remaining_times[level], trend, unit), is_strong=True)),
            (Column("not before (97.5 %)", align="right"), lambda level: show_date(level, "low")),
            (Column("median", align="right"), lambda level: show_date(level, "value")),
            (Column("not after (97.5 %)", align="right"), lambda level: show_date(level, "high")),
            (Column("probability", align="right"),
             lambda level: f"{100 * remaining_times[level].compute_probability_within(span):.0f} %"),
            caption="Probability: that the limit is reached within a time as long as the traces cover.",
            medium=Medium.PAGE)]
    return Section(fault.title, items,
                   badge=Cell(trend.verdict, MOODS[trend.level]), title_medium=Medium.BOTH)


def _describe_arrival(remaining: Remaining, trend: Trend, unit: UnitTrend) -> str:
    """Time left to a limit, and the dates of the median and of the interval."""
    text = _describe_time_left(remaining, trend, unit)
    if trend.verdict != "TREND" or remaining.high <= 0.0 or not math.isfinite(remaining.low):
        return text
    low, value, high = (_format_date(t, unit) for t in (remaining.low, remaining.value, remaining.high))
    return f"{text}: {value} ({low} .. {high})"


def _describe_trend(trend: Trend, unit: UnitTrend) -> list[str]:
    """What the traces say about one fault, a sentence each, the most important first."""
    points = unit.gathered.points[-len(trend.t):]
    is_cut = len(unit.gathered.points) > TREND_MOST_TRACES
    laws = sorted(trend.laws.items(), key=lambda item: -item[1]) if trend.verdict == "TREND" else []
    words = ", ".join(f"{law} {100 * p:.0f} %" for law, p in laws if p >= 0.005)
    return [_describe_growth(trend, unit),
            *(_describe_break(b, points[b.row], trend.stated[0], unit) for b in trend.breaks),
            *([f"only the latest {TREND_MOST_TRACES} traces are used"] if is_cut else []),
            *([f"growth law: {words}"] if words else [])]


def _describe_growth(trend: Trend, unit: UnitTrend) -> str:
    fault, now = trend.stated
    state = f"{fault.symbol} {format_interval(*now, fault.unit)} now"
    if trend.verdict == "TOO_FEW":
        reasons = {1: "one trace shows no growth", 2: "two traces fit every growth law"}
        reason = reasons.get(int(trend.used.sum()), "all traces have the same date")
        return f"{state}; no trend: {reason}; at least {TREND_FEWEST_TRACES} traces of different dates are needed"
    if trend.verdict == "NO_TREND" or trend.rate is None:
        return f"{state}; no trend: the probability that nothing grows is {100 * trend.no_growth:.0f} %"
    period, length = {"days": ("month", 30.44), "h": ("100 h", 100.0), "flights": ("100 flights", 100.0)}[unit.unit]
    return (f"{state}; {'falls' if fault.falls else 'grows'} by "
            f"{format_interval(*Estimate(*(length * x for x in trend.rate)), fault.unit)} per {period}")


def _describe_break(trend_break: Break, point: Point, fault: Fault, unit: UnitTrend) -> str:
    at = f"{point.trace}, {_collect_place(point.t, unit)}"
    size = format_amount(abs(trend_break.size), fault.unit, 2)
    side = "above" if (trend_break.size > 0) != fault.falls else "below"
    meaning = ("an outlier, a step or faster growth; each gets a probability of one third" if trend_break.size > 0 else
               "an outlier or a repair; it is left out")
    words = {"outlier": f"outlier, left out: {at}, {size} {side} the other traces",
             "step": f"step: from {at} on, the size is {size} {'smaller' if fault.falls else 'larger'}",
             "repair": f"repair: at {at} the size {'rises' if fault.falls else 'drops'} by {size}; the trend starts "
                       "there",
             "last": f"the last trace is {size} {side} the others: {meaning}; another trace would decide"}
    return words[trend_break.kind]


def _describe_time_left(remaining: Remaining, trend: Trend, unit: UnitTrend) -> str:
    """Time left to a limit, with its 95 % interval."""
    if remaining.high == 0.0:
        return "reached"
    if remaining.low == math.inf:
        return "not foreseeable"
    low, value, high = (_format_time(t, ".2g" if t < 10 else ".0f", unit.unit)
                        for t in (remaining.low, remaining.value, remaining.high))
    if trend.verdict != "TREND" or remaining.value == math.inf:
        return "may be reached already" if remaining.low == 0.0 else f"not before {low} (97.5 %)"
    return f"{value} ({low} .. {high if math.isfinite(remaining.high) else 'never'})"


def _format_date(t: float, unit: UnitTrend) -> str:
    """As `_format_place`; `t` counts from the last trace."""
    if not math.isfinite(t):
        return "never"
    at = unit.gathered.points[-1].t + t
    return _format_place(at, unit) if unit.gathered.axis == "date" else _format_time(at, ".0f", unit.unit)


def _format_time(t: float, digits: str, unit: str) -> str:
    """A time with its unit.

    >>> _format_time(1.0, "g", "flights"), _format_time(2.0, "g", "flights"), _format_time(1.0, "g", "h")
    ('1 flight', '2 flights', '1 h')
    """
    number = format(t, digits)
    return f"{number} {unit.removesuffix('s') if number == '1' else unit}"


def _format_place(t: float, unit: UnitTrend) -> str:
    """A date, with the time where the traces cover less than two days, or hours or flights; `t` is on their axis."""
    if unit.gathered.axis != "date":
        return _format_time(t, "g", unit.unit)
    points = unit.gathered.points
    return format_day(t, with_time=points[-1].t - points[0].t < 2.0)


def _collect_data(unit: UnitTrend) -> dict[str, Any]:
    """The answer of `rig trend --json`; infinity: not within 50 times the time covered by the traces.

    Its points can be read back, see `fdi.prognosis.unit_trend.read_points`.
    """
    g = unit.gathered
    return {"verdict": unit.level.name, "level": {trend.fault.name: trend.level.word for trend in unit.trends},
            "axis": g.axis, "unit": unit.unit, "faults": [asdict(fault) for fault in g.faults],
            "source": g.source, "last": _collect_place(g.points[-1].t, unit), "notes": g.notes,
            "points": [{"trace": p.trace, g.axis: _collect_place(p.t, unit), "t": p.t, "note": p.note,
                        **{f.key: p.sizes[f.name]._asdict() for f in g.faults}} for p in g.points],
            "trends": {trend.fault.name: _collect_trend(trend, unit) for trend in unit.trends}}


def _collect_trend(trend: Trend, unit: UnitTrend) -> dict[str, Any]:
    points, end = unit.gathered.points[-len(trend.t):], float(trend.t[-1])
    remaining_times = {level: {
        "limit": remaining.limit, "value": remaining.value, "low": remaining.low, "high": remaining.high,
        **{f"{name}_at": _collect_place(end + t, unit) if math.isfinite(t) else None
           for name, t in (("value", remaining.value), ("low", remaining.low), ("high", remaining.high))},
        "ever": remaining.compute_probability_within(1e300)} for level, remaining in trend.remaining.items()}
    return {"verdict": trend.verdict, "size": trend.fault.key, "unit": trend.fault.unit,
            "now": trend.now._asdict(), "rate": None if trend.rate is None else trend.rate._asdict(),
            "laws": {law: round(p, 4) for law, p in trend.laws.items()},
            "breaks": [{"kind": b.kind, "trace": points[b.row].trace, "t": points[b.row].t, "size": b.size}
                       for b in trend.breaks],
            "used": int(trend.used.sum()), "remaining": remaining_times,
            "forecast": None if trend.future is None else trend.future._asdict(),
            "reason": explain_level(trend), "says": _describe_trend(trend, unit)}


def _collect_place(t: float, unit: UnitTrend) -> str | float:
    """A place on the axis: an ISO date, or the number itself."""
    return format_day(t) if unit.gathered.axis == "date" else round(t, 3)


def draw_trends(unit: UnitTrend) -> Drawing:
    """The faults, one above the other."""
    xlabel = "" if unit.gathered.axis == "date" else f"{unit.gathered.axis} [{unit.unit}]"
    panels = [[*_draw_fault(trend, unit)] for trend in unit.trends]
    panels[0].append(legend(5))
    panels[-1].append(axes(xlabel=xlabel))
    return draw_panels("trend", [[panel] for panel in panels], 3.6 * len(panels), sharex=True)


def _draw_fault(trend: Trend, unit: UnitTrend) -> Panel:
    t = _convert_times(trend.t, unit)
    value, low, high = np.array(trend.sizes).T
    panel = [axes(ylim=(min(0.0, float(low.min())), 1.25 * max(trend.fault.maintenance, float(value.max()))),
                  ylabel=f"{trend.fault.title}, {trend.fault.symbol}{trend.fault.bracketed_unit}")]
    if trend.past is not None and trend.future is not None:
        for curve, colour, name, style in ((trend.past, BLUE, "fitted course", "-"),
                                           (trend.future, ORANGE, "forecast, 95 %", "--")):
            at = _convert_times(curve.t, unit)
            panel += [area(at, curve.low, curve.high, colour, alpha=0.15),
                      line(at, curve.middle, colour, name, 1.4, ls=style)]
    panel += [call("errorbar", t[rows], value[rows], [(value - low)[rows], (high - value)[rows]], fmt="o", ms=4, lw=1,
                   color=colour, label=name)
              for rows, colour, name in ((trend.used, INK, "traces"), (~trend.used, COMMAND, "traces left out"))
              if rows.any()]
    for name, limit, colour in (("maintenance", trend.fault.acceptable, AMBER),
                                ("non_nominal", trend.fault.maintenance, RED)):
        panel += [level(limit, colour, style=":"),
                  call("text", t[0], limit, f"{LIMIT_NAMES[name]} ", color=colour, va="bottom", fontsize=8),
                  *_mark_arrival(trend, name, limit, colour, unit)]
    return [*panel, *(call("annotate", "outlier?" if b.kind == "last" else b.kind, (t[b.row], value[b.row]), (0, 9),
                           textcoords="offset points", ha="center", fontsize=8, color=RED) for b in trend.breaks)]


def _mark_arrival(trend: Trend, name: str, limit: float, colour: str, unit: UnitTrend) -> list[Mark]:
    """The 95 % interval of when a limit is reached, as a bar on its line; it ends at the edge of the figure."""
    remaining, end = trend.remaining.get(name), float(trend.t[-1])
    if remaining is None or trend.verdict != "TREND" or remaining.high == 0.0 or remaining.low == math.inf:
        return []
    last = max(end, trend.future.t[-1] if trend.future else -math.inf)
    ends = _convert_times([min(end + x, last) for x in (remaining.low, remaining.high)], unit)
    bar = line(ends, [limit, limit], colour, width=4, alpha=0.6, solid_capstyle="butt")
    median = _convert_times([end + remaining.value], unit) if end + remaining.value <= last else []
    return [bar, *(dot(at, limit, colour, marker="D") for at in median)]


def _convert_times(t: Any, unit: UnitTrend) -> Any:
    """Times as matplotlib takes them."""
    return np.array(np.asarray(t) * 86400, dtype="datetime64[s]") if unit.gathered.axis == "date" else np.asarray(t)
