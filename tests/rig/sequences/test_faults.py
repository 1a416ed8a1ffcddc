"""The fault schedule: what is wrong in which cycle, the same for the same seed, and cheap to ask."""

import json
from pathlib import Path

import numpy as np
import pytest
from refusals import catch_refusal

from plant import load_model
from rig.benches.bench_file import load_bench
from rig.nodes.scenario import Scenario
from rig.sequences import faults
from rig.sequences.faults import (
    CORRUPT,
    CUT,
    DELAY,
    DOUBLE,
    DROP,
    NORMAL,
    Action,
    BusOff,
    Corrupted,
    Duplicated,
    Fault,
    Foreign,
    Jitter,
    Late,
    Lost,
    Noise,
    Offset,
    Parameter,
    Plan,
    Reset,
    Schedule,
    Short,
    Silent,
    Stuck,
    apply_action,
    require_possible,
)
from rig.sequences.sequence import Sequence, parse_sequence

MAIN = 'title = "T"\nmain = [{ kind = "hold", time = 1.0 }]\n'
BASE = {"filter.clogging": 0.0, "spool.static_friction": 5.0}


def schedule(*faults: Fault, start: int = 0, stop: int = 10_000, seed: int = 0) -> Schedule:
    return Schedule(Plan(faults=faults, start=start, stop=stop, seed=seed), BASE)


def hit_cycles(s: Schedule, frame: str, cycles: int) -> list[int]:
    return [k for k in range(cycles) if s.find_action(frame, k) != NORMAL]


def parse(text: str) -> Sequence:
    return parse_sequence(text, "mine.toml", lambda name: b"")


def test_without_faults_everything_is_as_it_was() -> None:
    s = schedule()
    assert s.parameters_at(5) == {} and s.change_signal("xj", 1.5, 5) == 1.5 and s.find_action("drive", 5) == NORMAL
    assert s.is_heartbeat_alive("plant", 5) and s.edges == ()


def test_a_parameter_ramps_from_its_base_and_returns() -> None:
    s = schedule(Parameter(parameter="spool.static_friction", value=45.0, start=1.0, end=2.0, ramp=0.1), start=500)
    changes = {k: v["spool.static_friction"] for k in range(4000) if (v := s.parameters_at(k))}
    assert list(changes) == [*range(1501, 1601), 2500]  # said only when it changes
    assert (changes[1501], changes[1600], changes[2500]) == (pytest.approx(5.4), 45.0, 5.0)


def test_skipped_cycles_lose_no_change_and_faults_end_when_main_ends() -> None:
    clogged = Parameter(parameter="filter.clogging", value=0.5, start=1.0)
    s = schedule(clogged, Lost(frame="drive", start=1.0), stop=2000)
    assert s.parameters_at(1003) == {} and s.parameters_at(1003, since=998) == {"filter.clogging": 0.5}
    assert s.parameters_at(2000) == {"filter.clogging": 0.0}
    assert s.find_action("drive", 1999) == Action(DROP) and s.find_action("drive", 2000) == NORMAL
    assert s.edges[:2] == ((1000, "parameter filter.clogging", True), (2000, "parameter filter.clogging", False))
    first = schedule(Parameter(parameter="filter.clogging", value=0.5, start=0.0))
    assert first.parameters_at(0) == {"filter.clogging": 0.5}


@pytest.mark.parametrize(("placed", "readings", "said"), [
    ([Stuck(signal="xj", start=0.003, end=0.006)], range(8), [0, 1, 2, 2, 2, 2, 6, 7]),
    ([Stuck(signal="xj", value=7.0, start=0.0, end=0.001)], [1, 1], [7, 1]),
    ([Offset(signal="xj", value=4.0, start=0.0, end=0.006, ramp=0.004)], [1] * 7, [1, 2, 3, 4, 5, 5, 1]),
    ([Offset(signal="xs", value=4.0, start=0.0)], [1], [1]),
    ([Offset(signal="xj", value=1.0, start=0.0), Stuck(signal="xj", value=9.0, start=0.0)], [0], [9]),  # in this order
])
def test_sensor_faults(placed: list[Fault], readings: list[float], said: list[float]) -> None:
    s = schedule(*placed)
    assert [s.change_signal("xj", float(value), k) for k, value in enumerate(readings)] == said


