"""The compiled emulator on a bus: the same numbers as the emulator on the embedded bus, whatever the faults."""
from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise

import codec
import numpy as np
import pytest
from bus_stations import spec
from node_bench import MS

from plant import Model
from rig.benches.bench_file import load_bench
from rig.device import NmtState
from rig.network.bus import Link, open_can, serve_node
from rig.network.frame import Frame, WallClock
from rig.network.node_objects import decode_cycle_record
from rig.network.raw_bus import RawBus
from rig.nodes import emulator_cycle as ec
from rig.nodes.emulator import Emulator
from rig.nodes.emulator_service import EmulatorService, compile_loop, list_unheard
from rig.nodes.scenario import Scenario
from rig.run.priority import enter_loop_thread
from rig.sequences.faults import DOUBLE, DROP, BusOff, Corrupted, Duplicated, Fault, Lost, Plan, Schedule, Short

raw_kinds = pytest.mark.parametrize("bus_kind", ["udp_multicast", "socketcan"], indirect=True)


class BusDesk:
    """Rig and controller by hand on a real bus, opposite an `EmulatorService` that runs as `rig node plant` runs it."""

    def __init__(self, where: str, scenario: Scenario) -> None:
        self.where, self.scenario, self.k = where, scenario, 0
        self.heard: list[tuple[int, bytes]] = []

    @contextmanager
    def run(self) -> Iterator[BusDesk]:
        compile_loop()
        ended = threading.Event()
        ready = threading.Event()

        def serve() -> None:
            clock = WallClock()
            with RawBus(self.where) as raw:
                link = Link(open_can(self.where), clock.now)
                link.leave_out(list_unheard(load_bench()))
                self.node = EmulatorService(link.send, raw, enter_loop_thread, self.scenario)
                ready.set()
                serve_node(self.node, link, clock, ended.is_set)
                self.node.close()
                link.close()

        thread = threading.Thread(target=serve)
        self.link = Link(open_can(self.where), time.monotonic_ns)
        thread.start()
        try:
            assert ready.wait(120)
            self.await_frame(0x703)
            self.restart()
            yield self
        finally:
            ended.set()
            thread.join()
            self.link.close()

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
            for place, (heard, data) in enumerate(self.heard[self._read:]):
                if heard == cob_id:
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
def desk(bus_kind: str) -> Iterator[BusDesk]:
    """A started emulator without noise, in lockstep."""
    with BusDesk(spec(bus_kind), Scenario(QUIET, Plan(stop=0))).run() as started:
        yield started


QUIET = Model().replace({f"sensors.{what}_noise": 0.0 for what in ("position", "pressure", "spool")})


def run_cycle(desk: BusDesk, current: float | None = 0.0) -> codec.ValveState:
    """SYNC, the emulator's two frames, and the drive that answers them (None: none)."""
    desk.sync()
    desk.await_frame(codec.FEEDBACK)
    valve = codec.unpack_valve_state(desk.await_frame(codec.VALVE_STATE))
    if current is not None:
        desk.drive(current, valve.cycle)
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


