"""The trends of both faults together, as numbers for other programs and as sentences for people."""
from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fdi.diagnosis.faults import FAULTS, Estimate, Level
from fdi.prognosis.dates import AXES, iso
from fdi.prognosis.gather import Gathered, Point
from fdi.prognosis.trend import Remaining, Trend, follow
from fdi.thresholds import TREND_FEWEST_TRACES, TREND_MOST_TRACES
from plant.errors import InputError

NAMES = {"maintenance": "MidBand", "non_nominal": "MaxBand"}


@dataclass(frozen=True, eq=False)
class Answer:
    """What `rig trend` tells."""

    gathered: Gathered
    trends: tuple[Trend, ...]

    @property
    def level(self) -> Level:
        """The worst of the faults now."""
        return max(trend.level for trend in self.trends)

    @property
    def unit(self) -> str:
        """Of time."""
        return AXES[self.gathered.axis]


def answer(gathered: Gathered) -> Answer:
    """Follow both faults through the traces."""
    t = [point.t for point in gathered.points]
    trends = (follow(fault, t, [point.sizes[fault.name] for point in gathered.points]) for fault in FAULTS)
    return Answer(gathered, tuple(trends))


def to_json(found: Answer) -> dict[str, Any]:
    """The answer as JSON values; null: not within 50 times the time seen so far. Its points can be read back."""
    g = found.gathered
    return {"level": {trend.fault.name: trend.level.word for trend in found.trends}, "axis": g.axis, "unit": found.unit,
            "source": g.source, "last": _when(g.points[-1].t, g.axis), "notes": list(g.notes),
            "points": [{"trace": p.trace, g.axis: _when(p.t, g.axis), "t": p.t, "note": p.note,
                        **{f.symbol: _estimate(p.sizes[f.name]) for f in FAULTS}} for p in g.points],
            "trends": {trend.fault.name: _trend(trend, found) for trend in found.trends}}


def _trend(trend: Trend, found: Answer) -> dict[str, Any]:
    end, axis = float(trend.t[-1]), found.gathered.axis
    points = found.gathered.points[-len(trend.t):]
    return {"verdict": trend.verdict, "size": trend.fault.symbol, "unit": trend.fault.unit,
            "now": _estimate(trend.now), "rate": None if trend.rate is None else _estimate(trend.rate),
            "laws": {law: round(p, 4) for law, p in trend.laws.items()},
            "breaks": [{"kind": b.kind, "trace": points[b.row].trace, "t": points[b.row].t, "size": b.size}
                       for b in trend.breaks],
            "used": int(trend.used.sum()),
            "remaining": {level: _left(left, end, axis) for level, left in trend.remaining.items()},
            "forecast": None if trend.future is None else {name: [float(x) for x in column] for name, column
                                                           in trend.future._asdict().items()},
            "says": sentences(trend, found)}


def _left(left: Remaining, end: float, axis: str) -> dict[str, Any]:
    span = {name: float(t) if math.isfinite(t) else None
            for name, t in (("value", left.value), ("low", left.low), ("high", left.high))}
    at = {f"{name}_at": None if t is None else _when(end + t, axis) for name, t in span.items()}
    return {"limit": left.limit, **span, **at, "ever": left.within(1e300)}


def _estimate(e: Estimate) -> dict[str, float]:
    return {name: float(x) for name, x in e._asdict().items()}


def _when(t: float, axis: str) -> str | float:
    """A place on the axis: an ISO date, or the number itself."""
    return iso(t) if axis == "date" else round(t, 3)


def read(path: Path) -> Gathered:
    """The points of an earlier answer, from its JSON file.

    Raises:
        InputError: a file that is no such answer.
    """
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        points = tuple(Point(str(p["trace"]), float(p["t"]), {
            f.name: Estimate(*(float(p[f.symbol][name]) for name in Estimate._fields)) for f in FAULTS},
            str(p.get("note", ""))) for p in told["points"])
        axis = str(told["axis"])
        if not all(math.isfinite(p.t) and all(e.low <= e.value <= e.high for e in p.sizes.values()) for p in points):
            raise ValueError("times and sizes that are numbers, each within its interval")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(path, "", f"an answer of rig trend ({type(error).__name__}: {error})") from error
    if axis not in AXES or not points:
        raise InputError(path, "axis", f"one of {', '.join(AXES)} and at least one point")
    return Gathered(str(path), axis, tuple(sorted(points, key=lambda p: p.t)), ())


