"""The report: one file that needs nothing else and says what the trace says, in any form and in a browser."""

import html
import json
import math
import re
import warnings
from collections.abc import Sequence
from dataclasses import replace
from enum import IntEnum
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from browser import measure_page, needs_browser
from html_page import HtmlPage
from noisy_traces import SHORT, record_plant
from refusals import catch_refusal
from rich.console import Console
from synthetic_run import record_run

from fdi.comparison.compare import compare
from fdi.discovery.detectable import Blind
from fdi.discovery.explain import Marks
from fdi.discovery.explain_runs import Answer, Candidate
from fdi.discovery.runs import Source
from fdi.discovery.update_model import ModelUpdate, Provenance, Row
from fdi.estimation import Value
from fdi.report import (
    Cell,
    Column,
    Figure,
    Item,
    Line,
    Medium,
    Paragraph,
    Report,
    Section,
    Table,
    build_comparison_report,
    build_explanation_report,
    build_model_report,
    build_run_report,
    compare_report,
    drawing,
    explain_report,
    format_report,
    print_report,
    read_verdict,
    render_html,
    run_report,
    to_plain,
    write_html,
    write_run_page,
)
from fdi.report.explain_report import MOODS, describe_findings, describe_verdict
from fdi.report.report import Listing, to_json
from fdi.trace import CheckResult, Event, Trace
from plant import EHA, Model
from rig.recorder import Recorder, Signals, Timing
from rig.recorder.recover import recover_log


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_run(tmp_path_factory.mktemp("run") / "trace.mcap")


@pytest.fixture(scope="module")
def page(log: Path) -> str:
    return render_run(Trace.read(log, all=True))


def render_run(trace: Trace) -> str:
    return render_html(build_run_report(trace))


def read_text(page: str) -> str:
    """What a reader of the page sees, on one line."""
    return " ".join(HtmlPage(page).text.split())


def test_it_needs_no_network(page: str) -> None:
    html = HtmlPage(page)
    assert not html.open and not {"link", "iframe", "img"} & set(html.tags)
    assert html.tags.count("script") == 1 and '<script id="figure-script">' in page  # no src: the text is in the page
    assert not re.search(r"\b(fetch|XMLHttpRequest|WebSocket|import)\b *\(", page)
    assert all(address.startswith("#") for address in html.addresses)
    assert not re.search(r"@import|url\((?!#)", page) and len(page) < 2_000_000


def test_it_says_what_the_trace_says(page: str) -> None:
    text = read_text(page)
    assert text.startswith("FAIL · ") and "1 of 4 checks failed: ramp error" in text
    assert not [words for words in (
        "3 of 4", "13.500 s, 13500 cycles", "overshoot of the 5 mm step", "61", "ms", "2.500 – 3.250 s",
        "mean of com - xj over the slope", "sensors.position_offset: ramps in", "pre-operational", "error [um]",
        "P12 [bar]", "XS [um]", "title = 'synthetic'", "p99.9", "0 of 14000") if words not in text]


def test_text_of_the_trace_is_no_html_and_may_be_of_another_program(log: Path) -> None:
    trace, nasty = Trace.read(log, all=True), "<script>alert(1)</script>"
    assert "<script>" not in render_run(replace(
        trace, checks=(replace(trace.checks[0], name=nasty, detail=nasty),),
        provenance={"sequence": nasty, "source": nasty, "cause.text": nasty, "cause.evidence": "[" * 100_000,
                    "cause.consequences": json.dumps([{"t": None, "text": nasty}])},
        attachments={nasty: nasty.encode()}))


@pytest.mark.parametrize(("status", "mood"), [("PASS", "good"), ("INVALID_TIMING", "doubtful"), ("ABORTED", "bad")])
def test_verdict_of_the_run_comes_first(log: Path, status: str, mood: str) -> None:
    provenance = {"verdict.verdict": status, "verdict.why": "because", "verdict.timing": "because"}
    page = render_run(replace(Trace.read(log), provenance=provenance))
    assert f'<div class="verdict {mood}">{status}</div>' in page and "because" in page


