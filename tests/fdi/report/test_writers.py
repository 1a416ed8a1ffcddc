"""The three writers: one report with an item of every kind, as terminal text, as a page and as JSON."""

import json
import math
from enum import IntEnum
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from html_page import HtmlPage
from refusals import catch_refusal
from rich.console import Console

from fdi.report.report import (
    Cell,
    Column,
    Figure,
    Item,
    Line,
    Listing,
    Medium,
    Paragraph,
    Report,
    Section,
    Table,
    render_html,
    to_json,
    to_plain,
    write_html,
)
from fdi.report.terminal import format_report, print_report

HOSTILE = "<script>alert('x')</script> [bold]a & b[/] [/nothing]"


def report_with(*items: Item, **fields: Any) -> Report:
    return Report("compare", "run 7", "MODEL_INCOMPLETE", "bad", "The error is above the noise floor.",
                  sections=[Section("Signals", items)], **fields)


TABLE = Table([Column("signal"), Column("error", "um", "right"), Column("floor from", medium=Medium.PAGE),
               Column("short form", medium=Medium.TERMINAL)],
              [["XJ", Cell("265", "bad", True), "repeats", "rep"], ["XS", Cell("1.02", "good"), "model", "mod"]],
              caption="A perfect model has ratio 1.")


@pytest.fixture
def whole() -> Report:
    drawn = Figure("The residual stays within the green band.", lambda: '<svg id="drawing"><path d="M0 0"/></svg>')
    items = [TABLE, Line("floor", "from 1 repeat"), Line("solver", "0.1 um", "doubtful"), drawn,
             Paragraph("Errors are RMS values."), Paragraph("only for a page", medium=Medium.PAGE),
             Paragraph("only for a terminal", medium=Medium.TERMINAL), Table([Column("no rows")], []),
             Listing("t,com,xj\n0,0,0", "run.csv", Medium.PAGE), Listing("*  *\n ** ", medium=Medium.TERMINAL)]
    return report_with(*items, facts=[("model", "eha")], notes=["3 rows were left out"],
                       next_command="rig explain run.csv", files=[("page", "compare.html")],
                       data={"verdict": "MODEL_INCOMPLETE", "error": np.float64(2.65e-4), "floor": math.nan})


def test_terminal_shows_every_kind_of_item(whole: Report) -> None:
    text = format_report(whole, 80)
    lines = text.splitlines()
    assert lines[0] == "MODEL_INCOMPLETE  The error is above the noise floor."
    assert not [words for words in (
        "signal", "error [um]", "265", "A perfect model has ratio 1.", "Errors are RMS values.", "only for a terminal",
        "rep", "*  *\n ** ") if words not in text]
    assert {f"{label:<10}{words}" for label, words in (
        ("floor", "from 1 repeat"), ("solver", "0.1 um"), ("note", "3 rows were left out"), ("page", "compare.html"),
        ("next", "rig explain run.csv"))} <= set(lines)
    assert not [words for words in ("only for a page", "floor from", "repeats", "svg", "t,com,xj", "green band",
                                    "Signals", "no rows") if words in text]


@pytest.mark.parametrize("width", [60, 80, 100])
@pytest.mark.parametrize("is_terminal", [True, False])
def test_a_terminal_cuts_no_word_and_no_command(width: int, is_terminal: bool) -> None:
    text = ("the noise floor of the position is far above that of the sensor, and every repeat of the command differs "
            "by more")
    command = "rig explain a_long_name_of_a_recording.csv --repeat another_long_name_of_a_recording.csv --signals xj,xs"
    out = StringIO()
    print_report(Report("compare", "x", "FAIL", "bad", text, notes=[text], next_command=command, conclusion=text),
                 Console(file=out, width=width, force_terminal=is_terminal, highlight=False, color_system=None))
    lines = out.getvalue().splitlines()
    others = [line for line in lines if command not in line]
    assert any(line.endswith(command) for line in lines)  # it can be copied
    assert " ".join(out.getvalue().split()).count(text) == 3 and (max(map(len, others)) <= width) == is_terminal, others
    assert {word for line in others for word in line.split()} <= {*text.split(), "FAIL", "note", "verdict"}


def test_page_shows_every_kind_of_item(whole: Report) -> None:
    text = render_html(whole)
    page = HtmlPage(text)
    assert page.open == [] and 'class="verdict bad"' in text
    assert not [words for words in (
        "MODEL_INCOMPLETE", "run 7", "The error is above the noise floor.", "Signals", "error [um]", "265",
        "A perfect model has ratio 1.", "from 1 repeat", "0.1 um", "Errors are RMS values.", "floor from",
        "only for a page", "The residual stays within the green band.", "t,com,xj\n0,0,0", "run.csv", "model", "eha",
        "3 rows were left out", "rig explain run.csv") if words not in page.text]
    assert {"figure", "figcaption", "svg", "details", "pre", "h2"} <= set(page.tags)
    assert all(cell in page.cells for cell in (["n is-bad strong", "265"], ["n is-good", "1.02"], ["", "XJ"]))
    assert not [words for words in ("only for a terminal", "short form", "*  *", "no rows") if words in page.text]


