"""Commands as data: what each segment does, that they join up, and what a bad one is told."""
from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from places import SHARED

from plant.errors import InputError
from plant.profile import build_profile, parse_columns, read_command, resample_on_cycles
from plant.segments import KINDS, Chirp, Csv, Hold, Multisine, Points, Ramp, Segment, Sine, Step

PRACTICE = SHARED / "practice/00/est.csv.gz"
PREFLIGHT = (
    Hold(time=0.5), Step(to=5e-3, time=1.0), Step(to=0.0, time=1.0), Step(to=1e-3, time=0.75), Step(to=0.0, time=0.75),
    Ramp(to=1e-3, time=2.0), Hold(time=0.5), Ramp(to=0.0, time=2.0), Hold(time=0.5),
    Sine(amplitude=3e-3, frequency=1.0, time=2.0), Chirp(amplitude=1e-3, f0=1.0, f1=20.0, fade=20.0, time=2.0),
    Hold(time=0.5),
)
ONE_OF_EACH: tuple[Segment, ...] = (
    Hold(time=0.1), Step(to=1e-3, time=0.1), Ramp(to=-1e-3, time=0.1), Sine(amplitude=1e-3, frequency=3.0, time=0.1),
    Chirp(amplitude=1e-3, f0=1.0, f1=9.0, time=0.1), Multisine(amplitude=1e-3, frequencies=(1.0, 7.0), time=0.1),
    Points(points=((0.05, 1e-3), (0.1, 0.0))), Csv(file="c.csv", values=(0.0, 1e-3, 2e-3)),
)


@pytest.mark.skipif(not PRACTICE.exists(), reason="no ../shared: no independent preflight to compare with")
def test_preflight_is_the_command_of_the_practice_traces() -> None:
    expected = read_command(PRACTICE).com
    command = build_profile(PREFLIGHT).command
    assert command.shape == expected.shape == (13_500,)
    np.testing.assert_allclose(command, expected, rtol=5e-9, atol=1e-17)  # the file has nine digits


def test_preflight_follows_the_formulas_of_physics_section_4() -> None:
    command, sections, end = build_profile(PREFLIGHT)
    t = np.arange(2000) / 1000
    chirp = 1e-3 * np.sin(2 * np.pi * (t + 4.75 * t**2)) * (1 - np.exp(-20 * t))
    np.testing.assert_allclose(command[11_000:13_000], chirp, atol=1e-16)
    np.testing.assert_allclose(command[4000:6000], 0.5e-3 * t, atol=1e-18)
    assert (command[[499, 500, 1499, 1500, 2500, 3250]] == [0, 5e-3, 5e-3, 0, 1e-3, 0]).all()
    assert sections[1] == ("step_2", "step", 500, 1500)
    assert sections[-1].stop == len(command)
    assert end == 0.0 and (command[13_000:] == 0).all()  # whole periods end exactly where they began


@pytest.mark.parametrize("segment", ONE_OF_EACH, ids=lambda s: s.kind)
def test_every_kind_has_its_length_and_its_section(segment: Segment) -> None:
    profile = build_profile([replace(segment, name="it")], start=2e-3)
    assert profile.sections == (("it", segment.kind, 0, round(segment.duration * 1000)),)
    assert len(profile.command) == profile.sections[0].stop
    assert np.isfinite(profile.command).all()
    assert {each.kind for each in ONE_OF_EACH} == set(KINDS)


@given(cycle_us=st.integers(100, 100_000), cycles=st.lists(st.integers(1, 300), min_size=1, max_size=5))
def test_a_profile_is_as_long_as_its_segments_at_any_rate(cycle_us: int, cycles: list[int]) -> None:
    rate = 1e9 / (1000 * cycle_us)
    segments = [Ramp(to=float(k % 7) / 7, time=n * cycle_us / 1e6) for k, n in enumerate(cycles)]
    command, sections, end = build_profile(segments, 0.5, rate)
    assert [section.stop - section.start for section in sections] == cycles
    assert len(command) == sum(cycles) and sections[-1].stop == len(command)
    assert command[0] == 0.5 and abs(end - (len(cycles) - 1) % 7 / 7) < 1e-12