def test_an_aborted_run_says_why_and_what_is_missing(aborted: Path) -> None:
    page = render_run(Trace.read(aborted, all=True))
    head, text = page[:page.index("</header>")], read_text(page)
    assert ">ABORTED<" in head and "guard 'ram far out' was passed by xj" in html.unescape(head)
    assert re.findall(r"missing samples \(red on the page\): [^()]*\(of 2871\)", text) == [
        "missing samples (red on the page): 45 of xj, cor, p12; 300 of xs (of 2871)"]
    assert len(re.findall("not reached ?the run ended at 2.271 s", text)) == 3 and "whole run" not in text
    assert text.count(": not measured") == 3 and not re.search(r"\bnan\b", text)  # drawn are names without a bar


def test_a_real_run_has_a_report(preflight: Path) -> None:
    page = (preflight / "report.html").read_text(encoding="utf-8")
    text = read_text(page)
    assert text.startswith("PASS · Preflight") and "17 of 17" in text and "12 of 12" in text
    assert "missing samples" not in text.split("Signals")[0] and page.count('<td class="is-good">pass</td>') == 29
    assert "section main: rest" in text.replace("section", "section ").replace("  ", " ")


def test_a_failed_run_names_its_checks(log: Path) -> None:
    trace = Trace.read(log)
    bad = tuple(replace(trace.checks[0], name=f"c{i}", passed=False) for i in range(6))
    for checks, verdict in ((trace.checks, ("FAIL", "1 of 4 checks failed: ramp error")),
                            (bad, ("FAIL", "6 of 6 checks failed: c0, c1, c2, c3 and 2 more")),
                            ((), ("NOT_JUDGED", "")), (trace.checks[:1], ("PASS", ""))):
        assert read_verdict(replace(trace, checks=checks)) == verdict


def test_single_missing_samples_leave_a_line_and_a_mark() -> None:
    k = np.arange(100)
    values = np.sin(k / 10)
    # every second one: a line through single samples would have no stroke at all
    holes = np.where((k % 2 == 1) | ((k >= 60) & (k < 80)), np.nan, values)
    sound, broken, empty = (
        run_report.draw_signals(Trace.from_columns({"com": values, "xj": xj, "cor": values}, 1e-3, {}))
        for xj in (values, holes, np.full(100, np.nan)))
    line = vars(broken)["figure"].axes[0].lines[1].get_ydata()
    assert np.isnan(line).sum() == 22 and np.isnan(line[59:80]).all()  # and the last
    np.testing.assert_allclose(line[:59], 1e3 * values[:59], atol=10.0)
    assert drawing.RED in broken and drawing.RED not in sound
    assert [ax.get_ylabel() for ax in vars(empty)["figure"].axes] == ["position [mm]", "current [mA]"], "of the command"


def test_any_trace_has_a_report(log: Path, tmp_path: Path) -> None:
    record_run(tmp_path / "aborted.mcap", stop=100)
    (tmp_path / "cut.mcap").write_bytes(log.read_bytes()[:-50_000])
    recover_log(tmp_path / "cut.mcap", tmp_path / "salvaged.mcap")
    (tmp_path / "short.csv").write_text("t,com,xj,cor\n0,0,,0\n0.001,0,1e-6,0\n0.004,0,1e-6,0\n")
    for name in ("aborted.mcap", "salvaged.mcap", "short.csv"):
        write_run_page(tmp_path / name, tmp_path / "report.html")
        page = (tmp_path / "report.html").read_text(encoding="utf-8")
        assert HtmlPage(page).open == [] and ("salvaged" in page) == (name == "salvaged.mcap")
    assert "NOT_JUDGED" in page and "2 cycles missing between 0.001 and 0.004 s" in page and "Cycle timing" not in page
    assert "can be written" in catch_refusal(write_run_page, tmp_path / "short.csv", tmp_path / "no" / "report.html")


@pytest.mark.parametrize(("phases", "timing"), [
    ([1], (0.0, 0.0, math.nan)), ([0], (0.0, 1e-4, 1e-4)), ([1, 1], (1e-4, 0.0, 0.0)), ([0, 1, 2], (1e-8, 1e-8, 1e-9))])
