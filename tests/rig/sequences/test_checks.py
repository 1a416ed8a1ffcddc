"""Checks against signals whose numbers are known in closed form, and against signals that are not there."""
from __future__ import annotations

from dataclasses import dataclass, replace
from math import atan2, degrees, exp, isnan, log, pi, sqrt
from typing import Any

import numpy as np
import pytest

from plant.errors import InputError
from plant.profile import build_profile
from plant.segments import Array, Hold, Ramp, Segment, Sine, Step
from rig.sequences import checks, measures
from rig.sequences.checks import CheckResult, evaluate_checks
from rig.sequences.measures import NO_DRIVES, DriveFrames

NOISE = 2e-6  # m rms, as the position transducer has it
LAG = 0.01  # s, of the first-order follower
MICRON = 1e-6


@dataclass
class Run:
    """Columns like a Trace's."""

    t: Array
    com: Array
    xj: Array
    cor: Array | None = None
    p12: Array | None = None


@dataclass
class Event:
    t: float
    kind: str
    text: str


def noise(n: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).standard_normal(n) * NOISE


def second_order(damping: float, omega: float, size: float = 5e-3) -> tuple[Run, dict[str, slice]]:
    """The textbook answer of a second-order system to a step at 0.1 s, noise added."""
    command, sections, _ = build_profile([Hold(time=0.1, name="rest"), Step(to=size, time=1.0, name="step")])
    t = np.arange(len(command)) / 1000
    after = np.maximum(t - 0.1, 0)
    wd = omega * sqrt(1 - damping**2)
    answer = 1 - np.exp(-damping * omega * after) * (
        np.cos(wd * after) + damping / sqrt(1 - damping**2) * np.sin(wd * after))
    return Run(t, command, size * answer + noise(len(t))), {s.name: slice(s.start, s.stop) for s in sections}


def follower(*segments: Segment, tau: float = LAG) -> tuple[Run, dict[str, slice]]:
    """A first-order lag with unit gain, sampled exactly for a command held over each cycle, noise added."""
    command, sections, _ = build_profile(segments)
    x, out = 0.0, np.empty(len(command))
    for k, demand in enumerate(command):
        out[k] = x
        x = demand + (x - demand) * exp(-1e-3 / tau)
    run = Run(np.arange(len(command)) / 1000, command, out + noise(len(command)))
    return run, {s.name: slice(s.start, s.stop) for s in sections}


def check(kind: str, **keys: Any) -> checks.Check:
    keys = {"name": kind, "high": 1e9, **keys}
    return checks.KINDS[kind](**keys)


def judged(run: Run, sections: dict[str, slice], kind: str, events: tuple[Event, ...] = (),
           drives: DriveFrames = NO_DRIVES, **keys: Any) -> CheckResult:
    (result,) = evaluate_checks([check(kind, **keys)], run, sections, events, {"fault": 0.5}, drives)
    return result


@pytest.mark.parametrize("damping", [0.3, 0.5, 0.7])
@pytest.mark.parametrize("size", [5e-3, -1e-3])
def test_overshoot_of_a_second_order_step(damping: float, size: float) -> None:
    run, sections = second_order(damping, 120.0, size)
    expected = 100 * exp(-pi * damping / sqrt(1 - damping**2))
    assert judged(run, sections, "overshoot", window="step").value == pytest.approx(expected, abs=1.2)


def test_no_overshoot_of_a_first_order_step() -> None:
    run, sections = follower(Hold(time=0.1), Step(to=5e-3, time=0.5, name="step"))
    assert judged(run, sections, "overshoot", window="step").value < 0.2  # 3 sigma of the filtered noise
    assert judged(run, sections, "overshoot", window=(0.1, 0.6)).value < 0.2
    assert judged(run, sections, "rise_time", window="step").value == pytest.approx(LAG * log(9), abs=5e-4)
    settled = judged(run, sections, "settling_time", window="step", band=2.0).value
    assert settled == pytest.approx(LAG * log(50), abs=2e-3)


def test_settling_time_of_a_second_order_step() -> None:
    run, sections = second_order(0.5, 60.0)
    after = np.arange(0, 1, 1e-5)
    wd = 60 * sqrt(0.75)
    deviation = np.abs(np.exp(-30 * after) * (np.cos(wd * after) + 0.5 / sqrt(0.75) * np.sin(wd * after)))
    expected = after[np.flatnonzero(deviation > 0.02)[-1]]
    result = judged(run, sections, "settling_time", window="step", band=2.0, unit="ms")
    assert result.value == pytest.approx(expected * 1000, abs=2.0) and result.unit == "ms"


def test_a_step_in_the_first_cycle_counts_from_where_the_ram_is() -> None:
    run, sections = follower(Step(to=5e-3, time=0.5, name="step"))
    assert judged(run, sections, "rise_time", window="step").value == pytest.approx(LAG * log(9), abs=5e-4)


