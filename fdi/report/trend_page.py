"""One HTML page about a trend that needs no network: remaining life of both faults, picture, traces."""
from __future__ import annotations

from typing import Any

from fdi.diagnosis.faults import FAULTS
from fdi.output import rendered
from fdi.prognosis.dates import iso
from fdi.prognosis.trend import Trend
from fdi.prognosis.unit_trend import NAMES, Answer, date, interval, left, sentences
from fdi.report.trend_figure import drawing

MOODS = ("good", "doubtful", "bad")


def render(found: Answer) -> str:
    """The page as text."""
    g = found.gathered
    return rendered(
        "trend.html",
        heading="Trend", title=g.source, verdict=found.level.name.replace("_", " "), mood=MOODS[found.level],
        why=f"{len(g.points)} traces, {_place(found, g.points[0].t)} to {_place(found, g.points[-1].t)}",
        notes=g.notes, picture=drawing(found),
        faults=[{"name": t.fault.name.replace("_", " "), "verdict": t.verdict.replace("_", " "),
                 "lines": sentences(t, found), "rows": _rows(t, found)} for t in found.trends],
        symbols=[f.symbol for f in FAULTS],
        points=[{"trace": p.trace, "at": _place(found, p.t), "note": p.note,
                 "sizes": [interval(p.sizes[f.name], f.unit) for f in FAULTS]} for p in g.points])


def _rows(trend: Trend, found: Answer) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for level, r in trend.remaining.items():
        at = ["–"] * 3 if r.high == 0.0 else [date(t, found) for t in (r.low, r.value, r.high)]
        rows.append({"name": NAMES[level], "left": left(r, trend, found), "from": at[0], "at": at[1], "to": at[2],
                     "soon": f"{100 * r.within(trend.t[-1] - trend.t[0]):.0f} %"})
    return rows


def _place(found: Answer, t: float) -> str:
    return iso(t) if found.gathered.axis == "date" else f"{t:g} {found.unit}"