def test_the_shortest_runs_draw_without_a_warning(tmp_path: Path, phases: list[int],
                                                  timing: tuple[float, float, float]) -> None:
    recorder = Recorder(tmp_path / "trace.mcap", {}, {"period": "0.001"})
    for k, phase in enumerate(phases):
        recorder.cycle(k * 1_000_000, Signals(k, phase, 0, 0, 0, 0, 0, 0, 0, 0, 0), Timing(k, False, *timing))
    recorder.put(0, CheckResult(name="x", signal="xj", unit="m", value=0.0, passed=True, t0=0.0, t1=0.0))
    recorder.close()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        render_run(Trace.read(tmp_path, all=True))


def test_thinned_line_keeps_its_extremes() -> None:
    t, values = np.arange(200_000) * 1e-3, np.zeros(200_000)
    values[[12_345, 140_001]], values[20_000:20_100] = (1.0, -1.0), np.nan
    thin_t, thin = drawing.thin_line(t, values)
    assert len(thin) < 3 * drawing.LINE_COLUMNS and t[12_345] in thin_t and (np.diff(thin_t) > 0).all()
    assert (np.nanmax(thin), np.nanmin(thin)) == (1, -1) and np.isnan(thin).any()


def test_injected_faults_are_shaded_from_begin_to_end(preflight: Path) -> None:
    trace = Trace.read(preflight)
    events = (Event(1.0, "WARN", "fault", "lost drive begins"), Event(2.5, "INFO", "fault", "lost drive ends"),
              Event(3.0, "WARN", "fault", "parameter filter.clogging begins"),
              *(Event(t, "ERROR", "emcy", "node 2 controller 0x2310") for t in (3.1, 3.2, 3.25)))
    faulty = replace(trace, events=events)
    assert run_report.list_faults(faulty) == [
        ("lost drive", 1.0, 2.5), ("parameter filter.clogging", 3.0, trace.t[-1])]
    assert "injected: lost drive from 1 to 2.5 s" in explain_report.describe_injected_faults(faulty)
    assert explain_report.describe_injected_faults(trace) == ""
    assert (all(each in render_run(faulty) for each in ("lost drive", "0x2310 (3 times, the last at 3.250 s)"))
            and [each.get_alpha() for each in vars(run_report.draw_signals(faulty))["figure"].axes[0].patches][-3:]
            == [1.0, 0.5, 0.5])  # the faults, half transparent, lie above the sections


def make_trace(every: int = 1) -> Trace:
    """A step of 5 mm at t = 0.5 s with 12 % overshoot, then a ramp with a lag of 20 um and a band of 8 um.

    The position is known in one of `every` cycles.
    """
    t = np.arange(3000) / 1000
    since = np.maximum(t - 0.5, 0.0)
    step = np.where(t < 0.5, 0.0, 5e-3 * (1.0 - np.exp(-40 * since) * np.cos(120 * since)))
    ramp = np.where(t > 1.5, 0.5e-3 * (t - 1.5), 0.0)
    com = np.where(t < 0.5, 0.0, 5e-3) + ramp
    xj = step + ramp - np.where(t > 1.5, 20e-6 + 8e-6 * np.sign(np.sin(20 * t)), 0.0)
    return Trace.from_columns({"com": com, "xj": np.where(np.arange(3000) % every == 0, xj, np.nan),
                               "cor": 4.0 * (com - xj)}, 1e-3, {})


def make_check(kind: str, value: float, unit: str, high: float, window: tuple[float, float], signal: str = "xj",
               low: float = math.nan) -> CheckResult:
    return CheckResult(name=kind, kind=kind, signal=signal, value=value, unit=unit, low=low, high=high, passed=False,
                       t0=window[0], t1=window[1])


def draw(check: CheckResult) -> Any:
    """Axes of the close-up of a check."""
    return vars(run_report.draw_failed_check(make_trace(), check))["figure"].axes[0]


def find_mark(ax: Any) -> tuple[float, float]:
    (mark,) = [line for line in ax.lines if line.get_marker() == "o"]
    return float(mark.get_xdata()[0]), float(mark.get_ydata()[0])


