"""The log of a run as the showing process reads it while it is written, and what it makes of it."""
from __future__ import annotations

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


@pytest.mark.parametrize("size", [(80, 24), (60, 20), (200, 60)])
def test_screen_fits(preflight: Path, size: tuple[int, int]) -> None:
    run, records, _ = make_run(preflight)
    run.add(0, NmtState(2, 5, "operational"))
    before = draw_screen(run, *size, silence=0.0).plain
    add(run, records[:6000])
    run.add(0, Event("ERROR", "process", "node 3 plant: its process was ended by SIGKILL"))
    run.add(0, Check(name="no emergency", passed=False, value=2.0, unit="1", signal=""))
    text = draw_screen(run, *size, silence=0.7).plain
    lines = text.split("\n")
    assert len(lines) <= size[1] and max(map(len, lines)) <= size[0]
    for words in ("node 2 controller operational", "node 3 plant      DEAD: its process was ended by SIGKILL",
                  "no new cycle for 0.7 s", "FAIL     no emergency 2", "measures", "lockstep: no cycle is late",
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