def test_noise_has_its_size_and_depends_on_seed_and_cycle_only() -> None:
    fault = Noise(signal="xj", value=3e-6, start=0.0)
    one, same, other = schedule(fault, seed=1), schedule(fault, seed=1), schedule(fault, seed=2)
    values = [one.change_signal("xj", 0.0, k) for k in range(10_000)]
    assert np.std(values) == pytest.approx(3e-6, rel=0.03) and abs(np.mean(values)) < 1e-7
    assert values[77] == same.change_signal("xj", 0.0, 77) != other.change_signal("xj", 0.0, 77)


def test_frames_are_lost_by_count_period_and_chance() -> None:
    three, periodic = (schedule(Lost(frame=frame, start=start, end=end, every=every, count=count))
                       for frame, start, end, every, count in (("drive", 0.01, None, 1, 3),
                                                               ("feedback", 0.0, 0.1, 20, 4)))
    assert hit_cycles(three, "drive", 30) == [10, 11, 12] and hit_cycles(three, "feedback", 30) == []
    assert three.edges == ((10, "lost drive", True), (13, "lost drive", False))
    assert hit_cycles(periodic, "feedback", 200) == [0, 20, 40, 60]
    hits, again = (hit_cycles(schedule(Lost(frame="command", start=0.0, probability=0.2), seed=3), "command", 10_000)
                   for _ in range(2))
    assert len(hits) == pytest.approx(2000, abs=150) and hits == again


ONE_OF_EACH: tuple[Fault, ...] = (
    Parameter(parameter="filter.clogging", value=0.3, start=1.0, ramp=0.5), Offset(signal="p12", value=1e5, start=0.1),
    Noise(signal="xs", value=1e-6, start=0.2, end=0.4), Stuck(signal="xj", start=0.3),
    Lost(frame="drive", start=1.0, count=3), Late(frame="feedback", start=1.0, delay=1e-3),
    Silent(node="rig", start=2.0, name="rig dies"), Duplicated(frame="sync", start=0.1, every=7),
    Corrupted(frame="feedback", start=0.1, bits=3), Short(frame="command", start=0.1, length=4, count=2),
    Jitter(size=2e-4, start=0.5), Foreign(start=0.1, cob_id=0x10, frames=20), BusOff(node="plant", start=0.1, end=0.2),
    Reset(start=0.7),
)


def test_a_plan_survives_json() -> None:
    assert {fault.kind for fault in ONE_OF_EACH} == set(faults.KINDS)
    plan = Plan(faults=ONE_OF_EACH, start=500, stop=9000, seed=7)
    assert Plan.from_json(json.loads(json.dumps(plan.to_json()))) == plan


@pytest.mark.parametrize(("data", "message"), [
    ([], "scenario: expected a table"),
    ({"stop": 1, "faults": [{"kind": "lots", "frame": "drive", "start": 0}]}, "did you mean 'lost'"),
    ({"stop": 1, "faults": [{"kind": "lost", "frame": "drvie", "start": 0}]}, "did you mean 'drive'"),
    ({"stop": 1.5}, "scenario: stop: expected a whole number, not 1.5"),
    ({"stop": 10**400}, "scenario: stop: expected a whole number"),
])
def test_a_bad_scenario_is_refused(data: object, message: str) -> None:
    assert message in catch_refusal(Plan.from_json, data)


