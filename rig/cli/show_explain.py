"""What `rig explain` shows a person: verdict, ranked candidates, what the test does not see, what to do next."""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from fdi.discovery.candidates import Answer, Candidate
from fdi.report import explain_text
from fdi.report.numbers import SIGNAL_NAMES, format_p_value, format_ratio
from rig.cli.terminal import console

COLOURS = {"NOTHING_MISSING": "green", "EXPLAINED": "green", "PARTLY": "yellow", "AMBIGUOUS": "yellow",
           "NOT_RESOLVABLE": "yellow", "UNEXPLAINED": "red"}
WORDS = {"explains": "green", "equal": "yellow", "part": "yellow"}
ROWS = 8  # in the terminal; page and JSON have all


def answer(a: Answer, notes: Sequence[str], then: str, page: Path | None, effect_file: str | None) -> None:
    """Everything, on standard output."""
    out = console()
    out.print(f"[bold {COLOURS[a.verdict]}]{a.verdict}[/]  {escape(explain_text.sentence(a))}", soft_wrap=True)
    if a.candidates:
        out.print()
        out.print(table(a))
    out.print()
    said = [*explain_text.lines(a), *(("note", note) for note in notes)]
    if page is not None:
        said.append(("page", str(page)))
    if effect_file:
        said.append(("effect", effect_file))
    for label, text in said:
        out.print(f"[dim]{label:<11}[/]{escape(text)}", soft_wrap=True)
    if then:
        out.print(f"[dim]{'next':<11}[/][bold]{escape(then)}[/]", soft_wrap=True)


def table(a: Answer) -> Table:
    """The candidates, best first: what they leave of each signal in floors, here and on the held-out run."""
    signals = list(a.explanation.floor)
    held = any(c.holdout for c in a.candidates)
    t = Table(box=None, pad_edge=False)
    t.add_column("effect")
    t.add_column("")
    for column in [*(SIGNAL_NAMES[s] for s in signals), *(["held out"] if held else []), "evidence", "p"]:
        t.add_column(column, justify="right")
    for c in a.explanations[:ROWS]:
        t.add_row(*_row(a, c, signals, held))
    before = a.explanation.base.ratio
    unseen = [_worst(a, a.baseline["holdout"])] if held else []
    t.add_row("[dim]none of them[/]", "", *(f"[dim]{format_ratio(before[s])}[/]" for s in signals),
              *(f"[dim]{word}[/]" for word in unseen), "", "")
    t.caption = "what is left of each signal, in floors (1: noise alone)"
    t.caption_justify = "left"
    return t


def _row(a: Answer, c: Candidate, signals: Sequence[str], held: bool) -> list[str]:
    colour = WORDS.get(c.word, "dim")
    name = " + ".join(f"[bold]{x}[/]" if colour != "dim" else x for x in (*c.beside, c.effect))
    shown = [format_ratio(c.ratios[s]) if s in c.ratios else "-" for s in signals]
    return [name, f"[{colour}]{c.word}[/]", *shown, *([_worst(a, c.holdout)] if held else []), f"{c.evidence:.0f}",
            format_p_value(c.p_value)]


def _worst(a: Answer, holdout: object) -> str:
    """The worst signal of a held-out run, in floors."""
    floor = a.explanation.floor
    by = holdout if isinstance(holdout, dict) else {}
    return format_ratio(max(x / floor[s] for s, x in by.items() if s in floor)) if by else "-"
