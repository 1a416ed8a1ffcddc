"""Runs side by side: what is subtracted, what is left out, and when two runs are the same."""

from dataclasses import replace

import numpy as np
import pytest

from fdi.comparison.run_differences import (
    RunDifferences,
    RunPair,
    SignalDifference,
    compare_runs,
    match_checks,
)
from fdi.report import build_diff_report, format_report, render_html
from fdi.trace import CheckResult, Trace

ROWS = 4000
NOISE = 2e-6  # m rms
LIMITED = CheckResult(name="overshoot", kind="overshoot", signal="xj", value=7.0, unit="%", high=11.0, passed=True,
                      t0=0.5, t1=1.5)


def make_run(seed: int = 0, period: float = 1e-3, start: float = 0.0, bump: float = 0.0, rows: int = ROWS) -> Trace:
    """A ram that follows steps and a sine, with noise of `seed`, and `bump` m more than it should at t = 2 s."""
    t = np.arange(rows) * period
    com = np.where(t < 1.0, 0.0, 5e-3) + np.where(t > 2.5, 1e-3 * np.sin(2 * np.pi * 2 * (t - 2.5)), 0.0)
    noise = np.random.default_rng(seed).standard_normal((2, rows))
    xj = com + bump * np.exp(-0.5 * ((t - 2.0) / 0.01) ** 2) + NOISE * noise[0]
    columns = {"t": t + start, "com": com, "xj": xj, "cor": 4.0 * (com - xj), "p12": 1e5 + 2e4 * noise[1]}
    return Trace.from_columns(columns, period, {})


def compare_two(other: Trace, first: Trace | None = None
                ) -> tuple[RunDifferences, RunPair, dict[str, SignalDifference]]:
    """A run against the reference (default: that of seed 0), and how each signal differs."""
    differences = compare_runs(["a", "b"], [make_run() if first is None else first, other])
    return differences, differences.pairs[0], {s.name: s for s in differences.pairs[0].signals}


def test_noise_of_another_seed_is_the_same_and_a_bump_is_found_with_its_size_sign_and_time() -> None:
    (differences, _, signals), (other, _, bumped) = compare_two(make_run(1)), compare_two(make_run(1, bump=-300e-6))
    xj, bump = signals["xj"], bumped["xj"]
    assert (differences.verdict, other.verdict) == ("SAME", "DIFFERENT") and not xj.is_equal and 0.9 < xj.ratio < 1.1
    assert (xj.rms, *xj.noise) == pytest.approx((np.sqrt(2) * NOISE, NOISE, NOISE), rel=0.05)
    assert xj.calm_share == pytest.approx(0.954, abs=0.02) and bump.t == pytest.approx(2.0, abs=0.01)
    assert bump.largest == pytest.approx(-300e-6, rel=0.05) and not bump.is_within_noise


@pytest.mark.parametrize("start", [12.345, -3.0])
def test_runs_with_other_clocks_are_aligned_by_the_command(start: float) -> None:
    differences, pair, _ = compare_two(make_run(1, start=start))
    assert differences.verdict == "SAME" and pair.offset == pytest.approx(-start) and len(pair.t) == ROWS
    assert any("aligned by the command" in note for note in pair.notes)


@pytest.mark.parametrize(("rows", "words"), [
    (slice(700, None), "; 0.700 s of the longer run are not in the other"), (slice(0, ROWS - 2), ""),
    (slice(0, 11), "; 3.989 s of the longer run are not in the other")])
def test_a_part_of_a_run_is_aligned_by_its_steps_and_is_another_run(rows: slice, words: str) -> None:
    differences, pair, _ = compare_two(make_run(1, start=-1e-3 * rows.start).take_rows(rows))
    assert (differences.verdict, pair.offset) == ("DIFFERENT" if words else "SAME", pytest.approx(1e-3 * rows.start))
    assert words in build_diff_report(differences).sentence and all(s.is_within_noise for s in pair.signals)


