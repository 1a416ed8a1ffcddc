"""The report: one file that needs nothing else, and says what the trace says."""
from __future__ import annotations

import html
import math
import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from html_page import HtmlPage
from rig_command import rig
from synthetic_run import record_run

from fdi.report import drawing, run_report
from fdi.report.html import render_html
from fdi.report.run_report import build_run_report, read_verdict, write_run_page
from fdi.trace.trace import Event, Trace
from plant.errors import InputError
from rig.recorder import Check, Recorder, Signals, Timing
from rig.recorder.recover import recover_log


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_run(tmp_path_factory.mktemp("run") / "trace.mcap")


@pytest.fixture(scope="module")
def page(log: Path) -> str:
    return render_run(Trace.read(log, all=True))


def render_run(trace: Trace) -> str:
    return render_html(build_run_report(trace))


def test_it_needs_no_network(page: str) -> None:
    seen = HtmlPage(page)
    assert not seen.open and not {"link", "iframe", "img"} & set(seen.tags)
    assert seen.tags.count("script") == 1 and '<script id="figure-script">' in page  # no src: the text is in the page
    assert not re.search(r"\b(fetch|XMLHttpRequest|WebSocket|import)\b *\(", page)
    assert all(address.startswith("#") for address in seen.addresses)
    assert not re.search(r"@import|url\((?!#)", page) and len(page) < 2_000_000


def test_it_says_what_the_trace_says(page: str) -> None:
    text = " ".join(HtmlPage(page).text.split())
    assert text.startswith("FAIL · ") and "1 of 4 checks failed: ramp error" in text
    assert not [words for words in (
        "3 of 4", "13.500 s, 13500 cycles", "overshoot of the 5 mm step", "61", "ms", "2.500 – 3.250 s",
        "mean of com - xj over the slope", "sensors.position_offset: ramps in", "pre-operational", "error [um]",
        "P12 [bar]", "XS [um]", "title = 'synthetic'", "p99.9", "0 of 14000") if words not in text]


def test_text_of_the_trace_is_no_html(log: Path) -> None:
    trace = Trace.read(log, all=True)
    nasty = "<script>alert(1)</script>"
    page = render_run(replace(trace, checks=(trace.checks[0]._replace(name=nasty, detail=nasty),),
                              provenance={"sequence": nasty, "source": nasty}, attachments={nasty: nasty.encode()}))
    assert "<script>" not in page


@pytest.mark.parametrize(("status", "mood"), [("PASS", "good"), ("INVALID_TIMING", "doubtful"), ("ABORTED", "bad")])
def test_verdict_of_the_run_comes_first(log: Path, status: str, mood: str) -> None:
    trace = Trace.read(log)
    said = {**trace.provenance, "verdict.verdict": status, "verdict.why": "because", "verdict.timing": "because"}
    page = render_run(replace(trace, provenance=said))
    assert f'<div class="verdict {mood}">{status}</div>' in page and "because" in page


def test_an_aborted_run_says_why_and_what_is_missing(aborted: Path) -> None:
    page = render_run(Trace.read(aborted, all=True))
    head, text = page[:page.index("</header>")], " ".join(HtmlPage(page).text.split())
    assert ">ABORTED<" in head and "guard 'ram far out' was passed by xj" in html.unescape(head)
    assert "missing samples (red on the page): 45 of xj, cor, p12; 300 of xs (of 2871)" in text
    assert text.count("missing samples (red on the page)") == 1
    assert len(re.findall("not reached ?the run ended at 2.271 s", text)) == 3 and "whole run" not in text
    assert text.count(": not measured") == 3  # the names in the drawing, without a bar
    assert not re.search(r"\bnan\b", text)


