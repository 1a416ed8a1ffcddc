"""What `rig compare` shows a person: the verdict, the table of signals, the blocks, where and when."""
from __future__ import annotations

from pathlib import Path

from rich.markup import escape
from rich.table import Table

from fdi.comparison.compare import Comparison
from fdi.report.compare_text import SHOWN, amount, block_word, digits, lines, sentence
from rig.cli.terminal import console

COLOURS = {"WITHIN_FLOOR": "green", "MODEL_INCOMPLETE": "red", "CANNOT_TELL": "yellow"}
HUGE = 1e4  # times the floor; beyond, more digits say nothing


def comparison(found: Comparison, then: str, page: Path | None) -> None:
    """Everything, on standard output."""
    out = console()
    out.print(f"[bold {COLOURS[found.verdict]}]{found.verdict}[/]  {escape(sentence(found))}", soft_wrap=True)
    out.print()
    out.print(signals(found))
    out.print()
    if any(value is not None for value in found.blocks.values()):
        out.print(blocks(found))
        out.print()
    for label, text in lines(found):
        out.print(f"[dim]{label:<10}[/]{escape(text)}", soft_wrap=True)
    if page is not None:
        out.print(f"[dim]{'page':<10}[/]{escape(str(page))}", soft_wrap=True)
    if then:
        out.print(f"[dim]{'next':<10}[/][bold]{escape(then)}[/]", soft_wrap=True)


def signals(found: Comparison) -> Table:
    """Error, floor, ratio, and the error of the whole loop."""
    table = Table(box=None, pad_edge=False)
    table.add_column("signal")
    for column in ("error", "floor", "ratio", "from the command alone"):
        table.add_column(column, justify="right")
    for s in found.signals.values():
        over = s.ratio > s.limit
        bound = ">= " if s.floor.lower_bound else ""
        table.add_row(SHOWN[s.name][0], amount(s.error, s.name), bound + amount(s.floor.value, s.name),
                      f"[{'bold red' if over else 'green'}]{ratio(s.ratio)}[/]", amount(s.closed_loop_error, s.name))
    return table


def blocks(found: Comparison) -> Table:
    """Each block with its ratio and what it was held against."""
    table = Table(box=None, pad_edge=False)
    table.add_column("block")
    table.add_column("ratio", justify="right")
    table.add_column("")
    for name, value in found.blocks.items():
        colour = "dim" if value is None else "bold red" if name in found.named else "green"
        shown = "-" if value is None else ratio(value)
        table.add_row(name, f"[{colour}]{shown}[/]", f"[dim]{escape(block_word(found, name))}[/]")
    return table


def ratio(value: float) -> str:
    """A ratio to the floor.

    >>> ratio(1.0234), ratio(499452.6), ratio(0.008)
    ('1.02', '>10000', '<0.1')
    """
    return f">{HUGE:.0f}" if value > HUGE else "<0.1" if value < 0.1 else digits(value)
