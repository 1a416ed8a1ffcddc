"""The report: what a command answers, as one value that the terminal, HTML and JSON writers render; and the last two.

A command builds a `Report` once. `terminal.print_report` shows it to a person, `render_html` writes it as a page,
and `to_json(report.data)` prints it for other programs. The report holds finished text; numbers in it went through
`numbers`. Figures are callables, so that nothing is drawn for a terminal.
"""
from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np

from fdi.output import write_text

if TYPE_CHECKING:
    from jinja2 import Environment


Mood = Literal["", "good", "doubtful", "bad", "neutral", "muted"]
T = TypeVar("T")


class Medium(Enum):
    """Where a part of a report is shown."""

    BOTH = "both"
    TERMINAL = "terminal"
    PAGE = "page"

    def includes(self, other: Medium) -> bool:
        """Whether a part for this medium is shown on `other`."""
        return self in (Medium.BOTH, other)


@dataclass(frozen=True)
class Cell:
    """A cell of a table: its text, the mood that colours it, and whether it is printed bold.

    `link` is where the text leads on the page: the path of a file, relative to the page.
    """

    text: str
    mood: Mood = ""
    is_strong: bool = False
    link: str = ""


@dataclass(frozen=True)
class Column:
    """A column of a table. Numbers are aligned to the right and never cut or wrapped."""

    title: str
    unit: str = ""
    align: Literal["left", "right"] = "left"
    medium: Medium = Medium.BOTH

    @property
    def heading(self) -> str:
        """Title and unit.

        >>> Column("error", "um").heading
        'error [um]'
        """
        return f"{self.title} [{self.unit}]" if self.unit else self.title


@dataclass(frozen=True)
class Table:
    """Rows under columns. Each row has a cell for every column; a plain string is a cell without mood.

    A table without rows is not shown.

    Args:
        columns: the columns, from the left.
        rows: the rows, from the top.
        caption: what to see in the table.
        terminal_rows: number of rows that the terminal shows; None for all. The page has all.
        is_list: the page gives the first column only the width it needs, as for names and values.
        medium: where the table is shown.
    """

    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell | str]]
    caption: str = ""
    terminal_rows: int | None = None
    is_list: bool = False
    medium: Medium = Medium.BOTH

    def select_columns(self, medium: Medium) -> Table:
        """The same table with the columns of one medium; cells are `Cell` values."""
        rows = [[cell if isinstance(cell, Cell) else Cell(cell)
                 for column, cell in zip(self.columns, row, strict=True) if column.medium.includes(medium)]
                for row in self.rows]
        return replace(self, columns=[column for column in self.columns if column.medium.includes(medium)], rows=rows)


def tabulate(values: Iterable[T], *columns: tuple[Column, Callable[[T], Cell | str]], **fields: Any) -> Table:
    """A table with a row for each value; beside each column stands the function that makes its cell of a value.

    `fields` are further fields of `Table`.

    >>> tabulate([0.5, 2.0], (Column("size", "N"), "{:.1f}".format), (Column("far"), lambda x: str(x > 1))).rows
    [['0.5', 'False'], ['2.0', 'True']]
    """
    return Table([column for column, _ in columns], [[show(value) for _, show in columns] for value in values],
                 **fields)


@dataclass(frozen=True)
class Line:
    """A label and what it says: "floor     from 1 repeat of the test". A line without text is not shown."""

    label: str
    text: str
    mood: Mood = ""
    medium: Medium = Medium.BOTH


@dataclass(frozen=True)
class Paragraph:
    """Running text."""

    text: str
    mood: Mood = ""
    medium: Medium = Medium.BOTH


@dataclass(frozen=True)
class Figure:
    """A figure on the page. `draw` returns it as SVG text, or "" where there is nothing to draw.

    The caption says what to see. The terminal never calls `draw`.
    """

    caption: str
    draw: Callable[[], str]
    medium: Medium = Medium.PAGE


@dataclass(frozen=True)
class Listing:
    """Text in fixed-width characters, line by line: a command, a file, a drawing made of characters.

    With a `title` the page folds the listing behind it.
    """

    text: str
    title: str = ""
    medium: Medium = Medium.BOTH


Item = Table | Line | Paragraph | Figure | Listing


