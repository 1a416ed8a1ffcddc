"""The cycle on a real bus, compiled in real time and Python in lockstep, against nodes that answer as the script says.

Any thread may stand still for half a second here: the machine is shared. So these tests ask for order and number and
for what follows from what, and where an answer is needed they play on until it has come.
"""

import struct
import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from itertools import groupby, pairwise
from math import isnan
from typing import Any

import codec
import pytest
from bus_stations import only_udp, raw_kinds, spec
from log_rows import CycleList
from numba.core.event import install_recorder

from plant import Model
from rig.benches import load_bench
from rig.network import Frame, Link, LinkWire, Master, WallClock, open_can
from rig.network.udp import PORT, Turn
from rig.nodes import Scenario
from rig.recorder import Signals
from rig.run import CycleInput, compile_cycle
from rig.run.hard_loop import HardLoop
from rig.run.loop import CycleLoop
from rig.sequences import BusOff, Corrupted, Fault, Jitter, Late, Plan, Schedule, Short
from rig.sequences.faults import Duplicated, Lost

PERIOD = 10_000_000  # ns: ten times the bench's, because the nodes of this test are Python on a busy machine


class Nodes(threading.Thread):
    """Plant and controller: three answers to each SYNC, the number of the cycle in each value. Keeps what it hears."""

    def __init__(self, where: str) -> None:
        super().__init__(daemon=True)
        self.heard: list[Frame] = []
        self.mute = False
        self._command = self._syncs = 0
        self._end = threading.Event()
        self._link = Link(open_can(where), time.monotonic_ns)
        self.start()

    def run(self) -> None:
        while not self._end.is_set():
            for frame in self._link.poll(0.02):
                self.heard.append(frame)
                if frame.cob_id == codec.SYNC and not self.mute:
                    k = self._syncs
                    self._link.send(codec.FEEDBACK, codec.pack_feedback(k * 1e-6, k * 10.0))
                    self._link.send(codec.VALVE_STATE, codec.pack_valve_state(k * 1e-9, 0, k))
                    self._link.send(codec.DRIVE, codec.pack_drive(k * 1e-8, 15, k))
                self._syncs += frame.cob_id == codec.SYNC

    def close(self) -> None:
        self._end.set()
        self.join()
        self._link.close()

    def wait_for(self, cob_id: int, data: bytes, limit: float = 60.0) -> None:
        """Until they have heard this frame."""
        end = time.monotonic() + limit
        while not any((frame.cob_id, frame.data) == (cob_id, data) for frame in reversed(self.heard[:])):
            assert time.monotonic() < end, f"the nodes have not heard 0x{cob_id:03X} for {limit:g} s"
            time.sleep(0.005)

    def commands(self) -> list[codec.Command]:
        return [codec.unpack_command(frame.data) for frame in self.heard if frame.cob_id == codec.COMMAND]

    def order(self) -> list[str]:
        """Commands and SYNCs as they were heard: c3 is the command of cycle 3."""
        names, syncs = [], 0
        for frame in self.heard:
            if frame.cob_id == codec.SYNC:
                names.append(f"s{syncs}")
                syncs += 1
            elif frame.cob_id == codec.COMMAND:
                names.append(f"c{codec.unpack_command(frame.data).cycle}")
        return names


class Bench(CycleList):
    """A loop on a bus with nodes, and a log of all it says."""

    def __init__(self, where: str, realtime: bool, faults: tuple[Fault, ...], ahead: int) -> None:
        super().__init__()
        clock = WallClock()
        self.where = where
        self.nodes = Nodes(where)
        self.wire = LinkWire(Link(open_can(where), clock.now), clock, 0.5)
        self.frames: list[Frame] = []
        self.master = Master(self.wire, lambda: self.loop.now(), realtime, load_bench())
        self.master.hooks.on_frame = self.frames.append
        schedule = Schedule(Plan(faults=faults, stop=1000))
        bench = replace(load_bench(), cycle_ns=PERIOD)
        parts = self.master, bench, Scenario(Model(), Plan(stop=0)), schedule, self
        self.loop: Any = HardLoop(*parts, where, ahead) if realtime else CycleLoop(
            *parts, realtime=False)
        self._markers = 0

    def play(self, *cycles: int, control: int = 7, phase: int = 1) -> None:
        """Give inputs whose demand is their number in 0.1 um."""
        for k in cycles:
            self.loop.cycle(CycleInput(phase, k * 1e-7, float(k), control))

    def play_until(self, is_done: Callable[[], bool], limit: float = 60.0) -> None:
        """Real time: let cycles pass, with the last demand again, until `is_done()`."""
        end = time.monotonic() + limit
        while not is_done():
            assert time.monotonic() < end, f"not in {limit:g} s of cycles"
            self.loop.serve()

    def settle(self) -> None:
        """Until the nodes have heard all that was sent: this frame comes to them behind it."""
        self._markers += 1
        marker = 0x7FE, bytes((self._markers,))
        self.wire.link.send(*marker)
        self.nodes.wait_for(*marker)

    def logged(self, cob_id: int) -> list[bytes]:
        """The data of all frames with that COB-ID in the log."""
        return [frame.data for frame in self.frames if frame.cob_id == cob_id]

    def demands(self) -> list[int]:
        return [round(row.com * 1e7) for row in self.rows]

    def check_demands(self, demand_order: list[int], idle: Collection[int] = ()) -> None:
        """These demands in this order, in consecutive cycles. A demand that is not one of `idle` stays for longer only
        because this program had not queued the next one in time, and each such cycle is an underrun.
        """
        demands = self.demands()
        assert [demand for demand, _ in groupby(demands)] == demand_order
        assert [row.cycle for row in self.rows] == list(range(len(demands)))
        repeats = [k for k in range(1, len(demands)) if demands[k] == demands[k - 1] and demands[k] not in idle]
        assert self.loop.underruns == len(repeats) <= self.loop.overruns
        assert all(self.timings[k].overrun for k in repeats)


