"""Checks against signals whose numbers are known in closed form, with their uncertainty, and of each profile; protocol
checks blame no node for a late rig.
"""

import datetime
from collections import namedtuple
from collections.abc import Callable
from dataclasses import replace
from math import exp, inf, isnan, log, nan, pi, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import ROOT
from refusals import catch_refusal
from rig_command import SHORT, job, play, rig, write_file

from fdi.report import build_run_report, format_report
from fdi.trace import CheckResult, Trace
from plant import EHA, Array, Columns, Hold, Segment, Signals, build_profile
from plant.segments import Ramp, Step
from rig.benches import Bench, Flags, SensorCalibration, load_bench, load_bench_from_files
from rig.sequences import (
    DriveFrames,
    Guard,
    GuardWatch,
    Heartbeat,
    Metrology,
    ProtocolLimits,
    ProtocolRecord,
    Rows,
    RunData,
    checks,
    evaluate_checks,
    judge_protocol,
    uncertainty,
)
from rig.sequences.checks import NO_DRIVES
from rig.sequences.protocol import measure_frozen
from rig.sequences.uncertainty import WIDTHS, Decision, decide

NOISE = 2e-6  # m rms, as the position transducer has it
LAG = 0.01  # s, of the first-order follower
MICRON = 1e-6
Event = namedtuple("Event", "t kind text")


def make_run(com: Array | float, xj: Array, rate: float = 1000.0) -> Columns:
    """A run of which only command and position were measured."""
    nothing = np.full(len(xj), np.nan)
    return Columns(np.arange(len(xj)) / rate, np.full(len(xj), com), xj, nothing, nothing, nothing, nothing)


def noise(n: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).standard_normal(n) * NOISE


def follower(*segments: Segment, tau: float = LAG) -> tuple[Columns, dict[str, slice]]:
    """A first-order lag with unit gain, sampled exactly for a command held over each cycle, noise added."""
    command, sections, _ = build_profile(segments)
    x, out = 0.0, np.empty(len(command))
    for k, demand in enumerate(command):
        out[k] = x
        x = demand + (x - demand) * exp(-1e-3 / tau)
    return make_run(command, out + noise(len(command))), {s.name: slice(s.start, s.stop) for s in sections}


def check(kind: str, **keys: Any) -> checks.Check:
    return checks.KEYS[kind](**{"kind": kind, "name": kind, "high": 1e9, **keys})


def judged(run: Columns, sections: dict[str, slice], kind: str, events: tuple[Event, ...] = (),
           drives: DriveFrames = NO_DRIVES, **keys: Any) -> CheckResult:
    (result,) = evaluate_checks([check(kind, **keys)], run, sections, events, {"fault": 0.5}, drives)
    return result


def test_break_away_is_half_the_band_of_a_triangle() -> None:
    command, sections, _ = build_profile([Ramp(to=1e-3, time=2.0, name="ramp")])
    t = np.arange(len(command)) / 1000
    triangle = 20e-6 * (2 * np.abs(2 * (t / 0.16 % 1) - 1) - 1)
    slips, wild = command - 7e-6 - triangle + noise(len(t)), 1e-3 * (np.arange(len(t)) == 500)
    spans = {s.name: slice(s.start, s.stop) for s in sections}
    break_away, with_spike, noise_only = (
        judged(make_run(command, xj), spans, "break_away", window="ramp", unit="um").value
        for xj in (slips, slips + wild, command + noise(len(t))))
    assert (break_away, with_spike) == pytest.approx((20.0, 20.0), abs=1.0) and noise_only < 4.0


def test_errors_of_a_known_offset() -> None:
    run = make_run(np.zeros(1000), 30e-6 + noise(1000))
    for kind, value in (("steady_error", pytest.approx(30, abs=0.3)), ("max_error", pytest.approx(30, abs=6)),
                        ("rms_error", pytest.approx(sqrt(900 + 4), abs=0.3))):
        assert judged(run, {}, kind, unit="um").value == value
    assert judged(run, {}, "never_exceeds", signal="error", unit="um").value == np.abs(run.xj).max() / MICRON


