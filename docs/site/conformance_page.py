"""The reference page of the conformance tests."""
from __future__ import annotations

from markdown_text import MADE, escape_markup, make_table

from rig.conformance.run_cases import CASES
from rig.conformance.target import CHAPTERS


def write_conformance_page() -> list[str]:
    """The page of all conformance tests, a table for each chapter."""
    lines = ["# Conformance tests", "", MADE, "",
             "`rig conformance` makes these tests; [test any CANopen node](../docs/conformance.md) shows how. Section "
             "numbers are those of CiA 301 version 4.2.0, unless another document is named."]
    for number, title in CHAPTERS.items():
        rows = [[escape_markup(text) for text in (each.number, each.name, each.expected, each.section)]
                for each in CASES if each.chapter == number]
        lines += ["", f"## {number} {title}", *make_table(("no.", "test", "expected", "CiA 301"), rows)]
    return lines
