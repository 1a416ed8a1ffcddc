"""The hard cycle loop: the rig's cycle runs compiled, on a socket of its own; the rest of the rig stays in Python.

It takes the place of `CycleLoop` on SocketCAN and the UDP bus in real time. A thread without the interpreter lock plays
a queue of inputs, which Python fills about a second ahead: the command profile is known. PDOs and SYNC use the loop's
socket; NMT, SDO, heartbeats and EMCY use the wire's socket, in the main thread. The log gets the frames of both in the
order of their times.

The queue does not delay a reaction: `override_control` changes the control word of what is queued, `hold` discards it.
"""

import threading
from bisect import bisect_right
from collections.abc import Callable
from functools import cache
from math import nan
from operator import itemgetter
from typing import Any

import numpy as np

from plant.compile import compile_function
from plant.errors import RigError
from plant.model import Model
from rig.benches import packing
from rig.benches.bench import FD, Bench, Role
from rig.network.bus import LinkWire
from rig.network.frame import Frame
from rig.network.master import Master
from rig.network.raw_bus import RawBus, make_closed_port
from rig.nodes import emulator_cycle as ec
from rig.nodes.emulator_service import compile_plant
from rig.nodes.scenario import DIVERGED, Scenario
from rig.recorder import Timing
from rig.run import hard_cycle as hc
from rig.run.loop import CycleInput, CycleObserver, CyclicValues, Loop, set_rig_faults
from rig.run.priority import enter_loop_thread, list_cpus
from rig.sequences.faults import Plan, Schedule

_US = 1000  # ns


_AT_REST = Scenario(Model(), Plan(stop=0))  # of a plant that nobody moves


@cache
def compile_cycle() -> Any:
    """Compile the cycle: some seconds on a new machine, half a second afterwards."""
    play = compile_function(hc.play_cycles)
    buffers = hc.make_buffers(1, 1, 1, 1, 1, 1, is_fd=False)
    buffers.words[hc.PERIOD], buffers.words[hc.SYNC_ID] = 1, 0x080
    # fails at once, on a bus that is not there
    play(make_closed_port(), buffers, packing.make_layout((), (), Role.RIG), ec.make_memory(_AT_REST))
    return play


