"""The cycle against a clock and a bus that do as the script says: due times, overruns, lateness, late frames."""

from collections.abc import Callable, Collection
from math import isnan

import codec
import pytest
from log_rows import CycleList

from plant import Model
from rig.benches import load_bench
from rig.network import Frame, Master, VirtualClock
from rig.nodes import Scenario
from rig.run import CycleInput
from rig.run.cycle import SLACK
from rig.run.loop import CycleLoop
from rig.sequences import Plan, Schedule

MS = 1_000_000  # ns


class Bench:
    """A wire that answers each SYNC as a bench does, after a delay; time is what the script makes of it."""

    def __init__(self, answer_ns: int = 0, silent: Collection[int] = ()) -> None:
        self.clock = VirtualClock()
        self.receive: Callable[[Frame], None] = lambda frame: None
        self.sent: list[tuple[float, int, bytes]] = []  # ms
        self.stalls: dict[int, int] = {}  # SYNC number: ns that the machine stands still after it
        self.answers: list[Frame] = []
        self._syncs, self._cycle, self._answer_ns, self._silent = 0, 0, answer_ns, silent

    def send(self, cob_id: int, data: bytes) -> None:
        now = self.clock.now()
        self.sent.append((now / MS, cob_id, data))
        if cob_id == codec.COMMAND:
            self._cycle = codec.unpack_command(data).cycle
        if cob_id == codec.SYNC:
            due = now + self._answer_ns
            self.answers += [Frame(due, codec.FEEDBACK, codec.pack_feedback(1e-3, 1e5)),
                             Frame(due, codec.VALVE_STATE, codec.pack_valve_state(1e-6, 0, self._syncs)),
                             Frame(due, codec.DRIVE, codec.pack_drive(2e-3, 15, self._syncs))][
                                 :2 if self._syncs in self._silent else 3]
            self.clock.sleep_until(now + self.stalls.get(self._syncs, 0))
            self._syncs += 1

    def wait(self, done: Callable[[], bool], seconds: float) -> bool:
        return done()

    def wait_for_answers(self, t_ns: int, done: Callable[[], bool]) -> None:
        self.run_until(t_ns)

    def run_until(self, t_ns: int) -> None:
        due = [frame for frame in self.answers if frame.t_ns <= max(t_ns, self.clock.now())]
        for frame in due:
            self.answers.remove(frame)
            self.clock.sleep_until(frame.t_ns)
            self.receive(frame)
        self.clock.sleep_until(t_ns)

    def close(self) -> None: ...

    def syncs(self) -> list[float]:
        return [t for t, cob_id, _ in self.sent if cob_id == codec.SYNC]


def loop(bench: Bench, realtime: bool = True) -> tuple[CycleLoop, CycleList]:
    book = CycleList()
    schedule = Schedule(Plan(stop=1000))
    master, scenario = Master(bench, bench.clock.now, False, load_bench()), Scenario(Model(), Plan(stop=0))
    return CycleLoop(master, load_bench(), scenario, schedule, book, realtime), book


def run(one: CycleLoop, cycles: int) -> None:
    for k in range(cycles):
        one.cycle(CycleInput(1, 1e-4 * k, 0.0, 7))
    one.finish()


@pytest.mark.parametrize("realtime", [False, True])
def test_a_row_holds_what_belongs_together(realtime: bool) -> None:
    """Command before SYNC in every cycle. In lockstep nothing is late, however long the machine stands still."""
    bench = Bench()
    bench.stalls = {} if realtime else {1: 5_300_000}
    one, book = loop(bench, realtime=realtime)
    run(one, 4)
    assert [(row.cycle, row.com) for row in book.rows] == [(k, pytest.approx(1e-4 * k)) for k in range(4)]
    assert {(row.xj, row.p12, row.xs, row.cor, row.status) for row in book.rows} == {(1e-3, 1e5, 1e-6, 2e-3, 15)}
    assert book.times == [MS, 2 * MS, 3 * MS, 4 * MS]
    assert [cob_id for _, cob_id, _ in bench.sent] == [codec.COMMAND, codec.SYNC] * 4
    assert one.overruns == 0 and {t.lateness for t in book.timings} == {0.0}


@pytest.mark.parametrize(("stalls", "syncs", "lateness", "overruns", "late"), [
    ({2: 1_700_000, 5: 1_200_000}, [1, 2, 3, 4.7, 5, 6, 7.2, 8], [0, 0, 0, 700, 0, 0, 200, 0], 1, 3),
    ({1: 5_300_000}, [1, 2, 7.3, 8, 9], [0, 0, 4300, 0, 0], 4, 2),  # no burst
])
def test_due_times_are_a_fixed_grid(stalls: dict[int, int], syncs: list[float], lateness: list[int], overruns: int,
                                    late: int) -> None:
    """Being late does not shift what follows; lost due times are counted, as is a cycle late by more than half."""
    bench = Bench()
    bench.stalls = stalls
    one, book = loop(bench)
    run(one, len(syncs))
    assert bench.syncs() == pytest.approx(syncs)
    assert [round(t.lateness * 1e6) for t in book.timings] == lateness
    assert one.overruns == overruns and [t.overrun for t in book.timings] == [k == late for k in range(len(syncs))]
    assert [row.cycle for row in book.rows] == list(range(len(syncs)))


def test_response_and_work_are_measured_from_sync_to_reception() -> None:
    one, book = loop(Bench(answer_ns=300_000))
    run(one, 4)
    assert [t.response for t in book.timings] == pytest.approx([0.3e-3] * 4, abs=1e-6)
    for column in ("work", "feedback_response", "valve_response"):
        assert [getattr(t, column) for t in book.timings] == pytest.approx([0.3e-3] * 4, abs=1e-6)
    assert all(t.execution > 0 for t in book.timings)


@pytest.mark.parametrize(("silent", "missing"), [
    ({3}, set()), ({3, 7}, set()), ({3, 7, 11}, {11}), ({3, 4}, {4}), (set(range(1, 20, 2)), set(range(5, 20, 2)))])
def test_without_sync_a_frame_may_slip_but_not_stay_away(silent: set[int], missing: set[int]) -> None:
    """The frame before stands in for one that slips into the next cycle; of those that never come only for two."""
    one, book = loop(Bench(silent=silent))
    one._words[SLACK] = True
    run(one, 20)
    assert {row.cycle for row in book.rows if isnan(row.cor)} == missing
