"""The plant emulator by scripts of frames: what acts when, what is counted, what goes wrong exactly when it is to."""

import json
import zlib
from typing import Any

import codec
import numpy as np
import pytest
from node_bench import MS, PlantDesk

from plant import Actuator, Model
from rig.device import Abort, NmtState
from rig.network.node_objects import COUNTERS
from rig.nodes.scenario import Scenario
from rig.sequences.faults import (
    Fault,
    Late,
    Lost,
    Noise,
    Offset,
    Parameter,
    Plan,
    Stuck,
)

QUIET_MODEL = Model().replace({f"sensors.{what}_noise": 0.0 for what in ("position", "pressure", "spool")})
STOP = 200


def scenario(*faults: Fault, model: Model = QUIET_MODEL, load: tuple[int, ...] = (), start: int = 0) -> Scenario:
    plan = Plan(faults=faults, start=start, stop=STOP)
    groups = {fault.parameter.partition(".")[0] for fault in faults if isinstance(fault, Parameter)}
    return Scenario(model.with_effects(groups), plan, load)


def counters(desk: PlantDesk) -> tuple[Any, Any]:
    values = desk.node.device.od.values
    return values[COUNTERS, 1], values[COUNTERS, 2]


def test_the_answer_to_cycle_k_acts_from_cycle_k_plus_1() -> None:
    """Sample 1 saw a plant without current, sample 2 one millisecond of it: as the plant alone, to the bit."""
    desk, alone = PlantDesk(scenario()), Actuator(QUIET_MODEL)
    currents = [4e-3, -2e-3, 0.0, 1e-3, 3e-3]
    for k, current in enumerate(currents):
        feedback, valve = desk.cycle(current)
        xj, p12, xs = alone.sample()
        assert feedback == codec.unpack_feedback(codec.pack_feedback(xj, p12))
        assert valve == codec.unpack_valve_state(codec.pack_valve_state(xs, 0, k))
        alone.advance(currents[k - 1] if k else 0.0)
    assert counters(desk) == (0, 0)


@pytest.mark.parametrize(("drives", "flags", "counted", "emergencies", "current"), [
    (".-<..", [0, 0, 1, 2, 0], (1, 1), [], 2e-3),  # the current stays
    (".---", [0, 0, 1, 1], (2, 0), [], 2e-3),
    (".---.", [0, 0, 1, 1, 5], (3, 0), [0x8250], 0.0),  # three in a row cut it ..
    (".---..", [0, 0, 1, 1, 5, 0], (3, 0), [0x8250, 0], 2e-3),  # .. and an answer brings it back
    ("<<<<<", [0, 2, 2, 6, 6], (0, 4), [0x8250], 0.0),
])
def test_missing_and_late_drives(drives: str, flags: list[int], counted: tuple[int, int], emergencies: list[int],
                                 current: float) -> None:
    """A drive after each SYNC: one that answers it, none (-), or one that answers another cycle (<)."""
    desk = PlantDesk(scenario())
    assert [desk.cycle(None if drive == "-" else 2e-3, answers=60_000 if drive == "<" else None)[1].flags
            for drive in drives] == flags
    assert (counters(desk), desk.emergencies(), desk.node.plant.drive) == (counted, emergencies, current)


def test_lost_and_late_drive_as_the_plan_says() -> None:
    for fault, two, counted in (
            (Lost(frame="drive", start=0.003, count=1), [1, 0], (1, 0)),
            (Late(frame="drive", start=0.003, end=0.004, delay=1.5e-3), [1, 2], (1, 1)),
            (Late(frame="drive", start=0.003, end=0.004, delay=0.5e-3), [0, 0], (0, 0))):  # what comes last counts
        desk = PlantDesk(scenario(fault))
        assert [desk.cycle(1e-3)[1].flags for _ in range(8)] == [0, 0, 0, 0, *two, 0, 0]
        assert counters(desk) == counted


def test_feedback_lost_and_late() -> None:
    """A late frame carries what was sampled, not what is true by then."""
    desk = PlantDesk(scenario(Lost(frame="feedback", start=0.002, end=0.003),
                              Late(frame="feedback", start=0.004, end=0.005, delay=1.5e-3),
                              Lost(frame="valve_state", start=0.005, end=0.006)))
    for _ in range(8):
        desk.cycle(5e-3)
    when = [t_ns / MS for t_ns, cob, _ in desk.heard if cob == codec.FEEDBACK]
    assert when == [0, 1, 3, 5, 6, 6, 7]  # that of cycle 4 was due at 5.5 ms, the tick is at 6
    assert [codec.unpack_valve_state(data).cycle for data in desk.frames(codec.VALVE_STATE)] == [0, 1, 2, 3, 4, 6, 7]
    sound = PlantDesk(scenario())
    for _ in range(8):
        sound.cycle(5e-3)
    assert sorted(desk.frames(codec.FEEDBACK)) == sorted(
        data for k, data in enumerate(sound.frames(codec.FEEDBACK)) if k != 2)


def test_sensor_faults_show_in_the_frames_only() -> None:
    desk = PlantDesk(scenario(Stuck(signal="xj", start=0.002, end=0.004, value=3e-3),
                              Offset(signal="p12", start=0.004, end=0.006, value=1e6),
                              Noise(signal="xs", start=0.006, value=1e-6)))
    sound = PlantDesk(scenario())
    a, b = [[d.cycle(1e-3) for _ in range(20)] for d in (desk, sound)]
    assert [f.position for f, _ in a[2:4]] == [3e-3, 3e-3]
    assert [x.pressure - y.pressure for (x, _), (y, _) in zip(a[4:6], b[4:6], strict=True)] == pytest.approx([1e6, 1e6])
    assert [x for x, _ in a[6:]] == [y for y, _ in b[6:]]
    assert np.std([x.spool - y.spool for (_, x), (_, y) in zip(a[6:], b[6:], strict=True)]) > 3e-7
    assert desk.node.plant.actuator.state == sound.node.plant.actuator.state