@pytest.mark.parametrize("rate", [2000.0, 500.0, 200.0, 100.0])
@pytest.mark.parametrize("segment", ONE_OF_EACH, ids=lambda s: s.kind)
def test_a_demand_is_the_same_function_of_time_at_any_rate(segment: Segment, rate: float) -> None:
    if isinstance(segment, Csv):
        segment = Csv(file="c.csv", values=tuple(np.arange(100) * 1e-5))
    fine, coarse = (build_profile([segment], 2e-3, most) for most in (max(rate, 1000.0), min(rate, 1000.0)))
    every = round(max(rate, 1000.0) / min(rate, 1000.0))
    np.testing.assert_allclose(coarse.command, fine.command[::every], rtol=1e-12, atol=1e-17)
    assert abs(coarse.end - fine.end) < 1e-15


@pytest.mark.parametrize("kind", ["hold", "ramp", "sine", "chirp", "multisine", "points"])
def test_a_segment_starts_from_the_last_demand(kind: str) -> None:
    segment = next(s for s in ONE_OF_EACH if s.kind == kind)
    assert build_profile([segment], start=7e-3).command[0] == 7e-3
    after_ramp = build_profile([Ramp(to=2e-3, time=0.01), replace(segment, name="it")])
    assert after_ramp.command[10] == 2e-3  # not 1.8e-3, the ramp's last sample


def test_schroeder_phases_keep_the_crest_low() -> None:
    lines = tuple(float(n) for n in range(1, 32))
    schroeder = Multisine(amplitude=1.0, frequencies=lines, time=1.0, fade=0.0)
    aligned = replace(schroeder, phases=(np.pi / 2,) * len(lines))

    def crest(segment: Segment) -> float:
        wave = build_profile([segment]).command
        return float(np.abs(wave).max() / np.sqrt(np.mean(wave**2)))

    assert crest(schroeder) < 2.0 < 7.0 < crest(aligned)


def test_csv_files_are_read_resampled_and_shifted_to_their_first_row() -> None:
    exact = parse_columns(b"t,com,xj\n4.000,0,9\n4.001,1e-3,9\n4.002,2e-3,9\n", "c.csv")
    assert exact.keys() == {"com"} and exact["com"].tolist() == [0.0, 1e-3, 2e-3]
    coarse = parse_columns(gzip.compress(b"t,value\n0,0\n0.004,4\n"), "c.csv.gz")
    np.testing.assert_allclose(coarse["value"], [0, 1, 2, 3, 4])


RAMP = 0.5 * np.arange(40) / 1000  # 0.5 m/s in rows of 1 ms
STEP = np.r_[np.zeros(21), np.ones(19)]


@pytest.mark.parametrize(("period", "cycles"), [(0.0005, 80), (0.001, 40), (0.0015, 27), (0.002, 20), (0.004, 10)])
def test_samples_hold_on_another_period_and_the_seconds_stay(period: float, cycles: int) -> None:
    t = 3.0 + np.arange(40) / 1000
    ramp, step = resample_on_cycles(t, RAMP, period), resample_on_cycles(t, STEP, period)
    at = np.arange(cycles) * period
    np.testing.assert_allclose(ramp, 0.5 * np.floor(at * 1000 + 1e-6) / 1000, atol=1e-15)
    assert step.tolist() == [float(x > 0.0209) for x in at]  # nothing between 0 and 1


@pytest.mark.parametrize("period", [0.0005, 0.002, 0.01])
def test_rows_at_the_models_period_are_taken_as_they_are(period: float) -> None:
    values = np.random.default_rng(0).standard_normal(1001)
    assert (resample_on_cycles(np.round(7.0 + np.arange(1001) * period, 6), values, period) == values).all()


@pytest.mark.parametrize(("t", "values", "period", "expected"), [
    ([0.0, 0.004, 0.005], [0.0, 4.0, 9.0], 0.002, [0, 2, 4]), ([5.0], [3.0], 0.002, [3.0]),
    ([0.0, 0.004, 0.005], [0.0, 4.0, 9.0], 0.001, [0, 1, 2, 3, 4, 9])])
def test_breakpoints_are_joined_by_lines_and_one_row_is_one_cycle(t: list[float], values: list[float], period: float,
                                                                 expected: list[float]) -> None:
    assert resample_on_cycles(np.array(t), np.array(values), period).tolist() == expected