def test_ramp_error_is_rate_times_lag_in_either_direction() -> None:
    run, sections = follower(Hold(time=0.1), Ramp(to=1e-3, time=2.0, name="out"), Ramp(to=0.0, time=2.0, name="in"))
    for window in ("out", "in"):
        value = judged(run, sections, "ramp_error", window=window, skip=0.2, unit="um").value
        assert value == pytest.approx(0.5e-3 * (LAG + 0.5e-3) / MICRON, abs=0.35)  # half a cycle: the command is held


def test_break_away_is_half_the_band_of_a_triangle() -> None:
    command, sections, _ = build_profile([Ramp(to=1e-3, time=2.0, name="ramp")])
    t = np.arange(len(command)) / 1000
    triangle = 20e-6 * (2 * np.abs(2 * (t / 0.16 % 1) - 1) - 1)
    run = Run(t, command, command - 7e-6 - triangle + noise(len(t)))
    spans = {s.name: slice(s.start, s.stop) for s in sections}
    assert judged(run, spans, "break_away", window="ramp", unit="um").value == pytest.approx(20.0, abs=1.0)
    run.xj[500] += 1e-3  # one wild sample
    assert judged(run, spans, "break_away", window="ramp", unit="um").value == pytest.approx(20.0, abs=1.0)
    quiet = replace(run, xj=command + noise(len(t)))
    assert judged(quiet, spans, "break_away", window="ramp", unit="um").value < 4.0


def test_errors_of_a_known_offset() -> None:
    command = np.zeros(1000)
    run = Run(np.arange(1000) / 1000, command, command + 30e-6 + noise(1000))
    assert judged(run, {}, "steady_error", unit="um").value == pytest.approx(30, abs=0.3)
    assert judged(run, {}, "rms_error", unit="um").value == pytest.approx(sqrt(900 + 4), abs=0.3)
    assert judged(run, {}, "max_error", unit="um").value == pytest.approx(30, abs=6)
    assert judged(run, {}, "never_exceeds", signal="error", unit="um").value == np.abs(run.xj).max() / MICRON


@pytest.mark.parametrize("frequency", [1.0, 10.0])
def test_gain_and_phase_of_a_first_order_lag(frequency: float) -> None:
    run, sections = follower(Sine(amplitude=3e-3, frequency=frequency, time=2.0, name="sine"))
    zoh = exp(-1e-3 / LAG)
    z = np.exp(2j * pi * frequency / 1000)
    h = (1 - zoh) / (z - zoh)  # of the sampled lag
    keys: dict[str, Any] = {"window": "sine", "frequency": frequency, "skip": 0.5}
    assert judged(run, sections, "amplitude_ratio", **keys).value == pytest.approx(abs(h), abs=1e-3)
    assert judged(run, sections, "phase_lag", **keys).value == pytest.approx(-degrees(atan2(h.imag, h.real)), abs=0.1)


def test_speed_of_a_ramp() -> None:
    run, sections = follower(Ramp(to=10e-3, time=1.0, name="ramp"))
    result = judged(run, sections, "never_exceeds", signal="speed", window="ramp", skip=0.2, unit="mm/s")
    assert result.value == pytest.approx(10.0, abs=0.7)


def test_noise_through_the_median_is_what_its_docstring_says() -> None:
    assert np.std(measures.filter_median(noise(100_000))) == pytest.approx(1.1e-6, abs=0.05e-6)
    assert np.std(measures.compute_speed(noise(100_000))) == pytest.approx(0.14e-3, abs=0.01e-3)


def test_response_to_a_fault_by_event_and_by_signal() -> None:
    run, sections = follower(Hold(time=0.6), Step(to=1e-3, time=0.4))
    events = (Event(0.1, "EMCY", "node 3: 0x8250"), Event(0.503, "emcy", "0x8250 node 3"))
    value = judged(run, sections, "response_within", events, after="fault", event="EMCY 0x8250", unit="ms").value
    assert value == pytest.approx(3.0)
    value = judged(run, sections, "response_within", after=0.6, signal="xj", above=0.5e-3, unit="ms").value
    assert value == pytest.approx(1000 * LAG * log(2), abs=1.1)
    value = judged(run, sections, "response_within", after=0.55, signal="xj", below=1e-3).value
    assert value == 0.0


def test_events_are_counted_in_their_window() -> None:
    run, sections = follower(Hold(time=1.0))
    events = (Event(0.2, "EMCY", "0x8250"), Event(0.7, "EMCY", "0x8250"))
    assert judged(run, sections, "event_occurs", events, event="0x8250").value == 2
    assert not evaluate_checks([checks.EventOccurs(name="n", event="0x9999")], run, {})[0].passed
    assert evaluate_checks([checks.EventNever(name="n", event="emcy", window=(0.3, 0.6))], run, {}, events)[0].passed
    assert not evaluate_checks([checks.EventNever(name="n", event="emcy")], run, {}, events)[0].passed


