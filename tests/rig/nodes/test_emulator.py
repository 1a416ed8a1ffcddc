"""The emulator and the reference firmware by scripts of frames: what acts when."""

from __future__ import annotations

import json
import struct
import threading
import time
import zlib
from collections.abc import Iterator
from contextlib import closing, contextmanager
from itertools import pairwise

import codec
import numpy as np
import pytest
from bus_stations import only_udp, raw_kinds, spec
from node_bench import MS, FirmwareHarness, PlantHarness

from plant import Actuator, Model
from rig.benches import CIA408, load_bench
from rig.device import Abort, NmtState
from rig.network import GAINS, Frame, Link, RawBus, WallClock, open_can, serve_node
from rig.network.node_objects import decode_cycle_record
from rig.nodes import Emulator, EmulatorService, Scenario, emulator_cycle as ec, list_unheard
from rig.nodes.emulator_service import compile_loop
from rig.nodes.firmware import LOST_AFTER
from rig.run import enter_loop_thread
from rig.sequences import (
    DOUBLE,
    DROP,
    BusOff,
    Corrupted,
    Fault,
    Late,
    Noise,
    Offset,
    Parameter,
    Plan,
    Schedule,
    Short,
    Stuck,
)
from rig.sequences.faults import Duplicated, Lost


class BusHarness:
    """Rig and controller by hand on a real bus, opposite an `EmulatorService` that runs as `rig node plant` runs it."""

    def __init__(self, where: str, scenario: Scenario) -> None:
        self.where, self.scenario, self.k = where, scenario, 0
        self.heard: list[tuple[int, bytes]] = []

    @contextmanager
    def run(self) -> Iterator[BusHarness]:
        compile_loop()
        stop = threading.Event()
        ready = threading.Event()

        def serve() -> None:
            clock = WallClock()
            with RawBus(self.where) as raw, closing(Link(open_can(self.where), clock.now)) as link:
                link.leave_out(list_unheard(load_bench()))
                self.node = EmulatorService(link.send, raw, enter_loop_thread, self.scenario)
                ready.set()
                serve_node(self.node, link, clock, stop.is_set)
                self.node.close()

        thread = threading.Thread(target=serve)
        with closing(Link(open_can(self.where), time.monotonic_ns)) as self.link:
            thread.start()
            try:
                assert ready.wait(120)
                self.await_frame(0x703)
                self.restart()
                yield self
            finally:
                stop.set()
                thread.join()

    def restart(self) -> None:
        """Reset, lockstep (0x1006 = 0: nobody watches SYNC), start."""
        self.nmt(130)
        self.await_frame(0x703)
        self.link.send(0x603, b"\x23\x06\x10" + bytes(5))
        assert self.await_frame(0x583)[0] == 0x60
        self.nmt(1)

    def nmt(self, command: int) -> None:
        self.link.send(0x000, bytes((command, 0)))

    def await_frame(self, cob_id: int, seconds: float = 10.0) -> bytes:
        """The next frame with this COB-ID; all others before it are noted."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for frame in self.link.poll(0.05):
                self.heard.append((frame.cob_id, frame.data))
            for place, (identifier, data) in enumerate(self.heard[self._read:]):
                if identifier == cob_id:
                    self._read += place + 1
                    return data
        raise TimeoutError(f"no frame 0x{cob_id:03X}")

    _read = 0

    def sync(self) -> None:
        self.link.send(codec.SYNC, b"")

    def drive(self, current: float, cycle: int) -> None:
        self.link.send(codec.DRIVE, codec.pack_drive(current, 15, cycle))

    def settle(self) -> None:
        """Until the emulator has dealt with what was sent: it answers an SDO request behind it."""
        self.upload(0x2211, 1)

    def upload(self, index: int, sub: int = 0) -> bytes:
        """SDO upload."""
        self.link.send(0x603, b"\x40" + index.to_bytes(2, "little") + bytes((sub,)) + bytes(4))
        reply = self.await_frame(0x583)
        if reply[0] & 2:
            return reply[4:8 - (reply[0] >> 2 & 3)]
        assert reply[0] == 0x41, reply
        size, data, toggle = int.from_bytes(reply[4:], "little"), b"", 0
        while len(data) < size:
            self.link.send(0x603, bytes((0x60 | toggle,)) + bytes(7))
            segment = self.await_frame(0x583)
            data += segment[1:8 - (segment[0] >> 1 & 7)]
            toggle ^= 0x10
        return data


@pytest.fixture
def harness(bus_kind: str) -> Iterator[BusHarness]:
    """A started emulator without noise, in lockstep."""
    with BusHarness(spec(bus_kind), Scenario(QUIET, Plan(stop=0))).run() as harness:
        yield harness


QUIET = Model().replace({f"sensors.{what}_noise": 0.0 for what in ("position", "pressure", "spool")})


def run_cycle(harness: BusHarness, current: float | None = 0.0) -> codec.ValveState:
    """SYNC, the emulator's two frames, and the drive that answers them (None: none)."""
    harness.sync()
    harness.await_frame(codec.FEEDBACK)
    valve = codec.unpack_valve_state(harness.await_frame(codec.VALVE_STATE))
    if current is not None:
        harness.drive(current, valve.cycle)
    return valve


