"""The uncertainty of checks covers what sensors and sampling do; decision rules; calibrations of a bench file."""

import datetime
from collections.abc import Callable
from math import inf, nan, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import ROOT
from rig_command import rig
from short_sequences import SHORT, job, play

from fdi.report.run_report import build_run_report
from fdi.report.terminal import format_report
from fdi.trace.check_result import CheckResult
from fdi.trace.trace import Trace
from plant.errors import InputError
from plant.run import Columns
from plant.segments import Array
from rig.benches.bench_file import load_bench
from rig.benches.calibration import SensorCalibration
from rig.sequences import checks, uncertainty
from rig.sequences.checks import RunData
from rig.sequences.uncertainty import WIDTHS, Decision, Metrology, decide

SIZE, FINE = 1e-3, 25  # m, of the step; instants of the true motion for each sample
DAY = datetime.date(2026, 3, 1), datetime.date(2027, 3, 1)


def calibrate(u: float = 5e-6, distribution: str = "normal", gain: float = 2e-3, noise: float = 0.0) -> Metrology:
    known = SensorCalibration("xj", "m", "K-118", *DAY, u, distribution, gain, noise)
    return Metrology("guarded", {"xj": known}, {"xj": 1e-6})


def make_columns(xj: Array, com: float = SIZE) -> Columns:
    nothing = np.full(len(xj), np.nan)
    return Columns(np.arange(len(xj)) / 1e3, np.full(len(xj), com), xj, nothing, nothing, nothing, nothing)


def first(beyond: Any) -> float:
    return float(np.argmax(beyond)) / FINE / 1e3


# kind: keys, noise of the sensor, and the true number from the true position at FINE instants a sample, without filter
CASES: dict[str, tuple[dict[str, Any], float, Callable[[Array], float]]] = {
    "overshoot": ({}, 0.0, lambda x: 100 * (x.max() / SIZE - 1)),
    "settling_time": ({"band": 10.0}, 1e-6, lambda x: len(x) / FINE / 1e3 - first(np.abs(x / SIZE - 1)[::-1] > 0.1)),
    "rise_time": ({}, 1e-6, lambda x: first(x > 0.9 * SIZE) - first(x > 0.1 * SIZE)),
    "steady_error": ({"window": (0.2, 0.4)}, 1e-6, lambda x: abs(float(np.mean(SIZE - x[200 * FINE:])))),
    "max_error": ({"window": (0.02, 0.4)}, 0.0, lambda x: float(np.abs(SIZE - x)[20 * FINE:].max())),
    "rms_error": ({}, 1e-6, lambda x: float(np.sqrt(np.mean((SIZE - x[::FINE]) ** 2)))),
    "never_exceeds": ({"signal": "xj"}, 0.0, lambda x: float(x.max())),
    "response_within": ({"after": 0.0, "signal": "xj", "above": 0.8e-3}, 1e-6, lambda x: first(x > 0.8e-3)),
}


