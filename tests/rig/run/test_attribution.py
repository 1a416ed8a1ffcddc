"""First causes: scripted records of runs in which the rig, the plant or the controller was late, stopped or died."""
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from rig.network.codec import Flags
from rig.network.master import StartTime
from rig.network.node_objects import CONTROLLER, PLANT, RIG, CycleRecord
from rig.run.attribution import (
    Attribution,
    CycleRecords,
    Injected,
    Trouble,
    attribute,
    count_most_in_a_row,
    find_injected,
    find_start_problem,
)
from rig.run.runner import select_plant_delays
from rig.sequences.faults import Fault, Late, Lost, Offset, Plan, Schedule, Silent
from rig.sequences.timing import TimingPolicy

MS = 1_000_000  # ns
N = 1000
POLICY = TimingPolicy()
NAN = float("nan")


class Script:
    """The records of a run in which all is well, to be spoilt."""

    def __init__(self) -> None:
        self.lateness = np.full(N, 2e-5)
        self.feedback, self.valve, self.response = np.full(N, 1e-4), np.full(N, 1.1e-4), np.full(N, 2e-4)
        self.flags = np.zeros(N, dtype=np.int64)
        self.injected = np.zeros((3, N), dtype=bool)
        self.delay = np.full(N, 1e-5)
        self.troubles: list[Trouble] = []

    def lose_feedback(self, first: int, last: int = N) -> None:
        self.feedback[first:last] = self.valve[first:last] = NAN
        self.lose_drive(first, last)  # nothing to answer

    def lose_drive(self, first: int, last: int = N) -> None:
        self.response[first:last] = NAN
        self.flags[first + 1:last + 1] |= int(Flags.DRIVE_MISSING)

    def report(self, cycle: float, node: int, code: int, kind: str = "emcy", text: str = "") -> None:
        self.troubles.append(Trouble(round(cycle * MS), node, kind, code, text or f"node {node} 0x{code:04X}"))

    def attribute(self, gone: Mapping[int, str] | None = None, policy: TimingPolicy = POLICY) -> Attribution:
        due = np.arange(N, dtype=np.int64) * MS
        records = CycleRecords(due, self.lateness, self.feedback, self.valve, self.response, self.flags,
                               Injected(*self.injected), self.delay)
        return attribute(records, self.troubles, policy, gone)


def source_and_kind(found: Attribution) -> tuple[int, str]:
    assert found.cause is not None
    return found.cause.source, found.cause.kind


@pytest.mark.parametrize(("controller", "plant", "blamed"), [
    (StartTime(0.02), StartTime(0.01), None), (StartTime(1.0), StartTime(0.99), None),
    (StartTime(1.5), StartTime(0.01), (CONTROLLER, "bring_up")), (None, StartTime(0.01), (CONTROLLER, "bring_up")),
    (StartTime(1.5, 0.2), StartTime(0.01), (CONTROLLER, "bring_up")),  # the rig stood still, but not that long
    (StartTime(1.5, 0.6), StartTime(0.01), (RIG, "late")), (StartTime(0.01), StartTime(1.3, 1.2), (RIG, "late")),
    (StartTime(1.5), StartTime(1.4), (0, "late")), (StartTime(1.5), None, (0, "late")), (None, None, (0, "late")),
    (StartTime(0.02), StartTime(1.4), (PLANT, "late")), (StartTime(0.02), None, (PLANT, "bring_up")),
])
def test_who_is_to_blame_for_a_slow_start(controller: StartTime | None, plant: StartTime | None,
                                          blamed: tuple[int, str] | None) -> None:
    times = {node: time for node, time in ((CONTROLLER, controller), (PLANT, plant)) if time is not None}
    found = find_start_problem(times, 1.0)
    assert (None if found is None else (found[2], found[0])) == blamed
    if found is not None and found[0] == "late":
        script = Script()
        script.report(0, found[2], 0, *found[:2])
        cause = script.attribute().cause
        assert cause is not None and cause.is_lateness and cause.text == found[1]