@contextmanager
def bench(kind: str, realtime: bool, *faults: Fault, ahead: int = 50) -> Iterator[Bench]:
    one = Bench(spec(kind), realtime, faults, ahead)
    with closing(one.wire), closing(one.nodes), closing(one.loop):
        yield one


paces = pytest.mark.parametrize("realtime", [False, True], ids=["lockstep", "realtime"])


@raw_kinds
@paces
def test_rows_and_log(bus_kind: str, realtime: bool) -> None:
    """Valve state and drive carry the number of their cycle. Feedback does not: a late one is the next cycle's.

    Every frame reaches the log once and in order: those of the cycle, and those that the services send and receive on
    their own socket. Nothing is compiled once the loop is made.
    """
    with (bench(bus_kind, realtime) as one, install_recorder("numba:compiler_lock") as compilations,
          closing(Link(open_can(one.where), time.monotonic_ns)) as other):
        one.master._beat.configure(1, one.wire.clock.now())
        for k in range(30):
            one.play(k)
            other.send(0x123, bytes([k]))

        def whole() -> list[Signals]:
            """Rows with all three answers, and feedback of their own SYNC."""
            return [row for row in one.rows if not (isnan(row.xj) or isnan(row.xs) or isnan(row.cor))
                    and round(row.xj * 1e6) == row.cycle]

        if realtime:
            one.loop.wait_until_played(lambda: False)
            one.play_until(lambda: bool(whole()) and one.logged(codec.DRIVE)[29:] != [])
        one.loop.finish()
        one.wire.poll(0.0)
        one.loop.close()
        one.settle()
        assert compilations.buffer == []
        one.check_demands(list(range(30)), idle=[29])
        assert realtime or all(later - earlier == PERIOD for earlier, later in pairwise(one.times))
        assert realtime or len(whole()) == len(one.logged(codec.DRIVE)) == 30
        for row in one.rows:
            k = row.cycle
            assert isnan(row.xs) or row.xs == pytest.approx(k * 1e-9)
            assert isnan(row.cor) or (row.cor == pytest.approx(k * 1e-8) and row.status == 15)
            assert isnan(row.xj) or (row.xj <= (k + 0.5) * 1e-6 and row.p12 == pytest.approx(row.xj * 1e7))
            assert (row.phase, row.load, row.control, row.flags) == (1, min(float(k), 29.0), 7, 0) or one.loop.underruns
        feedback = [round(row.xj * 1e6) for row in one.rows if not isnan(row.xj)]
        assert feedback == sorted(set(feedback))
        assert one.nodes.order()[:6] == ["c0", "s0", "c1", "s1", "c2", "s2"]
        for timing in (one.timings[row.cycle] for row in whole()):
            assert 0 < timing.feedback_response <= timing.valve_response <= timing.response <= timing.work
        assert all(earlier.t_ns <= later.t_ns for earlier, later in pairwise(one.frames))
        assert [data[0] for data in one.logged(0x123)] == list(range(30))
        for cob_id in (codec.COMMAND, codec.SYNC, 0x701):
            assert one.logged(cob_id) == [frame.data for frame in one.nodes.heard if frame.cob_id == cob_id] != []
        drives = one.logged(codec.DRIVE)
        assert drives == [codec.pack_drive(k * 1e-8, 15, k) for k in range(len(drives))]
        compile_cycle.cache_clear()
        compile_cycle()
        assert compilations.buffer  # the listener hears