def test_a_parameter_ramps_cycle_by_cycle_and_returns_when_main_ends() -> None:
    fault = Parameter(parameter="filter.clogging", value=0.4, start=0.01, ramp=0.004)
    desk = PlantDesk(Scenario(QUIET_MODEL, Plan(faults=(fault,), start=5, stop=25)))
    index = desk.node.plant.actuator._index["filter.clogging"]
    seen = []
    for _ in range(30):
        desk.cycle()
        seen.append(float(desk.node.plant.actuator._live[index]))
    assert seen[15:20] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert seen[:15] == [0.0] * 15 and seen[20:25] == [0.4] * 5 and seen[25:] == [0.0] * 5


def test_after_a_pause_the_cycle_is_that_of_the_bus_and_no_fault_was_slept_through() -> None:
    """A fault that ended meanwhile has ended; one that began has begun; the first cycle is nobody's miss."""
    desk = PlantDesk(Scenario(QUIET_MODEL, Plan(faults=(
        Parameter(parameter="filter.clogging", value=0.4, start=0.002, end=0.012),
        Parameter(parameter="spool.dynamic_friction", value=1.0, start=0.013)), stop=STOP)))
    for _ in range(5):
        desk.cycle(1e-3)
    desk.nmt(128)
    for _ in range(10):
        desk.send(codec.SYNC)
        desk.k += 1
        desk.wait(MS)
    desk.nmt(1)
    said = [desk.cycle(1e-3)[1] for _ in range(3)]
    assert [(s.cycle, s.flags) for s in said] == [(15, 0), (16, 0), (17, 0)] and counters(desk) == (0, 0)
    plant = desk.node.plant.actuator
    assert [float(plant._live[plant._index[name]]) for name in ("filter.clogging", "spool.dynamic_friction")] == [0, 1]


def table(**changes: object) -> bytes:
    good: dict[str, object] = json.loads(zlib.decompress(scenario().to_bytes()))
    return zlib.compress(json.dumps(good | changes).encode())


REFUSED = {
    "not compressed": b"nonsense", "empty": zlib.compress(b""), "cut short": zlib.compress(b'{"model": {}}')[:-6],
    "no table": zlib.compress(b"[1]"), "nested": zlib.compress(b"[" * 100_000),
    "no such parameter": table(model={"name": "eha", "effects": [], "values": {"spool.colour": 1.0}}),
    "impossible value": table(model={"name": "eha", "effects": [], "values": {"spool.mass": -1.0}}),
    "values no table": table(model={"name": "eha", "effects": [], "values": 5}),
    "load beyond numbers": table(load=[10**30]), "load no list": table(load={"a": 1}), "seed": table(seed="x"),
    "negative seed": table(seed=-1), "negative seed of a fault": table(plan={"faults": [
        {"kind": "noise", "signal": "xj", "value": 1.0, "start": 0.0}], "stop": 10, "seed": -1}),
    "no stop": table(plan={"faults": []}),
    "plan without end": table(plan={"faults": [{"kind": "noise", "signal": "xj", "value": 1.0, "start": 0.0}],
                                    "stop": 10**13}),
    "fault in the controller": table(plan={"faults": [
        {"kind": "parameter", "parameter": "controller.period", "value": 0.01, "start": 0.0}], "stop": 10}),
    "fault out of range": table(plan={"faults": [
        {"kind": "parameter", "parameter": "filter.clogging", "value": 2.0, "start": 0.0}], "stop": 10}),
    "fault that contradicts": table(plan={"faults": [
        {"kind": "parameter", "parameter": "spool.static_friction", "value": 1.0, "start": 0.0}], "stop": 10}),
    "fault beyond time": table(plan={"faults": [
        {"kind": "stuck", "signal": "xj", "start": 0.0, "end": 1e308}], "stop": 10}),
    "fault of nothing": table(plan={"faults": [{"kind": "parameter", "parameter": "a.b", "value": 1.0, "start": 0.0}],
                                    "stop": 10}),
}


@pytest.mark.parametrize("what", REFUSED)
def test_garbage_is_refused_and_the_plant_stays_as_it_was(what: str) -> None:
    desk = PlantDesk(scenario(Parameter(parameter="filter.clogging", value=0.4, start=0.0)), start=False)
    before = desk.node._scenario
    assert desk.download(REFUSED[what]) == Abort.VALUE
    assert desk.node._scenario == before
    desk.nmt(130)  # a reset makes the plant of the scenario anew
    desk.nmt(1)
    assert desk.cycle()[1] == (0.0, 0, 0)


def test_no_new_plant_while_one_runs() -> None:
    desk = PlantDesk(scenario())
    assert desk.download(scenario().to_bytes()) == Abort.STATE


def test_a_plant_without_a_number_says_so_and_stops() -> None:
    """Division by zero far out: EMCY 0x6000, no made-up feedback, and the node lives on."""
    desk = PlantDesk(scenario())
    desk.cycle()
    desk.node.plant.actuator._flat[:] = np.nan
    before = len(desk.frames(codec.FEEDBACK))
    desk.send(codec.SYNC)
    assert desk.emergencies() == [0x6000] and desk.node.device.state is NmtState.PRE_OPERATIONAL
    assert len(desk.frames(codec.FEEDBACK)) == before
    desk.nmt(130)
    desk.nmt(1)
    desk.k = 0
    assert desk.cycle()[1] == (0.0, 0, 0)