def test_a_run_without_trouble() -> None:
    found = Script().attribute()
    assert found.cause is None and found.judged.all() and not found.affected.any()
    assert set(found.invalid.values()) == {0} and found.overruns.sum() == 0


@pytest.mark.parametrize(("node", "code", "at"), [
    (CONTROLLER, 0x8100, 300.6),  # a stack that calls SYNC lost 1.5 periods after the last, before the late one comes
    (CONTROLLER, 0x8100, 302.0), (PLANT, 0x8100, 300.9),
    (PLANT, 0x8250, 303.2),  # nodes that stood still with the rig
])
def test_a_late_sync_is_the_cause_of_what_follows(node: int, code: int, at: float) -> None:
    """Seen once: one SYNC 1.9 ms late, and the run ended as ABORTED "node 2 controller 0x8100"."""
    script = Script()
    script.lateness[300] = 1.9e-3
    if code == 0x8250:
        script.lose_drive(300, 303)
    script.report(at, node, code)
    found = script.attribute()
    assert source_and_kind(found) == (RIG, "late") and found.cause is not None and found.cause.cycle == 300
    assert found.cause.text == "the rig sent SYNC 1.9 ms late"
    assert [trouble.code for trouble in found.consequences] == [code] and found.by_bench == 1
    assert not found.judged[299:303].any() and found.judged[:299].all() and found.judged[310:].all()


def test_the_controller_answers_for_its_own_errors_beside_a_late_sync() -> None:
    """Overcurrent is not about communication; a reset neither; and long after the late SYNC it is another story."""
    for cycle, kind, code in ((301.5, "emcy", 0x2310), (301.5, "nmt", 0), (400.0, "emcy", 0x8100)):
        script = Script()
        script.lateness[300] = 1.9e-3
        script.report(cycle, CONTROLLER, code, kind)
        found = script.attribute()
        assert source_and_kind(found) == (CONTROLLER, kind) and found.by_bench == 0


def test_a_stalled_plant_is_the_cause_of_what_the_controller_reports() -> None:
    """Seen once as "node 2 controller 0x8250"."""
    script = Script()
    script.lose_feedback(500, 510)
    script.report(503.2, CONTROLLER, 0x8250)
    script.report(511.1, PLANT, 0x8250)
    found = script.attribute()
    assert source_and_kind(found) == (PLANT, "late") and found.cause is not None and found.cause.cycle == 500
    assert "no feedback for 10 cycles" in found.cause.text and len(found.consequences) == 2
    assert not found.judged[500:520].any() and found.affected[500:600].all() and found.judged[600:].all()


@pytest.mark.parametrize("late", [0.6e-3, 0.99e-3])
def test_late_feedback_is_not_held_against_the_controller(late: float) -> None:
    script = Script()
    script.feedback[500] = late
    script.lose_drive(500, 501)
    found = script.attribute()
    assert not found.judged[500] and found.invalid["feedback_late"] == 1 and found.overruns.sum() == 1


def test_the_plants_own_record_shows_a_stall() -> None:
    script = Script()
    script.delay[500] = 3e-3
    script.lose_drive(499, 503)
    script.report(503.0, PLANT, 0x8250)
    found = script.attribute()
    assert source_and_kind(found) == (PLANT, "late") and found.cause is not None
    assert "by its own record the plant sent feedback 3.0 ms after SYNC" in found.cause.text


def test_the_plants_record_is_matched_by_cycle() -> None:
    cycle, sync = np.array([2, 3, 900]), np.array([1000, 2000, 3000])
    record = CycleRecord(cycle, sync, sync + 10, sync + 500, sync + 900, np.zeros(3, dtype=np.int64))
    assert select_plant_delays(record, 5) == pytest.approx([0, 0, 5e-7, 5e-7, 0])
    assert select_plant_delays(None, 5).tolist() == [0.0] * 5


