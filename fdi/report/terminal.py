"""The terminal writer: verdict, tables and labelled lines, for a person at a console of 80 columns or more."""

import textwrap
from collections.abc import Collection, Sequence
from io import StringIO

from rich.cells import cell_len
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from fdi.report.report import Cell, Column, Item, Line, Listing, Medium, Mood, Paragraph, Report, Table

STYLES: dict[Mood, str] = {"": "", "good": "green", "doubtful": "yellow", "bad": "red", "neutral": "bold",
                           "muted": "dim"}
GAP = 2  # characters between two columns


def print_report(report: Report, console: Console) -> None:
    """Print a report: the verdict first, then its sections, notes, files, and what to type next.

    A table that is wider than the console is printed in blocks of columns, each with the rows that say something
    there; a number is never cut.
    """
    verdict = Text.assemble((report.verdict, style_of(Cell("", report.mood, True))), f"  {report.sentence}")
    headline = verdict if report.verdict else Text(report.sentence, "bold")
    if headline.plain:
        console.print(headline, soft_wrap=not console.is_terminal)
    labels: list[Line] = []
    for section, items in report.select_sections(Medium.TERMINAL):
        if section.title_medium.includes(Medium.TERMINAL) or section.badge is not None:
            _flush_lines(labels, console)
            console.print()
            badge = Text(f"  {section.badge.text}", style_of(section.badge)) if section.badge else ""
            console.print(Text.assemble((section.title, "bold"), badge), soft_wrap=True)
        for item in items:
            if isinstance(item, Line):
                labels.append(item)
            else:
                _flush_lines(labels, console)
                _print_item(item, console)
    labels += [*(Line("note", note) for note in report.notes), *(Line(label, path) for label, path in report.files),
               *([Line("next", report.next_command, "neutral")] if report.next_command else []),
               *([Line("verdict", report.conclusion, report.mood)] if report.conclusion else [])]
    _flush_lines(labels, console, whole={"next", *(label for label, _ in report.files)})


def format_report(report: Report, width: int = 100) -> str:
    """A report as text without colours, for a console of so many characters."""
    out = StringIO()
    print_report(report, Console(file=out, width=width, highlight=False, color_system=None))
    return out.getvalue()


def _print_item(item: Item, console: Console) -> None:
    match item:
        case Table():
            console.print()
            _print_table(item.select_columns(Medium.TERMINAL), console)
        case Paragraph():
            console.print()
            console.print(Text(item.text, STYLES[item.mood]))
        case Listing():
            console.print(Text(item.text), soft_wrap=True)


def _flush_lines(lines: list[Line], console: Console, whole: Collection[str] = ()) -> None:
    """Print labelled lines with their texts in one column.

    A terminal shows a long text in several lines, between words and below each other; in a file or pipe it stays one
    line. So do commands and paths, the lines with a label in `whole`, because they are copied.
    """
    if not lines:
        return
    console.print()
    label_width = 10  # characters of a label, if none is longer
    width = max(label_width, *(cell_len(line.label) + GAP for line in lines))
    for line in lines:
        label = Text(line.label + " " * (width - cell_len(line.label)), "dim")
        if console.is_terminal and line.label not in whole and console.width > 2 * width:
            row = RichTable.grid()
            row.add_column(width=width, no_wrap=True)
            row.add_column(width=console.width - width, overflow="fold")
            row.add_row(label, Text(line.text, STYLES[line.mood]))
            console.print(row)
        else:
            console.print(Text.assemble(label, (line.text, STYLES[line.mood])), soft_wrap=True)
    lines.clear()


def _print_table(table: Table, console: Console) -> None:
    rows = [[cell for cell in row if isinstance(cell, Cell)] for row in table.rows]  # all are, once columns are chosen
    shown_rows = rows[:table.terminal_rows]
    least_widths = [_find_least_width(column, [row[i] for row in shown_rows]) for i, column in enumerate(table.columns)]
    for number, block in enumerate(_split_columns(least_widths, console.width)):
        console.print(_build_table([table.columns[i] for i in block],
                                   [[row[i] for i in block] for row in shown_rows
                                    if number == 0 or any(row[i].text for i in block[1:])],
                                   [least_widths[i] for i in block], console.width))
    if len(shown_rows) < len(rows):
        console.print(Text(f"and {len(rows) - len(shown_rows)} more", "dim"))
    if table.caption:
        console.print(Text(table.caption, "dim italic"))


def _find_least_width(column: Column, cells: Sequence[Cell]) -> int:
    """Characters that a column needs: its widest number, or its longest word where text may wrap; and its heading."""
    texts = [part for cell in cells for part in (cell.text.split() if column.align == "left" else
                                                 cell.text.split("\n"))]
    return max(map(cell_len, [*column.heading.split(), *texts]), default=0)


def _split_columns(least_widths: Sequence[int], width: int) -> list[list[int]]:
    """Numbers of the columns of each block that fits into `width` characters; each block begins with the first column.

    A single column that is wider than the console makes a block of its own.
    """
    blocks = [[0]]
    for i in range(1, len(least_widths)):
        if len(blocks[-1]) > 1 and sum(least_widths[j] + GAP for j in blocks[-1]) + least_widths[i] > width:
            blocks.append([0])
        blocks[-1].append(i)
    return blocks


def _build_table(columns: Sequence[Column], rows: Sequence[Sequence[Cell]], least_widths: Sequence[int], width: int
                 ) -> RichTable:
    out = RichTable(box=None, pad_edge=False, padding=(0, GAP, 0, 0), show_header=any(c.heading for c in columns))
    for column, column_width in zip(columns, _choose_widths(columns, rows, least_widths, width), strict=True):
        is_number = column.align == "right"
        heading = textwrap.fill(column.heading, column_width, break_on_hyphens=False) if is_number else column.heading
        out.add_column(Text(heading), justify=column.align, no_wrap=is_number, overflow="fold", width=column_width)
    for row in rows:
        out.add_row(*(Text(cell.text, style_of(cell)) for cell in row))
    return out


def _choose_widths(columns: Sequence[Column], rows: Sequence[Sequence[Cell]], least_widths: Sequence[int], width: int
                   ) -> list[int]:
    """Characters of each column: what it needs, and what it would like where the table has room for that.

    rich itself would shrink the widest column first, below the width of its longest word, and crop the table.
    """
    spare = [max(0, *(cell_len(line) - least_widths[i] for row in rows for line in row[i].text.split("\n")),
                 cell_len(column.heading) - least_widths[i]) for i, column in enumerate(columns)]
    out, room = list(least_widths), max(0, width - sum(least_widths) - GAP * (len(columns) - 1))
    words = sorted((i for i, column in enumerate(columns) if column.align == "left"), key=lambda i: spare[i])
    numbers = [i for i, column in enumerate(columns) if column.align == "right"]
    for place, i in enumerate([*words, *numbers]):
        more = spare[i] if spare[i] <= room else 0  # of a number the whole heading in one line, or as many as it takes
        if place < len(words):  # narrow columns first, so that one long text does not fold the others
            more = min(spare[i], room // (len(words) - place))
        out[i] += more
        room -= more
    return out


def style_of(cell: Cell) -> str:
    """The rich style of a cell: its colour, and bold where it matters."""
    return f"{'bold ' if cell.is_strong or cell.mood == 'bad' else ''}{STYLES[cell.mood]}".strip()
