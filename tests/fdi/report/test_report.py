"""The report: one file that needs nothing else and says what the trace says; close-ups of failed checks."""

import html
import math
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from html_page import HtmlPage
from refusals import catch_refusal
from synthetic_run import record_run

from fdi.report import drawing, run_report
from fdi.report.report import render_html
from fdi.report.run_report import build_run_report, read_verdict, write_run_page
from fdi.trace.check_result import CheckResult
from fdi.trace.trace import Event, Trace
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
    seen = HtmlPage(page)
    assert not seen.open and not {"link", "iframe", "img"} & set(seen.tags)
    assert seen.tags.count("script") == 1 and '<script id="figure-script">' in page  # no src: the text is in the page
    assert not re.search(r"\b(fetch|XMLHttpRequest|WebSocket|import)\b *\(", page)
    assert all(address.startswith("#") for address in seen.addresses)
    assert not re.search(r"@import|url\((?!#)", page) and len(page) < 2_000_000


def test_it_says_what_the_trace_says(page: str) -> None:
    text = read_text(page)
    assert text.startswith("FAIL · ") and "1 of 4 checks failed: ramp error" in text
    assert not [words for words in (
        "3 of 4", "13.500 s, 13500 cycles", "overshoot of the 5 mm step", "61", "ms", "2.500 – 3.250 s",
        "mean of com - xj over the slope", "sensors.position_offset: ramps in", "pre-operational", "error [um]",
        "P12 [bar]", "XS [um]", "title = 'synthetic'", "p99.9", "0 of 14000") if words not in text]


def test_text_of_the_trace_is_no_html(log: Path) -> None:
    trace, nasty = Trace.read(log, all=True), "<script>alert(1)</script>"
    assert "<script>" not in render_run(replace(
        trace, checks=(replace(trace.checks[0], name=nasty, detail=nasty),),
        provenance={"sequence": nasty, "source": nasty}, attachments={nasty: nasty.encode()}))


@pytest.mark.parametrize(("status", "mood"), [("PASS", "good"), ("INVALID_TIMING", "doubtful"), ("ABORTED", "bad")])
def test_verdict_of_the_run_comes_first(log: Path, status: str, mood: str) -> None:
    said = {"verdict.verdict": status, "verdict.why": "because", "verdict.timing": "because"}
    page = render_run(replace(Trace.read(log), provenance=said))
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
    sound, broken = (run_report.draw_signals(Trace.from_columns({"com": values, "xj": xj, "cor": values}, 1e-3, {}))
                     for xj in (values, holes))
    line = vars(broken)["figure"].axes[0].lines[1].get_ydata()
    assert np.isnan(line).sum() == 22 and np.isnan(line[59:80]).all()  # and the last
    np.testing.assert_allclose(line[:59], 1e3 * values[:59], atol=10.0)
    assert drawing.RED in broken and drawing.RED not in sound


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
              Event(3.0, "WARN", "fault", "parameter filter.clogging begins"))
    faulty = replace(trace, events=events)
    assert run_report.list_faults(faulty) == [
        ("lost drive", 1.0, 2.5), ("parameter filter.clogging", 3.0, trace.t[-1])]
    assert "lost drive" in render_run(faulty) and run_report.draw_signals(faulty) != run_report.draw_signals(trace)


NAN = float("nan")


def make_trace() -> Trace:
    """A step of 5 mm at t = 0.5 s with 12 % overshoot, then a ramp with a lag of 20 um and a band of 8 um."""
    t = np.arange(3000) / 1000
    since = np.maximum(t - 0.5, 0.0)
    step = np.where(t < 0.5, 0.0, 5e-3 * (1.0 - np.exp(-40 * since) * np.cos(120 * since)))
    ramp = np.where(t > 1.5, 0.5e-3 * (t - 1.5), 0.0)
    com = np.where(t < 0.5, 0.0, 5e-3) + ramp
    xj = step + ramp - np.where(t > 1.5, 20e-6 + 8e-6 * np.sign(np.sin(20 * t)), 0.0)
    return Trace.from_columns({"com": com, "xj": xj, "cor": 4.0 * (com - xj)}, 1e-3, {})


def make_check(kind: str, value: float, unit: str, high: float, window: tuple[float, float], signal: str = "xj",
               low: float = NAN) -> CheckResult:
    return CheckResult(name=kind, kind=kind, signal=signal, value=value, unit=unit, low=low, high=high, passed=False,
                       t0=window[0], t1=window[1])


def draw(check: CheckResult) -> Any:
    """Axes of the close-up of a check."""
    return vars(run_report.draw_failed_check(make_trace(), check))["figure"].axes[0]


def find_curve(ax: Any) -> Any:
    return max(ax.lines, key=lambda line: len(line.get_xdata()))


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
    assert 10.0 < np.nanmedian(find_curve(ax).get_ydata()) < 30.0  # um, not m


@pytest.mark.parametrize(("kind", "signal"), [("shut_off", ""), ("recovers", ""), ("response_within", "xj"),
                                              ("response_within", "node 2 0x8250")])
@pytest.mark.parametrize(("value", "places", "label"), [
    (12.0, [0.5, 0.505, 0.512], "measured 12 ms"), (NAN, [0.5, 0.505], "not measurable")])
def test_a_reaction_stands_between_its_begin_and_its_limit(kind: str, signal: str, value: float, places: list[float],
                                                           label: str) -> None:
    ax = draw(replace(make_check(kind, value, "ms", 5.0, (0.2, 1.5), signal), after=0.5, above=4e-3))
    assert list_places(ax, "x") == pytest.approx(places) and list_places(ax, "y") == [4.0]
    assert 0.45 < ax.get_xlim()[0] < 0.5 and 0.52 < ax.get_xlim()[1] < 0.6  # of a window of 1.3 s
    assert ax.get_ylabel() == ("xj [mm]" if signal == "xj" else "cor [mA]")
    assert {"most 5 ms", label} <= {text.get_text() for text in ax.get_legend().get_texts()}


@pytest.mark.parametrize("kind", sorted(run_report.DRAWERS))
def test_every_kind_survives_a_value_that_could_not_be_measured(kind: str) -> None:
    unit = {"overshoot": "%", "amplitude_ratio": "1", "phase_lag": "deg"}.get(kind, "ms" if "time" in kind else "um")
    check = make_check(kind, NAN, unit, 5.0, (0.5, 1.5))
    assert run_report.draw_failed_check(make_trace(), check).startswith("<svg")
    for other in (replace(check, t0=NAN, t1=NAN), replace(check, kind="event_never"),
                      replace(check, t0=50.0, t1=51.0)):
        assert not run_report.draw_failed_check(make_trace(), other)


def test_a_page_shows_each_failed_check_once() -> None:
    failed = make_check("overshoot", 12.0, "%", 11.0, (0.5, 1.5))
    trace = replace(make_trace(), checks=(failed, replace(failed, name="fine", passed=True),
                                        replace(failed, name="b")))
    page = render_html(build_run_report(trace))
    assert "Failed checks" in page and page.count("Dashed: limits; red") == 2 and page.count("<script") == 1
    assert "Failed checks" not in render_html(build_run_report(replace(trace, checks=())))
