"""The report: one file that needs nothing else, and says what the trace says."""
from __future__ import annotations

import re
import shutil
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from synthetic import record

from fdi import figures
from fdi.report import render, write_report
from fdi.trace import Trace
from plant.errors import InputError
from rig.recorder.recover import recover


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("run") / "trace.mcap")


@pytest.fixture(scope="module")
def page(log: Path) -> str:
    return render(Trace.read(log, all=True))


class _Page(HTMLParser):
    """Open tags, every address and the text of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.tags: list[str] = []
        self.open: list[str] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href", "action")]
        if tag not in ("meta", "br", "link", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href")]

    def handle_data(self, data: str) -> None:
        self.text += data


def test_it_needs_no_network(page: str) -> None:
    seen = _Page(page)
    assert not seen.open and not {"script", "link", "iframe", "img"} & set(seen.tags)
    assert all(address.startswith("#") for address in seen.addresses)
    assert not re.search(r"@import|url\((?!#)", page)
    assert len(page) < 2_000_000


def test_it_says_what_the_trace_says(page: str) -> None:
    text = " ".join(_Page(page).text.split())
    assert text.startswith("FAIL") and "3 of 4" in text and "13.500 s, 13500 cycles" in text
    for words in ("overshoot of the 5 mm step", "61", "ms", "2.500 – 3.250 s", "mean of com - xj over the slope",
                  "sensors.position_offset: ramps in", "pre-operational", "error [µm]", "P12 [MPa]", "XS [µm]",
                  "title = 'synthetic'", "p99.9", "0 of 14000"):
        assert words in text, words


def test_text_of_the_trace_is_no_html(log: Path) -> None:
    trace = Trace.read(log, all=True)
    nasty = "<script>alert(1)</script>"
    page = render(replace(trace, checks=(trace.checks[0]._replace(name=nasty, detail=nasty),),
                          provenance={"sequence": nasty, "source": nasty}, attachments={nasty: nasty.encode()}))
    assert "<script>" not in page


@pytest.mark.parametrize(("status", "mood"), [("PASS", "good"), ("INVALID_TIMING", "doubtful"), ("ABORTED", "bad")])
def test_verdict_of_the_run_comes_first(log: Path, status: str, mood: str) -> None:
    trace = Trace.read(log)
    page = render(replace(trace, provenance={**trace.provenance, "verdict.verdict": status, "verdict.why": "because"}))
    assert f'<div class="verdict {mood}">{status}</div>' in page and "because" in page


def test_any_trace_has_a_report(log: Path, tmp_path: Path) -> None:
    record(tmp_path / "aborted.mcap", stop=100)
    (tmp_path / "cut.mcap").write_bytes(log.read_bytes()[:-50_000])
    recover(tmp_path / "cut.mcap", tmp_path / "salvaged.mcap")
    (tmp_path / "short.csv").write_text("t,com,xj,cor\n0,0,,0\n0.001,0,1e-6,0\n0.004,0,1e-6,0\n")
    for name in ("aborted.mcap", "salvaged.mcap", "short.csv"):
        write_report(tmp_path / name, tmp_path / "report.html")
        page = (tmp_path / "report.html").read_text(encoding="utf-8")
        _Page(page)
        assert ("salvaged" in page) == (name == "salvaged.mcap")
    assert "NOT JUDGED" in page and "2 cycles missing between 0.001 and 0.004 s" in page
    assert "Cycle timing" not in page
    with pytest.raises(InputError, match="can be written"):
        write_report(tmp_path / "short.csv", tmp_path / "no" / "report.html")


def test_thinned_line_keeps_its_extremes() -> None:
    t, values = np.arange(50_000) * 1e-3, np.zeros(50_000)
    values[[12_345, 40_001]] = 1.0, -1.0
    values[20_000:20_100] = np.nan
    thin_t, thin = figures._thin(t, values)
    assert len(thin) < 5000 and np.nanmax(thin) == 1 and np.nanmin(thin) == -1 and np.isnan(thin).any()
    assert t[12_345] in thin_t and (np.diff(thin_t) > 0).all()


def test_command(log: Path) -> None:
    words = [sys.executable, "-m", "rig.cli", "report", str(log.parent)]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout == f"{log.parent / 'report.html'}\n", done.stderr


def test_a_browser_draws_it(log: Path, tmp_path: Path) -> None:
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no chromium on this machine (Debian: apt-get install chromium)")
    from matplotlib.image import imread

    write_report(log, tmp_path / "report.html")
    words = [browser, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}",
             f"--screenshot={tmp_path / 'page.png'}", "--window-size=1200,1600", (tmp_path / "report.html").as_uri()]
    subprocess.run(words, capture_output=True, check=True, timeout=120)
    shades = (imread(str(tmp_path / "page.png"))[..., :3] * 255).astype(int)
    for name, _, _, colour in figures.PANELS[:4]:
        wanted = np.array([int(colour[i:i + 2], 16) for i in (1, 3, 5)])
        assert (np.abs(shades - wanted).max(axis=2) < 30).sum() > 500, name