@pytest.mark.parametrize("is_first", [True, False])
def test_a_slower_run_is_compared_in_its_own_rows(is_first: bool) -> None:
    runs = [make_run(1, period=2e-3, rows=ROWS // 2), make_run(0)]
    _, pair, signals = compare_two(*runs if is_first else runs[::-1])
    assert pair.has_same_command and pair.t[1] - pair.t[0] == pytest.approx(2e-3)
    assert any("rows every" in note for note in pair.notes) and all(s.is_within_noise for s in signals.values())


def test_of_different_commands_only_equal_parts_are_compared() -> None:
    other = make_run(1)
    far = other.com + np.where(other.t > 2.5, 1e-3, 0.0)
    differences, pair, signals = compare_two(other.with_columns({"com": far, "xj": other.xj + far - other.com}))
    disjoint_runs, _, no_signals = compare_two(other.with_columns({"com": other.com + 1.0}))
    assert (differences.verdict, disjoint_runs.verdict, no_signals) == ("DIFFERENT", "DIFFERENT", {})
    assert pair.common == pytest.approx(2.5, abs=0.01) and signals["xj"].is_within_noise and not pair.has_same_command
    assert "elsewhere they differ" in build_diff_report(differences).sentence
    assert "no signal could be compared" in build_diff_report(disjoint_runs).sentence
    assert "<svg" not in render_html(build_diff_report(disjoint_runs))


def test_missing_samples_signals_and_units_are_left_out() -> None:
    other = make_run(1)
    holes = np.where((np.arange(ROWS) >= 100) & (np.arange(ROWS) < 200), np.nan, other.xj)
    other = other.with_columns({"com": other.com + 0.0 * holes, "xj": holes, "p12": np.full(ROWS, np.nan)},
                               units={**other.units, "cor": "rad/s"})
    _, pair, signals = compare_two(other)
    assert pair.has_same_command and list(signals) == ["xj"] and signals["xj"].samples == ROWS - 100
    assert pair.not_compared == {"p12": "only A has it", "cor": "in A in A, in rad/s in B"}


FAILED, NEW = replace(LIMITED, value=13.0, passed=False), replace(LIMITED, name="rise time")


@pytest.mark.parametrize(("runs", "is_changed", "has_other_limits"), [
    ([[LIMITED], [FAILED]], [True], [False]), ([[LIMITED], [LIMITED, NEW]], [False, True], [False, False]),
    ([[LIMITED], [replace(LIMITED, high=12.0)], []], [False], [True]),  # a run without any checks changes none
    ([[LIMITED, FAILED], [LIMITED, FAILED]], [False, False], [False, False])])
def test_checks_are_matched_by_name_and_changes_are_marked(runs: list[list[CheckResult]], is_changed: list[bool],
                                                           has_other_limits: list[bool]) -> None:
    checks = match_checks(runs)
    assert [[c.is_changed for c in checks], [c.has_other_limits for c in checks]] == [is_changed, has_other_limits]


def test_a_changed_check_makes_runs_different() -> None:
    first, second = (replace(make_run(0), checks=(replace(LIMITED, passed=is_good),)) for is_good in (True, False))
    differences, *_ = compare_two(second, first)
    assert differences.verdict == "DIFFERENT" and compare_two(first, first)[0].verdict == "SAME"
    text = format_report(build_diff_report(differences), 80)
    assert "pass -> FAIL" in text and "changed" in text and max(map(len, text.splitlines()[2:])) <= 80


def test_three_runs_share_one_reference_and_one_page() -> None:
    differences = compare_runs(["a", "b", "c"], [make_run(0), make_run(1), make_run(2, bump=1e-4)])
    report = build_diff_report(differences)
    page = render_html(report)
    assert [pair.run.label for pair in differences.pairs] == ["B", "C"] and page.count("<svg") == 1
    assert [pair["signals"]["xj"]["within_noise"] for pair in report.data["pairs"]] == [True, False]
    assert "C - A" in page and "nan" not in format_report(report)