@pytest.mark.parametrize(("keys", "value"), [
    ({"after": "fault", "event": "EMCY 0x8250"}, pytest.approx(3.0)),
    ({"after": 0.6, "signal": "xj", "above": 5e-4}, pytest.approx(1000 * LAG * log(2), abs=1.1)),
    ({"after": 0.55, "signal": "xj", "below": 1e-3}, 0.0)])
def test_response_to_a_fault_by_event_and_by_signal(keys: dict[str, Any], value: float) -> None:
    run, sections = follower(Hold(time=0.6), Step(to=1e-3, time=0.4))
    events = (Event(0.1, "EMCY", "node 3: 0x8250"), Event(0.503, "emcy", "0x8250 node 3"))
    assert judged(run, sections, "response_within", events, unit="ms", **keys).value == value


@pytest.mark.parametrize(("kind", "keys", "count", "is_passed"), [
    ("event_occurs", {"event": "0x8250"}, 2, True), ("event_occurs", {"event": "0x9999"}, 0, False),
    ("event_never", {"event": "emcy", "window": (0.3, 0.6)}, 0, True), ("event_never", {"event": "emcy"}, 2, False)])
def test_events_are_counted_in_their_window(kind: str, keys: dict[str, Any], count: int, is_passed: bool) -> None:
    run, sections = follower(Hold(time=1.0))
    events = (Event(0.2, "EMCY", "0x8250"), Event(0.7, "EMCY", "0x8250"))
    (result,) = evaluate_checks([checks.KEYS[kind](kind=kind, name="n", **keys)], run, sections, events)
    assert (result.value, result.passed) == (count, is_passed)


def test_few_missing_samples_are_bridged_and_mentioned() -> None:
    run, sections = follower(Hold(time=0.1), Ramp(to=1e-3, time=2.0, name="ramp"))
    whole = judged(run, sections, "ramp_error", window="ramp").value
    run.xj[500:510] = np.nan
    result = judged(run, sections, "ramp_error", window="ramp")
    assert result.value == pytest.approx(whole, abs=0.1 * MICRON) and result.detail == "10 missing samples bridged"


def break_run(run: Columns, fault: str) -> Columns:
    """The run with something wrong."""
    n = {"the run ended at 0.05 s": 50, "the run ended at 0 s": 0}.get(fault, len(run.t))
    missing = {"xj was not measured": np.full(n, True), "samples of xj are missing": np.arange(n) % 2 == 0}
    return make_run(run.com[:n], np.where(missing.get(fault, np.full(n, False)), np.nan, run.xj[:n]))


NEEDED: dict[str, dict[str, Any]] = {
    "settling_time": {"band": 5.0}, "never_exceeds": {"signal": "xj"}, "amplitude_ratio": {"frequency": 5.0},
    "phase_lag": {"frequency": 5.0}, "response_within": {"after": 0.1, "signal": "xj", "above": 1.0},
}


@pytest.mark.parametrize("kind", sorted(set(checks.KINDS) - {"event_occurs", "event_never", "shut_off", "recovers",
                                                              "python"}))
@pytest.mark.parametrize("fault", ["xj was not measured", "samples of xj are missing", "the run ended at 0.05 s",
                                   "the run ended at 0 s"])
def test_what_cannot_be_measured_has_failed_and_says_why(kind: str, fault: str) -> None:
    run, _ = follower(Hold(time=0.1), Step(to=1e-3, time=0.9))
    result = judged(break_run(run, fault), {"step": slice(100, 1000)}, kind, window="step", **NEEDED.get(kind, {}))
    assert not result.passed and isnan(result.value) and fault in result.detail