def test_limits_decide() -> None:
    run = Run(np.arange(100) / 1000, np.zeros(100), np.full(100, 1e-3))
    cases = ((None, 1.1, True), (None, 0.9, False), (0.9, None, True), (1.1, None, False), (1.0, 1.0, True))
    for low, high, passed in cases:
        result = judged(run, {}, "max_error", low=low, high=high, unit="mm")
        assert result.passed is passed
        assert (isnan(result.low), isnan(result.high)) == (low is None, high is None)


def test_few_missing_samples_are_bridged_and_mentioned() -> None:
    run, sections = follower(Hold(time=0.1), Ramp(to=1e-3, time=2.0, name="ramp"))
    whole = judged(run, sections, "ramp_error", window="ramp").value
    run.xj[500:510] = np.nan
    result = judged(run, sections, "ramp_error", window="ramp")
    assert result.value == pytest.approx(whole, abs=0.1 * MICRON) and result.detail == "10 missing samples bridged"


def broken_runs() -> dict[str, tuple[Run, str]]:
    """What can be wrong with a run, and the word the detail has for it."""
    run, _ = follower(Hold(time=0.1), Step(to=1e-3, time=0.9))
    holes = replace(run, xj=np.where(np.arange(1000) % 2, run.xj, np.nan))
    return {
        "no position": (replace(run, xj=np.full(1000, np.nan)), "xj was not measured"),
        "holes": (holes, "samples of xj are missing"),
        "broken off": (Run(run.t[:50], run.com[:50], run.xj[:50]), "the run ended at 0.05 s"),
        "empty": (Run(run.t[:0], run.com[:0], run.xj[:0]), "the run ended at 0 s"),
    }


NEEDED: dict[str, dict[str, Any]] = {
    "settling_time": {"band": 5.0}, "never_exceeds": {"signal": "xj"}, "amplitude_ratio": {"frequency": 5.0},
    "phase_lag": {"frequency": 5.0}, "response_within": {"after": 0.1, "signal": "xj", "above": 1.0},
}


@pytest.mark.parametrize("kind", sorted(set(checks.KINDS) - {"event_occurs", "event_never", "shut_off", "recovers"}))
@pytest.mark.parametrize("fault", ["no position", "holes", "broken off", "empty"])
def test_what_cannot_be_measured_has_failed_and_says_why(kind: str, fault: str) -> None:
    run, reason = broken_runs()[fault]
    result = judged(run, {"step": slice(100, 1000)}, kind, window="step", **NEEDED.get(kind, {}))
    assert not result.passed and isnan(result.value) and reason in result.detail


@pytest.mark.parametrize(("kind", "keys", "reason"), [
    ("max_error", {"window": "nowhere"}, "no section 'nowhere'"),
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
    ("response_within", {"after": "no fault", "event": "EMCY"}, "no fault 'no fault'"),
    ("response_within", {"after": "fault", "event": "EMCY"}, "no event 'EMCY' after 0.5 s"),
    ("response_within", {"after": 0.1, "signal": "xj", "above": 9.0}, "never passed"),
    ("response_within", {"after": 7.0, "signal": "xj", "above": 9.0}, "empty"),
])
def test_reasons(kind: str, keys: dict[str, Any], reason: str) -> None:
    run, sections = follower(Hold(time=0.1), Step(to=1e-3, time=0.9, name="step"))
    result = judged(run, sections, kind, **keys)
    assert not result.passed and reason in result.detail


@pytest.mark.parametrize(("kind", "keys", "key", "expected"), [
    ("max_error", {"high": None}, "", "a low, a high, or both"),
    ("max_error", {"low": 2.0, "high": 1.0}, "high", "from low = 2 up"),
    ("max_error", {"unit": "bar"}, "unit", "'m', 'mm' or 'um', not 'bar'"),
    ("never_exceeds", {"signal": "p12", "unit": "mm"}, "unit", "'MPa'"),
    ("max_error", {"window": (2.0, 1.0)}, "window", "t0 < t1"),
    ("max_error", {"skip": -1.0}, "skip", "0 s or more"),
    ("max_error", {"skip": 1e300}, "skip", "at most 3600"),
    ("max_error", {"window": (0.0, 1e306)}, "window", "t1 <= 1e+06"),
    ("settling_time", {"band": 0.0}, "band", "above 0 and at most 100 %"),
    ("settling_time", {"band": -5.0}, "band", "above 0"),
    ("amplitude_ratio", {"frequency": 0.0}, "frequency", "above 0 and below 500 Hz"),
    ("phase_lag", {"frequency": -1.0}, "frequency", "above 0 and below 500 Hz"),
    ("phase_lag", {"frequency": 500.0}, "frequency", "above 0 and below 500 Hz"),
    ("event_never", {"event": " "}, "event", "at least one word"),
    ("response_within", {"after": -1.0, "event": "EMCY"}, "after", "0 to 1e+06 s"),
    ("response_within", {"after": 1e308, "event": "EMCY"}, "after", "0 to 1e+06 s"),
    ("response_within", {"after": 1.0}, "event", "either an event or a signal"),
    ("response_within", {"after": 1.0, "signal": "xj"}, "signal", "a level"),
])
def test_an_impossible_check_is_refused(kind: str, keys: dict[str, Any], key: str, expected: str) -> None:
    with pytest.raises(InputError) as refusal:
        check(kind, **keys)
    assert refusal.value.field == key and expected in refusal.value.expected


