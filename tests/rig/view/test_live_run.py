"""The log of a run as the showing process reads it while it is written, and what it makes of it."""
from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from math import isnan
from pathlib import Path

import numpy as np
import pytest
from synthetic_run import build_cycles, record_run

from fdi.trace.trace import Trace
from rig.recorder import Check, Event, NmtState, Record, Recorder, Signals, Timing
from rig.sequences import load_sequence
from rig.view.live_log import follow_log
from rig.view.live_process import show_live
from rig.view.live_run import COLUMNS, LiveRun, find_dead_node, make_live_plan
from rig.view.live_screen import describe_line, draw_screen


def test_every_record_arrives_once_and_in_order_while_the_log_grows(tmp_path: Path) -> None:
    """Also from a file that ends within a chunk, and nothing more when the log is whole."""
    whole = record_run(tmp_path / "whole.mcap", stop=1000).read_bytes()
    log, found = tmp_path / "trace.mcap", []
    log.write_bytes(whole[:4000])
    batches = follow_log(log)
    for cut in range(4000, len(whole) + 30_000, 30_000):
        log.write_bytes(whole[:cut])
        found += next(batches)
    assert next(batches) == []
    written = [record for _, _, *rows in build_cycles() if rows[0].cycle < 1000 for record in rows]
    assert list(map(repr, written)) == [repr(record) for _, record in found if isinstance(record, Signals | Timing)]
    trace = Trace.read(log, all=True)
    assert [record.text for _, record in found if isinstance(record, Event)] == [event.text for event in trace.events]
    assert {type(record) for _, record in found} == {Signals, Timing, Event, NmtState, Check}


def test_what_is_written_is_there_soon(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "trace.mcap", {}, {})
    batches, found = follow_log(tmp_path / "trace.mcap"), []
    recorder.put(5, NmtState(2, 5, "operational"))
    while not found:  # not only when the log is closed
        found = next(batches)
    recorder.close()
    assert found == [(5, NmtState(2, 5, "operational"))]


def test_a_log_that_comes_late_and_is_moved_is_read_on(tmp_path: Path) -> None:
    log = tmp_path / "trace.mcap"
    batches = follow_log(log)
    assert next(batches) == []
    whole = record_run(tmp_path / "whole.mcap", stop=1000).read_bytes()
    with log.open("wb", buffering=0) as file:
        file.write(whole[:-50_000])
        first = next(batches)
        log.rename(tmp_path / "moved.mcap")
        file.write(whole[-50_000:])
        second = next(batches)
    assert first and second and next(batches) == []
    assert sum(isinstance(record, Timing) for _, record in first + second) == 1000


def test_a_log_that_cannot_be_read_is_the_end(tmp_path: Path) -> None:
    (tmp_path / "trace.mcap").mkdir()
    assert list(follow_log(tmp_path / "trace.mcap")) == []


class LeavesFolder:
    """What the Python of a sequence may do where the plan arrives."""

    def __reduce__(self) -> tuple[Callable[[str], None], tuple[str]]:
        return os.chdir, ("/",)


def test_log_in_a_relative_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                  capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    record_run(Path("trace.mcap"), stop=1000)
    plan = make_live_plan(load_sequence("preflight"), "lockstep")
    with show_live(plan._replace(title=LeavesFolder()), Path("trace.mcap"), last_cpu_is_taken=False) as begin:
        begin()
    said = capfd.readouterr().err
    assert "Traceback" not in said and "live: 0.7 of 13.5 s" in said.splitlines()[-1]


Records = list[tuple[int, Record]]


def make_run(preflight: Path) -> tuple[LiveRun, Records, Trace]:
    """A live run of preflight and all its cycles, from the log of a run that has ended."""
    records = [(t_ns, record) for t_ns, record in next(follow_log(preflight / "trace.mcap"))
               if isinstance(record, Signals | Timing)]
    plan = make_live_plan(load_sequence("preflight"), "lockstep")
    return LiveRun(plan), records, Trace.read(preflight, all=True)


def add(run: LiveRun, records: Records) -> None:
    for t_ns, record in records:
        run.add(t_ns, record)
    run.judge_checks()


