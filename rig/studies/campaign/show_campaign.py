"""A campaign on the terminal: how far it is, and its statistics as tables."""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from fdi.diagnosis.faults import FAULTS
from rig.studies.campaign.summary import name_size
from rig.studies.resumable.batch import BatchProgress

REASONS = 10  # failed or refused cases that are listed


def line(progress: BatchProgress) -> str:
    """How far it is, in a few words."""
    failed = f", {progress.failed} failed" if progress.failed else ""
    return f"{progress.done}/{progress.total}{failed}, {time(progress.left)} left"


def time(seconds: float) -> str:
    """Seconds, minutes or hours, as one would say it."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def summary(figures: Mapping[str, Any], out: Console) -> None:
    """The figures of `rig.studies.campaign.summary.summary`."""
    status = ", ".join(f"{count} {word}" for word, count in figures["status"].items())
    out.print(f"{figures['cases']} cases: {status or 'none yet'}")
    if took := figures["seconds"]:
        out.print(f"time a case: {took['median']:.2f} s (median), {took['p95']:.2f} s (95 of 100), "
                  f"{took['most']:.2f} s (most)")
    for part in figures["tolerances"]:
        out.print()
        out.print(f"[bold]Plants with {100 * part['tolerance']:g} % scatter[/], {part['cases']} cases")
        _part(part, out)
    if figures["traces"]:
        out.print()
        out.print(_traces(figures["traces"]))
    for reason in figures["reasons"][:REASONS]:
        out.print(f"{reason['case']}, seed {reason['seed']}: {reason['status']}, {reason['reason']}", markup=False,
                  soft_wrap=True)
    if len(figures["reasons"]) > REASONS:
        out.print(f"and {len(figures['reasons']) - REASONS} more")


def _part(part: Mapping[str, Any], out: Console) -> None:
    tables = [_rates(part["rates"]), *(_curve(fault.name, fault.unit, part["curves"][fault.name]) for fault in FAULTS),
              *(_counts(f"{fault.name}: truth, said", part["levels"][fault.name]) for fault in FAULTS),
              _ruling(part["ruling"]), _errors(part["errors"])]
    for table in tables:
        if table.row_count:
            out.print()
            out.print(table)


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False)
    for i, name in enumerate(columns):
        table.add_column(name, justify="left" if i == 0 else "right")
    return table


def percent(count: Mapping[str, Any]) -> tuple[str, str, str]:
    """A share as count, per cent and 95 % interval."""
    if not count["of"]:
        return "0/0", "-", "-"
    return (f"{count['good']}/{count['of']}", f"{100 * count['share']:.1f} %",
            f"{100 * count['low']:.1f} .. {100 * count['high']:.1f}")


def _rates(rates: Sequence[Mapping[str, Any]]) -> Table:
    table = _table("", "count", "share", "95 % interval", "asked", "")
    for r in rates:
        if r["share"]["of"]:
            wanted = asked(100 * r["least"], 100 * r["most"])
            verdict = ("too few" if wanted else "") if r["met"] is None else "met" if r["met"] else "NOT met"
            table.add_row(r["name"], *percent(r["share"]), wanted, verdict)
    return table


def asked(low: float, high: float) -> str:
    """What is asked for, between two shares in per cent; "" where nothing is."""
    if low > 0 and high < 100:
        return f"{low:g} .. {high:g} %"
    return f">= {low:g} %" if low > 0 else f"<= {high:g} %" if high < 100 else ""


def _curve(name: str, unit: str, points: Sequence[Mapping[str, Any]]) -> Table:
    table = _table(f"{name}{f', {unit}' if unit != '1' else ''}", "detected", "share", "95 % interval",
                   "non-nominal", "ruling", "by bands")
    for p in points if len(points) > 1 else []:
        more = (percent(p[key])[1] for key in ("most", "ruling", "bands"))
        table.add_row(f"{p['size']:g}", *percent(p["detected"]), *more)
    return table


def _counts(title: str, counts: Mapping[str, Mapping[str, int]]) -> Table:
    said = [word for word in next(iter(counts.values())) if any(row[word] for row in counts.values())]
    table = _table(title, *said)
    for truth, row in counts.items():
        if any(row.values()):
            table.add_row(truth, *(str(row[word]) for word in said))
    return table


def _ruling(counts: Mapping[str, Mapping[str, int]]) -> Table:
    said = sorted({word for row in counts.values() for word in row})
    table = _table("ruling fault: truth, said", *said)
    for truth, row in counts.items():
        table.add_row(truth, *(str(row.get(word, 0)) for word in said))
    return table


def _errors(errors: Sequence[Mapping[str, Any]]) -> Table:
    table = _table("estimates of", "", "cases", "bias", "RMS", "p95", "covered", "95 % interval")
    for e in errors:
        fault = next(fault for fault in FAULTS if fault.name == e["fault"])
        plant = e["label"]
        for other in FAULTS:
            plant = plant.replace(f"{other.name}=", f"{name_size(other)} ")
        table.add_row(plant, name_size(fault), str(e["cases"]), *(f"{e[key]:.2g}" for key in ("bias", "rms", "most")),
                      *percent(e["covered"])[1:])
    return table


def _traces(rows: Sequence[Mapping[str, Any]]) -> Table:
    table = _table("trace", *(fault.name for fault in FAULTS), "ruling", *(fault.symbol for fault in FAULTS))
    for row in rows:
        said = [row[f"level_{fault.name}"] or row["status"] for fault in FAULTS]
        sizes = [f"{value:.3g}" if (value := row[fault.symbol]) is not None and math.isfinite(value) else "-"
                 for fault in FAULTS]
        table.add_row(row["label"], *said, row["ruling"] or "-", *sizes)
    return table