class HardLoop(Loop):
    """Cycles in compiled code. Call `close` when done.

    Raises RigError from `cycle`, `serve` and `finish` when the bus is gone.
    """

    kind = "hard"

    def __init__(self, master: Master, bench: Bench, scenario: Scenario, faults: Schedule, log: CycleObserver,
                 bus: RawBus, ahead: int = 1000) -> None:
        """`ahead`: cycles that Python queues; a stall of Python up to that length does no harm."""
        wire = master.wire
        assert isinstance(wire, LinkWire)
        self._master, self._wire, self._bus, self._bench = master, wire, bus, bench
        self._faults, self._log, self._period, self._ahead = faults, log, bench.cycle_ns, ahead
        self._origin = wire.clock.origin_ns
        self._values = CyclicValues(bench)
        # where the plant is a node of its own, the cycle does not move this one
        code = () if bench.has_plant_node else compile_plant(scenario.model)
        self._plant = ec.make_memory(_AT_REST if bench.has_plant_node else scenario, *code)
        self._noise = np.random.default_rng(scenario.seed)
        ec.fill_noise(self._plant, self._noise)
        self._play = compile_cycle()
        channels, is_fd = len(self._values.names), any(each.identifier & FD for each in bench.frames.frames)
        self._buffers = hc.make_buffers(ahead, 8 * ahead, 64 * ahead, 1100, len(self._values.given), channels, is_fd)
        self._words = self._buffers.words
        self._inputs = [CycleInput(0, 0.0, 0.0, 0)] * (9 * ahead)  # of all rows that are not yet logged, and the queue
        self._thread: threading.Thread | None = None
        self._idle_phase = 0
        self._frames: list[tuple[int, Frame]] = []  # of both sockets, until everything before them is known
        self._came_at: int | None = None  # wall time of the service frame under way
        self._last_t_ns = 0
        self._ours = [bench.frames.sync, *(each.identifier for each in bench.frames.list_from(Role.RIG))]
        self.outputs = dict.fromkeys(self._values.names, 0.0)
        self._write_frame, master.hooks.on_frame = master.hooks.on_frame, self._keep_frame
        self._receive, wire.receive = wire.receive, self._receive_service
        wire.link.leave_out(bench.frames.identifiers)  # those that the rig sends itself may come from a second rig
        self._prepare_cycle()

    # ------------------------------------------------------------------------------------ what the session sees

    @property
    def k(self) -> int:
        """See `Loop`."""
        return int(self._words[hc.CYCLES])

    @property
    def queued(self) -> int:
        """See `Loop`."""
        return self.k + self.waiting

    @property
    def waiting(self) -> int:
        """Inputs that are queued and not yet taken."""
        return int(self._words[hc.TAIL] - self._words[hc.HEAD])

    @property
    def overruns(self) -> int:
        """See `Loop`."""
        return int(self._words[hc.OVERRUNS])

    @property
    def unsound(self) -> int:
        """See `Loop`."""
        return sum(int(self._layout.words[at + packing.UNSOUND]) for at in packing.list_frame_places(self._layout))

    @property
    def underruns(self) -> int:
        """See `Loop`."""
        return int(self._words[hc.UNDERRUNS])

    def now(self) -> int:
        """See `Loop`."""
        return self._wire.clock.now()

    def cycle(self, step: CycleInput) -> None:
        """Queue one cycle. Complete cycles go to the log."""
        self._push(step)
        if self._thread is None:
            self._words[hc.DUE] = self._origin + self._wire.clock.now() + 20 * self._period
            self._thread = threading.Thread(target=self._run_thread, name="cycle", daemon=True)
            self._thread.start()
        while self.waiting >= self._ahead:
            self.serve()

    def serve(self) -> None:
        """Receive what the other nodes send and log the cycles that are complete; takes up to a period."""
        # at the end of the queue the next input must come within a period
        self._wire.poll(self._period * (0.1e-9 if self.waiting <= 2 else 1e-9))
        self._drain()
        ec.fill_noise(self._plant, self._noise)  # a minute ahead
        set_rig_faults(self._master, self._faults, self.k)
        self._master.tick()
        self._require_bus()

    def override_control(self, word: int) -> None:
        """See `Loop`."""
        self._buffers.settings[-1] = self._values.list_safe(word)
        self._words[hc.OVERRIDE_LIMIT] = self._words[hc.TAIL]

    def wait_until_played(self, stop: Callable[[], bool]) -> None:
        """See `Loop`. The queue may then run empty: until the next input the last one is repeated."""
        self._words[hc.MAY_IDLE_AT] = self._words[hc.TAIL]
        is_over = False
        while self.waiting and not is_over:
            self.serve()
            is_over = stop()

    def hold(self, phase: int) -> float:
        """See `Loop`; the last input is repeated until the next one."""
        self._idle_phase = phase
        self._words[hc.MAY_IDLE_AT] = self._words[hc.TAIL]
        self._words[hc.CANCEL] = self._is_running()
        while self._is_running() and self._words[hc.CANCEL]:
            self.serve()
        if not self._is_running():  # nobody will take what is queued
            self._words[hc.TAIL] = self._words[hc.HEAD]
        return self._inputs[self._words[hc.POSITION] % len(self._inputs)].demand if self.k else 0.0

    def finish(self) -> None:
        """See `Loop`."""
        self._words[hc.FINISH] = 1
        while self._is_running():
            self.serve()
        self._require_bus()
        self._drain()

    def close(self) -> None:
        """End the thread at the end of its cycle and give the bus back."""
        self._words[hc.CANCEL] = self._words[hc.FINISH] = 1
        if self._thread is not None:
            self._thread.join()
        self._bus.close()
        self._wire.link.leave_out(())
        try:
            self._drain()
        finally:
            self._release_frames(2**63)
            self._master.hooks.on_frame, self._wire.receive = self._write_frame, self._receive

    # ------------------------------------------------------------------------------------ towards the cycle

    def _push(self, step: CycleInput) -> None:
        k = self.queued
        command, sync = self._faults.find_action("command", k), self._faults.find_action("sync", k)
        position = int(self._words[hc.TAIL])
        self._inputs[position % len(self._inputs)] = step
        queue = self._buffers.inputs
        self._buffers.settings[position % len(queue)] = self._values.list_given(step)
        queue[position % len(queue)] = (
            step.is_counted, *command, *sync, self._faults.is_bus_off("rig", k))
        self._words[hc.TAIL] = position + 1

    def _run_thread(self) -> None:
        with enter_loop_thread(from_last=1) as self.scheduler:
            self._play(self._bus.port, self._buffers, self._layout, self._plant)

    def _is_running(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def _require_bus(self) -> None:
        if self._is_running():
            return
        if self._words[hc.FAILURE]:
            raise self._bus.explain_failure(int(self._words[hc.FAILURE]))
        if self._thread is not None and not self._words[hc.FINISH]:
            raise RigError("internal error: the cycle thread ended by itself")

    def _prepare_cycle(self) -> None:
        """The words of a cycle that has not begun, and the tables of its frames."""
        words, bench, place = self._words, self._bench, self._values.place
        self._layout = packing.make_layout(bench.frames.list_of(Role.RIG), self._values.names, Role.RIG)
        words[hc.PERIOD], words[hc.MAY_IDLE_AT], words[hc.SPINS_ALWAYS] = self._period, -1, len(list_cpus()) > 1
        words[hc.LEAD], words[hc.SPIN] = min(200 * _US, self._period // 4), min(80 * _US, self._period // 8)
        sync = bench.frames.sync
        words[hc.SYNC_ID] = -1 if sync is None else sync
        words[hc.MOVES_PLANT], words[hc.MISSED_LIMIT] = not bench.has_plant_node, bench.most_missed
        # without a SYNC the controller has its own clock: its frame may slip from one cycle of the rig to the next
        words[hc.SLACK] = sync is None
        words[hc.DRIVEN], words[hc.SENT_CHANNELS] = len(self._values.given), len(self._values.sent)
        words[hc.SENSED_AT], words[hc.DRIVE_VALUE_AT] = place[self._values.readings[0]], place[self._values.drive]
        words[hc.FLAGS_AT] = place["flags"]

    # ------------------------------------------------------------------------------------ from the cycle

    def _drain(self) -> None:
        """Log the cycles and frames that are complete."""
        words, buffers = self._words, self._buffers
        self.problem = DIVERGED if words[hc.DIVERGED] else ""
        until = int(words[hc.COMPLETE_UNTIL])  # first: what is added meanwhile waits for the next time
        first, last = int(words[hc.FRAMES_READ]), int(words[hc.FRAMES_DONE])
        for t_ns, head, *data in _read_ring(buffers.frames, first, last):
            raw = b"".join([(word & 0xFFFFFFFFFFFFFFFF).to_bytes(8, "little") for word in data])
            self._take_frame(t_ns - self._origin, head & 0xFFFFFFFF, raw[:head >> 32 & 0xFF], bool(head >> 40))
        words[hc.FRAMES_READ] = last
        self._release_frames(until - self._origin)
        first, last = int(words[hc.ROWS_READ]), int(words[hc.ROWS])
        values = _read_ring(buffers.values, first, last)
        for row, said in zip(_read_ring(buffers.rows, first, last), values, strict=True):
            words[hc.ROWS_READ] += 1
            self._take_row(row, dict(zip(self._values.names, said, strict=True)))

    def _take_frame(self, t_ns: int, cob_id: int, data: bytes, is_sent: bool) -> None:
        frame = Frame(t_ns, cob_id, data)
        if cob_id in self._ours and not is_sent:
            self._receive_service(frame)  # the master reports a second rig
        else:
            self._frames.append((t_ns, frame))

    def _receive_service(self, frame: Frame) -> None:
        self._came_at = frame.t_ns
        try:
            self._receive(frame)
        finally:
            self._came_at = None

    def _keep_frame(self, frame: Frame) -> None:
        """A frame that the master received or sent."""
        self._frames.append((self._wire.clock.now() if self._came_at is None else self._came_at, frame))

    def _release_frames(self, until_ns: int) -> None:
        """Write the frames up to that time, in the order of their times."""
        self._frames.sort(key=itemgetter(0))
        count = bisect_right(self._frames, until_ns, key=itemgetter(0))
        for _, frame in self._frames[:count]:
            # The kernel's clock may have been set, or two sockets differ by a microsecond.
            self._last_t_ns = max(self._last_t_ns, frame.t_ns)
            self._write_frame(Frame(self._last_t_ns, frame.cob_id, frame.data))
        del self._frames[:count]

    def _take_row(self, row: list[int], said: dict[str, float]) -> None:
        self.outputs = said
        if not row[hc.IS_COUNTED]:
            return
        step = self._inputs[row[hc.INPUT] % len(self._inputs)]
        phase = self._idle_phase if row[hc.INPUT_HELD] and self._idle_phase else step.phase
        roles = {role for role, bit in packing.BITS.items() if row[hc.ANSWERS] & bit}
        signals = self._values.open_row(row[hc.CYCLE], phase, said[self._values.command], step.load,
                                        int(said["control_word"]))
        self._values.fill_row(signals, said, roles)
        timing = Timing(
            row[hc.CYCLE], bool(row[hc.OVERRUN]), row[hc.LATENESS] * 1e-9,
            row[hc.DRIVE_AT] * 1e-9 if "drive" in roles else nan,
            row[hc.COMPLETE_AT] * 1e-9 if row[hc.COMPLETE_AT] else nan,
            row[hc.FEEDBACK_AT] * 1e-9 if "feedback" in roles else nan,
            row[hc.VALVE_AT] * 1e-9 if "valve_state" in roles else nan, row[hc.EXECUTION] * 1e-9)
        self._log.cycle(row[hc.DUE_AT] - self._origin, signals, timing)


def _read_ring(ring: np.ndarray, first: int, last: int) -> list[list[Any]]:
    """Entries `first` to `last` - 1 of a ring."""
    entries: list[list[Any]] = ring[np.arange(first, last) % len(ring)].tolist()
    return entries
