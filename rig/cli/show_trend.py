"""What `rig trend` shows a person: time left, the sizes drawn over time, what is to be said; or the table of scores."""
from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from rich.markup import escape
from rich.table import Table

from fdi.prognosis.trend import Trend
from fdi.prognosis.unit_trend import NAMES, Answer, date, left, sentences
from rig.cli.terminal import console
from rig.studies.prognosis.score import LAMBDAS
from rig.studies.prognosis.summary import LawScores, Scores

COLOURS = ("green", "yellow", "red")  # by level
WIDTH, HEIGHT = 72, 11  # characters of a drawing
SCORES = 120  # of the table of scores, as wide as it needs
MARK, STRAY, BAR, COURSE, FAN = "●", "○", "│", "·", "░"
AHEAD = 0.35  # at least this part of a drawing is future


def answer(found: Answer, place: Path | None) -> None:
    """Everything, on standard output."""
    out = console()
    level = found.level
    out.print(f"[bold {COLOURS[level]}]{level.name.replace('_', ' ')}[/]  {escape(_head(found))}", soft_wrap=True)
    for trend in found.trends:
        out.print()
        word = trend.verdict.replace("_", " ")
        out.print(f"[bold]{trend.fault.name.replace('_', ' ')}[/]  [{COLOURS[trend.level]}]{word}[/]", soft_wrap=True)
        for line in sentences(trend, found):
            out.print(f"  {escape(line)}", soft_wrap=True)
        for name, remaining in trend.remaining.items():
            until = f"  [dim]{escape(_dates(remaining.low, remaining.value, remaining.high, found))}[/]"
            out.print(f"  {NAMES[name]} ({remaining.limit:g})  [bold]{escape(left(remaining, trend, found))}[/]"
                      + (until if trend.verdict == "TREND" and remaining.high > 0 else ""), soft_wrap=True)
        for row in picture(trend, found):
            out.print(f"  {escape(row)}", soft_wrap=True)
    out.print()
    for note in found.gathered.notes:
        out.print(f"[dim]{'note':<10}[/]{escape(note)}", soft_wrap=True)
    if place is not None:
        out.print(f"[dim]{'written':<10}[/]{escape(str(place))}", soft_wrap=True)


def _head(found: Answer) -> str:
    points = found.gathered.points
    count = f"{len(points)} trace" + "s" * (len(points) > 1)
    first, last = (date(p.t - points[-1].t, found) for p in (points[0], points[-1]))
    return f"{found.gathered.source}: {count}, {first}" + (f" to {last}" if last != first else "")


def _dates(low: float, value: float, high: float, found: Answer) -> str:
    return f"{date(value, found)}, {date(low, found)} .. {date(high, found)}" if math.isfinite(low) else ""


def picture(trend: Trend, found: Answer) -> list[str]:
    """Sizes, the course so far and what may come, as lines of text; no picture of a single time."""
    start, end = float(trend.t[0]), float(trend.t[-1])
    if end == start:
        return []
    until = end + AHEAD / (1.0 - AHEAD) * (end - start)
    if trend.future is not None:
        until = min(max(until, float(trend.future.t[-1])), end + 1.5 * (end - start))
    top = 1.15 * max(trend.fault.most, max(e.value for e in trend.sizes))
    cells = [[" "] * WIDTH for _ in range(HEIGHT)]

    def column(t: float) -> int:
        return round((t - start) / (until - start) * (WIDTH - 1))

    def row(size: float) -> int:
        return HEIGHT - 1 - min(max(round(size / top * (HEIGHT - 1)), 0), HEIGHT - 1)

    for limit in (trend.fault.middle, trend.fault.most):
        cells[row(limit)] = ["-"] * WIDTH
    _future(cells, trend, row, column, end)
    for t, e, used in zip(trend.t, trend.sizes, trend.used, strict=True):
        for y in range(row(e.high), row(e.low) + 1):
            cells[y][column(t)] = BAR
        cells[row(e.value)][column(t)] = MARK if used else STRAY
    labels = {row(trend.fault.middle): "MidBand", row(trend.fault.most): "MaxBand"}
    lines = [f"{top * (HEIGHT - 1 - y) / (HEIGHT - 1):>6.3g} {''.join(line)} {labels.get(y, '')}".rstrip()
             for y, line in enumerate(cells)]
    names = [date(t - end, found) for t in (start, end, until)]
    foot = list(f"{'':7}{names[0]:<{WIDTH - len(names[2])}}{names[2]}")
    at = 7 + min(max(column(end) - len(names[1]) // 2, len(names[0]) + 1), WIDTH - len(names[2]) - len(names[1]) - 1)
    foot[at:at + len(names[1])] = names[1]
    return [*lines, "".join(foot)]


def _future(cells: list[list[str]], trend: Trend, row: object, column: object, end: float) -> None:
    """What may come, shaded, with its middle; and the course so far."""
    assert callable(row) and callable(column)
    for curve, shade in ((trend.past, ""), (trend.future, FAN)):
        if curve is None:
            continue
        for x in range(max(column(curve.t[0]), 0), min(column(curve.t[-1]), WIDTH - 1) + 1):
            where = [column(t) for t in curve.t]
            low, middle, high = (float(np.interp(x, where, line)) for line in (curve.low, curve.middle, curve.high))
            if shade and x > column(end):
                for y in range(row(high), row(low) + 1):
                    cells[y][x] = shade
            cells[row(middle)][x] = COURSE


def scores(found: Scores) -> None:
    """The table of `rig trend --score`."""
    out = console()
    table = Table(box=None, pad_edge=False)
    table.add_column("\ntrue law", no_wrap=True)
    marks = " ".join(f"{x:g}".lstrip("0") for x in LAMBDAS)
    for head in ("\nunits", f"alpha-lambda\n{marks}", "\nhorizon", f"relative accuracy\n{marks}", "95 %\nto MaxBand",
                 "95 %\nto MidBand", "too\nlate", "first\ntrend"):
        table.add_column(head, justify="right", no_wrap=True)
    for one in found.lines:
        table.add_row(*_cells(one))
    out.width = max(out.width, SCORES)
    out.print(table)
    out.print(f"\nhealthy units in which a trend was told: {found.told} of {found.healthy}")


def _cells(one: LawScores) -> list[str]:
    def share(pair: tuple[int, int]) -> str:
        return f"{pair[0]}/{pair[1]} {100 * pair[0] / max(pair[1], 1):.0f} %"

    def four(values: tuple[float, ...]) -> str:
        return " ".join(f"{x:.2f}" for x in values)

    return [one.law, str(one.units), four(one.alpha_lambda), f"{one.horizon:.2f}", four(one.relative), share(one.held),
            share(one.held_middle), share(one.early), f"{one.latency:.2f}"]