def sentences(trend: Trend, found: Answer) -> list[str]:
    """What is to be said of one fault, the main thing first."""
    lines = [_main(trend, found)]
    points = found.gathered.points[-len(trend.t):]
    for b in trend.breaks:
        lines.append(_broken(b.kind, points[b.row], _number(abs(b.size), trend.fault.unit), b.size > 0, found))
    if len(found.gathered.points) > TREND_MOST_TRACES:
        lines.append(f"only the latest {TREND_MOST_TRACES} traces are looked at")
    if trend.verdict == "TREND" and trend.laws:
        lines.append("law: " + ", ".join(f"{law} {100 * p:.0f} %" for law, p in
                                         sorted(trend.laws.items(), key=lambda item: -item[1]) if p >= 0.005))
    return lines


def _main(trend: Trend, found: Answer) -> str:
    now = interval(trend.now, trend.fault.unit)
    state = f"{trend.fault.symbol} {now} now"
    if trend.verdict == "TOO_FEW":
        count = int(trend.used.sum())
        why = ("all traces are of one time" if count >= TREND_FEWEST_TRACES else
               "one trace shows a size, no growth" if count == 1 else "two points lie on every line")
        return f"{state}; no trend yet: {why}; at least {TREND_FEWEST_TRACES} traces of different times are needed"
    if trend.verdict == "NO_TREND":
        return f"{state}; no trend yet: that nothing grows has a probability of {100 * trend.laws['none']:.0f} %"
    assert trend.rate is not None
    per = {"days": ("a month", 30.44), "h": ("in 100 h", 100.0), "flights": ("in 100 flights", 100.0)}[found.unit]
    rate = interval(Estimate(*(per[1] * x for x in trend.rate)), trend.fault.unit, sign=True)
    return f"{state}; grows by {rate} {per[0]}"


def left(remaining: Remaining, trend: Trend, found: Answer) -> str:
    """Time to a limit in words."""
    if remaining.high == 0.0:
        return "reached"
    low, value, high = (_time(x, found) for x in (remaining.low, remaining.value, remaining.high))
    if remaining.low == math.inf:
        return "not in sight"
    if trend.verdict != "TREND" or remaining.value == math.inf:
        return "may be reached already" if remaining.low == 0.0 else f"not before {low} (97.5 %)"
    most = f"to {high}" if math.isfinite(remaining.high) else "or never"
    return f"{value}, from {low} {most}"


def date(t: float, found: Answer) -> str:
    """A place on the axis in words; t from the last trace on."""
    end = found.gathered.points[-1].t
    if not math.isfinite(t):
        return "never"
    return iso(end + t) if found.gathered.axis == "date" else f"{end + t:.0f} {found.unit}"


def _time(t: float, found: Answer) -> str:
    return f"{t:.2g} {found.unit}" if t < 10 else f"{t:.0f} {found.unit}"


def _broken(kind: str, point: Point, size: str, up: bool, found: Answer) -> str:
    at = f"{point.trace}, {_when(point.t, found.gathered.axis)}"
    if kind == "outlier":
        return f"out of line and left out: {at}, {size} {'above' if up else 'below'} the others"
    if kind == "step":
        return f"a step: from {at} on the size is {size} more, at once"
    if kind == "repair":
        return f"a repair: at {at} the size falls by {size}; the trend begins there"
    if up:
        return (f"the last trace is {size} above the others: a trace out of line, a step, or a faster course; each is "
                "given a third, another trace will tell")
    return f"the last trace is {size} below the others: out of line, or a repair; left out, another trace will tell"


def interval(e: Estimate, unit: str, sign: bool = False) -> str:
    """A size with its interval, to the digits that its interval warrants."""
    width = max(e.high - e.low, 1e-9)
    places = max(0, min(4, math.ceil(-math.log10(width / 30.0))))
    words = [f"{x:{'+' if sign else ''}.{places}f}" for x in (e.value, e.low, e.high)]
    tail = "" if unit == "1" else f" {unit}"
    return f"{words[0]} ({words[1]} .. {words[2]}){tail}"


def _number(x: float, unit: str) -> str:
    return f"{x:.2g}" + ("" if unit == "1" else f" {unit}")
