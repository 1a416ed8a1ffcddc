"""First causes: scripted records of runs in which the rig, the plant or the controller was late, stopped or died."""
from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
import pytest

from rig.benches import Flags, Role, load_bench
from rig.network import CONTROLLER, PLANT, RIG, CycleRecord, StartTime
from rig.run.attribution import (
    Attribution,
    CycleRecords,
    Injected,
    Trouble,
    attribute,
    find_injected,
    find_start_problem,
)
from rig.run.runner import select_plant_delays
from rig.sequences import Fault, Late, Offset, Plan, Schedule, Silent, TimingPolicy
from rig.sequences.faults import Lost

MS = 1_000_000  # ns
N = 1000
POLICY = TimingPolicy()
NAN = float("nan")
NAMES = {role: load_bench().describe_node(role) for role in (CONTROLLER, PLANT)}


class Script:
    """The records of a run in which all is well, to be spoilt."""

    def __init__(self) -> None:
        self.lateness = np.full(N, 2e-5)
        self.feedback, self.valve, self.response = np.full(N, 1e-4), np.full(N, 1.1e-4), np.full(N, 2e-4)
        self.flags = np.zeros(N, dtype=np.int64)
        self.injected = np.zeros((3, N), dtype=np.int64)
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

    def late(self, cycle: int, seconds: float) -> None:
        self.lateness[cycle] = seconds

    def feed(self, cycle: int, seconds: float) -> None:
        self.feedback[cycle] = seconds

    def stall(self, cycle: int, seconds: float) -> None:
        self.delay[cycle] = seconds

    def inject(self, first: int, last: int, number: int = 1) -> None:
        self.injected[2, first:last] = number

    def spoil(self, steps: list[tuple[Any, ...]]) -> Script:
        for name, *arguments in steps:
            getattr(self, name)(*arguments)
        return self

    def attribute(self, gone_nodes: Mapping[Role, str] | None = None, policy: TimingPolicy = POLICY) -> Attribution:
        due = np.arange(N, dtype=np.int64) * MS
        records = CycleRecords(due, self.lateness, self.feedback, self.valve, self.response, self.flags,
                               Injected(self.injected[0] != 0, self.injected[1] != 0, self.injected[2],
                                        ("lost drive", "lost heartbeat")), self.delay)
        return attribute(records, self.troubles, policy, load_bench(), gone_nodes or {})


@pytest.mark.parametrize(("controller", "plant", "blame"), [
    (StartTime(0.02), StartTime(0.01), None), (StartTime(1.0), StartTime(0.99), None),
    (StartTime(1.5), StartTime(0.01), (CONTROLLER, "bring_up")), (None, StartTime(0.01), (CONTROLLER, "bring_up")),
    (StartTime(1.5, 0.2), StartTime(0.01), (CONTROLLER, "bring_up")),  # the rig stood still, but not that long
    (StartTime(1.5, 0.6), StartTime(0.01), (RIG, "late")), (StartTime(0.01), StartTime(1.3, 1.2), (RIG, "late")),
    (StartTime(1.5), StartTime(1.4), (0, "late")), (StartTime(1.5), None, (0, "late")), (None, None, (0, "late")),
    (StartTime(0.02), StartTime(1.4), (PLANT, "late")), (StartTime(0.02), None, (PLANT, "bring_up")),
])
def test_who_is_to_blame_for_a_slow_start(controller: StartTime | None, plant: StartTime | None,
                                          blame: tuple[int, str] | None) -> None:
    times = {node: time for node, time in ((CONTROLLER, controller), (PLANT, plant)) if time is not None}
    problem = find_start_problem(times, 1.0, NAMES)
    assert (None if problem is None else (problem[2], problem[0])) == blame
    if problem is not None and problem[0] == "late":
        script = Script()
        script.report(0, problem[2], 0, *problem[:2])
        cause = script.attribute().cause
        assert cause is not None and cause.is_lateness and cause.text == problem[1]