def list_places(ax: Any, axis: str) -> list[float]:
    """Heights of the horizontal lines (axis y), or places of the vertical lines (axis x)."""
    ends = [getattr(line, f"get_{axis}data")() for line in ax.lines]
    return sorted(float(pair[0]) for pair in ends if len(pair) == 2 and pair[0] == pair[1])


def test_overshoot_is_marked_at_its_peak_beside_its_limit_and_times_are_lines_after_the_step() -> None:
    trace = make_trace()
    peak = int(np.argmax(trace.xj[500:700])) + 500
    value = 100 * (trace.xj[peak] / 5e-3 - 1)
    ax, times = (draw(make_check(*check, (0.5, 1.5))) for check in (
        ("overshoot", value, "%", 11.0), ("settling_time", 94.0, "ms", 78.0)))
    assert list_places(ax, "y") == pytest.approx([11.0, value]) and "[%]" in ax.get_ylabel()
    assert find_mark(ax) == (pytest.approx(trace.t[peak], abs=0.003), pytest.approx(value, rel=0.02))
    assert list_places(times, "x") == pytest.approx([0.578, 0.594]) and times.get_xlim()[1] > 0.6


@pytest.mark.parametrize(("kind", "value", "levels"), [
    ("ramp_error", 20.0, [-20.0, -14.0, 14.0, 20.0]), ("rms_error", 21.5, [-21.5, -14.0, 14.0, 21.5]),
    ("break_away", 8.0, [12.0, 14.0, 26.0, 28.0])])
def test_levels_stand_in_the_unit_of_the_check(kind: str, value: float, levels: list[float]) -> None:
    ax = draw(make_check(kind, value, "um", 6.0 if kind == "break_away" else 14.0, (1.6, 2.9)))
    assert list_places(ax, "y") == pytest.approx(levels, abs=0.5) and "[um]" in ax.get_ylabel()
    curve = max((line.get_ydata() for line in ax.lines), key=len)
    assert 10.0 < np.nanmedian(curve) < 30.0  # um, not m


@pytest.mark.parametrize(("kind", "signal"), [("shut_off", ""), ("recovers", ""), ("response_within", "xj"),
                                              ("response_within", "node 2 0x8250")])
@pytest.mark.parametrize(("value", "places", "label"), [
    (12.0, [0.5, 0.505, 0.512], "measured 12 ms"), (math.nan, [0.5, 0.505], "not measurable")])
def test_a_reaction_stands_between_its_begin_and_its_limit(kind: str, signal: str, value: float, places: list[float],
                                                           label: str) -> None:
    ax = draw(replace(make_check(kind, value, "ms", 5.0, (0.2, 1.5), signal), after=0.5, above=4e-3))
    assert list_places(ax, "x") == pytest.approx(places) and list_places(ax, "y") == [4.0]
    assert 0.45 < ax.get_xlim()[0] < 0.5 and 0.52 < ax.get_xlim()[1] < 0.6  # of a window of 1.3 s
    assert ax.get_ylabel() == ("xj [mm]" if signal == "xj" else "cor [mA]")
    assert {"most 5 ms", label} <= {text.get_text() for text in ax.get_legend().get_texts()}


@pytest.mark.parametrize("kind", sorted(run_report.DRAWERS))
def test_every_kind_survives_a_value_that_could_not_be_measured_and_missing_samples(kind: str) -> None:
    unit = {"overshoot": "%", "amplitude_ratio": "1", "phase_lag": "deg"}.get(kind, "ms" if "time" in kind else "um")
    check = make_check(kind, math.nan, unit, 5.0, (0.5, 1.5))
    assert all(run_report.draw_failed_check(make_trace(every), check).startswith("<svg") for every in (1, 2))
    for other in (replace(check, t0=math.nan, t1=math.nan), replace(check, kind="event_never"),
                      replace(check, t0=50.0, t1=51.0)):
        assert not run_report.draw_failed_check(make_trace(), other)