def test_read_command_gives_the_load_only_if_there_is_one(tmp_path: Path) -> None:
    file = tmp_path / "c.csv"
    file.write_text("\ufeffT, Com ,load\n0,1e-3,100\n\n0.001,2e-3,200\n", encoding="utf-8")
    command = read_command(file)
    assert command.load is not None
    assert command.com.tolist() == [1e-3, 2e-3] and command.load.tolist() == [100.0, 200.0]
    file.write_text("t,com\n0,1\n")
    assert read_command(file).load is None


@pytest.mark.parametrize(("text", "message"), [
    ("", "c.csv: line 1: expected a header with a column t and commas between columns"),
    ("t;com\n0;1\n", "c.csv: line 1: expected a header with a column t and commas between columns"),
    ("t,xj\n0,1\n", "c.csv: line 1: expected a header with the columns t and com"),
    ("t,com\n", "c.csv: line 2: expected at least one row below the header"),
    ("t,com\n0,1\n0.001,one\n", "c.csv: line 3, com: expected a finite number, not 'one'"),
    ("t,com\n0,1\n0.001\n", "c.csv: line 3, com: expected a finite number, not ''"),
    ("t,com\n0,nan\n", "c.csv: line 2, com: expected a finite number, not 'nan'"),
    ("t,com\n0,1\n0.001,-5\n", "c.csv: line 3, com: expected at most 1 either way, not -5"),
    ("t,com,load\n0,0,1e7\n", "c.csv: line 2, load: expected at most 1e+06 either way, not 1e+07"),
    ("t,com\n0,1\n0,2\n", "c.csv: line 3, t: expected a time after 0 s, not 0"),
    ("t,com\n0,1\n10000,2\n", "c.csv: line 3, t: expected seconds, and at most 3600 of them, not 10000"),
])
def test_a_bad_file_is_refused_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "c.csv").write_text(text)
    with pytest.raises(InputError) as refusal:
        read_command(tmp_path / "c.csv")
    assert str(refusal.value) == f"{tmp_path}/{message}"


def test_what_is_no_csv_at_all_is_refused(tmp_path: Path) -> None:
    (tmp_path / "c.csv").write_bytes(b"\x1f\x8bnot gzip")
    for path in (tmp_path / "c.csv", tmp_path / "absent.csv", tmp_path):
        with pytest.raises(InputError, match="CSV"):
            read_command(path)


@pytest.mark.parametrize(("make", "key", "expected"), [
    (lambda: Hold(time=0.0), "time", "above 0 and at most 3600 s, not 0"),
    (lambda: Hold(time=float("nan")), "time", "at most 3600 s, not nan"),
    (lambda: build_profile([Hold(time=0.0105)]), "time", "whole cycles of 0.001 s, not 0.0105"),
    (lambda: build_profile([Hold(time=1e-3)], rate=500.0), "time", "whole cycles of 0.002 s, not 0.001"),
    (lambda: build_profile([Sine(amplitude=1.0, frequency=500.0, time=1.0)]), "frequency", "below 500 Hz"),
    (lambda: build_profile([Chirp(amplitude=1.0, f0=1.0, f1=60.0, time=1.0)], rate=100.0), "f1", "below 50 Hz, not 60"),
    (lambda: build_profile([Multisine(amplitude=1.0, frequencies=(1.0, 50.0), time=1.0)], rate=100.0), "frequencies",
     "below 50 Hz, not 50"),
    (lambda: Chirp(amplitude=1.0, f0=0.0, f1=1.0, time=1.0), "f0", "above 0"),
    (lambda: Chirp(amplitude=1.0, f0=1.0, f1=2.0, time=1.0, fade=-1.0), "fade", "0 or more"),
    (lambda: Multisine(amplitude=1.0, frequencies=(), time=1.0), "frequencies", "at least one"),
    (lambda: Multisine(amplitude=1.0, frequencies=(1.0, 2.0), phases=(0.0,), time=1.0), "phases", "2 phases"),
    (lambda: Points(points=((1.0, 0.0), (0.5, 0.0))), "points", "increasing"),
    (lambda: Points(points=()), "points", "pairs"),
    (lambda: build_profile([Hold(time=1.0, name="a"), Hold(time=1.0, name="a")]), "name", "used once"),
])
def test_an_impossible_segment_is_refused_by_key(make, key: str, expected: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InputError, match=expected) as refusal:
        make()
    assert refusal.value.field == key