KILLED = "its process was ended by SIGKILL"
LATE_SYNC = ("late", 300, 1.9e-3)
MISSED = ("report", 604.0, PLANT, 0x8250)
GUARD = ("report", 650.0, 0, 0, "guard", "guard 'too far' was passed by xj")
CASES: dict[str, tuple[list[tuple[Any, ...]], dict[int, str], tuple[int, str, int], str]] = {
    # what was wrong, who is gone; who is the first cause, of which kind, in which cycle, and words of the text
    "a stack calls SYNC lost 1.5 periods after the last, before the late one comes": (
        [LATE_SYNC, ("report", 300.6, CONTROLLER, 0x8100)], {}, (RIG, "late", 300), "the rig sent SYNC 1.9 ms late"),
    "a late SYNC is lost for the controller": (
        [LATE_SYNC, ("report", 302.0, CONTROLLER, 0x8100)], {}, (RIG, "late", 300), ""),
    "a late SYNC is lost for the plant": ([LATE_SYNC, ("report", 300.9, PLANT, 0x8100)], {}, (RIG, "late", 300), ""),
    "nodes stood still with the rig": (
        [LATE_SYNC, ("lose_drive", 300, 303), ("report", 303.2, PLANT, 0x8250)], {}, (RIG, "late", 300), ""),
    "overcurrent is not about communication": (
        [LATE_SYNC, ("report", 301.5, CONTROLLER, 0x2310)], {}, (CONTROLLER, "emcy", 301), ""),
    "neither is a reset": ([LATE_SYNC, ("report", 301.5, CONTROLLER, 0, "nmt")], {}, (CONTROLLER, "nmt", 301), ""),
    "long after a late SYNC": (
        [LATE_SYNC, ("report", 400.0, CONTROLLER, 0x8100)], {}, (CONTROLLER, "emcy", 400), ""),
    "a stalled plant is behind what the controller reports": (
        [("lose_feedback", 500, 510), ("report", 503.2, CONTROLLER, 0x8250), ("report", 511.1, PLANT, 0x8250)], {},
        (PLANT, "late", 500), "no feedback for 10 cycles"),
    "the plant's own record shows a stall": (
        [("stall", 500, 3e-3), ("lose_drive", 499, 503), ("report", 503.0, PLANT, 0x8250)], {}, (PLANT, "late", 500),
        "by its own record the plant sent feedback 3.0 ms after SYNC"),
    "a dead controller, and not the plant that misses it": (
        [("lose_drive", 600), MISSED], {CONTROLLER: KILLED}, (CONTROLLER, "stopped", 600),
        f"no valid drive frame since cycle 600; {KILLED}"),
    "although a SYNC was late just before": (
        [("late", 598, 0.7e-3), ("lose_drive", 600), MISSED], {CONTROLLER: "no heartbeat any more"},
        (CONTROLLER, "stopped", 600), ""),
    "a controller killed while the plant was late, for lateness ends no process": (
        [("feed", 597, 4e-3), ("feed", 598, 4e-3), ("report", 598.0, CONTROLLER, 0x8250), ("lose_drive", 600), MISSED],
        {CONTROLLER: KILLED}, (CONTROLLER, "stopped", 600), ""),
    "a plant that was late long before": (
        [("feed", 300, 4e-3), ("feed", 301, 4e-3), ("report", 301.0, CONTROLLER, 0x8250), ("lose_drive", 600), MISSED],
        {CONTROLLER: KILLED}, (PLANT, "late", 300), ""),
    "a dead plant, and not the controller that misses it": (
        [("lose_feedback", 600), ("report", 603.5, CONTROLLER, 0x8250), ("report", 620.0, PLANT, 0, "process")],
        {PLANT: KILLED}, (PLANT, "stopped", 600), ""),
    "a controller that stalls alone": (
        [("lose_drive", 600, 612), MISSED], {}, (CONTROLLER, "stopped", 600),
        "did not answer in time: no valid drive frame for 12 cycles from 600"),
    "missing feedback that came": ([("report", 604.0, CONTROLLER, 0x8250)], {}, (CONTROLLER, "emcy", 604), ""),
    "a plant that leaves OPERATIONAL, known by its next heartbeat": (
        [("lose_feedback", 600, 720), ("report", 603.5, CONTROLLER, 0x8250), ("report", 690.0, PLANT, 127, "nmt")], {},
        (PLANT, "stopped", 600), ""),
    "a plant that boots": (
        [("lose_feedback", 600, 720), ("report", 603.5, CONTROLLER, 0x8250), ("report", 690.0, PLANT, 0, "nmt")], {},
        (PLANT, "stopped", 600), ""),
    "a plant that has an error of its own": (
        [("lose_feedback", 600, 720), ("report", 603.5, CONTROLLER, 0x8250), ("report", 600.4, PLANT, 0x6000)], {},
        (PLANT, "emcy", 600), ""),
    "a fault of the sequence": (
        [("inject", 600, 607), ("lose_drive", 600, 603), MISSED], {}, (0, "injected", 600), ""),
    "a heartbeat lost 264 cycles ago": (
        [("inject", 340, 900, 2), ("report", 604.0, PLANT, 0x8130)], {}, (0, "injected", 340),
        "frames; fault 'lost heartbeat' acts on them from cycle 340"),
    "a heartbeat lost long ago, with frames lost meanwhile": (
        [("inject", 340, 900, 2), ("inject", 500, 510), ("report", 604.0, PLANT, 0x8130)], {}, (0, "injected", 340),
        "'lost heartbeat'"),
    "frames lost while a heartbeat is": (
        [("inject", 340, 900, 2), ("inject", 600, 607), ("lose_drive", 600, 603), MISSED], {}, (0, "injected", 600),
        "'lost drive' acts on them from cycle 600"),
    "a guard passed because frames were late": ([("lose_feedback", 600, 605), GUARD], {}, (PLANT, "late", 600), ""),
    "a guard": ([GUARD], {}, (0, "guard", 650), ""),
    "only a heartbeat is missing": (
        [("report", 600.0, CONTROLLER, 0, "heartbeat")], {}, (CONTROLLER, "heartbeat", 600), ""),
    "the first of several: that the bench is late afterwards changes nothing": (
        [("report", 400.0, CONTROLLER, 0x2310), ("late", 700, 8e-3), ("report", 702.0, PLANT, 0x8100)], {},
        (CONTROLLER, "emcy", 400), ""),
}


