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

from plant import Model, RigError, compile_function
from rig.benches import Bench
from rig.network import COUNTERS, CYCLE_RECORD, RING, CycleRecord, RawBus, Send, encode_cycle_record, make_closed_port
from rig.nodes import emulator_cycle as ec
from rig.nodes.emulator import PlantNode
from rig.nodes.scenario import Scenario
from rig.sequences import Plan

_COMPILED, _FIFO, _LOCKED, _PINNED = 1, 2, 4, 8  # 0x2211 sub 9
_STOP_LIMIT = 15.0  # s: the longest that the loop waits inside a cycle is 10 s, for its turn to send


class EmulatorService(PlantNode):
    """The plant node whose cycle is compiled, on a bus of its own; to be closed.

    `send` is for the services; the loop uses `bus`. `enter_thread` gives the loop's thread its priority and its CPU and
    yields the name of the scheduler. `is_locked`: the memory of the process is locked.
    """

    def __init__(self, send: Send, bus: RawBus, enter_thread: Callable[[], AbstractContextManager[str]],
                 scenario: Scenario | None = None, is_locked: bool = False, bench: Bench | None = None) -> None:
        super().__init__(send, bench)
        self._bus, self._enter_thread, self._is_locked = bus, enter_thread, is_locked
        self._thread: threading.Thread | None = None
        self._kind = _COMPILED
        self._run = compile_loop()
        self.load_scenario(scenario)

    def tick(self, t_ns: int) -> None:
        """Run the timers, take over what the loop reports, and draw noise ahead.

        Raises:
            RigError: the loop's bus is gone.
        """
        self._book_events()
        if (cycles := int(self._memory.words[ec.RECORDED])) != self._noticed:
            self._noticed = cycles
            self.device.sync.notice(t_ns)
        self.device.tick(t_ns)
        ec.fill_noise(self._memory, self._noise)
        self._share_settings()
        self._watch_loop()

    # -- the loop's thread

    @contextmanager
    def _pause(self) -> Iterator[None]:
        self.close()
        try:
            yield
        finally:
            # each page of 512 numbers has its memory before the loop begins: it takes the kernel up to 10 us to find
            self._memory.words[::512] |= 0
            self._memory.words[ec.STOP] = 0
            self._thread = threading.Thread(target=self._serve, name="emulator", daemon=True)
            self._thread.start()

    def _serve(self) -> None:
        with self._enter_thread() as scheduler:
            self._kind = (_COMPILED | _FIFO * (scheduler == "SCHED_FIFO") | _LOCKED * self._is_locked
                          | _PINNED * (len(os.sched_getaffinity(0)) == 1))
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

    def _share_settings(self) -> None:
        words = self._memory.words
        old_ids = int(words[ec.SYNC_ID]), int(words[ec.DRIVE_ID])
        super()._share_settings()
        self._bus.use_kernel_times(bool(words[ec.PERIOD]))
        new_ids = int(words[ec.SYNC_ID]), int(words[ec.DRIVE_ID])
        if old_ids != new_ids:
            self._bus.set_filter([0, *(cob_id for cob_id in new_ids if cob_id >= 0)])

    def _show_values(self, request: bytes) -> None:
        super()._show_values(request)
        words = self._memory.words
        longest = (words[word] // 1000 for word in (ec.LONGEST_WAKE, ec.LONGEST_RESPONSE, ec.LONGEST_CYCLE))
        counts = words[ec.RECORDED], words[ec.UNSENT], self._bus.overflows, *longest, self._kind
        for sub, value in enumerate(counts, 3):
            self._od[COUNTERS, sub] = min(int(value), 0xFFFFFFFF)
        if len(request) == 8 and request[0] >> 5 == 2 and int.from_bytes(request[1:3], "little") == CYCLE_RECORD:
            self._od[CYCLE_RECORD, 0] = encode_cycle_record(self.read_record())

    def read_record(self) -> CycleRecord:
        """The record of the cycles so far, at most the last RING."""
        cycles = int(self._memory.words[ec.RECORDED])
        times = self._memory.words[ec.TIMES_AT: ec.TIMES_AT + 6 * RING].reshape(-1, 6)
        return CycleRecord(*times[np.arange(max(0, cycles - RING), cycles) % RING].T)


@cache
def compile_loop() -> Any:
    """The loop, for any plant: some seconds on a new machine, half a second afterwards."""
    run = compile_function(ec.run_emulator)
    memory = ec.make_memory(Scenario(Model(), Plan(stop=0)))
    memory.words[ec.STOP] = 1
    run(make_closed_port(), memory)  # compiles it; the loop ends at once
    return run