def test_a_real_run_has_a_report(preflight: Path) -> None:
    page = (preflight / "report.html").read_text(encoding="utf-8")
    text = " ".join(HtmlPage(page).text.split())
    assert text.startswith("PASS · Preflight") and "17 of 17" in text and "12 of 12" in text
    assert "missing samples" not in text.split("Signals")[0] and page.count('<td class="is-good">pass</td>') == 29
    assert "section main: rest" in text.replace("section", "section ").replace("  ", " ")


def test_a_failed_run_names_its_checks(log: Path) -> None:
    trace = Trace.read(log)
    bad = tuple(trace.checks[0]._replace(name=f"c{i}", passed=False) for i in range(6))
    for checks, verdict in ((trace.checks, ("FAIL", "1 of 4 checks failed: ramp error")),
                            (bad, ("FAIL", "6 of 6 checks failed: c0, c1, c2, c3 and 2 more")),
                            ((), ("NOT_JUDGED", "")), (trace.checks[:1], ("PASS", ""))):
        assert read_verdict(replace(trace, checks=checks)) == verdict


def test_single_missing_samples_leave_a_line_and_a_mark() -> None:
    values = np.sin(np.arange(100) / 10)
    holes = values.copy()
    holes[1::2] = np.nan  # every second one: a line through single samples would have no stroke at all
    holes[60:80] = np.nan
    columns = {"com": values, "xj": values, "cor": values}
    sound, broken = (run_report.draw_signals(Trace.from_columns({**columns, "xj": xj}, 1e-3, {}))
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
    with pytest.raises(InputError, match="can be written"):
        write_run_page(tmp_path / "short.csv", tmp_path / "no" / "report.html")


@pytest.mark.parametrize("phases", [[1], [0], [1, 1], [0, 1, 2]], ids=str)
@pytest.mark.parametrize("timing", [(0.0, 1e-4, 1e-4), (0.0, 0.0, math.nan), (1e-4, 0.0, 0.0), (1e-8, 1e-8, 1e-9)],
                         ids=str)
def test_the_shortest_runs_draw_without_a_warning(tmp_path: Path, phases: list[int],
                                                  timing: tuple[float, float, float]) -> None:
    recorder = Recorder(tmp_path / "trace.mcap", {}, {"period": "0.001"})
    for k, phase in enumerate(phases):
        recorder.cycle(k * 1_000_000, Signals(k, phase, 0, 0, 0, 0, 0, 0, 0, 0, 0), Timing(k, False, *timing))
    recorder.put(0, Check(name="x", signal="xj", unit="m", value=0.0, passed=True, t0=0.0, t1=0.0))
    recorder.close()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        render_run(Trace.read(tmp_path, all=True))


def test_thinned_line_keeps_its_extremes() -> None:
    t, values = np.arange(200_000) * 1e-3, np.zeros(200_000)
    values[[12_345, 140_001]] = 1.0, -1.0
    values[20_000:20_100] = np.nan
    thin_t, thin = drawing.thin_line(t, values)
    assert len(thin) < 3 * drawing.LINE_COLUMNS
    assert np.nanmax(thin) == 1 and np.nanmin(thin) == -1 and np.isnan(thin).any()
    assert t[12_345] in thin_t and (np.diff(thin_t) > 0).all()


def test_command(log: Path) -> None:
    said = rig("report", log.parent)
    assert said[:2] == (0, f"{log.parent / 'report.html'}\n"), said.err


def test_injected_faults_are_shaded_from_begin_to_end(preflight: Path) -> None:
    trace = Trace.read(preflight)
    events = (Event(1.0, "WARN", "fault", "lost drive begins"), Event(2.5, "INFO", "fault", "lost drive ends"),
              Event(3.0, "WARN", "fault", "parameter filter.clogging begins"))
    faulty = replace(trace, events=events)
    assert run_report.list_faults(faulty) == [
        ("lost drive", 1.0, 2.5), ("parameter filter.clogging", 3.0, trace.t[-1])]
    assert "lost drive" in render_run(faulty) and run_report.draw_signals(faulty) != run_report.draw_signals(trace)