@pytest.mark.parametrize("case", CASES)
def test_the_first_cause(case: str) -> None:
    steps, gone_nodes, cause, words = CASES[case]
    script = Script().spoil(steps)
    attribution = script.attribute(gone_nodes)
    assert attribution.cause is not None and cause == (
        attribution.cause.source, attribution.cause.kind, attribution.cause.cycle)
    assert (words in "; ".join([attribution.cause.text, *attribution.cause.evidence])
            and attribution.cause.is_gone is (attribution.cause.source in gone_nodes))
    own_troubles = sum(trouble.text == attribution.cause.text for trouble in script.troubles)
    assert (len(attribution.consequences) == len(script.troubles) - own_troubles
            and attribution.by_bench >= attribution.cause.is_lateness)
    if (attribution.cause.source, attribution.cause.kind) == (CONTROLLER, "stopped"):
        assert "SYNC was sent at most 0.02 ms late and feedback came within 0.10 ms" in attribution.cause.evidence[0]


@pytest.mark.parametrize(("steps", "unjudged", "affected", "invalid", "overruns"), [
    ([LATE_SYNC], range(299, 304), (), {"sync_late": 1}, {300: 1}),
    ([("late", 300, 5.3e-3)], range(299, 308), (), {"sync_late": 1}, {300: 5}),  # it changes no signal
    ([("lose_feedback", 500, 510)], range(500, 521), range(500, 610), {"feedback_late": 10},
     dict.fromkeys(range(500, 510), 1)),
    ([("feed", 500, 0.6e-3), ("lose_drive", 500, 501)], range(500, 503), range(500, 601), {"feedback_late": 1},
     {500: 1}),
    ([("feed", 500, 0.4e-3), ("late", 300, 0.3e-3)], (), (), {}, {}),  # within the limits
])
def test_what_lateness_spoils(steps: list[tuple[Any, ...]], unjudged: Collection[int], affected: Collection[int],
                              invalid: dict[str, int], overruns: dict[int, int]) -> None:
    attribution = Script().spoil(steps).attribute()
    assert [set(np.flatnonzero(rows)) for rows in (~attribution.judged, attribution.affected)] == [
        set(unjudged), set(affected)]
    assert invalid.items() <= attribution.invalid.items()
    assert {int(k): int(attribution.overruns[k]) for k in np.flatnonzero(attribution.overruns)} == overruns


def test_the_limits_are_those_of_the_sequence_and_a_plant_that_is_dead_is_not_late() -> None:
    strict = Script().spoil([("late", 300, 0.3e-3), ("feed", 400, 0.4e-3)]).attribute(
        policy=TimingPolicy(sync=0.2e-3, feedback=0.2e-3))
    assert strict.invalid["sync_late"] == strict.invalid["feedback_late"] == 1
    assert Script().spoil([("lose_feedback", 600)]).attribute({PLANT: KILLED}).overruns.sum() == 0


def test_the_plants_record_is_matched_by_cycle() -> None:
    cycle, sync = np.array([2, 3, 900]), np.array([1000, 2000, 3000])
    record = CycleRecord(cycle, sync, sync + 10, sync + 500, sync + 900, np.zeros(3, dtype=np.int64))
    assert select_plant_delays(record, 5) == pytest.approx([0, 0, 5e-7, 5e-7, 0])
    assert select_plant_delays(None, 5).tolist() == [0.0] * 5


def test_a_run_without_cycles() -> None:
    empty, mask = np.zeros(0), np.zeros(0, dtype=bool)
    records = CycleRecords(np.zeros(0, dtype=np.int64), empty, empty, empty, empty, np.zeros(0, dtype=np.int64),
                           Injected(mask, mask, np.zeros(0, dtype=np.int64)), empty)
    attribution = attribute(records, [Trouble(0, CONTROLLER, "bring_up", 0, "slow")], POLICY, load_bench(),
                            {PLANT: "gone"})
    assert attribution.cause is not None and attribution.cause.source == CONTROLLER and len(attribution.judged) == 0


@pytest.mark.parametrize(("fault", "cycles"), [
    (Lost(frame="drive", start=0.1, count=3), (set(), set(), {*range(100, 106)})),
    (Lost(frame="feedback", start=0.1, count=1), (set(), {100}, {*range(100, 104)})),
    (Late(frame="feedback", start=0.1, count=1, delay=1.5e-3), (set(), {100, 101, 102}, {*range(100, 106)})),
    (Silent(node="rig", start=0.1, end=0.2), (set(), set(), {*range(100, 600)})),
    (Offset(signal="xj", start=0.1, value=1e-3), (set(), set(), set())),
])
def test_cycles_that_faults_disturb(fault: Fault, cycles: tuple[set[int], ...]) -> None:
    plan = Plan(faults=(fault,), stop=900)
    *masks, labels = find_injected(plan, Schedule(plan), 900)
    assert labels == (fault.label,) and tuple(set(np.flatnonzero(mask).tolist()) for mask in masks) == cycles