def test_words_stand_for_their_numbers_and_what_fits_together_is_taken() -> None:
    s = parse(MAIN + """faults = [
      { kind = "parameter", parameter = "filter.law", value = "linear", start = 0.1 },
      { kind = "parameter", parameter = "spool.static_friction", value = 70, start = 0.2, ramp = 0.3 },
      { kind = "parameter", parameter = "spool.dynamic_friction", value = 30, start = 0.2, ramp = 0.3 },
      { kind = "parameter", parameter = "null_bias.current", value = 1e-4, start = 0.2 },
    ]
    [model]
    overrides = { filter.law = "pressure" }
    """)
    assert s.model.overrides == {"filter.law": "pressure"}
    model = load_model("eha").replace(s.model.overrides)
    asked = Schedule(s.plan(0), {**model.values, "null_bias.current": 0.0})
    at = [asked.list_parameters(k) for k in (0, 100, 999, 1000)]
    assert [values["filter.law"] for values in at] == [0.0, 1.0, 1.0, 0.0]
    assert [values["spool.static_friction"] for values in at] == [5.0, 5.0, 70.0, 5.0]


def test_a_fault_that_contradicts_the_model_of_the_run_is_refused_before_it() -> None:
    """The sequence is sound on the actuator it names; --set has made another of it."""
    s = parse(MAIN + 'faults = [{ kind = "parameter", parameter = "jack.static_friction", value = 600, start = 0 }]')
    other = load_model("eha").replace({"jack.dynamic_friction": 700.0})
    Scenario.build(load_model("eha"), s.plan(0), s.load_profile(), 0)
    line = catch_refusal(Scenario.build, other, s.plan(0), s.load_profile(), 0)
    assert "parameter jack.static_friction: expected jack.dynamic_friction at most " in line


DATA = bytes(range(8))


@pytest.mark.parametrize(("action", "data", "arrives"), [
    (NORMAL, DATA, (DATA,)), (Action(DROP), DATA, ()), (Action(DOUBLE), DATA, (DATA, DATA)), (NORMAL, b"", (b"",)),
    (Action(DELAY, 1000), DATA, (DATA,)), (Action(CUT, 3), DATA, (DATA[:3],)),
    (Action(CORRUPT, 0x01 - (1 << 63)), DATA, (bytes((1, 1, 2, 3, 4, 5, 6, 0x87)),)),  # first byte lowest
    (Action(CORRUPT, -(1 << 63)), b"\x01\x02", (b"\x01\x02",))])
def test_what_arrives_of_a_frame(action: Action, data: bytes, arrives: tuple[bytes, ...]) -> None:
    assert apply_action(action, data) == arrives


def test_actions_are_as_late_as_corrupted_and_as_short_as_asked_for() -> None:
    s = schedule(Late(frame="valve_state", start=0.0, delay=400e-6), Jitter(size=2e-4, start=0.01, end=0.5),
                 Corrupted(frame="drive", start=0.0, end=0.1, bits=3), Short(frame="feedback", start=0.0, length=3))
    assert s.find_action("valve_state", 0) == Action(DELAY, 400_000) and s.find_action("feedback", 0) == Action(CUT, 3)
    masks = [s.find_action("drive", k).argument & (1 << 64) - 1 for k in range(100)]
    assert {mask.bit_count() for mask in masks} == {3} and len(set(masks)) > 90
    codes, delays = zip(*(s.find_action("sync", k) for k in range(10, 500)), strict=True)
    assert set(codes) == {DELAY} and 0 <= min(delays) < 10_000 and 190_000 < max(delays) <= 200_000
    assert s.find_action("sync", 9) == s.find_action("sync", 500) == NORMAL


def test_the_table_of_a_frame_says_what_happens_to_each() -> None:
    """Compiled loops read tables."""
    plan = Plan(faults=(*ONE_OF_EACH, Lost(frame="feedback", start=0.15, count=1)), stop=2000, seed=3)
    s = Schedule(plan, {"filter.clogging": 0.0})
    found = set()
    for name in ("command", "sync", "feedback", "valve_state", "drive"):
        hits = s.list_frame_hits(name).tolist()
        assert hits == [[k, *s.find_action(name, k)] for k in hit_cycles(s, name, 2100)]
        found |= {code for _, code, _ in hits}
    assert found == {DROP, DELAY, DOUBLE, CORRUPT, CUT}


