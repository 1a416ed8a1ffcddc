"""Shared memory between the writer of the log and the showing process, and what the latter makes of it."""
from __future__ import annotations

from math import isnan
from typing import Any

import numpy as np
import pytest

from rig.recorder import Check, Event, NmtState, Signals, Timing
from rig.sequences import load_sequence
from rig.view.live_feed import COLUMNS, MESSAGES, ROWS, LiveFeed, LiveReader, Message, make_shared_file
from rig.view.live_run import LiveRun, find_dead_node, make_live_plan
from rig.view.live_screen import describe_line, draw_screen


def add_cycle(feed: LiveFeed, k: int, xj: float = 0.0) -> None:
    feed.observe(k * 1_000_000, Signals(k, 1, 1e-3, xj, 2e-3, 3e5, 4e-6, 5.0, 7, 15, 0))
    feed.observe(k * 1_000_000, Timing(k, k % 10 == 0, 20e-6, 150e-6, 200e-6))


def test_rows_and_messages_arrive_once_and_in_order() -> None:
    with make_shared_file() as file:
        feed, reader = LiveFeed(file.fileno()), LiveReader(file.fileno())
        for k in range(100):
            add_cycle(feed, k, xj=k / 1e6)
        rows = reader.read_rows()
        assert rows.shape == (100, len(COLUMNS)) and len(reader.read_rows()) == 0
        assert dict(zip(COLUMNS, rows[30], strict=True)) == {
            "number": 30, "t_ns": 30e6, "phase": 1, "com": 1e-3, "xj": 30e-6, "cor": 2e-3, "p12": 3e5, "xs": 4e-6,
            "load": 5.0, "lateness": 20e-6, "response": 150e-6, "overrun": 1}
        feed.observe(5, NmtState(2, 5, "operational"))
        feed.observe(6, Event("INFO", "phase", "ä" * 5000))
        first, second = reader.read_messages()
        assert first == Message("NmtState", 5, {"node": 2, "code": 5, "name": "operational"})
        assert second.fields["text"] == "ä" * 60 and reader.read_messages() == []
        assert reader.lost == 0 and not reader.is_over
        feed.end()
        assert reader.is_over


def test_slow_reader_loses_the_oldest_and_counts_them() -> None:
    with make_shared_file() as file:
        feed, reader = LiveFeed(file.fileno()), LiveReader(file.fileno())
        for k in range(ROWS + 300):
            add_cycle(feed, k)
        assert reader.read_rows()[:, 0].tolist() == list(range(300, ROWS + 300)) and reader.lost == 300
        for number in range(MESSAGES + 7):
            feed.observe(number, Event("INFO", "phase", "main"))
        assert [message.t_ns for message in reader.read_messages()] == list(range(7, MESSAGES + 7))
        assert reader.lost == 307


def test_a_row_under_way_is_dropped() -> None:
    """The writer was interrupted within a row: its number is not the one that is due there."""
    with make_shared_file() as file:
        feed, reader = LiveFeed(file.fileno()), LiveReader(file.fileno())
        for k in range(10):
            add_cycle(feed, k)
        reader._ring[4, 0] = ROWS + 4
        assert reader.read_rows()[:, 0].tolist() == [0, 1, 2, 3, 5, 6, 7, 8, 9] and reader.lost == 1


def make_run(preflight: Any) -> tuple[LiveRun, np.ndarray, Any]:
    """A live run of preflight and all its rows, from the log of a run that has ended."""
    from fdi.trace.trace import Trace

    trace = Trace.read(preflight, all=True)
    rows = np.column_stack([np.arange(len(trace.t)), trace.t * 1e9, trace.phase, trace.com, trace.xj, trace.cor,
                            trace.p12, trace.xs, trace.load, np.zeros(len(trace.t)), np.full(len(trace.t), 1e-4),
                            np.zeros(len(trace.t))])
    return LiveRun(make_live_plan(load_sequence("preflight"), "lockstep")), rows, trace


def test_checks_turn_when_their_window_is_over(preflight: Any) -> None:
    run, rows, trace = make_run(preflight)
    final = {check.name: check for check in trace.checks}
    seen: dict[str, list[str]] = {name: [] for name in run.checks}
    main = int(np.argmax(rows[:, 2] == 1))
    for first in range(0, len(rows), 250):
        run.add_rows(rows[first:first + 250])
        run.judge_checks()
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


def test_a_limit_that_is_passed_fails_at_once(preflight: Any) -> None:
    run, rows, _ = make_run(preflight)
    rows = rows[:4000].copy()
    rows[2000, 4] = 7e-3  # mm: the limit of the position is 6 mm for all of main
    run.add_rows(rows)
    run.judge_checks()
    assert run.checks["position"].word == "FAIL" and run.checks["position"].value == pytest.approx(7.0)
    assert run.checks["pressure, unloaded"].word == "measures"


@pytest.mark.parametrize("size", [(80, 24), (60, 20), (200, 60)])
def test_screen_fits(preflight: Any, size: tuple[int, int]) -> None:
    run, rows, _ = make_run(preflight)
    run.add_message(Message("NmtState", 0, {"node": 2, "code": 5, "name": "operational"}))
    before = draw_screen(run, *size, silence=0.0).plain
    run.add_rows(rows[:3000])
    run.judge_checks()
    run.add_message(Message("Event", 0, {"level": "ERROR", "kind": "process",
                                         "text": "node 3 plant: its process was ended by SIGKILL"}))
    run.add_message(Message("Check", 0, {"name": "no emergency", "passed": False, "value": 2.0, "unit": "1",
                                         "detail": ""}))
    text = draw_screen(run, *size, silence=0.7).plain
    lines = text.split("\n")
    assert len(lines) <= size[1] and max(map(len, lines)) <= size[0]
    for words in ("node 2 controller operational", "node 3 plant      DEAD: its process was ended by SIGKILL",
                  "no new cycle for 0.7 s", "FAIL     no emergency 2", "measures", "lockstep: no cycle is late",
                  "response p50 100 p99 100", "overruns 0"):
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
        run.add_message(Message("Event", 0, {"level": level, "kind": "heartbeat", "text": text}))
        assert (3 in run.troubles) == (level == "ERROR")
    assert run.read_last("lateness", 10).tolist() == [] and isnan(run.t)
    assert "bring-up" in describe_line(run)


def test_check_record_ends_the_waiting() -> None:
    run = LiveRun(make_live_plan(load_sequence("preflight"), "lockstep"))
    check = Check(value=1.0, passed=True, name="slip speed", signal="xj", unit="mm/s")
    with make_shared_file() as file:
        feed, reader = LiveFeed(file.fileno()), LiveReader(file.fileno())
        feed.observe(0, check)
        for message in reader.read_messages():
            run.add_message(message)
    assert run.checks["slip speed"].word == "PASS" and run.checks["slip speed"].is_final
