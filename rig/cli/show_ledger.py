"""What `rig add` and `rig remove` show a person: the error after each step, as a table and as bars."""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from fdi.discovery.model_file import Row
from fdi.report import explain_text
from fdi.report.numbers import SIGNAL_NAMES, SIGNAL_UNITS, format_amount, format_interval, format_ratio
from rig.cli.model_update import Done
from rig.cli.terminal import console

WIDTH = 36  # characters of the longest bar
GOOD = 1.15  # floors


def shown(done: Done, path: Path, page: Path | None, kept: Path | None, why: str) -> None:
    """Everything, on standard output."""
    out = console()
    colour = "green" if done.refit is None or done.refit.helps else "yellow"
    out.print(f"[bold {colour}]{escape(why)}[/]", soft_wrap=True)
    floor = done.provenance.floor or {}
    if done.refit is not None:
        out.print()
        out.print(table(done.provenance.ledger, floor))
        out.print()
        out.print(bars(done.provenance.ledger, floor))
    out.print()
    said = [(name, format_interval(v.value, v.low, v.high, v.unit)) for name, v in done.effects.items()]
    said += [("suspicious", explain_text.suspicious(done.doubts))] if done.doubts else []
    said += [("note", note) for note in done.notes]
    said.append(("model", f"{path}" + (f" (the one before: {kept})" if kept else "")))
    said += [("page", str(page))] if page is not None and done.refit is not None else []
    wide = max(len(label) for label, _ in said) + 2
    for label, text in said:
        out.print(f"[dim]{label:<{wide}}[/]{escape(text)}", soft_wrap=True)


def table(rows: Sequence[Row], floor: Mapping[str, float]) -> Table:
    """RMS error of each signal after each step, on the fitted run and on the held-out one."""
    t = Table(box=None, pad_edge=False)
    t.add_column("")
    t.add_column("")
    for s in floor:
        t.add_column(SIGNAL_NAMES[s], justify="right")
    for row in rows:
        t.add_row(name_of(row), "", *(_cell(row.error, s, floor) for s in floor))
        if row.holdout:
            t.add_row("", "[dim]held out[/]", *(_cell(row.holdout, s, floor) for s in floor))
    t.add_row("[dim]floor[/]", "", *(f"[dim]{format_amount(x, SIGNAL_UNITS[s])}[/]" for s, x in floor.items()))
    return t


def name_of(row: Row) -> str:
    """What a step did."""
    return "the model as it was" if row.effect is None else f"{'-' if row.removed else '+'} {row.effect}"


def _cell(by: Mapping[str, float], signal: str, floor: Mapping[str, float]) -> str:
    if signal not in by:
        return "-"
    good = by[signal] <= GOOD * floor[signal]
    return f"[{'green' if good else 'red'}]{format_amount(by[signal], SIGNAL_UNITS[signal])}[/]"


def bars(rows: Sequence[Row], floor: Mapping[str, float]) -> Table:
    """The worst signal's error in floors, as bars on a logarithmic scale: the floor has none."""
    t = Table.grid(padding=(0, 1))
    sizes = [[max((x / floor[s] for s, x in by.items() if s in floor), default=math.nan) for by in
              (row.error, row.holdout)] for row in rows]
    top = max((x for pair in sizes for x in pair if math.isfinite(x)), default=1.0)
    for row, (own, held) in zip(rows, sizes, strict=True):
        t.add_row(name_of(row), "", *_bar(own, top))
        if math.isfinite(held):
            t.add_row("", "[dim]held out[/]", *_bar(held, top))
    return t


def _bar(size: float, top: float) -> tuple[str, str]:
    length = max(1, round(WIDTH * math.log(max(size, 1.0)) / math.log(max(top, 1.1))))
    return f"[{'green' if size <= GOOD else 'red'}]{'█' * length}[/]", f"{format_ratio(size)} floors"