def test_a_dead_controller_is_named_and_not_the_plant_that_misses_it() -> None:
    """Seen five of five times as "node 3 plant 0x8250"."""
    script = Script()
    script.lose_drive(600)
    script.report(604.0, PLANT, 0x8250)
    found = script.attribute({CONTROLLER: "its process was ended by SIGKILL"})
    assert source_and_kind(found) == (CONTROLLER, "stopped") and found.cause is not None and found.cause.cycle == 600
    assert found.cause.text.endswith("no drive frame since cycle 600; its process was ended by SIGKILL")
    assert "SYNC was sent at most 0.02 ms late and feedback came within 0.10 ms" in found.cause.evidence[0]
    assert [trouble.node for trouble in found.consequences] == [PLANT] and found.by_bench == 0
    assert found.judged[:N - 1].all() and found.cause.is_gone


def test_a_dead_controller_is_named_although_a_sync_was_late_just_before() -> None:
    script = Script()
    script.lateness[598] = 0.7e-3
    script.lose_drive(600)
    script.report(604.0, PLANT, 0x8250)
    assert source_and_kind(script.attribute({CONTROLLER: "no heartbeat any more"})) == (CONTROLLER, "stopped")


def test_a_controller_killed_while_the_plant_was_late_is_named() -> None:
    """Lateness ends no process. Long before the kill it is the first cause."""
    for late, expected in ((597, (CONTROLLER, "stopped")), (300, (PLANT, "late"))):
        script = Script()
        script.feedback[late:late + 2] = 4e-3
        script.report(late + 1, CONTROLLER, 0x8250)
        script.lose_drive(600)
        script.report(604.0, PLANT, 0x8250)
        found = script.attribute({CONTROLLER: "its process was ended by SIGKILL"})
        assert source_and_kind(found) == expected and len(found.consequences) == 2


def test_a_dead_plant_is_named_and_not_the_controller_that_misses_it() -> None:
    """Seen five of five times as "node 2 controller"."""
    script = Script()
    script.lose_feedback(600)
    script.report(603.5, CONTROLLER, 0x8250)
    script.report(620.0, PLANT, 0, "process", "node 3 plant: its process was ended by SIGKILL")
    found = script.attribute({PLANT: "its process was ended by SIGKILL"})
    assert source_and_kind(found) == (PLANT, "stopped") and found.cause is not None and found.cause.cycle == 600
    assert found.overruns.sum() == 0  # it did not come late: it did not come any more


def test_a_controller_that_stalls_alone() -> None:
    script = Script()
    script.lose_drive(600, 612)
    script.report(604.0, PLANT, 0x8250)
    found = script.attribute()
    assert source_and_kind(found) == (CONTROLLER, "stopped") and found.cause is not None
    assert "did not answer in time: no drive frame for 12 cycles from 600" in found.cause.text


def test_a_controller_that_reports_missing_feedback_which_came() -> None:
    script = Script()
    script.report(604.0, CONTROLLER, 0x8250)
    assert source_and_kind(script.attribute()) == (CONTROLLER, "emcy")


@pytest.mark.parametrize(("kind", "code"), [("nmt", 127), ("nmt", 0), ("emcy", 0x6000)])
def test_a_plant_that_stops_by_itself_was_not_late(kind: str, code: int) -> None:
    """The controller notices first; the plant's own message, or its next heartbeat, says what was."""
    script = Script()
    script.lose_feedback(600, 720)
    script.report(603.5, CONTROLLER, 0x8250)
    script.report(690.0 if kind == "nmt" else 600.4, PLANT, code, kind)
    found = script.attribute()
    assert found.cause is not None and found.cause.source == PLANT and not found.cause.is_lateness