@dataclass(frozen=True)
class Section:
    """Items under a heading. A section without items is not shown.

    Args:
        title: heading on the page, "" for none.
        items: what stands below it.
        badge: a word beside the heading, such as the level of a fault, with its mood.
        medium: where the section is shown.
        title_medium: where its heading is shown; most tables speak for themselves on a terminal.
    """

    title: str
    items: Sequence[Item]
    badge: Cell | None = None
    medium: Medium = Medium.BOTH
    title_medium: Medium = Medium.PAGE

    def select_items(self, medium: Medium) -> list[Item]:
        """The items that one medium shows; none if it does not show the section."""
        items = (item for item in self.items if self.medium.includes(medium) and item.medium.includes(medium))
        return [item for item in items if not ((isinstance(item, Table) and not item.rows)
                                               or (isinstance(item, Line) and not item.text))]


@dataclass(frozen=True)
class Report:
    """What a command answers.

    Args:
        command: the command that answers, such as "compare".
        title: what it is about: the trace, the model file.
        verdict: the verdict word of the JSON answer; "" where the command has none.
        mood: colour of the verdict.
        sentence: the verdict in plain English.
        facts: (name, text) of what the answer is based on; under the title of the page.
        notes: what a reader must know before trusting the answer.
        sections: tables, lines, figures and text, in the order in which they are shown.
        next_command: what to type next; "" if there is nothing left to do.
        files: (label, path) of the files that were written.
        data: the JSON answer: plain values, numpy values, NaN and infinity; SI units.
        conclusion: the verdict once more, as the last line of the terminal; "" where the headline is enough.
    """

    command: str
    title: str
    verdict: str = ""
    mood: Mood = "neutral"
    sentence: str = ""
    facts: Sequence[tuple[str, str]] = ()
    notes: Sequence[str] = ()
    sections: Sequence[Section] = ()
    next_command: str = ""
    files: Sequence[tuple[str, str]] = ()
    data: Mapping[str, Any] = field(default_factory=dict)
    conclusion: str = ""

    def select_sections(self, medium: Medium) -> list[tuple[Section, list[Item]]]:
        """The sections that one medium shows, each with its items there."""
        pairs = ((section, section.select_items(medium)) for section in self.sections)
        return [(section, items) for section, items in pairs if items]


def to_json(data: Mapping[str, Any]) -> str:
    """The JSON text of an answer, in one line.

    >>> to_json({"error": np.float64(1.5), "ratio": float("nan"), "names": ("a", "b")})
    '{"error": 1.5, "ratio": null, "names": ["a", "b"]}'
    """
    return json.dumps(to_plain(data), allow_nan=False)


def to_plain(value: Any) -> Any:
    """A value as JSON can hold it: None for NaN and infinity, lists for tuples and arrays, dicts for mappings.

    A named tuple becomes a list, as `json` itself would write it; give its `_asdict()` where names are wanted.

    Raises:
        TypeError: a value of another type, which an answer must not hold.
    """
    match value:
        case np.ndarray() | np.generic():
            return to_plain(value.tolist())
        case Enum():
            return to_plain(value.value)
        case Mapping():
            return {str(key): to_plain(item) for key, item in value.items()}
        case list() | tuple() | set() | frozenset():
            return [to_plain(item) for item in value]
        case float():
            return value if math.isfinite(value) else None
        case Path():
            return str(value)
        case None | bool() | int() | str():
            return value
    raise TypeError(f"{type(value).__name__} in an answer: {value!r}")


def render_html(report: Report) -> str:
    """The page of a report as text. Everything in the report is escaped but the figures, which are SVG."""
    template = load_templates().get_template("page.html")
    return template.render(report=report, sections=report.select_sections(Medium.PAGE), page=Medium.PAGE)


def write_html(report: Report, path: str | Path, option: str = "--out") -> None:
    """Write the page of a report.

    Raises:
        InputError: a path that cannot be written; it names `option`.
    """
    write_text(path, render_html(report), option)


@cache
def load_templates() -> Environment:
    """The page template of this package with its functions; what is put in is escaped."""
    from jinja2 import Environment, PackageLoader

    templates = Environment(loader=PackageLoader("fdi.report", "."), autoescape=True, trim_blocks=True,
                            lstrip_blocks=True)
    templates.globals["group_by_kind"] = lambda items: [  # neighbours of one type share a table
        (kind.__name__, list(group)) for kind, group in groupby(items, key=type)]
    templates.globals["figure_script"] = Path(__file__).with_name("figure.js").read_text(encoding="utf-8")
    return templates
