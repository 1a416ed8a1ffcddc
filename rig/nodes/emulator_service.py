"""The plant node on SocketCAN and UDP: the compiled cycle in a thread of its own, and the CANopen services in Python.

The loop hears the NMT commands and obeys them in the order of the bus, between two SYNCs; it passes them on to the
services, which keep the state that heartbeat, SDO and EMCY need. All that they share are arrays (emulator_cycle.py).
While the plant or the faults change (a scenario, an NMT reset) the loop is stopped; the frames that come meanwhile wait
in its socket.
"""

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from typing import Any

import numpy as np

from plant import Model
from plant.compile import compile_function
from plant.errors import RigError
from rig.benches.bench import Bench
from rig.benches.canopen_map import RPDO, TPDO
from rig.benches.packing import VALUES_AT
from rig.device import EmcyCode, ErrorRegister, NmtState
from rig.network.frame import Frame, Send
from rig.network.node_objects import COUNTERS, CYCLE_RECORD, RING, CycleRecord, encode_cycle_record
from rig.network.raw_bus import RawBus, make_closed_port
from rig.nodes import emulator_cycle as ec
from rig.nodes.emulator import PlantNode
from rig.nodes.plant_code import compile_plant
from rig.nodes.scenario import Scenario
from rig.sequences.faults import Plan

_COMPILED, _FIFO, _LOCKED, _PINNED = 1, 2, 4, 8  # 0x2211 sub 9
_RAISED = {  # events of the loop: the errors that they raise
    ec.TIMEOUT_RAISED: (EmcyCode.RPDO_TIMEOUT, ErrorRegister.COMMUNICATION),
    ec.DRIVE_SHORT: (EmcyCode.PDO_TOO_SHORT, ErrorRegister.COMMUNICATION),
    ec.DIVERGED: (EmcyCode.SOFTWARE, ErrorRegister.GENERIC)}
_CLEARED = {ec.TIMEOUT_CLEARED: EmcyCode.RPDO_TIMEOUT, ec.DRIVE_WHOLE: EmcyCode.PDO_TOO_SHORT}
_STOP_LIMIT = 15.0  # s: the longest that the loop waits inside a cycle is 10 s, for its turn to send