@only_udp
@paces
def test_commands_lost_and_late(bus_kind: str, realtime: bool) -> None:
    """A late command is sent before the first SYNC that is due after it."""
    faults = (Lost(frame="command", start=0.001, end=0.002), Late(frame="command", start=0.003, end=0.004, delay=4e-3),
              Late(frame="command", start=0.005, end=0.006, delay=25e-3))
    with bench(bus_kind, realtime, *faults) as one:
        one.play(*range(12))
        one.loop.finish()
        one.settle()
        order, count = one.nodes.order(), len(one.rows)
        assert [name for name in order if name[0] == "s"] == [f"s{k}" for k in range(count)]
        assert [name for name in order if name[0] == "c" and name not in ("c3", "c5")] == [
            f"c{k}" for k in range(count) if k not in (1, 3, 5)]
        due = [one.times[0], *(t_ns + PERIOD for t_ns in one.times)]  # before missed due times are dropped
        following = []
        for k, delay in ((3, 4_000_000), (5, 25_000_000)):
            following.append(next(each for each in range(k + 1, count) if due[each] > one.times[k] + delay))
            before, after = (order.index(f"s{each}") for each in (following[-1] - 1, following[-1]))
            assert before < order.index(f"c{k}") < after
        if all(later - earlier == PERIOD for earlier, later in pairwise(one.times)):
            assert following == [4, 8]
        else:
            assert realtime and one.loop.overruns


@raw_kinds
def test_commands_and_syncs_changed_by_faults(bus_kind: str) -> None:
    faults = (
        Lost(frame="sync", start=0.002, end=0.003), Duplicated(frame="sync", start=0.004, end=0.005),
        Corrupted(frame="command", start=0.006, end=0.007, bits=64), Short(frame="command", start=0.007, end=0.008,
                                                                          length=3),
        Duplicated(frame="command", start=0.008, end=0.009), BusOff(node="rig", start=0.010, end=0.012),
        Jitter(size=9e-4, start=0.013, end=0.014))
    with bench(bus_kind, True, *faults) as one:
        one.play(*range(16))
        one.loop.finish()
        one.settle()
        one.check_demands(list(range(16)))
        more = len(one.rows) - 16  # the last demand again, while this program stood still
        frames = [frame for frame in one.nodes.heard if frame.cob_id in (codec.SYNC, codec.COMMAND)]
        assert sum(frame.cob_id == codec.SYNC for frame in frames) == 16 - 1 + 1 - 2 + more
        commands = [frame.data for frame in frames if frame.cob_id == codec.COMMAND]
        plain = [codec.pack_command(min(k, 15) * 1e-7, 7, k) for k in range(16 + more)]
        inverse = bytes(255 - byte for byte in plain[6])
        assert commands == [*plain[:6], inverse, plain[7][:3], plain[8], *plain[8:10], *plain[12:]]
        for cycle, syncs in ((2, 2), (10, 10), (11, 10)):  # no SYNC in this cycle, so many before
            replies = {round(row.xj * 1e6) for row in one.rows[:cycle] if not isnan(row.xj)}
            xj = one.rows[cycle].xj
            late = not isnan(xj) and syncs - 1 not in replies and round(xj * 1e6) in set(range(syncs)) - replies
            assert isnan(xj) or late


@only_udp
def test_an_empty_queue_holds_the_last_demand(bus_kind: str) -> None:
    """And each such cycle counts as an overrun: the bench left its sequence."""
    with bench(bus_kind, True, ahead=10) as one:
        one.play(*range(5))
        one.play_until(lambda: one.loop.k >= 12)
        one.play(20, 21)
        one.loop.finish()
        one.check_demands([0, 1, 2, 3, 4, 20, 21])
        assert one.loop.underruns == len(one.rows) - 7 >= 12 - 5
        assert {row.control for row in one.rows} == {7}


@only_udp
def test_waiting_for_the_end_of_the_queue_is_no_underrun(bus_kind: str) -> None:
    """Neither is the hold behind it. The ring has eight rows for each input ahead: Python may be held for 0.4 s."""
    with bench(bus_kind, True, ahead=60) as one:
        one.play(*range(60))
        assert one.loop.waiting <= 58  # the next input must not be written over the last one, which is held
        one.loop.wait_until_played(lambda: False)
        assert one.loop.waiting == 0
        underruns, k = one.loop.underruns, one.loop.k
        one.play_until(lambda: one.loop.k >= k + 3)
        assert one.loop.hold(2) == pytest.approx(59e-7)
        hold_cycle = one.loop.k
        one.play_until(lambda: one.loop.k >= hold_cycle + 3)
        assert one.loop.underruns == underruns
        one.play(30, phase=2)
        one.loop.finish()
        one.check_demands([*range(60), 30], idle=[59])
        phases = [row.phase for row in one.rows]
        assert phases == sorted(phases) and set(phases) == {1, 2}
        assert set(phases[:60]) == {1} and set(phases[hold_cycle:]) == {2}