@pytest.mark.parametrize(("kind", "keys", "reason"), [
    ("max_error", {"window": "step", "skip": 5.0}, "empty"),
    ("never_exceeds", {"signal": "p12"}, "p12 was not measured"),
    ("never_exceeds", {"signal": "xs"}, "xs was not measured"),
    ("overshoot", {"window": (0.0, 0.05)}, "does not step"),
    ("overshoot", {}, "does not step"),
    ("ramp_error", {"window": "step"}, "does not move"),
    ("settling_time", {"window": (0.1, 0.105), "band": 1.0}, "still outside"),
    ("rise_time", {"window": (0.1, 0.105)}, "never reached"),
    ("phase_lag", {"window": "step", "frequency": 0.5}, "shorter than one period"),
    ("phase_lag", {"window": "step", "frequency": 10.0}, "no 10 Hz"),
    ("response_within", {"after": "fault", "event": "EMCY"}, "no event 'EMCY' after 0.5 s"),
    ("response_within", {"after": 0.1, "signal": "xj", "above": 9.0}, "never passed"),
    ("response_within", {"after": 0.1, "event": "count"}, "no event 'count' after 0.1 s"),
    ("response_within", {"after": 7.0, "signal": "xj", "above": 9.0}, "empty"),
])
def test_reasons(kind: str, keys: dict[str, Any], reason: str) -> None:
    run, sections = follower(Hold(time=0.1), Step(to=1e-3, time=0.9, name="step"))
    result = judged(run, sections, kind, **keys)
    assert not result.passed and reason in result.detail


@pytest.mark.parametrize(("largest", "is_step"), [(1.0, False), (0.1, True), (inf, True)])
def test_how_small_a_step_may_be_depends_on_the_size_of_the_motion(largest: float, is_step: bool) -> None:
    small = Signals(*(s._replace(largest=largest) if s.role == "command" else s for s in EHA[1:]))
    (result,) = evaluate_checks([check("settling_time", window="step", band=90.0)],
                                *follower(Hold(time=0.1), Step(to=1e-5, time=0.9, name="step")), signals=small)
    assert isnan(result.value) != is_step


