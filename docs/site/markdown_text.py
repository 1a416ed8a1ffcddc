"""Pieces of Markdown for the pages that are made from the code."""
from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

MADE = "*This page is made from the code when the site is built.*"


def make_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """A table in Markdown; [] without rows."""
    cells = [[str(cell).replace("|", "\\|").replace("\n", " ") for cell in row] for row in rows]
    if not cells:
        return []
    return ["", f"| {' | '.join(head)} |", "|---" * len(head) + "|", *(f"| {' | '.join(row)} |" for row in cells), ""]


def quote_code(value: object) -> str:
    """A value as code; "" for none."""
    return f"`{value}`" if str(value) else ""


def escape_markup(text: str) -> str:
    """A plain text in Markdown: no character of it is markup. Code in backticks stays."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(part if part.startswith("`") and len(part) > 1 else re.sub(r"([*_<\[\]$~])", r"\\\1", part)
                   for part in parts)


def make_contents(names: Iterable[str]) -> list[str]:
    """A table of contents that Sphinx reads and does not show."""
    return ["```{toctree}", ":hidden:", "", *names, "```"]


def name_anchor(kind: str, name: str) -> str:
    """The anchor of a section about a thing, such as "effect-null-bias"."""
    return f"{kind}-{name.replace('_', '-')}"