def test_checks_turn_when_their_window_is_over(preflight: Path) -> None:
    run, records, trace = make_run(preflight)
    final = {check.name: check for check in trace.checks}
    seen: dict[str, list[str]] = {name: [] for name in run.checks}
    main = int(np.argmax(trace.phase == 1))
    for first in range(0, len(records) // 2, 250):
        add(run, records[2 * first:2 * first + 500])
        for name, state in run.checks.items():
            if seen[name][-1:] != [state.word]:
                seen[name].append(state.word)
            check = final[name]
            if state.word == "PASS" and not np.isnan(check.t1):
                assert first + 250 >= main + round(1000 * check.t1) - 250, name
    assert seen["overshoot, 5 mm"] == seen["position"] == ["waits", "measures", "PASS"]
    for name, state in run.checks.items():
        assert state.word == ("PASS" if final[name].passed else "FAIL"), name
        np.testing.assert_allclose(state.value, final[name].value, rtol=1e-9, err_msg=name)


def test_a_limit_that_is_passed_fails_at_once(preflight: Path) -> None:
    run, records, _ = make_run(preflight)
    t_ns, signals = records[4000]
    records[4000] = t_ns, replace(signals, xj=7e-3)  # type: ignore[call-arg]  # the limit is 6 mm for all of main
    add(run, records[:8000])
    assert run.checks["position"].word == "FAIL" and run.checks["position"].value == pytest.approx(7.0)
    assert run.checks["pressure, unloaded"].word == "measures"
    assert run.read_rows_from(0).shape == (4000, len(COLUMNS)) and run.read_last("xj", 2000)[0] == 7e-3


EVENTS = """title = "Events"
setup = [{ kind = "hold", time = 0.02 }]
main = [{ name = "rest", kind = "hold", time = 0.1 }, { name = "more", kind = "hold", time = 0.1 }]
checks = [{ name = "begins", kind = "event_occurs", event = "phase main", window = "rest" },
          { name = "no fault", kind = "event_never", event = "fault early", window = "rest" },
          { name = "answer", kind = "response_within", event = "fault early", after = 0.0, high = 1, window = "rest" },
          { name = "first cycle", kind = "event_occurs", event = "guard first", window = "more" }]
"""


@pytest.mark.parametrize("begin_ns", [0, *range(1_800_000_000_000_000_000, 1_800_000_000_000_000_256, 51)])
def test_events_stand_at_their_cycle(begin_ns: int, tmp_path: Path) -> None:
    """Those written before the first row of main too, and whatever the log times: a float64 rounds ns since 1970."""
    (tmp_path / "events.toml").write_text(EVENTS)
    run = LiveRun(make_live_plan(load_sequence(tmp_path / "events.toml"), "lockstep"))
    words = {0: ("phase", "set-up"), 20: ("phase", "main"), 120: ("guard", "first")}
    for cycle in range(220):
        t_ns = begin_ns + cycle * 1_000_000
        if cycle in words:
            run.add(t_ns, Event("INFO", *words[cycle]))
        if cycle == 20:
            run.add(t_ns, Event("WARN", "fault", "early"))
        run.add(t_ns, Signals(cycle, int(cycle >= 20), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 7, 15, 0))
        run.add(t_ns, Timing(cycle, False, 0.0, 0.0, 0.0))
    run.judge_checks()
    assert [event.t for event in run.events] == [-0.02, 0.0, 0.0, 0.1] and run.t == 0.199
    assert [(state.word, state.value) for state in run.checks.values()] == [
        ("PASS", 1.0), ("FAIL", 1.0), ("PASS", 0.0), ("PASS", 1.0)]


@pytest.mark.parametrize("size", [(80, 24), (60, 20), (200, 60)])
def test_screen_fits(preflight: Path, size: tuple[int, int]) -> None:
    run, records, _ = make_run(preflight)
    run.add(0, NmtState(2, 5, "operational"))
    before = draw_screen(run, *size, silence=0.0).plain
    add(run, records[:6000])
    run.add(0, Event("ERROR", "process", "node 3 plant: its process was ended by SIGKILL"))
    run.add(0, Check(name="no emergency", passed=False, value=2.0, unit="1", signal=""))
    text = draw_screen(run, *size, silence=1.2).plain
    lines = text.split("\n")
    assert len(lines) <= size[1] and max(map(len, lines)) <= size[0]
    for words in ("node 2 controller operational", "node 3 plant      DEAD: its process was ended by SIGKILL",
                  "no new cycle in the log", "FAIL     no emergency 2", "measures", "lockstep: no cycle is late",
                  "response p50", "overruns 0"):
        assert words in text, words
    dots = sum(0x2800 < ord(letter) < 0x2900 for letter in text)
    assert dots > size[0] // 2 > sum(0x2800 < ord(letter) < 0x2900 for letter in before)
    assert "3 plant its process" not in describe_line(run) and "3 its process was ended" in describe_line(run)


def test_dead_node() -> None:
    assert find_dead_node("ERROR", "process", "node 2 controller: its process ended with exit status 1") == 2
    assert find_dead_node("ERROR", "heartbeat", "node 3 plant is silent") == 3
    assert find_dead_node("INFO", "heartbeat", "node 3 plant is heard") == 0
    assert find_dead_node("ERROR", "emcy", "node 3 plant 0x8250") == 0
    run = LiveRun(make_live_plan(load_sequence("preflight"), "realtime"))
    for level, text in (("ERROR", "node 3 plant is silent"), ("INFO", "node 3 plant is heard")):
        run.add(0, Event(level, "heartbeat", text))
        assert (3 in run.troubles) == (level == "ERROR")
    assert run.read_last("lateness", 10).tolist() == [] and isnan(run.t)
    assert "bring-up" in describe_line(run)


def test_check_record_ends_the_waiting() -> None:
    run = LiveRun(make_live_plan(load_sequence("preflight"), "lockstep"))
    run.add(0, Check(value=1.0, passed=True, name="slip speed", signal="xj", unit="mm/s"))
    assert run.checks["slip speed"].word == "PASS" and run.checks["slip speed"].is_final