@only_udp
def test_the_control_word_is_overridden_and_hold_discards_what_is_queued(bus_kind: str) -> None:
    """An abort: no current from the next cycle on, and clean-up begins where the demand was."""
    with bench(bus_kind, True, ahead=500) as one:
        one.play(*range(400))
        one.play_until(lambda: one.loop.k >= 5)
        before = one.loop.k
        one.loop.override_control(0)
        after = one.loop.k
        one.play_until(lambda: one.loop.k >= after + 3)
        demand = round(one.loop.hold(2) * 1e7)
        hold_cycle = one.loop.k
        one.play(1000, phase=2, control=3)
        one.loop.finish()
        one.check_demands([*range(demand + 1), 1000], idle=[demand])
        assert {row.phase for row in one.rows[:demand]} == {1} and {row.phase for row in one.rows[hold_cycle:]} == {2}
        words = [row.control for row in one.rows]
        assert [word for word, _ in groupby(words)] == [7, 0, 3] and before <= words.index(0) <= after + 1
        assert one.demands()[words.index(3)] == 1000
        one.settle()
        assert [round(command.position * 1e7) for command in one.nodes.commands()] == one.demands()
        assert [command.control for command in one.nodes.commands()] == words


@only_udp
def test_a_late_cycle_drops_due_times_and_counts_them(bus_kind: str) -> None:
    """The turn to send on the bus is held for 5 periods: no burst follows, and the grid stays."""
    with bench(bus_kind, True) as one, closing(Turn(one.where.partition(":")[2], PORT)) as turn:
        one.play(*range(20))
        one.play_until(lambda: one.loop.k >= 5)
        turn.take()
        time.sleep(5.2 * PERIOD * 1e-9)
        turn.give()
        one.loop.finish()
        steps = [(later - earlier) / PERIOD for earlier, later in pairwise(one.times)]
        assert all(step == round(step) >= 1 for step in steps) and max(steps) >= 4
        late = [k for k, timing in enumerate(one.timings) if timing.lateness > 0.5 * PERIOD * 1e-9]
        assert late and all(one.timings[k].overrun for k in late)
        assert one.loop.overruns >= 4
        one.check_demands(list(range(20)))


@only_udp
@paces
def test_frames_of_another_cycle_or_length_are_no_answers(bus_kind: str, realtime: bool) -> None:
    with bench(bus_kind, realtime) as one, closing(Link(open_can(one.where), time.monotonic_ns)) as stranger:
        one.nodes.mute = True
        for k in range(3):
            for cob_id in (codec.FEEDBACK, codec.VALVE_STATE, codec.DRIVE):
                stranger.send(cob_id, bytes(7))
            stranger.send(codec.DRIVE, codec.pack_drive(1e-3, 15, k + 77))
            stranger.send(codec.VALVE_STATE, codec.pack_valve_state(1e-3, 0, k + 77))
            one.play(k)
        one.loop.finish()
        for row, timing in zip(one.rows, one.timings, strict=True):
            assert all(map(isnan, (row.xj, row.p12, row.xs, row.cor, timing.response, timing.work)))
            assert all(map(isnan, (timing.feedback_response, timing.valve_response)))


@only_udp
@paces
def test_a_second_rig_is_told(bus_kind: str, realtime: bool) -> None:
    with bench(bus_kind, realtime) as one, closing(Link(open_can(one.where), time.monotonic_ns)) as rig:
        rivals: list[int] = []
        one.master.hooks.on_rival = rivals.append
        one.play(0, 1)
        rig.send(codec.COMMAND, struct.pack("<iHH", 0, 7, 500))
        rig.send(0x000, b"\x80\x00")
        one.play(*range(2, 10))
        one.loop.finish()
        assert sorted(rivals) == [0x000, codec.COMMAND]


def test_closing_ends_the_thread_whatever_is_queued() -> None:
    before = threading.active_count()
    with bench("udp_multicast", True, ahead=500) as one:
        one.play(*range(400))
        assert threading.active_count() > before
    assert threading.active_count() == before
    assert len(one.rows) < 400
    one.check_demands(list(range(len({row.com for row in one.rows}))))