def write_script(text: str, schedule: Schedule) -> list[tuple[int, bytes]]:
    """Frames: S is a SYNC as faults leave it, D the drive that answers the last one, P a pause by NMT, G its end."""
    frames, k = [], -1
    for letter in text:
        if letter == "S":
            k += 1
            frames += [(codec.SYNC, b"")] * {DROP: 0, DOUBLE: 2}.get(schedule.find_action("sync", k).code, 1)
        else:
            frames.append({"D": (codec.DRIVE, codec.pack_drive(1e-4 * k, 15, k)), "P": (0, b"\x80\x00"),
                           "G": (0, b"\x01\x00")}[letter])
    return frames


class TestServices:
    """The CANopen services beside the loop, and what passes between the two."""

    @raw_kinds
    def test_the_record_of_the_cycles_can_be_read(self, harness: BusHarness) -> None:
        before = time.monotonic_ns()
        for _ in range(20):
            run_cycle(harness)
        run_cycle(harness, None)
        run_cycle(harness)
        record = decode_cycle_record(harness.upload(0x2212))
        after = time.monotonic_ns()
        assert list(record.cycle) == list(range(22))
        assert list(record.flags) == [0] * 21 + [1]
        assert before - MS < record.sync[0] and record.done[-1] < after
        for earlier, later in pairwise((record.sync, record.start, record.sent, record.done)):
            assert np.all(earlier <= later)
        counts = [int.from_bytes(harness.upload(0x2211, sub), "little") for sub in range(1, 10)]
        assert counts[:5] == [1, 0, 22, 0, 0]
        assert abs(counts[7] - int((record.done - record.sync).max()) // 1000) <= 1
        assert counts[8] & 1  # compiled

    @only_udp
    def test_a_short_drive_is_an_emergency_and_counts_as_missing(self, harness: BusHarness) -> None:
        run_cycle(harness, None)
        harness.link.send(codec.DRIVE, b"123")
        assert run_cycle(harness).flags == 1
        harness.settle()
        assert next(data[:2] for cob_id, data in harness.heard if cob_id == 0x083) == b"\x10\x82"

    @only_udp
    def test_a_plant_without_a_number_says_so_and_stops(self, harness: BusHarness) -> None:
        run_cycle(harness)
        words = harness.node._memory.words
        harness.node._memory.reals[words[ec.FLAT_AT]: words[ec.FLAT_AT] + words[ec.FLAT]] = np.nan
        before = sum(cob_id == codec.FEEDBACK for cob_id, _ in harness.heard)
        harness.sync()
        assert harness.await_frame(0x083)[:2] == b"\x00\x60"
        harness.sync()
        harness.settle()
        assert harness.node.device.state is NmtState.PRE_OPERATIONAL
        assert sum(cob_id == codec.FEEDBACK for cob_id, _ in harness.heard) == before
        harness.restart()
        assert run_cycle(harness) == (0.0, 0, 0)

    @only_udp
    @pytest.mark.parametrize(("text", "fault"), [
        ("SD" * 14, Lost(frame="sync", start=0.005, end=0.007)), ("SD" * 14, Lost(frame="sync", start=0.005, end=0.01)),
        ("SD" * 14, Duplicated(frame="sync", start=0.003, end=0.009)),
        ("SD" * 14, BusOff(node="plant", start=0.004, end=0.006)),
        ("SD" * 14, BusOff(node="plant", start=0.004, end=0.009)),
        ("SD" * 14, Corrupted(frame="valve_state", bits=3, start=0.003, end=0.009)),
        ("SD" * 14, Short(frame="feedback", length=3, start=0.003, end=0.006)),
        ("SDSSSSSDSDSD", None),  # the EMCY stands before the feedback of its cycle
        ("SDSDSDPSSSSGSDSDSD", None), ("SD" + "PSGS" * 20, None),  # the loop obeys the order of the bus
    ])
    def test_it_answers_as_the_node_in_python(self, bus_kind: str, text: str, fault: Fault | None) -> None:
        """The same frames in, the same frames out, also where it hears no SYNC or nothing at all."""
        scenario = Scenario(QUIET, Plan(faults=() if fault is None else (fault,), stop=20))
        script = write_script(text, Schedule(scenario.plan))
        answers: list[tuple[int, bytes]] = []
        emulator = Emulator(lambda cob_id, data: answers.append((cob_id, data)), scenario)
        emulator.tick(0)
        for cob_id, data in ((0, b"\x01\x00"), *script):
            emulator.receive(Frame(0, cob_id, data))
        sent_in_cycle = codec.FEEDBACK, codec.VALVE_STATE, 0x083
        answers = [each for each in answers if each[0] in sent_in_cycle]
        with BusHarness(spec(bus_kind), scenario).run() as harness:
            for each in script:
                harness.link.send(*each)
            for _ in range(sum(cob_id == codec.VALVE_STATE for cob_id, _ in answers)):
                harness.await_frame(codec.VALVE_STATE)
            harness.settle()
        assert [each for each in harness.heard if each[0] in sent_in_cycle] == answers

    @only_udp
    def test_the_loop_ends_with_the_services(self, bus_kind: str) -> None:
        with BusHarness(spec(bus_kind), Scenario(QUIET, Plan(stop=0))).run() as harness:
            run_cycle(harness)
            thread = harness.node._thread
            assert thread is not None and thread.is_alive()
        assert not thread.is_alive()

    @raw_kinds
    def test_a_transmission_type_and_a_cob_id_set_by_sdo_are_those_of_the_loop(self, harness: BusHarness) -> None:
        harness.nmt(128)
        for request in (b"\x2f\x00\x18\x02\x02\0\0\0",  # feedback with every second SYNC
                        b"\x23\x00\x14\x01\x82\x01\0\x80", b"\x23\x00\x14\x01\x92\x01\0\0"):  # drive: 0x192
            harness.link.send(0x603, request)
            assert harness.await_frame(0x583)[0] == 0x60
        harness.nmt(1)
        flags = []
        for k in range(6):
            harness.sync()
            flags.append(codec.unpack_valve_state(harness.await_frame(codec.VALVE_STATE)).flags)
            harness.link.send(0x192, codec.pack_drive(0.0, 15, k))
        assert flags == [0] * 6
        assert sum(cob_id == codec.FEEDBACK for cob_id, _ in harness.heard) == 3


STOP = 200


def scenario(*faults: Fault, model: Model = QUIET, load: tuple[int, ...] = (), start: int = 0) -> Scenario:
    plan = Plan(faults=faults, start=start, stop=STOP)
    groups = {fault.parameter.partition(".")[0] for fault in faults if isinstance(fault, Parameter)}
    return Scenario(model.with_effects(groups), plan, load)


def counters(harness: PlantHarness) -> tuple[int, ...]:
    replies = [harness.send(0x603, b"\x40\x11\x22" + bytes((sub, 0, 0, 0, 0))) for sub in (1, 2)]  # object 0x2211
    return tuple(int.from_bytes(data[4:], "little") for data, in replies)


def read_reals(harness: PlantHarness, place: int, count: int = 1) -> list[float]:
    """Numbers of the memory that the cycle works on."""
    return list(harness.node._memory.reals[place:place + count])


def test_the_answer_to_cycle_k_acts_from_cycle_k_plus_1() -> None:
    """Sample 1 saw a plant without current, sample 2 one millisecond of it: as the plant alone, to the bit."""
    harness, alone = PlantHarness(scenario()), Actuator(QUIET)
    currents = [4e-3, -2e-3, 0.0, 1e-3, 3e-3]
    for k, current in enumerate(currents):
        feedback, valve = harness.cycle(current)
        xj, p12, xs = alone.sample()
        assert feedback == codec.unpack_feedback(codec.pack_feedback(xj, p12))
        assert valve == codec.unpack_valve_state(codec.pack_valve_state(xs, 0, k))
        alone.advance(currents[k - 1] if k else 0.0)
    assert counters(harness) == (0, 0)


@pytest.mark.parametrize(("drives", "flags", "counts", "emergencies", "current"), [
    (".-<..", [0, 0, 1, 2, 0], (1, 1), [], 2e-3),  # the current stays
    (".---", [0, 0, 1, 1], (2, 0), [], 2e-3),
    (".---.", [0, 0, 1, 1, 5], (3, 0), [0x8250], 0.0),  # three in a row cut it ..
    (".---..", [0, 0, 1, 1, 5, 0], (3, 0), [0x8250, 0], 2e-3),  # .. and an answer brings it back
    ("<<<<<", [0, 2, 2, 6, 6], (0, 4), [0x8250], 0.0),
])
def test_missing_and_late_drives(drives: str, flags: list[int], counts: tuple[int, int], emergencies: list[int],
                                 current: float) -> None:
    """A drive after each SYNC: one that answers it, none (-), or one that answers another cycle (<)."""
    harness = PlantHarness(scenario())
    assert [harness.cycle(None if drive == "-" else 2e-3, answers=60_000 if drive == "<" else None)[1].flags
            for drive in drives] == flags
    assert (counters(harness), harness.emergencies(), read_reals(harness, ec.IN_FORCE)) == (
        counts, emergencies, [current])


@pytest.mark.parametrize(("fault", "two", "counts"), [
    (Lost(frame="drive", start=0.003, count=1), [1, 0], (1, 0)),
    (Late(frame="drive", start=0.003, end=0.004, delay=1.5e-3), [1, 2], (1, 1)),
    (Late(frame="drive", start=0.003, end=0.004, delay=0.5e-3), [0, 0], (0, 0))])  # what comes last counts
def test_lost_and_late_drive_as_the_plan_says(fault: Fault, two: list[int], counts: tuple[int, int]) -> None:
    harness = PlantHarness(scenario(fault))
    assert [harness.cycle(1e-3)[1].flags for _ in range(8)] == [0, 0, 0, 0, *two, 0, 0]
    assert counters(harness) == counts


def test_feedback_lost_and_late() -> None:
    """A late frame carries what was sampled, not what is true by then."""
    harness = PlantHarness(scenario(Lost(frame="feedback", start=0.002, end=0.003),
                                    Late(frame="feedback", start=0.004, end=0.005, delay=1.5e-3),
                                    Lost(frame="valve_state", start=0.005, end=0.006)))
    for _ in range(8):
        harness.cycle(5e-3)
    when = [t_ns / MS for t_ns, cob, _ in harness.heard if cob == codec.FEEDBACK]
    assert when == [0, 1, 3, 5, 6, 6, 7]  # that of cycle 4 was due at 5.5 ms, the tick is at 6
    assert [codec.unpack_valve_state(data).cycle for data in harness.frames(codec.VALVE_STATE)] == [0, 1, 2, 3, 4, 6, 7]
    sound = PlantHarness(scenario())
    for _ in range(8):
        sound.cycle(5e-3)
    assert sorted(harness.frames(codec.FEEDBACK)) == sorted(
        data for k, data in enumerate(sound.frames(codec.FEEDBACK)) if k != 2)


def test_sensor_faults_show_in_the_frames_only() -> None:
    harness = PlantHarness(scenario(Stuck(signal="xj", start=0.002, end=0.004, value=3e-3),
                                    Offset(signal="p12", start=0.004, end=0.006, value=1e6),
                                    Noise(signal="xs", start=0.006, value=1e-6)))
    sound = PlantHarness(scenario())
    a, b = [[d.cycle(1e-3) for _ in range(20)] for d in (harness, sound)]
    assert [f.position for f, _ in a[2:4]] == [3e-3, 3e-3]
    assert [x.pressure - y.pressure for (x, _), (y, _) in zip(a[4:6], b[4:6], strict=True)] == pytest.approx([1e6, 1e6])
    assert [x for x, _ in a[6:]] == [y for y, _ in b[6:]]
    assert np.std([x.spool - y.spool for (_, x), (_, y) in zip(a[6:], b[6:], strict=True)]) > 3e-7
    ours, other = (read_reals(each, *each.node._memory.words[[ec.FLAT_AT, ec.FLAT]]) for each in (harness, sound))
    assert ours == other


@pytest.mark.parametrize(("faults", "readings", "outputs"), [
    ([Stuck(signal="xj", start=0.003, end=0.006)], range(8), [0, 1, 2, 2, 2, 2, 6, 7]),
    ([Stuck(signal="xj", value=7.0, start=0.0, end=0.001)], [1, 1], [7, 1]),
    ([Offset(signal="xj", value=4.0, start=0.0, end=0.006, ramp=0.004)], [1] * 7, [1, 2, 3, 4, 5, 5, 1]),
    ([Offset(signal="xs", value=4.0, start=0.0)], [1], [1]),
    ([Offset(signal="xj", value=1.0, start=0.0), Stuck(signal="xj", value=9.0, start=0.0)], [0], [9]),  # in this order
])
def test_sensor_faults(faults: list[Fault], readings: list[float], outputs: list[float]) -> None:
    memory = ec.make_memory(scenario(*faults))
    assert [ec._disturb(memory, 0, float(value), k) for k, value in enumerate(readings)] == outputs


def test_noise_has_its_size_and_depends_on_seed_and_cycle_only() -> None:
    plans = [Plan(faults=(Noise(signal="xj", value=3e-6, start=0.0),), stop=10_000, seed=seed) for seed in (1, 1, 2)]
    one, same, other = (ec.make_memory(Scenario(QUIET, plan)) for plan in plans)
    values = [ec._disturb(one, 0, 0.0, k) for k in range(10_000)]
    assert np.std(values) == pytest.approx(3e-6, rel=0.03) and abs(np.mean(values)) < 1e-7
    assert values[77] == ec._disturb(same, 0, 0.0, 77) != ec._disturb(other, 0, 0.0, 77)


def test_after_a_pause_the_cycle_is_that_of_the_bus_and_no_fault_was_slept_through() -> None:
    """A fault that ended meanwhile has ended; one that began has begun; the first cycle is nobody's miss."""
    harness = PlantHarness(Scenario(QUIET, Plan(faults=(
        Parameter(parameter="filter.clogging", value=0.4, start=0.002, end=0.012),
        Parameter(parameter="spool.dynamic_friction", value=1.0, start=0.013)), stop=STOP)))
    for _ in range(5):
        harness.cycle(1e-3)
    harness.nmt(128)
    for _ in range(10):
        harness.send(codec.SYNC)
        harness.k += 1
        harness.wait(MS)
    harness.nmt(1)
    signals = [harness.cycle(1e-3)[1] for _ in range(3)]
    assert [(s.cycle, s.flags) for s in signals] == [(15, 0), (16, 0), (17, 0)] and counters(harness) == (0, 0)
    names, live = QUIET.list_names(), int(harness.node._memory.words[ec.LIVE_AT])
    assert [read_reals(harness, live + names.index(name))
            for name in ("filter.clogging", "spool.dynamic_friction")] == [[0.0], [1.0]]


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
    harness = PlantHarness(scenario(Parameter(parameter="filter.clogging", value=0.4, start=0.0)), start=False)
    before = harness.node._scenario
    assert harness.download(REFUSED[what]) == Abort.VALUE
    assert harness.node._scenario == before
    harness.nmt(130)  # a reset makes the plant of the scenario anew
    harness.nmt(1)
    assert harness.cycle()[1] == (0.0, 0, 0)


def test_no_new_plant_while_one_runs() -> None:
    assert PlantHarness(scenario()).download(scenario().to_bytes()) == Abort.STATE


ACTIVE, RESET = CIA408.ladder[-1], CIA408.reset


def pause(harness: FirmwareHarness) -> None:
    """PRE-OPERATIONAL and back."""
    harness.nmt(128)
    harness.nmt(1)


def set_gain(harness: FirmwareHarness, sub: int, value: float) -> int:
    """SDO download of a REAL64; the abort code or 0."""
    harness.send(0x602, b"\x21" + GAINS.to_bytes(2, "little") + bytes((sub, 8, 0, 0, 0)))
    data = struct.pack("<d", value)
    harness.send(0x602, b"\x00" + data[:7])
    reply = harness.send(0x602, b"\x1d" + data[7:].ljust(7, b"\0"))[0]
    return int.from_bytes(reply[4:], "little") if reply[0] == 0x80 else 0


@pytest.mark.parametrize(("control", "status"), [
    (0b000, 0b1000), (0b001, 0b1001), (0b011, 0b1011), (0b111, 0b1111),
    (0b010, 0b1000), (0b100, 0b1000), (0b101, 0b1000), (0b110, 0b1000),
])
def test_the_levels_build_on_each_other(control: int, status: int) -> None:
    """Current flows with all three, and none is skipped."""
    drive = FirmwareHarness().cycle(control, demand=1e-3)
    assert drive is not None and drive.status == status
    assert (drive.current != 0) == (control == ACTIVE)


def test_lost_feedback_is_a_fault_that_is_latched_until_its_cause_is_gone_and_reset_rises() -> None:
    harness = FirmwareHarness()
    harness.cycle(ACTIVE | RESET, 1e-3)  # a bit that is up already acknowledges nothing
    drives = [harness.cycle(ACTIVE | RESET, 1e-3, position=None) for _ in range(LOST_AFTER + 1)]
    assert [d is not None for d in drives] == [False] * LOST_AFTER + [True]
    assert drives[-1] is not None and (drives[-1].current, drives[-1].status) == (0.0, 0)
    harness.cycle(ACTIVE, position=None)
    harness.cycle(ACTIVE | RESET, position=None)  # while the cause stands
    assert harness.emergencies() == [0x8250]
    assert not harness.status(ACTIVE | RESET, 2)
    assert harness.emergencies() == [0x8250, 0]  # feedback is back, the fault is not
    assert not harness.status(ACTIVE, 1)
    assert harness.status(ACTIVE | RESET, 1) == ACTIVE | 8
    assert harness.status(ACTIVE, 1) == ACTIVE | 8


def test_a_restart_takes_the_fault_but_not_the_error_that_stands() -> None:
    """START after a pause: the emergency is taken back with the first feedback, and the next fault can be reset."""
    harness = FirmwareHarness()
    for _ in range(LOST_AFTER + 1):
        harness.cycle(ACTIVE, position=None)
    pause(harness)
    assert harness.status(ACTIVE, 1) == ACTIVE | 8
    assert harness.emergencies() == [0x8250, 0] and harness.node.device.emcy.active == []


@pytest.mark.parametrize(("sub", "value", "is_taken"), [
    (1, float("nan"), False), (1, float("inf"), False), (1, float("-inf"), False),
    (4, -1e-3, False), (4, 0.0, True), (5, 0.0, False), (5, -1e-3, False), (5, 5e-324, True),
])
def test_gains_that_cannot_be_are_refused(sub: int, value: float, is_taken: bool) -> None:
    harness = FirmwareHarness()
    assert set_gain(harness, 3, 1.0) == 0  # with a derivative part the period is divided by
    assert set_gain(harness, sub, value) == (0 if is_taken else Abort.VALUE)
    pause(harness)
    assert [harness.cycle(ACTIVE, 1e-3 * k) is not None for k in range(3)] == [True] * 3