class EmulatorService(PlantNode):
    """The plant node whose cycle is compiled, on a bus of its own; to be closed.

    `send` is for the services; the loop uses `bus`. `enter_thread` gives the loop's thread its priority and its CPU and
    yields the name of the scheduler. `is_locked`: the memory of the process is locked.
    """

    _memory: ec.Memory  # what the loop works on

    def __init__(self, send: Send, bus: RawBus, enter_thread: Callable[[], AbstractContextManager[str]],
                 scenario: Scenario | None = None, is_locked: bool = False, bench: Bench | None = None) -> None:
        super().__init__(send, bench)
        self._bus, self._enter_thread, self._is_locked = bus, enter_thread, is_locked
        self._thread: threading.Thread | None = None
        self._kind = _COMPILED
        self._obeying = False  # an NMT command, which the loop obeys by itself
        self._run = compile_loop()
        self._booking = False  # an error whose EMCY the loop has sent
        self._seen = self._last_sync = 0
        self._frames = [self._bench.frames.find_role(role) for role in ("drive", "feedback", "valve_state")]
        self._emcy, self._sdo, self._reply = map(self._node.find_cob_id, (0x080, 0x600, 0x580))
        self._unheard = list_unheard(self._bench)
        sent = self.device.pdo.tpdos.values()
        self._tpdos = [next(pdo for pdo in sent if pdo.cob_id == spec.identifier) for spec in self._frames[1:]]
        self.load_scenario(scenario)

    def _begin(self, scenario: Scenario) -> None:
        """Make new memory for the loop, whose next SYNC is the first; it stays in its NMT state."""
        memory = ec.make_memory(scenario, *compile_plant(scenario.model), self._frames)
        answered = self._node.inputs["cycle"].field
        memory.words[ec.NODE: ec.MISSED_LIMIT + 1] = (self._node.node, self._drive.n, answered.wrap_number(-1),
                                                      self._bench.most_missed)
        with self._stop_loop():
            words = memory.words
            words[ec.STATE] = self._memory.words[ec.STATE] if self._scenario else ec.INITIALISING
            words[ec.BEGUN] = words[ec.FIRST] = words[ec.STATE] == ec.OPERATIONAL
            self._scenario, self._memory, self._schedule = scenario, memory, scenario.make_schedule()
            self._rng = np.random.default_rng(scenario.seed)
            self._seen = self._last_sync = 0
            ec.fill_noise(self._memory, self._rng)
            self._share_settings()

    def receive(self, frame: Frame) -> None:
        """A frame for the services arrived."""
        is_bus_off = self._schedule.is_bus_off("plant", int(self._memory.words[ec.CYCLE]) - 1)
        if frame.cob_id in self._unheard or is_bus_off:
            return
        self._book_events()
        if frame.cob_id == self._sdo:
            self._show_values(frame.data)
        self.device.receive(frame)

    def tick(self, t_ns: int) -> None:
        """Run the timers, take over what the loop reports, and draw noise ahead.

        Raises:
            RigError: the loop's bus is gone.
        """
        self._book_events()
        if (last := int(self._memory.words[ec.LAST_SYNC])) != self._last_sync:
            self._last_sync = last
            self.device.sync.notice(t_ns)
        self.device.tick(t_ns)
        ec.fill_noise(self._memory, self._rng)
        self._share_settings()
        self._watch_loop()

    # -- the loop's thread

    @contextmanager
    def _stop_loop(self) -> Iterator[None]:
        """Stop the loop, and start it again with what has been set meanwhile."""
        self.close()
        try:
            yield
        finally:
            self._memory.words[ec.STOP] = 0
            self._thread = threading.Thread(target=self._serve, name="emulator", daemon=True)
            self._thread.start()

    def _serve(self) -> None:
        with self._enter_thread() as scheduler:
            self._kind = _COMPILED | _FIFO * (scheduler == "SCHED_FIFO") | _LOCKED * self._is_locked
            self._kind |= _PINNED * (len(os.sched_getaffinity(0)) == 1)
            self._run(self._bus.port, self._memory)

    def close(self) -> None:
        """Stop the loop."""
        if self._thread is None:
            return
        self._memory.words[ec.STOP] = 1
        self._thread.join(_STOP_LIMIT)
        if self._thread.is_alive():
            raise RigError(f"{self._bus.spec}: the emulator's loop did not stop within {_STOP_LIMIT:g} s")
        self._thread = None

    def _watch_loop(self) -> None:
        """Why the loop has ended, if it has: an NMT reset, or its bus is gone."""
        if self._thread is None or self._thread.is_alive():
            return
        words = self._memory.words
        if words[ec.FAILURE]:
            raise self._bus.explain_failure(int(words[ec.FAILURE]))
        self._book_events()
        self._obey(int(words[ec.RESET_COMMAND]))

    def _obey(self, command: int) -> None:
        """Do what the loop has done at an NMT command, or left to the services."""
        self._obeying = True
        try:
            self.device.receive(Frame(self.device.t_ns, 0, bytes((command, self.device.node_id))))
        finally:
            self._obeying = False

    # -- CANopen

    def _transmit(self, cob_id: int, data: bytes) -> None:
        """Send a frame of the services unless a fault or the loop has dealt with it."""
        if cob_id == self._emcy and self._booking:
            return
        if cob_id == self._reply:
            self._share_settings()  # what SDO has written is in force when it is confirmed
        if cob_id == self._heartbeat and data == bytes(1) and not self._memory.words[ec.STATE]:  # the first boot-up
            self._memory.words[ec.STATE] = ec.PRE_OPERATIONAL
        words = self._memory.words
        self._pass_on(cob_id, data, self._schedule, int(words[ec.CYCLE]), bool(words[ec.BEGUN] and not words[ec.FIRST]))

    def _on_nmt(self, old: NmtState, new: NmtState) -> None:
        if new is NmtState.INITIALISING:
            assert self._scenario is not None
            self._memory.words[ec.STATE] = ec.PRE_OPERATIONAL
            self._begin(self._scenario)
        elif not self._obeying and old is NmtState.OPERATIONAL:  # an error of the services: 0x1029
            self._memory.words[ec.DEMOTED] = new

    def _share_settings(self) -> None:
        """What SDO may change, and the error register without the loop's own error."""
        shared, od = self._memory.words, self.device.od
        shared[ec.PERIOD] = od.read_number(0x1006, 0)
        self._bus.use_kernel_times(bool(shared[ec.PERIOD]))
        emcy = od.read_number(0x1014, 0, 1 << 31)
        shared[ec.EMCY_ID] = -1 if emcy >> 31 else emcy & 0x7FF
        others = [code for code in self.device.emcy.active if code != EmcyCode.RPDO_TIMEOUT]
        communication = any(code != EmcyCode.SOFTWARE for code in others)
        shared[ec.OTHER_REGISTER] = ErrorRegister.GENERIC * bool(others) | ErrorRegister.COMMUNICATION * communication
        for row, tpdo in enumerate(self._tpdos):
            at, kind = ec.TPDOS_AT + 4 * row, od.read_number(TPDO + tpdo.n - 1, 2)
            shared[at + ec.ID] = _encode_cob_id(tpdo.cob_id)
            if shared[at + ec.TYPE] != kind:
                shared[at + ec.TYPE] = shared[at + ec.COUNT] = kind
        shared[ec.DRIVE_TYPE] = od.read_number(RPDO + self._drive.n - 1, 2)
        heard = shared[ec.SYNC_ID], shared[ec.DRIVE_ID]
        shared[ec.SYNC_ID] = od.read_number(0x1005, 0, 0x80) & 0x7FF
        shared[ec.DRIVE_ID] = _encode_cob_id(self._drive.cob_id)
        if heard != (shared[ec.SYNC_ID], shared[ec.DRIVE_ID]):
            wanted = 0, int(shared[ec.SYNC_ID]), int(shared[ec.DRIVE_ID])
            self._bus.set_filter([cob_id for cob_id in wanted if cob_id >= 0])

    def _book_events(self) -> None:
        """Take over what the loop has done or noticed: errors, whose EMCY it sends itself or leaves to the services."""
        emcy, t_ns, number = self.device.emcy, self.device.t_ns, bytes((self._drive.n,))
        while self._seen < self._memory.words[ec.EVENTS]:
            event = self._memory.words[ec.EVENTS_AT + self._seen % ec.EVENT_RING]
            self._seen += 1
            self._booking = event in (ec.TIMEOUT_RAISED, ec.TIMEOUT_CLEARED)
            if event >= ec.COMMANDED:
                self._obey(int(event) - ec.COMMANDED)
            elif event == ec.SYNC_MALFORMED:
                self.device.sync.receive(Frame(t_ns, self._bench.frames.sync or 0, b"\0"))
            elif event in _RAISED:
                emcy.raise_error(*_RAISED[event], b"\x03" if event == ec.DIVERGED else number)
            else:
                emcy.clear(_CLEARED[event], number if event == ec.DRIVE_WHOLE else b"")
            if event == ec.DIVERGED:
                self._obeying = True  # the loop has left OPERATIONAL
                self.device.nmt.communication_error(0)
                self._obeying = False
            self._booking = False

    def _show_values(self, request: bytes) -> None:
        """Put the loop's values into the dictionary, which an SDO request is about to read."""
        shared, od = self._memory.words, self._od
        node, frames = self._node, self._memory.frames
        values = dict(zip(ec.list_channels(self._bench.signals), frames.doubles[frames.words[VALUES_AT]:],
                          strict=False))
        for places, cycle in ((node.outputs, ec.FRAME_CYCLE), (node.inputs, ec.ANSWERED)):
            for signal, (key, field) in places.items():
                od[key] = (field.wrap_number(int(shared[cycle])) if signal == "cycle" else
                           field.compute_counts(values.get(signal, 0.0)))
        longest = (shared[word] // 1000 for word in (ec.LONGEST_WAKE, ec.LONGEST_RESPONSE, ec.LONGEST_CYCLE))
        counts = (shared[ec.MISSING], shared[ec.LATE], shared[ec.RECORDED], shared[ec.UNSENT], self._bus.overflows,
                  *longest, self._kind)
        for sub, value in enumerate(counts, 1):
            od[COUNTERS, sub] = min(int(value), 0xFFFFFFFF)
        if len(request) == 8 and request[0] >> 5 == 2 and int.from_bytes(request[1:3], "little") == CYCLE_RECORD:
            od[CYCLE_RECORD, 0] = encode_cycle_record(self.read_record())

    def read_record(self) -> CycleRecord:
        """The record of the cycles so far, at most the last RING."""
        recorded = int(self._memory.words[ec.RECORDED])
        times = self._memory.words[ec.TIMES_AT: ec.TIMES_AT + 6 * RING].reshape(-1, 6)
        return CycleRecord(*times[np.arange(max(0, recorded - RING), recorded) % RING].T)


def list_unheard(bench: Bench) -> tuple[int, ...]:
    """What the services need not hear: the frames of the bench, and what the loop hears."""
    return 0x000, *bench.frames.identifiers


def _encode_cob_id(cob_id: int | None) -> int:
    return -1 if cob_id is None else cob_id


@cache
def compile_loop() -> Any:
    """The loop, for any plant: some seconds on a new machine, half a second afterwards."""
    run = compile_function(ec.run_emulator)
    memory = ec.make_memory(Scenario(Model(), Plan(stop=0)))
    memory.words[ec.STOP] = 1
    run(make_closed_port(), memory)  # compiles it; the loop ends at once
    return run