@pytest.mark.parametrize(("error", "message"), [
    (ZeroDivisionError("float division by zero"), "the measure failed (ZeroDivisionError: float division by zero)"),
    (np.linalg.LinAlgError("SVD did not converge"), "the measure failed (LinAlgError: SVD did not converge)"),
    (OverflowError("too large"), "the measure failed (OverflowError: too large)"),
    (None, "the measure came to inf"),
])
def test_a_measure_that_raises_or_has_no_end_has_failed(error: Exception | None, message: str,
                                                        monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> float:
        if error is not None:
            raise error
        return float("inf")

    run, sections = follower(Hold(time=0.1), Step(to=1e-3, time=0.9, name="step"))
    monkeypatch.setattr(checks, "measure_overshoot", broken)
    both = [check("overshoot", window="step", low=0.0, high=None), check("rise_time", window="step")]
    spoilt, sound = evaluate_checks(both, run, sections)
    assert (spoilt.passed, isnan(spoilt.value), spoilt.detail, sound.passed) == (False, True, message, True)


ON, OFF = 2e-3, 0.0  # A
Drives = tuple[tuple[float, float, int], ...]  # time, current and status word of drive frames
LEFT = (Event(0.51, "nmt", "node 2 controller left OPERATIONAL: boot-up"),)


@pytest.mark.parametrize(("kind", "keys", "frames", "seconds"), [
    ("shut_off", {"after": "fault"}, ((0.49, ON, 15), (0.5, ON, 15), (0.503, OFF, 0), (0.504, OFF, 0)), 0.003),
    # once is not for good
    ("shut_off", {"after": "fault"}, ((0.5, ON, 15), (0.503, OFF, 0), (0.504, ON, 15), (0.505, OFF, 0)), 0.005),
    # zero current and the loop open, both
    ("shut_off", {"after": "fault"}, ((0.5, ON, 0), (0.501, OFF, 15), (0.502, OFF, 8)), 0.002),
    ("shut_off", {"after": 0.5, "status": 0}, ((0.5, ON, 15), (0.501, OFF, 8), (0.502, OFF, 0)), 0.002),
    ("shut_off", {"after": 0.5, "status": 1}, ((0.5, ON, 15), (0.501, OFF, 8)), None),
    ("shut_off", {"after": 0.5, "events": LEFT}, ((0.5, ON, 15), (0.505, ON, 15)), 0.01),
    ("shut_off", {"after": 0.5, "events": LEFT}, ((0.5, ON, 15), (0.52, ON, 15)), None),
    ("recovers", {}, ((0.9, ON, 15), (1.0, OFF, 0), (1.001, OFF, 8), (1.002, ON, 15), (1.003, ON, 15)), 0.002),
    ("recovers", {}, ((1.0 - 1e-9, ON, 15), (1.001, ON, 15)), 0.0),  # times come from ns
    ("recovers", {}, ((1.0, ON, 15), (1.2, OFF, 0)), None), ("recovers", {}, ((0.9, ON, 15),), None),
])
def test_time_until_the_controller_is_off_or_active_again(kind: str, keys: dict[str, Any], frames: Drives,
                                                          seconds: float | None) -> None:
    run, sections = follower(Hold(time=1.0))
    drives = DriveFrames(*(np.array(column) for column in zip(*frames, strict=True)))
    result = judged(run, sections, kind, drives=drives, **keys)
    assert isnan(result.value) if seconds is None else result.value == pytest.approx(seconds)
    assert seconds is not None or "did not say zero current" in result.detail or "not ACTIVE" in result.detail


def test_a_guard_trips_after_enough_cycles_in_a_row() -> None:
    guard = Guard(name="far", signal="xj", high=10.0, unit="mm", cycles=3)
    watch = GuardWatch([Guard(name="other", signal="p12", low=-1.0, high=1.0), guard])
    values = [0.011, 0.011, 0.0, 0.011, float("nan"), 0.011, 0.011]
    assert [watch.find_passed({"xj": x}) for x in values] == [None] * 6 + [guard]
    assert GuardWatch([]).find_passed({"xj": 1e9}) is None


ON_TIME = [Heartbeat(0.1 * k) for k in range(10)]
SLOW = [Heartbeat(0.2 * k) for k in range(5)]
LATE = [Heartbeat(0.15 * k, 0.06) for k in range(6)]  # the rig stood still before it took them in


@pytest.mark.parametrize(("beats", "deaf", "passes"), [
    (ON_TIME, 0.0, [True]), (SLOW, 0.0, [False]), ([], 0.0, [False]), (ON_TIME[:1], 0.0, [False]), (LATE, 0.0, []),
    ([*ON_TIME[:5], Heartbeat(0.62, 0.12), *ON_TIME[7:]], 0.0, [True]),  # one stall
    ([*SLOW, Heartbeat(0.95, 0.3)], 0.0, [False]),  # a stall is no excuse for the other heartbeats
    ([Heartbeat(0.1 * k - 1.0) for k in range(10)], 0.0, [False]),  # silent for the last 1.1 s
    ([], 0.5, [False]), ([], 0.8, []),  # s in which the rig received nothing: most of the run
])
def test_heartbeats_that_waited_for_the_rig_are_not_judged(beats: list[Heartbeat], deaf: float, passes: list[bool]
                                                           ) -> None:
    rows = Rows(*[np.zeros(5)] * 7, on_time=np.ones(5, bool))
    record = ProtocolRecord(run=rows, heartbeats={"controller": beats, "plant": SLOW}, heartbeat_periods={"plant": 0.2},
                            heard=(0.0, 1.0), deaf=deaf, drive_limit=8e-3)
    checks = judge_protocol(record, ProtocolLimits())[0]
    assert [check.passed for check in checks if check.signal == "heartbeat"] == [*passes, *([] if deaf else [True])]


@pytest.mark.parametrize(("frozen", "limit", "flags", "is_found"), [
    (2e-4, 8e-3, Flags(0), True),  # it is also the largest current of the run
    (8e-3, 8e-3, Flags(0), False),  # at the limit it says it has
    (2e-4, None, Flags(0), False),  # a controller that does not say its limit may have this one
    (2e-4, 8e-3, Flags.DRIVE_MISSING, False),  # no frame came: the last current stays, and another check counts them
])
def test_a_current_that_stands_still_below_the_limit_is_found(
    frozen: float, limit: float | None, flags: Flags, is_found: bool
) -> None:
    cycles = 100
    error = np.linspace(0.0, 1e-3, cycles)
    current = np.where(np.arange(cycles) < 50, 1e-5 * np.sin(np.arange(cycles)), frozen)
    zero, words = np.zeros(cycles), np.full(cycles, 15.0)
    rows = Rows(demand=error, position=zero, drive=current, control=words, status=words,
                flags=np.full(cycles, int(flags)), response=zero, on_time=np.ones(cycles, bool))
    assert (measure_frozen(rows, limit) > 4e-4) == is_found


def measure_at(rate: float, kind: str, **keys: Any) -> float:
    """What a check says of a well-known motion: a step of second order, a ramp, and a sine that lags by 200 deg."""
    t = np.arange(round(3.0 * rate)) / rate
    com = np.select([t < 0.2, t < 1.0, t < 2.0], [0.0, 5e-3, 5e-3 - 5e-3 * (t - 1.0)], 1e-3 * np.sin(4 * pi * t))
    after, wd = np.maximum(t - 0.2, 0.0), 30.0 * sqrt(0.75)
    step = 5e-3 * (1 - np.exp(-15.0 * after) * (np.cos(wd * after) + 15.0 / wd * np.sin(wd * after)))
    xj = np.select([t < 1.0, t < 2.0], [step, com + 1e-4], 0.8e-3 * np.sin(4 * pi * t - pi / 0.9))
    edges = {name: slice(round(a * rate), round(b * rate))
             for name, a, b in (("step", 0.2, 1.0), ("ramp", 1.1, 2.0), ("sine", 2.0, 3.0))}
    [result] = evaluate_checks([check(kind, **keys)], make_run(com, xj, rate), edges, rate=rate)
    assert result.detail == "" and result.t1 == pytest.approx(edges[keys["window"]].stop / rate)
    return result.value


@pytest.mark.parametrize("rate", [2000.0, 1000.0, 500.0, 200.0, 100.0, 1e9 / 3e6])
@pytest.mark.parametrize(("kind", "keys", "truth", "cycles"), [
    ("overshoot", {"window": "step"}, 100 * exp(-pi / sqrt(3)), 0),
    ("rise_time", {"window": "step"}, 0.0546, 1),
    ("settling_time", {"window": "step", "band": 5.0}, 0.1764, 1),
    ("response_within", {"window": "step", "after": 0.2, "signal": "xj", "above": 2.5e-3}, 0.0431, 1),
    ("ramp_error", {"window": "ramp"}, 1e-4, 0),
    ("never_exceeds", {"window": "ramp", "signal": "speed"}, 5e-3, 0),
    ("amplitude_ratio", {"window": "sine", "frequency": 2.0}, 0.8, 0),
    ("phase_lag", {"window": "sine", "frequency": 2.0}, 200.0, 0)])
def test_a_check_measures_the_same_at_any_rate(rate: float, kind: str, keys: dict[str, Any], truth: float,
                                               cycles: int) -> None:
    """But for what one sample can miss: `cycles` of time, or the curve of a peak."""
    peak = {"overshoot": 100 * (30.0 / rate) ** 2 / 2 + 0.1}.get(kind, 1e-9)
    assert measure_at(rate, kind, **keys) == pytest.approx(truth, abs=cycles / rate + peak + 0.002 * truth)


SIZE, FINE = 1e-3, 25  # m, of the step; instants of the true motion for each sample
DAY = datetime.date(2026, 3, 1), datetime.date(2027, 3, 1)


def calibrate(u: float = 5e-6, distribution: str = "normal", gain: float = 2e-3, noise: float = 0.0) -> Metrology:
    calibration = SensorCalibration("xj", "m", "K-118", *DAY, u, distribution, gain, noise)
    return Metrology("guarded", {"xj": calibration}, {"xj": 1e-6})


def test_a_count_is_that_of_the_signals_own_field() -> None:
    """Unused bits of a frame have no name, as most signals have no alias; they count 1."""
    bench = load_bench(str(ROOT / "examples/cia402_drive/ema.toml"))
    counts = uncertainty.collect_metrology(bench, bench.signals, None, 0).counts
    assert (counts["current_demand"], counts["position"], counts["motor_speed"]) == (0.02, 0.0, 0.0)


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
    "never_exceeds speed": ({"signal": "speed"}, 0.0, lambda x: float(np.diff(x).max()) * FINE * 1e3),
    "response_within": ({"after": 0.0, "signal": "xj", "above": 0.8e-3}, 1e-6, lambda x: first(x > 0.8e-3)),
}