def test_faults_of_the_sequence_are_the_sequences() -> None:
    script = Script()
    script.injected[2, 600:607] = True
    script.lose_drive(600, 603)
    script.report(604.0, PLANT, 0x8250)
    found = script.attribute()
    assert found.cause is not None and (found.cause.kind, found.cause.cycle) == ("injected", 600)


def test_a_guard_passed_because_frames_were_late_is_the_benchs() -> None:
    script = Script()
    script.lose_feedback(600, 605)
    script.report(650.0, 0, 0, "guard", "guard 'too far' was passed by xj")
    assert source_and_kind(script.attribute()) == (PLANT, "late")
    script = Script()
    script.report(650.0, 0, 0, "guard", "guard 'too far' was passed by xj")
    assert source_and_kind(script.attribute()) == (0, "guard")


def test_only_a_heartbeat_is_missing() -> None:
    script = Script()
    script.report(600.0, CONTROLLER, 0, "heartbeat", "node 2 controller is silent")
    found = script.attribute()
    assert source_and_kind(found) == (CONTROLLER, "heartbeat") and found.consequences == ()


def test_a_late_sync_alone_changes_no_signal() -> None:
    script = Script()
    script.lateness[300] = 5.3e-3
    found = script.attribute()
    assert not found.affected.any() and found.overruns[300] == 5 and found.invalid["sync_late"] == 1


def test_the_limits_are_those_of_the_sequence() -> None:
    script = Script()
    script.lateness[300], script.feedback[400] = 0.3e-3, 0.4e-3
    assert script.attribute().judged.all()
    strict = script.attribute(policy=TimingPolicy(sync=0.2e-3, feedback=0.2e-3))
    assert strict.invalid["sync_late"] == strict.invalid["feedback_late"] == 1


def test_a_run_without_cycles() -> None:
    empty, mask = np.zeros(0), np.zeros(0, dtype=bool)
    records = CycleRecords(np.zeros(0, dtype=np.int64), empty, empty, empty, empty, np.zeros(0, dtype=np.int64),
                           Injected(mask, mask, mask), empty)
    found = attribute(records, [Trouble(0, CONTROLLER, "bring_up", 0, "slow")], POLICY, {PLANT: "gone"})
    assert source_and_kind(found) == (CONTROLLER, "bring_up") and len(found.judged) == 0


def test_the_first_of_several_causes() -> None:
    """The controller fails at 400; that the bench is late at 700 changes nothing."""
    script = Script()
    script.report(400.0, CONTROLLER, 0x2310)
    script.lateness[700] = 8e-3
    script.report(702.0, PLANT, 0x8100)
    found = script.attribute()
    assert source_and_kind(found) == (CONTROLLER, "emcy") and found.by_bench == 1


@pytest.mark.parametrize(("values", "most"), [([], 0), ([0, 0], 0), ([1, 1, 0, 1], 2), ([0, 7, 0], 7), ([2, 1], 3)])
def test_overruns_in_a_row(values: list[int], most: int) -> None:
    assert count_most_in_a_row(np.array(values, dtype=np.int64)) == most


@pytest.mark.parametrize(("fault", "expected"), [
    (Lost(frame="drive", start=0.1, count=3), (set(), set(), {*range(100, 106)})),
    (Lost(frame="feedback", start=0.1, count=1), (set(), {100}, {*range(100, 104)})),
    (Late(frame="feedback", start=0.1, count=1, delay=1.5e-3), (set(), {100, 101, 102}, {*range(100, 106)})),
    (Silent(node="rig", start=0.1, end=0.2), (set(), set(), {*range(100, 600)})),
    (Offset(signal="xj", start=0.1, value=1e-3), (set(), set(), set())),
])
def test_cycles_that_faults_disturb(fault: Fault, expected: tuple[set[int], ...]) -> None:
    plan = Plan(faults=(fault,), stop=900)
    found: Any = find_injected(plan, Schedule(plan), 900)
    assert tuple(set(np.flatnonzero(mask).tolist()) for mask in found) == expected