def test_frames_of_other_nodes() -> None:
    s = schedule(Foreign(start=0.01, end=0.02, cob_id=0x10, frames=3, every=4), Foreign(start=0.013, length=0))
    assert [len(s.foreign_frames(k)) for k in range(10, 22)] == [3, 0, 0, 1, 4, 1, 1, 1, 4, 1, 1, 1]
    assert s.foreign_frames(10) == [(0x10, (10).to_bytes(8, "little"))] * 3 and s.foreign_frames(13) == [(0x7E5, b"")]


def test_a_node_that_is_bus_off_sends_and_receives_nothing() -> None:
    s = schedule(BusOff(node="plant", start=0.1, end=0.2), BusOff(node="rig", start=0.3, end=0.4))
    for name, first in (("feedback", 100), ("valve_state", 100), ("drive", 100), ("command", 300), ("sync", 300)):
        assert hit_cycles(s, name, 500) == [*range(first, first + 100)]
        assert s.find_action(name, first) == Action(DROP)
    assert s.is_bus_off("plant", 150) and not s.is_bus_off("rig", 150) and not s.is_heartbeat_alive("rig", 350)
    assert s.list_bus_off_cycles("rig").tolist() == [*range(300, 400)]
    assert s.count_lost_syncs(300) == 100 and s.count_lost_syncs(299) == 0


EXAMPLES = Path(__file__).parents[3] / "examples"


@pytest.mark.parametrize(("bench", "fault", "said"), [
    ("", Foreign(start=0.0, cob_id=0x183), "cob_id: expected an identifier from 1 to 0x7FF that 'EHA controller' does "
                                           "not use; 0x183 is RPDO2"),
    ("", Foreign(start=0.0, cob_id=0x702), "cob_id: expected an identifier from 1 to 0x7FF that 'EHA controller' does "
                                           "not use; 0x702 is heartbeat of node 2"),
    ("", Foreign(start=0.0, cob_id=0x205), ""),  # which node 5 of the other bench has
    ("cia402_drive", Foreign(start=0.0, cob_id=0x205), "0x205 is RPDO1"),
    ("cia402_drive", Foreign(start=0.0, cob_id=0x183), ""), ("cia402_drive", Lost(start=0.0, frame="sync"), ""),
    ("cia402_drive", Lost(start=0.0, frame="valve_state"),
     "frame: expected a frame of 'Actuator with a CiA 402 drive': 'command', 'drive', 'feedback' or 'sync', not "
     "'valve_state'"),
    ("cia402_drive", Silent(start=0.0, node="plant"), "node: expected a node of 'Actuator with a CiA 402 drive' with a "
                                                      "heartbeat, not 'plant'"),
    ("can_ecu", Jitter(start=0.0, size=1e-4), "kind: expected a fault without SYNC"),
    ("can_ecu", Reset(start=0.0), "kind: expected a fault without NMT"),
    ("can_ecu", Silent(start=0.0, node="rig"), "node: expected a node of 'Actuator with an ECU on plain CAN' with a"),
    ("can_ecu", Lost(start=0.0, frame="drive"), ""),
])
def test_a_fault_is_refused_on_a_bench_that_cannot_have_it(bench: str, fault: Fault, said: str) -> None:
    at = load_bench(str(EXAMPLES / bench / "bench.toml")) if bench else load_bench()
    if not said:
        require_possible([fault], at, "x.toml")
        return
    refusal = catch_refusal(require_possible, [fault], at, "x.toml")
    assert refusal.startswith("x.toml: faults[0].") and said in refusal