@pytest.mark.parametrize(("raised", "said"), [
    (ZeroDivisionError("float division by zero"), "the measure failed (ZeroDivisionError: float division by zero)"),
    (np.linalg.LinAlgError("SVD did not converge"), "the measure failed (LinAlgError: SVD did not converge)"),
    (OverflowError("too large"), "the measure failed (OverflowError: too large)"),
])
def test_a_measure_that_raises_has_failed(raised: Exception, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> float:
        raise raised

    run, sections = follower(Hold(time=0.1), Step(to=1e-3, time=0.9, name="step"))
    monkeypatch.setattr(measures, "measure_overshoot", broken)
    checks = [check("overshoot", window="step"), check("rise_time", window="step")]
    spoilt, sound = evaluate_checks(checks, run, sections)
    assert (spoilt.passed, isnan(spoilt.value), spoilt.detail) == (False, True, said)
    assert sound.passed


def test_a_measure_without_end_has_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    run, sections = follower(Hold(time=0.1), Step(to=1e-3, time=0.9, name="step"))
    monkeypatch.setattr(measures, "measure_overshoot", lambda *_: float("inf"))
    result = judged(run, sections, "overshoot", window="step", low=0.0, high=None)
    assert not result.passed and isnan(result.value) and result.detail == "the measure came to inf"


def drives(*frames: tuple[float, float, int]) -> DriveFrames:
    """Time, current and status word of drive frames."""
    t, current, status = (np.array(column) for column in zip(*frames, strict=True))
    return DriveFrames(t, current, status)


ON, OFF = 2e-3, 0.0  # A


@pytest.mark.parametrize(("frames", "expected"), [
    (((0.49, ON, 15), (0.5, ON, 15), (0.503, OFF, 0), (0.504, OFF, 0)), 0.003),
    (((0.5, ON, 15), (0.503, OFF, 0), (0.504, ON, 15), (0.505, OFF, 0)), 0.005),  # once is not for good
    (((0.5, ON, 0), (0.501, OFF, 15), (0.502, OFF, 8)), 0.002),  # zero current and the loop open, both
])
def test_time_until_the_controller_is_off(frames: tuple[tuple[float, float, int], ...], expected: float) -> None:
    run, sections = follower(Hold(time=1.0))
    result = judged(run, sections, "shut_off", after="fault", drives=drives(*frames))
    assert result.value == pytest.approx(expected)


def test_a_status_word_that_is_asked_for() -> None:
    run, sections = follower(Hold(time=1.0))
    frames = drives((0.5, ON, 15), (0.501, OFF, 8), (0.502, OFF, 0))
    assert judged(run, sections, "shut_off", after=0.5, status=0, drives=frames).value == pytest.approx(0.002)
    result = judged(run, sections, "shut_off", after=0.5, status=1, drives=frames)
    assert isnan(result.value) and "did not say zero current" in result.detail


def test_a_controller_that_left_operational_is_off() -> None:
    run, sections = follower(Hold(time=1.0))
    left = (Event(0.51, "nmt", "node 2 controller left OPERATIONAL: boot-up"),)
    frames = drives((0.5, ON, 15), (0.505, ON, 15))
    assert judged(run, sections, "shut_off", left, after=0.5, drives=frames).value == pytest.approx(0.01)
    later = drives((0.5, ON, 15), (0.52, ON, 15))
    assert isnan(judged(run, sections, "shut_off", left, after=0.5, drives=later).value)


def test_time_until_the_controller_is_active_again() -> None:
    run, sections = follower(Hold(time=1.0))
    frames = drives((0.9, ON, 15), (1.0, OFF, 0), (1.001, OFF, 8), (1.002, ON, 15), (1.003, ON, 15))
    assert judged(run, sections, "recovers", drives=frames).value == pytest.approx(0.002)
    for gone in (drives((1.0, ON, 15), (1.2, OFF, 0)), drives((0.9, ON, 15))):
        assert isnan(judged(run, sections, "recovers", drives=gone).value)
