"""Close-ups of failed checks: the right curve, the limits and the measured value, in the unit of the check."""
from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fdi.report import run_report
from fdi.report.html import render_html
from fdi.report.run_report import build_run_report
from fdi.trace.trace import Check, Trace

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
               low: float = NAN) -> Check:
    return Check(kind, kind, signal, value, unit, low, high, False, *window, "")


def draw(check: Check) -> Any:
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


def test_overshoot_is_marked_at_its_peak_beside_its_limit() -> None:
    trace = make_trace()
    peak = int(np.argmax(trace.xj[500:700])) + 500
    value = 100 * (trace.xj[peak] / 5e-3 - 1)
    ax = draw(make_check("overshoot", value, "%", 11.0, (0.5, 1.5)))
    assert list_places(ax, "y") == [11.0] and "[%]" in ax.get_ylabel()
    assert find_mark(ax) == (pytest.approx(trace.t[peak], abs=0.003), pytest.approx(value))
    assert np.nanmax(find_curve(ax).get_ydata()) == pytest.approx(value, rel=0.02)  # the curve reaches the mark


def test_times_are_lines_after_the_step() -> None:
    ax = draw(make_check("settling_time", 94.0, "ms", 78.0, (0.5, 1.5)))
    assert list_places(ax, "x") == pytest.approx([0.578, 0.594]) and ax.get_xlim()[1] > 0.6


@pytest.mark.parametrize(("kind", "value", "levels"), [
    ("ramp_error", 20.0, [14.0, 20.0]), ("rms_error", 21.5, [-21.5, -14.0, 14.0, 21.5]),
    ("break_away", 8.0, [12.0, 14.0, 26.0, 28.0])])
def test_levels_stand_in_the_unit_of_the_check(kind: str, value: float, levels: list[float]) -> None:
    ax = draw(make_check(kind, value, "um", 6.0 if kind == "break_away" else 14.0, (1.6, 2.9)))
    assert list_places(ax, "y") == pytest.approx(levels, abs=0.5) and "[um]" in ax.get_ylabel()
    assert 10.0 < np.nanmedian(find_curve(ax).get_ydata()) < 30.0  # um, not m


def test_largest_size_and_its_place() -> None:
    ax = draw(make_check("never_exceeds", 20.0, "mA", 8.0, (0.5, 1.5), "cor"))
    assert find_mark(ax) == pytest.approx((0.5, 20.0)) and list_places(ax, "y") == [-8.0, 8.0]


@pytest.mark.parametrize(("kind", "signal"), [("shut_off", ""), ("recovers", ""), ("response_within", "xj"),
                                              ("response_within", "node 2 0x8250")])
@pytest.mark.parametrize(("value", "places", "label"), [
    (12.0, [0.5, 0.505, 0.512], "measured 12 ms"), (NAN, [0.5, 0.505], "not measurable")])
def test_a_reaction_stands_between_its_begin_and_its_limit(kind: str, signal: str, value: float, places: list[float],
                                                           label: str) -> None:
    ax = draw(make_check(kind, value, "ms", 5.0, (0.2, 1.5), signal)._replace(after=0.5, above=4e-3))
    assert list_places(ax, "x") == pytest.approx(places) and list_places(ax, "y") == [4.0]
    assert 0.45 < ax.get_xlim()[0] < 0.5 and 0.52 < ax.get_xlim()[1] < 0.6  # of a window of 1.3 s
    assert ax.get_ylabel() == ("xj [mm]" if signal == "xj" else "cor [mA]")
    assert {"most 5 ms", label} <= {text.get_text() for text in ax.get_legend().get_texts()}


@pytest.mark.parametrize("kind", sorted(run_report.DRAWERS))
def test_every_kind_survives_a_value_that_could_not_be_measured(kind: str) -> None:
    unit = {"overshoot": "%", "amplitude_ratio": "1", "phase_lag": "deg"}.get(kind, "ms" if "time" in kind else "um")
    check = make_check(kind, NAN, unit, 5.0, (0.5, 1.5))
    assert run_report.draw_failed_check(make_trace(), check).startswith("<svg")
    for other in (check._replace(t0=NAN, t1=NAN), check._replace(kind="event_never"), check._replace(t0=50.0, t1=51.0)):
        assert not run_report.draw_failed_check(make_trace(), other)


def test_a_page_shows_each_failed_check_once() -> None:
    failed = make_check("overshoot", 12.0, "%", 11.0, (0.5, 1.5))
    trace = replace(make_trace(), checks=(failed, failed._replace(name="fine", passed=True), failed._replace(name="b")))
    page = render_html(build_run_report(trace))
    assert "Failed checks" in page and page.count("Dashed: limits; red") == 2 and page.count("<script") == 1
    assert "Failed checks" not in render_html(build_run_report(replace(trace, checks=())))
