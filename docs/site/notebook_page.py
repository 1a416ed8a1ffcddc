"""Run a notebook and make a page of it.

The cells are run one after the other in one namespace, as Jupyter would, without Jupyter: a kernel and its client are
some 30 more packages for what needs 60 lines here. Magics and shell lines (%, !) are not supported, and a notebook of
this project has none.
"""
from __future__ import annotations

import ast
import contextlib
import io
import json
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple


class RunCell(NamedTuple):
    """A cell with what it printed and what its last line gave."""

    kind: str  # "markdown" or "code"
    source: str
    printed: str = ""
    value: Any = None


class NotebookError(Exception):
    """A cell failed; the message names it."""


def read_cells(path: Path) -> list[tuple[str, str]]:
    """(kind, source) of the cells of a notebook."""
    return [(cell["cell_type"], "".join(cell["source"])) for cell in json.loads(path.read_text())["cells"]]


def run_notebook(path: Path) -> list[RunCell]:
    """Run all cells of a notebook in a temporary folder; return them with their results.

    Raises:
        NotebookError: a cell failed.
    """
    names: dict[str, Any] = {"__name__": "__main__"}
    run: list[RunCell] = []
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            for number, (kind, source) in enumerate(read_cells(path), 1):
                run.append(run_cell(source, names, f"{path.name}, cell {number}") if kind == "code"
                           else RunCell(kind, source))
        finally:
            os.chdir(before)
    return run


def run_cell(source: str, names: dict[str, Any], where: str) -> RunCell:
    """Run one cell in the namespace of the cells before it."""
    printed = io.StringIO()
    value = None
    try:
        tree = ast.parse(source, where)
        last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
        with contextlib.redirect_stdout(printed):
            exec(compile(tree, where, "exec"), names)
            if isinstance(last, ast.Expr):
                value = eval(compile(ast.Expression(last.value), where, "eval"), names)
    except Exception as error:
        raise NotebookError(f"{where}: {type(error).__name__}: {error}") from error
    return RunCell("code", source, printed.getvalue(), value)


def write_notebook_page(notebook: Path, cells: Sequence[RunCell], page: Path) -> None:
    """Write a page of a notebook that was run; pictures become files beside it."""
    lines: list[str] = []
    for number, cell in enumerate(cells, 1):
        if cell.kind == "markdown":
            lines += [cell.source, ""]
            continue
        lines += ["```python", cell.source, "```", ""]
        if cell.printed:
            lines += ["```text", cell.printed.rstrip(), "```", ""]
        if hasattr(cell.value, "_repr_svg_"):
            picture = page.with_name(f"{notebook.stem}_{number}.svg")
            picture.write_text(cell.value._repr_svg_())
            caption = getattr(cell.value, "caption", "")
            lines += [f"![{caption.partition('.')[0]}]({picture.name})", "", f"*{caption}*" if caption else "", ""]
        elif cell.value is not None:
            lines += ["```text", repr(cell.value), "```", ""]
    page.write_text("\n".join(lines) + f"\nThe notebook: [{notebook.name}]({notebook.name}).\n")


def check_format(notebook: Mapping[str, Any]) -> list[str]:
    """What keeps a file from being a notebook of version 4 without results; [] for nothing."""
    faults = [] if (notebook.get("nbformat"), notebook.get("nbformat_minor")) == (4, 5) else ["expected nbformat 4.5"]
    for number, cell in enumerate(notebook["cells"], 1):
        required = {"id", "cell_type", "metadata", "source"}
        required |= {"outputs", "execution_count"} if cell["cell_type"] == "code" else set()
        if set(cell) != required:
            faults.append(f"cell {number}: expected the keys {', '.join(sorted(required))}")
        if cell.get("outputs") or cell.get("execution_count"):
            faults.append(f"cell {number}: expected no results")
    return faults
