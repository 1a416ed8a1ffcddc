"""A trial's figures on the terminal."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from rig.studies.resumable.batch import BatchProgress


def line(progress: BatchProgress) -> str:
    """One finished case, in one line with the time left."""
    truth, answer = progress.row["truth"], progress.row["answer"]
    hidden = ", ".join(f"{h['effect']} {h['size']:.3g}" for h in truth.get("hidden", [])) or "nothing"
    named = ", ".join(answer["effects"] or []) or "-"
    return (f"{progress.done}/{progress.total}, {_time(progress.left)} left: seed {progress.row['seed']}, {hidden}"
            f" -> {answer['verdict']} {named}, {progress.row['seconds']:.1f} s")


def _time(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds > 90 else f"{seconds:.0f} s"


def summary(figures: Mapping[str, Any], out: Console) -> None:
    """Rates, confusion table and failures of `score.summary`."""
    out.print(_rates(figures["rates"]))
    out.print()
    out.print(_by_signals(figures["by_signals"]))
    names = figures["names_on_average"]
    if names is not None:
        out.print(f"names in the set, where the truth is in it: {names:.2f} on average (at most 3 asked for)")
    if seconds := figures["seconds"]:
        out.print(f"time a case: {seconds['median']:.1f} s (median), {seconds['most']:.1f} s (most)")
    out.print()
    out.print(_confusion(figures["confusion"]))
    if figures["failures"]:
        out.print()
        out.print("Against a rate:")
        for failure in figures["failures"]:
            out.print(_failure(failure), markup=False)


def _rates(rates: Sequence[Mapping[str, Any]]) -> Table:
    table = Table("Blind trial, all signals", "good", "share", "95 % interval", "asked", "", box=None, pad_edge=False)
    for r in rates:
        share = "-" if r["share"] is None else f"{100 * r['share']:.1f} %"
        span = f"{100 * r['low']:.1f} .. {100 * r['high']:.1f}" if r["of"] else ""
        verdict = "" if not r["of"] else "met" if r["met"] else "NOT met"
        table.add_row(r["name"], f"{r['good']}/{r['of']}", share, span, f"{100 * r['asked']:.0f} %", verdict)
    return table


def _by_signals(counts: Mapping[str, Mapping[str, Sequence[int]]]) -> Table:
    table = Table("by what is measured", *counts, box=None, pad_edge=False)
    for name in next(iter(counts.values())):
        table.add_row(name, *("{}/{}".format(*of[name]) for of in counts.values()))
    return table


def _confusion(confusion: Mapping[str, Mapping[str, int]]) -> Table:
    """By truth, because verdicts times right and wrong are too many columns for a terminal."""
    table = Table("truth", "answers", box=None, pad_edge=False)
    for truth, counts in confusion.items():
        often = sorted(counts.items(), key=lambda item: -item[1])
        table.add_row(truth, ", ".join(f"{count} {answer}" for answer, count in often))
    return table


def _failure(f: Mapping[str, Any]) -> str:
    hidden = ", ".join(f"{name} {size:.3g}" for name, size in f["hidden"].items()) or "nothing"
    answer = " ".join([f["verdict"], ", ".join(f["named"] or []), f["error"] or ""]).strip()
    case = f"seed {f['seed']} ({f['signals']}): {hidden}, {f['floors']:.1f} floors"
    return f"{case} -> {answer} [{'; '.join(f['against'])}]"