def test_page_leaves_out_a_figure_without_a_drawing_and_an_empty_section() -> None:
    empty = Section("Nothing to see", [Paragraph("only there", medium=Medium.TERMINAL)])
    report = Report("compare", "run 7", sections=[empty, Section("Drawn", [Figure("caption", lambda: "")])])
    page = HtmlPage(render_html(report))
    assert "Nothing to see" not in page.text and "caption" not in page.text and "figure" not in page.tags
    assert 'class="verdict' not in render_html(report)  # it has none


def test_neighbouring_lines_share_a_table_and_a_section_has_a_badge() -> None:
    assert render_html(report_with(Line("a", "1"), Line("b", "2"), Paragraph("-"), Line("c", "3"))).count("<table") == 2
    section = Section("filter clogging", [Line("size", "0.3")], Cell("MAINTENANCE", "doubtful"))
    report = Report("fdi", "run 7", sentence="one sentence", sections=[section])
    assert format_report(report).startswith("one sentence\n")
    assert "filter clogging  MAINTENANCE\n" in format_report(report)
    assert '<h2>filter clogging <span class="is-doubtful">MAINTENANCE</span></h2>' in render_html(report)


@pytest.mark.parametrize("item", [
    Table([Column(HOSTILE)], [[HOSTILE]], HOSTILE), Line(HOSTILE, HOSTILE), Paragraph(HOSTILE),
    Listing(HOSTILE, HOSTILE), Figure(HOSTILE, lambda: "<svg></svg>")], ids=lambda item: type(item).__name__)
def test_text_is_escaped(item: Item) -> None:
    """Nothing that a file or a user says is markup, on the page or in the terminal."""
    report = Report("compare", HOSTILE, HOSTILE, "bad", HOSTILE, [(HOSTILE, HOSTILE)], [HOSTILE],
                    [Section(HOSTILE, [item], Cell(HOSTILE))], HOSTILE, [(HOSTILE, HOSTILE)])
    page = HtmlPage(render_html(report))
    assert page.open == [] and "script" not in page.tags and page.text.count(HOSTILE) >= 7
    assert HOSTILE in format_report(report, 400)


class _Level(IntEnum):
    HIGH = 2


@pytest.mark.parametrize(("value", "plain"), [
    (math.nan, None), (-math.inf, None), (np.float64("inf"), None), (np.float32(0.5), 0.5), (np.int64(3), 3),
    (np.bool_(True), True), (True, True), (1, 1), (None, None), ("word", "word"), (_Level.HIGH, 2),
    ((1, math.nan), [1, None]), (np.array([1.0, np.nan]), [1.0, None]), (np.arange(2), [0, 1]),
    ({"a": {"b": np.nan}}, {"a": {"b": None}}), (Path("a/b"), "a/b")])
def test_plain_values(value: Any, plain: Any) -> None:
    found = to_plain(value)
    assert found == plain and type(found) is type(plain)
    assert json.loads(to_json({"x": value}), parse_constant=pytest.fail) == {"x": plain}


@pytest.mark.parametrize("columns", [3, 7, 12])
@pytest.mark.parametrize("width", [40, 80])
def test_narrow_terminal_cuts_no_number(columns: int, width: int) -> None:
    """What does not fit goes into another block of columns, which begins with the names of the rows again."""
    numbers = [f"{1.23456789 * 10 ** (i % 7):.6g} um" for i in range(columns)]
    head = [Column("effect"), *(Column(f"error of signal {i}", align="right") for i in range(columns))]
    table = Table(head, [["spool_friction", *numbers], ["null_bias", *numbers]])
    folding = Table([Column("block"), Column("ratio", align="right"), Column("held against")],
                    [["servovalve", "16.5", "Cor to XS, " * 20]])
    lines, folded = (format_report(report_with(each), width).splitlines() for each in (table, folding))
    own = [line for line in lines if "spool_friction" in line]
    assert max(map(len, lines[2:])) <= width and "…" not in "".join(lines)
    assert " ".join(" ".join(line.split()[1:]) for line in own) == " ".join(numbers)
    assert (len(own) > 1 or columns < 12) and len(own) == sum("null_bias" in line for line in lines)
    assert any(line.startswith("servovalve") and "16.5" in line for line in folded)  # long words fold beside numbers
    assert max(map(len, folded[2:])) <= width and "\n".join(folded).count("Cor") == 20


def test_terminal_limits_rows_and_says_how_many_are_left_and_each_must_fit_its_columns() -> None:
    report = report_with(Table([Column("effect")], [[f"effect_{i}"] for i in range(12)], terminal_rows=8))
    text = format_report(report)
    assert "effect_7" in text and "effect_8" not in text and "and 4 more" in text
    assert "effect_11" in render_html(report)
    with pytest.raises(ValueError, match="longer"):
        format_report(report_with(Table([Column("a")], [["1", "2"]])))


def test_page_that_cannot_be_written(tmp_path: Path, whole: Report) -> None:
    assert "--report" in catch_refusal(write_html, whole, tmp_path / "none" / "page.html", "--report")
    write_html(whole, tmp_path / "page.html")
    assert "run 7" in (tmp_path / "page.html").read_text(encoding="utf-8")
