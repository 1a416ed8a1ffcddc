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
from operator import itemgetter
from typing import Any

from plant import RigError, compile_function
from rig.benches import Bench, Role
from rig.network import Frame, LinkWire, Master, RawBus, make_closed_port
from rig.nodes import Scenario
from rig.run import cycle as cy
from rig.run.loop import CycleInput, CycleObserver, Loop, make_trial, read_ring, set_rig_faults
from rig.run.priority import enter_loop_thread, list_cpus
from rig.sequences import Schedule

_US = 1000  # ns


@cache
def compile_cycle() -> Any:
    """Compile the cycle: some seconds on a new machine, half a second afterwards."""
    play = compile_function(cy.play_cycles)
    _, *parts = make_trial()
    play(make_closed_port(), *parts)  # fails at once, on a bus that is not there
    return play


class HardLoop(Loop):
    """Cycles in compiled code. Call `close` when done.

    Raises RigError from `cycle`, `serve` and `finish` when the bus is gone.
    """

    kind = "hard"

    def __init__(self, master: Master, bench: Bench, scenario: Scenario, faults: Schedule, log: CycleObserver,
                 bus: str, ahead: int = 1000) -> None:
        """`ahead`: cycles that Python queues; a stall of Python up to that length does no harm.

        Raises RigError if the bus cannot be opened.
        """
        super().__init__(master, bench, scenario, faults, log, ahead)
        wire = master.wire
        assert isinstance(wire, LinkWire)
        self._wire, self._bus, self._play = wire, RawBus(bus, bench.frames.identifiers), compile_cycle()
        self._origin = wire.clock.origin_ns
        words, period = self._words, self._period
        words[cy.LEAD], words[cy.SPIN] = min(200 * _US, period // 4), min(80 * _US, period // 8)
        words[cy.SPINS_ALWAYS] = len(list_cpus()) > 1
        # without a SYNC the controller has its own clock: its frame may slip from one cycle of the rig to the next
        words[cy.SLACK] = bench.frames.sync is None
        self._thread: threading.Thread | None = None
        self._frames: list[tuple[int, Frame]] = []  # of both sockets, until everything before them is known
        self._came_at: int | None = None  # wall time of the service frame under way
        self._last_t_ns = 0
        self._ours = [bench.frames.sync, *(each.identifier for each in bench.frames.list_from(Role.RIG))]
        self._write_frame, master.hooks.on_frame = master.hooks.on_frame, self._keep_frame
        self._receive, wire.receive = wire.receive, self._receive_service
        wire.link.leave_out(bench.frames.identifiers)  # those that the rig sends itself may come from a second rig

    # ------------------------------------------------------------------------------------ what the session sees

    @property
    def k(self) -> int:
        """See `Loop`."""
        return int(self._words[cy.CYCLES])

    @property
    def queued(self) -> int:
        """See `Loop`."""
        return self.k + self.waiting

    @property
    def waiting(self) -> int:
        """Inputs that are queued and not yet taken."""
        return int(self._words[cy.TAIL] - self._words[cy.HEAD])

    def now(self) -> int:
        """See `Loop`."""
        return self._wire.clock.now()

    def cycle(self, step: CycleInput) -> None:
        """Queue one cycle. Complete cycles go to the log."""
        self._push(step)
        if self._thread is None:
            self._words[cy.DUE] = self._origin + self._wire.clock.now() + 20 * self._period
            self._thread = threading.Thread(target=self._run_thread, name="cycle", daemon=True)
            self._thread.start()
        while self.waiting >= self._ahead - 1:  # the cycle still reads the row of its last input
            self.serve()

    def serve(self) -> None:
        """Receive what the other nodes send and log the cycles that are complete; takes up to a period."""
        # at the end of the queue the next input must come within a period
        self._wire.poll(self._period * (0.1e-9 if self.waiting <= 2 else 1e-9))
        self._drain()
        self._draw_noise()
        set_rig_faults(self._master, self._faults, self.k)
        self._master.tick()
        self._require_bus()

    def override_control(self, word: int) -> None:
        """See `Loop`."""
        self._buffers.settings[-1] = self._values.list_safe(word)
        self._words[cy.OVERRIDE_LIMIT] = self._words[cy.TAIL]

    def wait_until_played(self, stop: Callable[[], bool]) -> None:
        """See `Loop`. The queue may then run empty: until the next input the last one is repeated."""
        self._words[cy.MAY_IDLE_AT] = self._words[cy.TAIL]
        is_over = False
        while self.waiting and not is_over:
            self.serve()
            is_over = stop()

    def hold(self, phase: int) -> float:
        """See `Loop`; the last input is repeated until the next one."""
        self._idle_phase = phase
        self._words[cy.MAY_IDLE_AT] = self._words[cy.TAIL]
        self._words[cy.CANCEL] = self._is_running()
        while self._is_running() and self._words[cy.CANCEL]:
            self.serve()
        if not self._is_running():  # nobody will take what is queued
            self._words[cy.TAIL] = self._words[cy.HEAD]
        return self._inputs[self._words[cy.POSITION] % len(self._inputs)].demand if self.k else 0.0

    def finish(self) -> None:
        """See `Loop`."""
        self._words[cy.FINISH] = 1
        while self._is_running():
            self.serve()
        self._require_bus()
        self._drain()

    def close(self) -> None:
        """End the thread at the end of its cycle and give the bus back."""
        self._words[cy.CANCEL] = self._words[cy.FINISH] = 1
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

    def _run_thread(self) -> None:
        with enter_loop_thread(from_last=1) as self.scheduler:
            self._play(self._bus.port, self._buffers, self._layout, self._plant)

    def _is_running(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def _require_bus(self) -> None:
        if self._is_running():
            return
        if self._words[cy.FAILURE]:
            raise self._bus.explain_failure(int(self._words[cy.FAILURE]))
        if self._thread is not None and not self._words[cy.FINISH]:
            raise RigError("internal error: the cycle thread ended by itself")

    # ------------------------------------------------------------------------------------ from the cycle

    def _drain(self) -> None:
        """Log the cycles and frames that are complete."""
        self._note_problem()
        until = int(self._words[cy.COMPLETE_UNTIL])  # first: what is added meanwhile waits for the next time
        first, last = int(self._words[cy.FRAMES_READ]), int(self._words[cy.FRAMES_DONE])
        for t_ns, head, *data in read_ring(self._buffers.frames, first, last):
            raw = b"".join([(word & 0xFFFFFFFFFFFFFFFF).to_bytes(8, "little") for word in data])
            frame = Frame(t_ns - self._origin, head & 0xFFFFFFFF, raw[:head >> 32 & 0xFF])
            if frame.cob_id in self._ours and not head >> 40:  # not sent by this rig
                self._receive_service(frame)  # the master reports a second rig
            else:
                self._frames.append((frame.t_ns, frame))
        self._words[cy.FRAMES_READ] = last
        self._release_frames(until - self._origin)
        self._log_rows()

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

    def _take_row(self, row: list[int], values: dict[str, float]) -> None:
        self.outputs = values
        super()._take_row(row, values)