@raw_kinds
class TestServices:
    """The CANopen services beside the loop, and what passes between the two."""

    def test_the_record_of_the_cycles_can_be_read(self, desk: BusDesk) -> None:
        before = time.monotonic_ns()
        for _ in range(20):
            run_cycle(desk)
        run_cycle(desk, None)
        run_cycle(desk)
        record = decode_cycle_record(desk.upload(0x2212))
        after = time.monotonic_ns()
        assert list(record.cycle) == list(range(22))
        assert list(record.flags) == [0] * 21 + [1]
        assert before - MS < record.sync[0] and record.done[-1] < after
        for earlier, later in pairwise((record.sync, record.start, record.sent, record.done)):
            assert np.all(earlier <= later)
        assert np.all(record.done[:-1] < record.sync[1:] + MS)
        counts = [int.from_bytes(desk.upload(0x2211, sub), "little") for sub in range(1, 10)]
        assert counts[:5] == [1, 0, 22, 0, 0]
        assert abs(counts[7] - int((record.done - record.sync).max()) // 1000) <= 1
        assert counts[8] & 1  # compiled

    def test_a_short_drive_is_an_emergency_and_counts_as_missing(self, desk: BusDesk) -> None:
        run_cycle(desk, None)
        desk.link.send(codec.DRIVE, b"123")
        assert run_cycle(desk).flags == 1
        desk.settle()
        assert next(data[:2] for cob_id, data in desk.heard if cob_id == 0x083) == b"\x10\x82"

    def test_a_plant_without_a_number_says_so_and_stops(self, desk: BusDesk) -> None:
        run_cycle(desk)
        words = desk.node._memory.words
        desk.node._memory.reals[words[ec.FLAT_AT]: words[ec.FLAT_AT] + words[ec.FLAT]] = np.nan
        before = sum(cob_id == codec.FEEDBACK for cob_id, _ in desk.heard)
        desk.sync()
        assert desk.await_frame(0x083)[:2] == b"\x00\x60"
        desk.sync()
        desk.settle()
        assert desk.node.device.state is NmtState.PRE_OPERATIONAL
        assert sum(cob_id == codec.FEEDBACK for cob_id, _ in desk.heard) == before
        desk.restart()
        assert run_cycle(desk) == (0.0, 0, 0)

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
    def test_it_answers_as_the_emulator_in_python(self, bus_kind: str, text: str, fault: Fault | None) -> None:
        """The same frames in, the same frames out, also where it hears no SYNC or nothing at all."""
        scenario = Scenario(QUIET, Plan(faults=() if fault is None else (fault,), stop=20))
        script = write_script(text, Schedule(scenario.plan))
        expected: list[tuple[int, bytes]] = []
        emulator = Emulator(lambda cob_id, data: expected.append((cob_id, data)), scenario)
        emulator.tick(0)
        for cob_id, data in ((0, b"\x01\x00"), *script):
            emulator.receive(Frame(0, cob_id, data))
        sent_in_cycle = codec.FEEDBACK, codec.VALVE_STATE, 0x083
        expected = [each for each in expected if each[0] in sent_in_cycle]
        with BusDesk(spec(bus_kind), scenario).run() as desk:
            for each in script:
                desk.link.send(*each)
            for _ in range(sum(cob_id == codec.VALVE_STATE for cob_id, _ in expected)):
                desk.await_frame(codec.VALVE_STATE)
            desk.settle()
        assert [each for each in desk.heard if each[0] in sent_in_cycle] == expected

    def test_the_loop_ends_with_the_services(self, bus_kind: str) -> None:
        with BusDesk(spec(bus_kind), Scenario(QUIET, Plan(stop=0))).run() as desk:
            run_cycle(desk)
            thread = desk.node._thread
            assert thread is not None and thread.is_alive()
        assert not thread.is_alive()

    def test_a_transmission_type_and_a_cob_id_set_by_sdo_are_those_of_the_loop(self, desk: BusDesk) -> None:
        desk.nmt(128)
        for request in (b"\x2f\x00\x18\x02\x02\0\0\0",  # feedback with every second SYNC
                        b"\x23\x00\x14\x01\x82\x01\0\x80", b"\x23\x00\x14\x01\x92\x01\0\0"):  # drive: 0x192
            desk.link.send(0x603, request)
            assert desk.await_frame(0x583)[0] == 0x60
        desk.nmt(1)
        flags = []
        for k in range(6):
            desk.sync()
            flags.append(codec.unpack_valve_state(desk.await_frame(codec.VALVE_STATE)).flags)
            desk.link.send(0x192, codec.pack_drive(0.0, 15, k))
        assert flags == [0] * 6
        assert sum(cob_id == codec.FEEDBACK for cob_id, _ in desk.heard) == 3