@pytest.mark.parametrize("kind", CASES)
def test_the_interval_covers_the_truth_as_often_as_it_says(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """95 % of 60 units, each with sensor errors of its own: fewer than 85 % have a chance of 1 in 2000."""
    monkeypatch.setattr(uncertainty, "DRAWS", 60)
    keys, noise, find_truth = CASES[kind]
    check = checks.KEYS[kind](kind=kind, name=kind, high=1e9, **keys)
    metrology, errors, expanded = calibrate(noise=noise), [], []
    for seed in range(60):
        random = np.random.default_rng(seed)
        omega, damping = random.uniform(80, 120), random.uniform(0.3, 0.5)
        t = np.arange(400 * FINE) / FINE / 1e3
        wd = omega * sqrt(1 - damping**2)
        x = SIZE * (1 - np.exp(-damping * omega * t) * (np.cos(wd * t) + damping * omega / wd * np.sin(wd * t)))
        readings = x[::FINE] * (1 + 2e-3 * random.normal()) + 5e-6 * random.normal() + noise * random.normal(size=400)
        result = check.judge(RunData(make_columns(np.round(readings / 1e-6) * 1e-6), metrology=metrology))
        errors.append(result.value - find_truth(x))
        expanded.append(result.uncertainty)
    assert np.mean(np.abs(errors) <= expanded) >= 0.85
    assert np.median(expanded) < 5 * np.std(errors)  # nor is it a blanket


@pytest.mark.parametrize("distribution", WIDTHS)
def test_a_mean_has_the_uncertainty_of_its_sensor_whatever_the_distribution(distribution: str) -> None:
    check = checks.KEYS["steady_error"](kind="steady_error", name="mean", high=1.0, unit="um")
    run = RunData(make_columns(np.full(500, SIZE - 100e-6)), metrology=calibrate(5e-6, distribution, gain=0.0))
    result = check.judge(run)
    assert result.value == pytest.approx(100.0) and not result.detail
    assert result.uncertainty == pytest.approx(2 * sqrt(5**2 + 1 / 12), rel=0.03)


def test_without_a_calibration_the_uncertainty_is_unknown_and_exact_numbers_have_none() -> None:
    def judge(kind: str, **keys: Any) -> CheckResult:
        run = RunData(make_columns(np.zeros(100), 0.0), metrology=Metrology("guarded"))
        return checks.KEYS[kind](**{"kind": kind, "name": kind, "high": 1.0, **keys}).judge(run)

    unknown = judge("never_exceeds", signal="xj")
    assert (unknown.verdict, unknown.detail) == ("CANNOT_TELL", "no calibration of xj")
    assert np.isnan(unknown.uncertainty)
    for exact in (judge("never_exceeds", signal="com"), judge("event_never", event="load", high=0.0)):
        assert (exact.verdict, exact.uncertainty) == ("PASS", 0.0)


def test_a_level_that_only_the_errors_of_the_sensor_pass_is_open() -> None:
    check = checks.KEYS["response_within"](kind="response_within", name="level", signal="xj", above=1e-3, after=0.0,
                                           high=1.0)
    for position, verdict in ((0.996e-3, "CANNOT_TELL"), (1.004e-3, "CANNOT_TELL"), (1.1e-3, "PASS"), (0.9e-3, "FAIL")):
        result = check.judge(RunData(make_columns(np.full(100, position)), metrology=calibrate()))
        assert result.verdict == verdict, position


@pytest.mark.parametrize(("decision", "value", "low", "high", "u", "expected"), [
    ("simple", 9.9, nan, 10.0, 5.0, True), ("simple", 10.1, nan, 10.0, nan, False),
    ("simple", nan, 0.0, 1.0, nan, False), ("guarded", 5.0, nan, 10.0, nan, None),
    ("guarded", 9.0, nan, 10.0, 1.0, True), ("guarded", 9.1, nan, 10.0, 1.0, None),
    ("guarded", 11.0, nan, 10.0, 1.0, None), ("guarded", 11.1, nan, 10.0, 1.0, False),
    ("guarded", 1.5, 1.0, 10.0, 1.0, None), ("guarded", -0.1, 1.0, 10.0, 1.0, False),
    ("guarded", 5.0, 4.5, 5.5, 1.0, None), ("guarded", 0.0, nan, 0.0, 0.0, True),
    ("guarded", nan, nan, 10.0, nan, False), ("guarded", nan, nan, 10.0, inf, None),
    ("shared", 9.9, nan, 10.0, 3.3, True), ("shared", 10.1, nan, 10.0, 3.3, False),
    ("shared", 1.0, nan, 10.0, 3.4, None), ("shared", 5.0, nan, 10.0, inf, None),
    ("shared", 5.0, 0.0, 10.0, 1.6, True), ("shared", 5.0, 0.0, 10.0, 1.7, None)])
def test_decision_rules(decision: Decision, value: float, low: float, high: float, u: float,
                        expected: bool | None) -> None:
    assert decide(value, low, high, u, decision) is expected


CALIBRATION = """
[calibration]
decision = "guarded"
[calibration.ram_position]
identifier = "LVDT 4711"
date = 2026-03-01
expiry = "2099-03-01"
u = "2 um"
gain = 1e-3
[calibration.p12]
identifier = "P 12"
date = 2020-03-01
expiry = 2021-03-01
u = "rectangular ±0.2 bar"
"""


def write_bench(folder: Path, calibration: str = CALIBRATION) -> Path:
    for name in ("node2.eds", "node3.eds"):
        (folder / name).write_bytes((ROOT / "dbc" / name).read_bytes())
    (folder / "rig.toml").write_text((ROOT / "rig/benches/eha.toml").read_text() + calibration)
    return folder / "rig.toml"


def test_a_bench_file_has_the_calibrations(tmp_path: Path) -> None:
    bench = load_bench(str(write_bench(tmp_path)))
    assert bench.decision == "guarded" and list(bench.calibration) == ["xj", "p12"]
    assert bench.calibration["p12"].u == pytest.approx(0.2e5 / sqrt(3)) and bench.calibration["xj"].u == 2e-6
    assert load_bench().calibration == {} and load_bench().decision == "simple"


@pytest.mark.parametrize(("old", "new", "message"), [
    ("calibration.ram_position]", "calibration.ram_positoin]",
     "rig.toml:50: calibration.ram_positoin: expected decision or a measured signal: "),
    ('"guarded"', '"guraded"', "calibration.decision: expected 'guarded', 'shared' or 'simple', not 'guraded'"),
    ("date = 2020-03-01", "date = 2022-03-01", "calibration.p12.expiry: expected a date from 2022-03-01 on, not "),
    ('"2099-03-01"', '"soon"', "calibration.ram_position.expiry: expected a date such as 2026-03-01, not 'soon'"),
    ('"2099-03-01"', "2099-13-01", "expected TOML; "), ('"2 um"', '"2"', "expected a number and a unit"),
    ('"2 um"', '"2 bar"', "calibration.ram_position.u: expected one of m, cm, mm, um"), ('"2 um"', '"0 um"', "above 0"),
    ('u = "2 um"', "", "also the key 'u'"), ("gain = 1e-3", "gain = 2", "gain: expected a number from 0 and below 1"),
    ("identifier = \"P 12\"", "serial = 5", "a key: "), ("calibration.p12]", "calibration.xj]", "each signal once")])
def test_mistakes_are_one_line_each(old: str, new: str, message: str, tmp_path: Path) -> None:
    path = write_bench(tmp_path, CALIBRATION.replace(old, new))
    with pytest.raises(InputError) as refused:
        load_bench(str(path))
    assert message in str(refused.value) and "\n" not in str(refused.value)


def test_a_run_says_it_everywhere(tmp_path: Path) -> None:
    """U and the open verdict stand in JSON, terminal, page, log and JUnit; a calibration that has expired is said."""
    sequence = tmp_path / "short.toml"
    sequence.write_text(SHORT.replace("high = 30.0 }", "high = 20.0, requirement = 'REQ-1' }").replace(
        "event = \"EMCY\" },", "event = \"EMCY\" },\n{name = 'pressure', kind = 'never_exceeds', signal = 'p12', "
        "high = 400, unit = 'bar'}"))
    bench = write_bench(tmp_path, CALIBRATION.replace("gain = 1e-3", "gain = 0.5"))
    found = rig("run", sequence, "--bench", bench, "--out", tmp_path / "run", "--junit", tmp_path / "j.xml", "--json")
    answer = found.json
    overshoot, none, pressure = answer["checks"][:3]
    assert (found.status, answer["verdict"], answer["decision"]) == (1, "CANNOT_TELL", "guarded")
    assert answer["why"] == "too uncertain for a verdict: overshoot; calibration of p12 expired on 2021-03-01"
    assert overshoot["verdict"] == "CANNOT_TELL" and not overshoot["passed"] and overshoot["uncertainty"] > 10
    assert pressure["verdict"] == "PASS" and pressure["detail"] == "calibration of p12 expired on 2021-03-01"
    assert pressure["uncertainty"] == pytest.approx(2 * 0.2 / sqrt(3), rel=0.05) and none["uncertainty"] == 0.0
    assert answer["calibration"]["p12"] == {
        "signal": "p12", "unit": "Pa", "identifier": "P 12", "date": "2020-03-01", "expiry": "2021-03-01", "gain": 0.0,
        "u": pytest.approx(0.2e5 / sqrt(3)), "distribution": "rectangular", "noise": 0.0,
        "problem": "calibration of p12 expired on 2021-03-01"}
    trace = Trace.read(tmp_path / "run", all=True)
    assert trace.checks[0].verdict == "CANNOT_TELL" and trace.provenance["metrology.decision"] == "guarded"
    text = format_report(build_run_report(trace))
    assert "CANNOT_TELL" in text and "expanded uncertainty" in text and "expired on 2021-03-01" in text
    page = (tmp_path / "run" / "report.html").read_text()
    assert "guard band of U at each limit" in page and "P 12, 2020-03-01 to 2021-03-01" in page
    junit = (tmp_path / "j.xml").read_text()
    assert '<skipped message="CANNOT_TELL: measured' in junit and ", U " in junit
    suite = rig("run", sequence, sequence, "--bench", bench, "--out", tmp_path / "suite", "--json")
    assert (suite.status, suite.json["verdict"], suite.json["requirements"][0]["verdict"]) == (1, "CANNOT_TELL", "OPEN")


def test_a_sequence_chooses_its_own_rule(tmp_path: Path) -> None:
    outcome = play(job('decision = "shared"\n' + SHORT), tmp_path)
    assert outcome.verdict == "CANNOT_TELL" and outcome.checks[0].detail == "no calibration of xj"
    assert play(job(SHORT), tmp_path).verdict == "PASS"
