"""Close-ups of failed checks: the right curve, the limits and the measured value, in the unit of the check."""
from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fdi.report import run_figures
from fdi.report.html import render_html
from fdi.report.run_report import build_run_report
from fdi.trace.trace import Check, Trace

NAN = float("nan")
ROWS = 3000


def make_trace() -> Trace:
    """A step of 5 mm at t = 0.5 s with 12 % overshoot, then a ramp with a lag of 20 um and a band of 8 um."""
    t = np.arange(ROWS) / 1000
    since = np.maximum(t - 0.5, 0.0)
    step = np.where(t < 0.5, 0.0, 5e-3 * (1.0 - np.exp(-40 * since) * np.cos(120 * since)))
    ramp = np.where(t > 1.5, 0.5e-3 * (t - 1.5), 0.0)
    com = np.where(t < 0.5, 0.0, 5e-3) + ramp
    xj = step + ramp - np.where(t > 1.5, 20e-6 + 8e-6 * np.sign(np.sin(20 * t)), 0.0)
    return Trace.from_columns({"com": com, "xj": xj, "cor": 4.0 * (com - xj)}, 1e-3, {})


def make_check(kind: str, value: float, unit: str, high: float, window: tuple[float, float], signal: str = "xj",
               low: float = NAN) -> Check:
    return Check(kind, kind, signal, value, unit, low, high, False, *window, "")


def draw(check: Check) -> Any:
    """Axes of the close-up of a check."""
    return vars(run_figures.draw_failed_check(make_trace(), check))["figure"].axes[0]


def list_levels(ax: Any) -> list[float]:
    """Heights of the horizontal lines."""
    return sorted(float(line.get_ydata()[0]) for line in ax.lines if len(line.get_ydata()) == 2
                  and line.get_ydata()[0] == line.get_ydata()[1])


def test_overshoot_is_marked_at_its_peak_beside_its_limit() -> None:
    trace = make_trace()
    peak = int(np.argmax(trace.xj[500:700])) + 500
    value = 100 * (trace.xj[peak] / 5e-3 - 1)
    ax = draw(make_check("overshoot", value, "%", 11.0, (0.5, 1.5)))
    (mark,) = [line for line in ax.lines if line.get_marker() == "o"]
    assert list_levels(ax) == [11.0] and abs(mark.get_xdata()[0] - trace.t[peak]) < 0.003
    assert mark.get_ydata()[0] == pytest.approx(value) and "[%]" in ax.get_ylabel()
    curve = max(ax.lines, key=lambda line: len(line.get_xdata()))
    assert np.nanmax(curve.get_ydata()) == pytest.approx(value, rel=0.02)  # the curve reaches the mark


def test_times_are_lines_after_the_step() -> None:
    ax = draw(make_check("settling_time", 94.0, "ms", 78.0, (0.5, 1.5)))
    across = {round(float(line.get_xdata()[0]), 3) for line in ax.lines if len(line.get_xdata()) == 2
              and line.get_xdata()[0] == line.get_xdata()[1]}
    assert across == {0.578, 0.594} and ax.get_xlim()[1] > 0.6


@pytest.mark.parametrize(("kind", "value", "levels"), [
    ("ramp_error", 20.0, [14.0, 20.0]), ("rms_error", 21.5, [-21.5, -14.0, 14.0, 21.5]),
    ("break_away", 8.0, [12.0, 14.0, 26.0, 28.0])])
def test_levels_stand_in_the_unit_of_the_check(kind: str, value: float,
                                               levels: list[float]) -> None:
    high = 6.0 if kind == "break_away" else 14.0
    ax = draw(make_check(kind, value, "um", high, (1.6, 2.9)))
    assert list_levels(ax) == pytest.approx(levels, abs=0.5) and "[um]" in ax.get_ylabel()
    curve = max(ax.lines, key=lambda line: len(line.get_xdata()))
    assert 10.0 < np.nanmedian(curve.get_ydata()) < 30.0  # um, not m


def test_largest_size_and_its_place() -> None:
    ax = draw(make_check("never_exceeds", 20.0, "mA", 8.0, (0.5, 1.5), "cor"))
    (mark,) = [line for line in ax.lines if line.get_marker() == "o"]
    assert mark.get_xdata()[0] == pytest.approx(0.5) and mark.get_ydata()[0] == pytest.approx(20.0)
    assert list_levels(ax) == [-8.0, 8.0]


def list_times(ax: Any) -> list[float]:
    """Places of the vertical lines."""
    return sorted(float(line.get_xdata()[0]) for line in ax.lines if len(line.get_xdata()) == 2
                  and line.get_xdata()[0] == line.get_xdata()[1])


@pytest.mark.parametrize(("kind", "signal"), [("shut_off", ""), ("recovers", ""), ("response_within", "xj"),
                                              ("response_within", "node 2 0x8250")])
def test_a_reaction_stands_between_its_begin_and_its_limit(kind: str, signal: str
                                                           ) -> None:
    check = make_check(kind, 12.0, "ms", 5.0, (0.2, 1.5), signal)._replace(after=0.5, above=4e-3)
    ax = draw(check)
    assert list_times(ax) == pytest.approx([0.5, 0.505, 0.512]) and list_levels(ax) == [4.0]
    assert 0.45 < ax.get_xlim()[0] < 0.5 and 0.52 < ax.get_xlim()[1] < 0.6  # of a window of 1.3 s
    assert ax.get_ylabel() == ("xj [mm]" if signal == "xj" else "cor [mA]")
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert {"most 5 ms", "measured 12 ms"} <= {*labels}


def test_a_reaction_that_did_not_come_has_its_limit_alone() -> None:
    ax = draw(make_check("shut_off", NAN, "ms", 5.0, (0.2, 1.5), "")._replace(after=0.5))
    assert list_times(ax) == pytest.approx([0.5, 0.505]) and ax.get_xlim()[1] == pytest.approx(0.55, abs=2e-3)
    assert "not measurable" in [text.get_text() for text in ax.get_legend().get_texts()]


@pytest.mark.parametrize("kind", sorted(run_figures.DRAWERS))
def test_every_kind_survives_a_value_that_could_not_be_measured(kind: str) -> None:
    unit = {"overshoot": "%", "amplitude_ratio": "1", "phase_lag": "deg"}.get(kind, "ms" if "time" in kind else "um")
    check = make_check(kind, NAN, unit, 5.0, (0.5, 1.5))
    assert run_figures.draw_failed_check(make_trace(), check).startswith("<svg")
    for other in (check._replace(t0=NAN, t1=NAN), check._replace(kind="event_never"), check._replace(t0=50.0, t1=51.0)):
        assert not run_figures.draw_failed_check(make_trace(), other)


def test_a_page_shows_each_failed_check_once() -> None:
    failed = make_check("overshoot", 12.0, "%", 11.0, (0.5, 1.5))
    trace = replace(make_trace(), checks=(failed, failed._replace(name="fine", passed=True), failed._replace(name="b")))
    page = render_html(build_run_report(trace))
    assert "Failed checks" in page and page.count("Dashed: limits; red") == 2 and page.count("<script") == 1
    assert "Failed checks" not in render_html(build_run_report(replace(trace, checks=())))