def test_a_page_shows_each_failed_check_once() -> None:
    check = make_check("overshoot", 12.0, "%", 11.0, (0.5, 1.5))
    trace = replace(make_trace(), checks=(check, replace(check, name="fine", passed=True),
                                        replace(check, name="b")))
    page = render_html(build_run_report(trace))
    assert "Failed checks" in page and page.count("Dashed: limits; red") == 2 and page.count("<script") == 1
    assert "Failed checks" not in render_html(build_run_report(replace(trace, checks=())))


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
    figure = Figure("The residual stays within the green band.", lambda: '<svg id="drawing"><path d="M0 0"/></svg>')
    items = [TABLE, Line("floor", "from 1 repeat"), Line("solver", "0.1 um", "doubtful"), figure,
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
    output = to_plain(value)
    assert output == plain and type(output) is type(plain)
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


FLOOR = {"xj": 2e-6, "p12": 2e4}
ERROR = {"xj": 45e-6, "p12": 3e5}


def candidate(effect: str, *beside: str, word: str = "explains") -> Candidate:
    value = Value(1.5e-4, 1.4e-4, 1.6e-4, "A")
    return Candidate(effect, beside, {f"{effect}.current": value}, dict(FLOOR), {"xj": 2.1e-6, "p12": 2e4},
                     {"xj": 1.0, "p12": 1.0}, 1200.0, 1e-30, word)


def answer(verdict: str, effects: tuple[str, ...], *candidates: Candidate, is_at_floor: bool = False,
           ranked: Sequence[Any] = (), **fields: Any) -> Answer:
    base = SimpleNamespace(is_at_floor=is_at_floor, is_far=False, effects=(), ratio={"xj": 22.5, "p12": 15.0})
    trace = SimpleNamespace(declared=EHA, notes=(), events=())
    explanation = SimpleNamespace(verdict=verdict, effects=effects, base=base, floor=FLOOR, marks=Marks(1.0, 1e-6, ()),
                                  ledger=[base], unseen={}, holdout={}, excerpt="", ranked=ranked,
                                  search=SimpleNamespace(problem=SimpleNamespace(trace=trace), model=Model()))
    baseline = {"error": ERROR, "floor": FLOOR, "holdout": {"xj": 44e-6, "p12": 3e5}}
    blind = (Blind("sensor_gain", "sensor_gain.error", 0.02, "1", "a stop"),
             Blind("sensor_offset", "sensor_offset.offset", 1e-4, "m", "a stop"))
    return Answer(cast(Any, explanation), candidates, baseline, blind, ("quantisation",), (), (), **fields)


CASES = {
    "NOTHING_MISSING": (answer("NOTHING_MISSING", ()), "the residual is noise"),
    "EXPLAINED": (answer("EXPLAINED", ("a",), candidate("a")), "a explains the residual"),
    "EXPLAINED by two": (answer("EXPLAINED", ("a", "b"), candidate("a", "b"), candidate("b", "a")),
                         "a and b together explain the residual"),
    "AMBIGUOUS": (answer("AMBIGUOUS", ("a", "b"), candidate("a"), candidate("b")), "a or b: each explains the"),
    "AMBIGUOUS beside one": (answer("AMBIGUOUS", ("a", "b", "c"), candidate("b", "a"), candidate("c", "a"), ranked=[
        SimpleNamespace(effects=pair, is_at_floor=True) for pair in (("a", "b"), ("c", "a"))]),
        "a together with b or c: each explains the"),
    "PARTLY": (answer("PARTLY", ("a",), candidate("a", word="part")), "a explains part of the residual"),
    "PARTLY by none": (answer("PARTLY", (), candidate("a", word="part")), "No effect of the catalogue"),
    "UNEXPLAINED": (answer("UNEXPLAINED", (), candidate("c", word="no")._replace(ratios={"xj": 5.0}),
                           candidate("a", "b", word="no")), "the best, b and a, leaves XJ error 2.00 um."),
    "UNEXPLAINED and none better": (answer("UNEXPLAINED", (), candidate("a", word="no")._replace(ratios={"xj": 30.0})),
                                    "XJ error 45.0 um, noise floor 2.00 um."),
    "UNEXPLAINED without candidates": (answer("UNEXPLAINED", ()), "No effect of the catalogue"),
    "NOT_RESOLVABLE": (answer("NOT_RESOLVABLE", ("a",), candidate("a")), "a may be present"),
}


@pytest.mark.parametrize("case", CASES)
def test_a_sentence_has_error_and_noise_floor(case: str) -> None:
    sentence, words = describe_verdict(CASES[case][0]), CASES[case][1]
    assert sentence.endswith(".") and {case.split(" ")[0] for case in CASES} == set(MOODS)
    assert [each for each in (words, "XJ error 45.0 um", "noise floor 2.00 um") if each not in sentence] == []


@pytest.mark.parametrize(("case", "words"), [
    ("EXPLAINED", "current 150 uA (140 .. 160)"), ("PARTLY", "current 150 uA (140 .. 160)"),
    ("NOT_RESOLVABLE", "current 150 uA (140 .. 160)"),
    ("EXPLAINED by two", "a: current 150 uA (140 .. 160); b: current 150 uA (140 .. 160)")])
def test_a_size_has_its_interval(case: str, words: str) -> None:
    assert words in describe_verdict(CASES[case][0])


def test_findings() -> None:
    by = {"by": "measure XS too", "between": ("a", "b")}
    separable_case = answer("AMBIGUOUS", ("a", "b"), candidate("a"), candidate("b"), separate=by, pattern="a force")
    plain, lines = ({line.label: line.text for line in describe_findings(case)}
                    for case in (CASES["AMBIGUOUS"][0], separable_case))
    assert plain["to discriminate"].startswith("no sensor and no command")
    assert plain["not detectable"] == "sensor_gain (up to 0.0200) and sensor_offset (up to 100 um); " \
        "a stop would reveal sensor_gain and sensor_offset"
    assert (lines["to discriminate"], lines["residual"]) == (
        "measure XS too: in simulation this discriminates between a and b", "a force")


@pytest.mark.parametrize("verdict", ["UNEXPLAINED", "EXPLAINED"])
def test_an_actuator_far_from_the_model_is_to_be_identified(verdict: str) -> None:
    """Only where no explanation is found: an explained one has its parameters listed as suspicious."""
    far = answer(verdict, (), candidate("a", word="no"))
    cast(Any, far.explanation.base).is_far = True
    assert any("rig identify" in line.text for line in describe_findings(far)) == (verdict == "UNEXPLAINED")
    cast(Any, far.explanation.base).ratio["xj"] = 400.0
    assert any("400 noise floors" in line.text for line in describe_findings(far)) == (verdict == "UNEXPLAINED")


def render_without_figures(report: Report) -> str:
    """Drawing a figure needs whole traces; the commands' own tests draw them."""
    sections = [replace(s, items=[i for i in s.items if not isinstance(i, Figure)]) for s in report.sections]
    return render_html(replace(report, sections=sections))


def test_the_report_of_an_explanation_in_all_forms() -> None:
    sources = [Source("est.csv", "1"), Source("repeat.csv", "2"), Source("holdout.csv", "3")]
    report = build_explanation_report(CASES["EXPLAINED"][0], "est.csv", "eha", sources, "rig explain est.csv",
                                      "rig add a est.csv", notes=["3 rows left out"])
    text, page, data = format_report(report, 80), render_without_figures(report), to_plain(report.data)
    assert "no effect" in text and "explains" in text and "<1e-99" not in text and "1e-30" in text
    assert "note            3 rows left out" in text and "next            rig add a est.csv" in text
    assert not [words for words in ("held-out run", "holdout.csv", "150 uA (140 .. 160)", "not detectable up to",
                                    "rig explain est.csv") if words not in page]
    assert data["verdict"] == "EXPLAINED" and data["candidates"][0]["with"] == [] and "ledger" not in data
    assert data["blind_to"][1]["smallest_visible"] is None
    assert "ledger" in build_explanation_report(CASES["EXPLAINED by two"][0], "est.csv", "eha", sources).data


def update(helps: bool) -> ModelUpdate:
    steps = [SimpleNamespace(holdout=by, hypothesis=SimpleNamespace(errors=by)) for by in (ERROR, FLOOR)]
    refit = SimpleNamespace(helps=helps, steps=steps, last=steps[-1], floor=FLOOR,
                            search=SimpleNamespace(problem=SimpleNamespace(trace=SimpleNamespace(declared=EHA))))
    provenance = Provenance(trace=Source("est.csv", "1"), holdout=Source("holdout.csv", "2"), floor=FLOOR,
                            ledger=(Row(None, ERROR, ERROR), Row("a", FLOOR, FLOOR)), history=("rig add a",),
                            effects=("a",))
    return ModelUpdate(Model(), provenance, ("a",), "", cast(Any, refit),
                       {"a.current": Value(1.5e-4, 1.4e-4, 1.6e-4, "A")}, (), ())


def test_the_report_of_a_model_update_in_all_forms(tmp_path: Any) -> None:
    report, useless = (build_model_report(update(helps), tmp_path / "m.toml", tmp_path / "m.toml.bak",
                                          tmp_path / "m.html") for helps in (True, False))
    assert useless.mood == "doubtful" and useless.sentence.endswith("a explains nothing but noise.")
    text, page = format_report(report, 80), render_without_figures(report)
    assert report.sentence == ("a added: XJ error 45.0 um -> 2.00 um, noise floor 2.00 um; held-out run 45.0 um -> "
                               "2.00 um.")
    assert not [words for words in ("model as it was", "+ a", "noise floor", "150 uA (140 .. 160)", "m.toml.bak",
                                    "m.html") if words not in text.replace("\n", "")]
    assert "held-out" in page and "22.5" in page and to_plain(report.data)["helps"] is True


OFFSETS = {"xj": 0.0, "p12": 3e5, "xs": 8e-6}  # of the sensors; XJ is drawn to the measurement, so it has none


def test_a_comparison_shows_measured_minus_model() -> None:
    """Of a trace whose sensors of P12 and XS show too much, so that measured minus model is positive."""
    trace = record_plant(com=SHORT, seed=2)
    biased = trace.with_columns({name: trace.column(name) + size for name, size in OFFSETS.items()})
    comparison = compare(biased, Model())
    panels = [[np.asarray(line.get_ydata()) for line in ax.lines if len(line.get_ydata()) > 2]  # those over time
              for ax in vars(compare_report.draw_overview(comparison))["figure"].axes]
    scales = {"xj": 1e6, "p12": 1e-5, "xs": 1e6}
    for number, (name, scale) in enumerate(scales.items()):
        (measurement, model), (residual,) = panels[1 + 2 * number:3 + 2 * number]  # after Com and XJ
        if name != "xj":  # drawn in mm, its residual in um
            np.testing.assert_allclose(residual, measurement - model, atol=1e-9)
            assert np.nanmean(residual) == pytest.approx(OFFSETS[name] * scale, rel=0.1)
    captions = [item.caption for section in build_comparison_report(comparison).sections for item in section.items
                if isinstance(item, Figure | Table) and "esidual" in item.caption]
    assert captions and all("measured minus model" in text for text in captions[:2])


FIND_SCROLLING = """window.probeNotes = {scrolling: [...document.querySelectorAll(".scroll")]
  .filter(e => e.scrollWidth > e.clientWidth + 1).map(e => e.innerText.slice(0, 40)).join("; ")};"""
ZOOM = """
const svg = document.querySelector("svg[data-axes]"), r = svg.getBoundingClientRect();
const k = r.width / svg.viewBox.baseVal.width;
const panel = JSON.parse(svg.dataset.axes)[0], [x0, top, x1] = panel.box;
const at = (x, y) => ({clientX: r.left + k * x, clientY: r.top + k * y, pointerId: 1, bubbles: true, button: 0});
const place = t => x0 + (t - panel.x[0]) / (panel.x[1] - panel.x[0]) * (x1 - x0);
const texts = () => [...svg.querySelectorAll("text")].filter(e => getComputedStyle(e).display !== "none"
  && ![...svg.querySelectorAll("[style*='display: none'] text")].includes(e)).map(e => e.textContent).join("|");
const read = () => [...document.querySelectorAll(".readout div")]
  .map(e => e.children[0].textContent + "=" + e.children[1].textContent).join("|");
svg.setPointerCapture = () => {};
window.probeNotes = {before: texts()};
svg.dispatchEvent(new PointerEvent("pointermove", at(place(0.75), top + 20)));
window.probeNotes.whole = read();
svg.dispatchEvent(new PointerEvent("pointerdown", at(place(0.52), top + 10)));
svg.dispatchEvent(new PointerEvent("pointerup", at(place(0.58), top + 11)));
svg.dispatchEvent(new PointerEvent("pointermove", at((x0 + x1) / 2, top + 20)));
Object.assign(window.probeNotes, {zoomed: texts(), read: read()});
svg.dispatchEvent(new MouseEvent("dblclick", {bubbles: true}));
window.probeNotes.after = texts();
"""


@pytest.fixture(scope="module")
def run_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 3 s with a failed check and long words."""
    t = np.arange(3000) / 1000
    com = np.where(t < 0.5, 0.0, 5e-3)
    xj = np.where(t < 0.5, 0.0, 5e-3 * (1.0 - np.exp(-40 * (t - 0.5))))
    check = CheckResult(
        name="settling time of the step", kind="settling_time", signal="xj", value=100.0, unit="ms", high=80.0,
        passed=False, t0=0.5, t1=1.5,
        detail="0 of 1000 samples missing, and a remark that is long enough to need several lines on a phone")
    trace = Trace.from_columns({"com": com, "xj": xj, "cor": 4.0 * (com - xj)}, 1e-3, {"node2.name": "x" * 200})
    path = tmp_path_factory.mktemp("run_page") / "report.html"
    path.write_text(render_html(build_run_report(replace(trace, checks=(check,) * 3))), encoding="utf-8")
    return path


@needs_browser
@pytest.mark.parametrize("width", [1400, 400])
def test_nothing_is_cut_off(run_page: Path, width: int) -> None:
    size = measure_page(run_page, width)
    assert size.inner == width and size.scroll <= size.client and size.beyond == [] and size.errors == []


@needs_browser
def test_a_wide_table_fits_into_a_window_of_800_pixels(tmp_path: Path) -> None:
    """Ten columns with long headings, as rig explain has: none is hidden and none is squeezed to a word a line."""
    headings = ["XJ", "P12", "XS", "XJ, held-out run", "P12, held-out run", "XS, held-out run", "evidence", "p"]
    columns = [Column("effect"), *(Column(heading, align="right") for heading in headings), Column("size")]
    size = "amplitude 0.00022 (-0.00016 .. 0.00060), frequency 344 Hz (338 .. 349), phase 4.3 rad (0.3 .. 8.3)"
    rows = [["null_bias + supply_ripple", "0.997", "0.999", "1.00", "1.00", "1.00", "0.991", "362661", "<1e-99", size]]
    run_page = tmp_path / "wide.html"
    report = Report("explain", "run.csv", sections=[Section("Candidates", [Table(columns, rows)])])
    run_page.write_text(render_html(report))
    high = "row: String(document.querySelectorAll('tr')[1].offsetHeight)"
    notes = measure_page(run_page, 800, FIND_SCROLLING + f"Object.assign(window.probeNotes, {{{high}}})").notes
    assert notes["scrolling"] == "" and int(notes["row"]) < 200, notes


@needs_browser
def test_a_figure_is_zoomed_and_read(run_page: Path) -> None:
    notes = measure_page(run_page, 1200, ZOOM)
    assert notes.errors == []
    readouts = notes.notes
    assert "XJ less the target=" in readouts["whole"]
    assert "time=0.7500 s" in readouts["whole"].replace("0.750 s", "0.7500 s")
    assert readouts["zoomed"] != readouts["before"] == readouts["after"]
    assert {"0.540", "0.560"} <= set(readouts["zoomed"].split("|")) and "0.540" not in readouts["before"].split("|")
    readout = dict(part.split("=") for part in readouts["read"].split("|"))
    assert float(readout["time"].removesuffix(" s")) == pytest.approx(0.55, abs=0.001)
    percent = float(readout["XJ less the target"].split()[0].replace("\u2212", "-"))
    assert percent == pytest.approx(-100 * np.exp(-40 * 0.05), abs=1.0)  # beyond the target, % of the step