@pytest.mark.parametrize("kind", CASES)
def test_the_interval_covers_the_truth_as_often_as_it_says(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """95 % of 60 units, each with sensor errors of its own: fewer than 85 % have a chance of 1 in 2000."""
    monkeypatch.setattr(uncertainty, "DRAWS", 60)
    keys, noise, find_truth = CASES[kind]
    check = checks.KEYS[kind.split()[0]](kind=kind.split()[0], name=kind, high=1e9, **keys)
    metrology, errors, uncertainties = calibrate(noise=noise), [], []
    for seed in range(60):
        random = np.random.default_rng(seed)
        omega, damping = random.uniform(80, 120), random.uniform(0.3, 0.5)
        t = np.arange(400 * FINE) / FINE / 1e3
        wd = omega * sqrt(1 - damping**2)
        x = SIZE * (1 - np.exp(-damping * omega * t) * (np.cos(wd * t) + damping * omega / wd * np.sin(wd * t)))
        readings = x[::FINE] * (1 + 2e-3 * random.normal()) + 5e-6 * random.normal() + noise * random.normal(size=400)
        result = check.judge(RunData(make_run(SIZE, np.round(readings / 1e-6) * 1e-6), metrology=metrology))
        errors.append(result.value - find_truth(x))
        uncertainties.append(result.uncertainty)
    # nor is it a blanket
    assert np.mean(np.abs(errors) <= uncertainties) >= 0.85 and np.median(uncertainties) < 5 * np.std(errors)


@pytest.mark.parametrize("distribution", WIDTHS)
def test_a_mean_has_the_uncertainty_of_its_sensor_whatever_the_distribution(distribution: str) -> None:
    check = checks.KEYS["steady_error"](kind="steady_error", name="mean", high=1.0, unit="um")
    run = RunData(make_run(SIZE, np.full(500, SIZE - 100e-6)), metrology=calibrate(5e-6, distribution, gain=0.0))
    result = check.judge(run)
    assert result.value == pytest.approx(100.0) and not result.detail
    assert result.uncertainty == pytest.approx(2 * sqrt(5**2 + 1 / 12), rel=0.03)


def test_without_a_calibration_the_uncertainty_is_unknown_and_exact_numbers_have_none() -> None:
    def judge(kind: str, **keys: Any) -> CheckResult:
        run = RunData(make_run(0.0, np.zeros(100)), metrology=Metrology("guarded"))
        return checks.KEYS[kind](**{"kind": kind, "name": kind, "high": 1.0, **keys}).judge(run)

    unknown = judge("never_exceeds", signal="xj")
    assert (unknown.verdict, unknown.detail) == ("CANNOT_TELL", "no calibration of xj")
    assert np.isnan(unknown.uncertainty)
    for exact in (judge("never_exceeds", signal="com"), judge("event_never", event="load", high=0.0)):
        assert (exact.verdict, exact.uncertainty) == ("PASS", 0.0)


@pytest.mark.parametrize(("position", "verdict"), [
    (0.996e-3, "CANNOT_TELL"), (1.004e-3, "CANNOT_TELL"), (1.1e-3, "PASS"), (0.9e-3, "FAIL")])
def test_a_level_that_only_the_errors_of_the_sensor_pass_is_open(position: float, verdict: str) -> None:
    check = checks.KEYS["response_within"](kind="response_within", name="level", signal="xj", above=1e-3, after=0.0,
                                           high=1.0)
    assert check.judge(RunData(make_run(SIZE, np.full(100, position)), metrology=calibrate())).verdict == verdict


@pytest.mark.parametrize(("decision", "value", "low", "high", "u", "verdict"), [
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
                        verdict: bool | None) -> None:
    assert decide(value, low, high, u, decision) is verdict


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
    return write_file(folder / "rig.toml", (ROOT / "rig/benches/eha.toml").read_text() + calibration)


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
    assert message in catch_refusal(load_bench, str(write_bench(tmp_path, CALIBRATION.replace(old, new))))


def test_a_run_says_it_everywhere(tmp_path: Path) -> None:
    """U and the open verdict stand in JSON, terminal, page, log and JUnit; a calibration that has expired is said."""
    text = SHORT.replace("high = 30.0 }", "high = 20.0, requirement = 'REQ-1' }").replace(
        "event = \"EMCY\" },", "event = \"EMCY\" },\n{name = 'pressure', kind = 'never_exceeds', signal = 'p12', "
        "high = 400, unit = 'bar'}")
    sequence = write_file(tmp_path / "short.toml", text)
    bench = write_bench(tmp_path, CALIBRATION.replace("gain = 1e-3", "gain = 0.5"))
    result = rig("run", sequence, "--bench", bench, "--out", tmp_path / "run", "--junit", tmp_path / "j.xml", "--json")
    answer = result.json
    _, none, pressure = answer["checks"][:3]
    assert (result.status, answer["verdict"], answer["decision"]) == (1, "CANNOT_TELL", "guarded")
    assert answer["why"] == "too uncertain for a verdict: overshoot; calibration of p12 expired on 2021-03-01"
    assert pressure["verdict"] == "PASS" and pressure["detail"] == "calibration of p12 expired on 2021-03-01"
    assert pressure["uncertainty"] == pytest.approx(2 * 0.2 / sqrt(3), rel=0.05) and none["uncertainty"] == 0.0
    assert answer["calibration"]["p12"] == {
        "signal": "p12", "unit": "Pa", "identifier": "P 12", "date": "2020-03-01", "expiry": "2021-03-01", "gain": 0.0,
        "u": pytest.approx(0.2e5 / sqrt(3)), "distribution": "rectangular", "noise": 0.0,
        "problem": "calibration of p12 expired on 2021-03-01"}
    trace = Trace.read(tmp_path / "run", all=True)
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


DRIVE, ECU = (load_bench(str(ROOT / "examples" / name / "bench.toml")) for name in ("cia402_drive", "can_ecu"))
# What a run sends, and what a sound drive answers: a control word, a status word and a current, for some cycles.
ENABLED = [(0x06, 0x0231, 0.0, 3), (0x07, 0x0233, 0.0, 3), (0x0F, 0x1237, 1e-3, 50)]
SOUND = [*ENABLED, (0x00, 0x0250, 0.0, 20)]


def make_rows(parts: list[tuple[int, int, float, int]]) -> Rows:
    columns = [np.repeat([part[i] for part in parts], [part[3] for part in parts]).astype(float) for i in range(3)]
    zero = np.zeros(len(columns[0]))
    return Rows(demand=zero, position=zero, drive=columns[2], control=columns[0], status=columns[1], flags=zero,
                response=zero, on_time=np.ones(len(zero), bool))


def judge(rows: Rows, bench: Bench, limits: ProtocolLimits | None = None,
          ) -> tuple[dict[str, CheckResult], dict[str, str]]:
    record = ProtocolRecord(run=rows, bench=bench, drive_limit=8e-3)
    checks, skipped_checks = judge_protocol(record, limits or ProtocolLimits())
    return {check.name: check for check in checks}, {check.name: check.reason for check in skipped_checks}


@pytest.mark.parametrize(("unsound", "missing", "is_passed"), [(0, None, True), (1, None, False), (1, 0.1, True)])
def test_checksums_and_alive_counters_are_judged(unsound: int, missing: float | None, is_passed: bool) -> None:
    record = ProtocolRecord(run=make_rows(SOUND), bench=ECU, unsound=unsound)
    checks = {each.name: each for each in judge_protocol(record, ProtocolLimits(missing=missing))[0]}
    assert checks["wrong checksums and alive counters"].passed is is_passed


STATES, FOLLOWS, IDLE = ("status word follows the states of CiA 402", "status word follows the control word",
                         "no current unless Operation enabled")


@pytest.mark.parametrize(("parts", "failures"), [
    (SOUND, set()),
    ([(0x06, 0x0250, 0.0, 100), *SOUND[1:]], set()),  # READY was between two frames
    ([(0x06, 0x0250, 0.0, 100), *SOUND], set()),  # a slow drive
    ([(0x06, 0x0250, 0.0, 600), *SOUND], {FOLLOWS}),  # too slow
    ([(0x0F, 0x1237, 1e-3, 50)], {STATES, IDLE}),  # enabled by itself, never without current
    ([*ENABLED, (0x00, 0x1237, 1e-3, 600)], {FOLLOWS, IDLE}),  # ignores Disable voltage
    ([*ENABLED, (0x00, 0x0250, 1e-3, 600)], {IDLE}),  # says so, and lets the current flow
    ([*ENABLED, (0x00, 0x0250, 1e-5, 600)], {IDLE}),
    ([*ENABLED, (0x0F, 0x0218, 0.0, 10), (0x00, 0x0218, 0.0, 5), (0x80, 0x0250, 0.0, 5), *SOUND], set()),  # a fault
    ([*ENABLED, (0x0F, 0x0218, 0.0, 10), (0x0F, 0x0250, 0.0, 5)], {STATES}),  # which ends without a reset
    ([*ENABLED, (0x02, 0x0217, 1e-3, 30), (0x02, 0x0250, 0.0, 5)], set()),  # quick stop, with an automatic end
    ([(0x00, 0x0210, 0.0, 5), (0x06, 0x0250, 0.0, 5), *SOUND], set()),  # it initialises itself first
    ([*ENABLED, (0x0F, 0x0220, 0.0, 5)], {STATES}),  # a word that the profile does not have
])
def test_a_drive_is_held_against_the_state_machine(parts: list[tuple[int, int, float, int]],
                                                   failures: set[str]) -> None:
    checks, _ = judge(make_rows(parts), DRIVE)
    assert {name for name in (STATES, FOLLOWS, IDLE) if not checks[name].passed} == failures


@pytest.mark.parametrize(("before", "is_passed"), [(ENABLED, True), ([(0x0F, 0x1237, 0.0, 5)], False)])
def test_the_cycles_in_which_a_drive_is_enabled_are_judged_with_the_run(before: list[tuple[int, int, float, int]],
                                                                        is_passed: bool) -> None:
    """They come before the run, whose first row finds the drive enabled."""
    record = ProtocolRecord(run=make_rows([(0x0F, 0x1237, 1e-3, 50)]), enabling=[(0, make_rows(before))], bench=DRIVE,
                            drive_limit=8e-3)
    verdicts = {check.name: check.passed for check in judge_protocol(record, ProtocolLimits())[0]}
    assert verdicts[STATES] is is_passed


def test_a_small_current_may_be_allowed_when_idle() -> None:
    rows = make_rows([*ENABLED, (0x00, 0x0250, 1e-5, 600)])
    assert judge(rows, DRIVE, ProtocolLimits(idle_current=2e-5))[0][IDLE].passed


def test_a_controller_that_is_switched_off_by_phase_sends_no_current() -> None:
    def largest(currents: list[float], offset: bytes = b"0") -> CheckResult:
        parts = [(word, 0, current, 100) for word, current in zip((2, 3, 2), currents, strict=True)]
        files = {name: data.replace(b"(0.001,0)", b"(0.001,%s)" % offset) for name, data in ECU.files.items()}
        return judge(make_rows(parts), load_bench_from_files(files))[0]["no current unless enabled"]

    assert largest([0.0, 1e-3, 0.0]).passed and largest([4e-7, 1e-3, 4e-7], offset=b"0.0004").passed
    assert not largest([1e-3, 1e-3, 0.0]).passed and not largest([0.0, 1e-3, 1e-3]).passed
    for word, bench in ((0, replace(ECU, phases={})), (3, ECU)):  # nothing can disable it, or nothing does in this run
        assert "no current unless enabled" in judge(make_rows([(word, 0, 1e-3, 100)]), bench)[1]


@pytest.mark.parametrize(("bench", "names"), [
    (DRIVE, {"drive frames of another cycle", "heartbeat period, controller", "undocumented EMCY codes"}),
    (ECU, {"drive frames of another cycle", "same answers after a reset", "heartbeat period, controller",
           "undocumented EMCY codes", "status word follows the control word"})], ids=["drive", "ECU"])
def test_what_does_not_apply_is_named_with_its_reason_and_is_no_check(bench: Bench, names: set[str]) -> None:
    checks, reasons = judge(make_rows(SOUND), bench)
    assert set(reasons) == names and all(reasons.values()) and not set(checks) & set(reasons)
