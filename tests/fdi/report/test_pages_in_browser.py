"""Pages as a browser shows them: no overflow at any width, figures that can be zoomed and read, a print."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import measure_page, needs_browser, print_page, take_picture
from PIL import Image  # comes with matplotlib

from fdi.report.report import Column, Report, Section, Table, render_html
from fdi.report.run_report import build_run_report
from fdi.trace.check_result import CheckResult
from fdi.trace.trace import Trace

pytestmark = needs_browser

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
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 3 s with a failed check and long words."""
    t = np.arange(3000) / 1000
    com = np.where(t < 0.5, 0.0, 5e-3)
    xj = np.where(t < 0.5, 0.0, 5e-3 * (1.0 - np.exp(-40 * (t - 0.5))))
    failed = CheckResult(
        name="settling time of the step", kind="settling_time", signal="xj", value=100.0, unit="ms", high=80.0,
        passed=False, t0=0.5, t1=1.5,
        detail="0 of 1000 samples missing, and a remark that is long enough to need several lines on a phone")
    trace = Trace.from_columns({"com": com, "xj": xj, "cor": 4.0 * (com - xj)}, 1e-3, {"node2.name": "x" * 200})
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(render_html(build_run_report(replace(trace, checks=(failed,) * 3))), encoding="utf-8")
    return path


@pytest.mark.parametrize("width", [1400, 400])
def test_nothing_is_cut_off(page: Path, width: int) -> None:
    size = measure_page(page, width)
    assert size.inner == width and size.scroll <= size.client and size.beyond == [] and size.errors == []


def test_a_wide_table_fits_into_a_window_of_800_pixels(tmp_path: Path) -> None:
    """Ten columns with long headings, as rig explain has: none is hidden and none is squeezed to a word a line."""
    headings = ["XJ", "P12", "XS", "XJ, held-out run", "P12, held-out run", "XS, held-out run", "evidence", "p"]
    columns = [Column("effect"), *(Column(heading, align="right") for heading in headings), Column("size")]
    size = "amplitude 0.00022 (-0.00016 .. 0.00060), frequency 344 Hz (338 .. 349), phase 4.3 rad (0.3 .. 8.3)"
    rows = [["null_bias + supply_ripple", "0.997", "0.999", "1.00", "1.00", "1.00", "0.991", "362661", "<1e-99", size]]
    page = tmp_path / "wide.html"
    page.write_text(render_html(Report("explain", "run.csv", sections=[Section("Candidates", [Table(columns, rows)])])))
    high = "row: String(document.querySelectorAll('tr')[1].offsetHeight)"
    notes = measure_page(page, 800, FIND_SCROLLING + f"Object.assign(window.probeNotes, {{{high}}})").notes
    assert notes["scrolling"] == "" and int(notes["row"]) < 200, notes


def test_a_figure_is_zoomed_and_read(page: Path) -> None:
    notes = measure_page(page, 1200, ZOOM)
    assert notes.errors == []
    said = notes.notes
    assert "XJ less the target=" in said["whole"] and "time=0.7500 s" in said["whole"].replace("0.750 s", "0.7500 s")
    assert said["zoomed"] != said["before"] == said["after"]
    assert {"0.540", "0.560"} <= set(said["zoomed"].split("|")) and "0.540" not in said["before"].split("|")
    shown = dict(part.split("=") for part in said["read"].split("|"))
    assert float(shown["time"].removesuffix(" s")) == pytest.approx(0.55, abs=0.001)
    percent = float(shown["XJ less the target"].split()[0].replace("\u2212", "-"))
    assert percent == pytest.approx(-100 * np.exp(-40 * 0.05), abs=1.0)  # beyond the target, % of the step


def test_pictures_and_print_are_not_empty(page: Path, tmp_path: Path) -> None:
    take_picture(page, 400, tmp_path / "page.png")
    with Image.open(tmp_path / "page.png") as image:
        pixels = np.asarray(image.convert("L"))[:, :400]
    assert pixels.shape[0] > 1000 and pixels.std() > 10 and pixels[200:].std() > 10
    print_page(page, tmp_path / "page.pdf")
    assert (tmp_path / "page.pdf").read_bytes().count(b"/Type /Page\n") >= 1
