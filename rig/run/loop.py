"""The cycle of the bench: command, SYNC, answers, row. This loop is Python, for every bus and both paces.

SocketCAN and the UDP bus have a compiled one as well (hard_loop.py), which gives the same rows.

Lockstep: the next cycle begins when this one's frames are in. Real time: it begins when it is due; due times are a
fixed grid, and a cycle that is late by whole periods drops the due times it has missed (and counts them) instead of
firing a burst. Either way the plant moves one period a SYNC, so a run that was late is late, not wrong.
"""
from __future__ import annotations

import heapq
from array import array
from collections.abc import Callable
from math import nan
from typing import NamedTuple, Protocol

import numpy as np

from plant.segments import Array
from rig.network import codec
from rig.network.clock import WallClock
from rig.network.frame import Frame
from rig.network.master import Master
from rig.recorder import Signals, Timing
from rig.run.priority import name_scheduler
from rig.sequences.faults import Delay, Drop, Schedule, apply_action

_XJ, _XS, _COR = 1, 2, 4  # answers of a cycle that have come
_ALL = _XJ | _XS | _COR


class CycleObserver(Protocol):
    """Receives each cycle when it is complete."""

    def cycle(self, t_ns: int, signals: Signals, timing: Timing) -> None:
        """A cycle is over."""


class CycleInput(NamedTuple):
    """Inputs of one cycle."""

    phase: int  # 0 set-up, 1 main, 2 clean-up
    demand: float  # m
    load: float  # N, force on the ram from the scenario
    control: int  # control word


class Loop(Protocol):
    """What the session needs of a cycle loop. A loop may run behind the inputs that it was given (`waiting`)."""

    kind: str  # "soft" or "hard" real time

    @property
    def k(self) -> int:
        """The cycle to come."""

    @property
    def queued(self) -> int:
        """The cycle of the input that `cycle` takes next."""

    @property
    def overruns(self) -> int:
        """Due times missed, and cycles late by more than half a period."""

    @property
    def underruns(self) -> int:
        """Cycles for which no input was given in time; they repeat the last one, and count as overruns."""

    @property
    def scheduler(self) -> str:
        """How the kernel schedules the thread of the cycle; empty before it has run."""

    def now(self) -> int:
        """Time for the log, ns since the run began."""

    def cycle(self, step: CycleInput) -> None:
        """Run one cycle, or queue it; cycles that are complete go to the log."""

    def override_control(self, word: int) -> None:
        """Use this control word in all cycles already queued, from the next one on."""

    def wait_until_played(self, stop: Callable[[], bool]) -> bool:
        """Wait until all inputs are taken; False when `stop()` came true before."""

    def hold(self, phase: int) -> float:
        """Discard the inputs not yet taken and repeat the last one under `phase`; return its demand, m."""

    def finish(self) -> None:
        """Play what is queued, wait for the answers of the last cycle and log it."""

    def close(self) -> None:
        """Give back what the loop holds, whatever happened."""


class CycleLoop:
    """Runs cycles one by one and passes each to `log` when it is complete. In real time it is soft: Python is in it."""

    kind = "soft"
    underruns = 0  # it waits for its inputs

    def __init__(self, master: Master, faults: Schedule, log: CycleObserver, period_ns: int, realtime: bool) -> None:
        self._master, self._wire = master, master.wire
        self._faults, self._log, self._period, self._realtime = faults, log, period_ns, realtime
        self.k = 0  # the cycle to come
        self.overruns = 0
        self._open: tuple[int, Signals, Timing] | None = None  # the cycle under way
        self._seen = 0
        self._wall = WallClock()
        self._t_ns = self._wire.clock.now() + period_ns  # when the cycle under way, or to come, is due
        self._sync = 0
        self._held: list[tuple[int, int, bytes]] = []  # late commands: due, cycle, frame
        self._demand = 0.0  # m, of the last cycle
        read = {codec.FEEDBACK: self._feedback, codec.VALVE_STATE: self._valve, codec.DRIVE: self._drive}
        master.hooks.on_cyclic.update(read)

    @property
    def queued(self) -> int:
        """See `Loop`: nothing is queued here."""
        return self.k

    @property
    def scheduler(self) -> str:
        """See `Loop`."""
        return name_scheduler()

    def now(self) -> int:
        """Time for the log, ns since the run began: in lockstep that of the cycle under way or to come."""
        return self._wire.clock.now() if self._realtime else self._t_ns

    def override_control(self, word: int) -> None:
        """See `Loop`; nothing is queued here."""

    def wait_until_played(self, stop: Callable[[], bool]) -> bool:
        """See `Loop`; nothing is queued here."""
        return True

    def hold(self, phase: int) -> float:
        """See `Loop`; nothing is queued here, and the next cycle follows at once."""
        return self._demand

    def close(self) -> None:
        """See `Loop`; nothing to give back."""

    def cycle(self, step: CycleInput) -> None:
        """One cycle; the cycle before, which it closes, goes to the log."""
        lateness = self._wait_until_due()
        self._close()
        self._demand = step.demand
        master, k = self._master, self.k
        began = self._wall.now()
        row = Signals(k, step.phase, codec.position(codec.raw_position(step.demand)), nan, nan, nan, nan,
                      step.load, step.control, 0, 0)
        timing = Timing(k, self._overrun(lateness), lateness * 1e-9, nan, nan)
        self._open, self._seen = (self._t_ns, row, timing), 0
        master.silent = not self._faults.is_heartbeat_alive("rig", k)
        master.is_deaf = self._faults.is_bus_off("rig", k)
        self._command(codec.pack_command(step.demand, step.control, k))
        delay = self._send_sync()
        timing.execution = (self._wall.now() - began) * 1e-9
        if not self._realtime:
            self._wait_for_answers(delay)
            self._send_held(self._t_ns + self._period)
        master.tick()
        self.k += 1
        self._t_ns += self._period

    def finish(self) -> None:
        """Wait for the answers of the last cycle and close it."""
        self._wait_until_due()
        self._close()

    def _wait_until_due(self) -> int:
        """The next cycle is due; by how much it is late, ns. Lockstep is never late."""
        if not self._realtime:
            return 0
        while self._held and self._held[0][0] < self._t_ns:
            due = self._held[0][0]
            self._wire.run_until(due)
            self._send_held(due + 1)
        self._wire.run_until(self._t_ns)
        late = self._wire.clock.now() - self._t_ns
        lost = late // self._period
        self.overruns += max(lost, self._overrun(late))
        self._t_ns += lost * self._period
        return late

    def _overrun(self, late_ns: int) -> bool:
        """Late by more than half a cycle: the controller is left too little of it to answer in."""
        return 2 * late_ns > self._period

    def _send_sync(self) -> int | None:
        """Send SYNC; returns how late a fault makes it, ns, or None where it is lost."""
        action = self._faults.find_action("sync", self.k)
        delay = action.ns if isinstance(action, Delay) else 0
        if delay and self._realtime:
            self._wire.run_until(self._t_ns + delay)
        self._sync = self._wire.clock.now() if self._realtime else self._wall.now()
        for _ in apply_action(action, b""):
            self._master.send(codec.SYNC, b"")
        return None if isinstance(action, Drop) else delay

    def _wait_for_answers(self, delay: int | None) -> None:
        """Lockstep: let the answers come in; without a SYNC there are none, and a cycle's time passes."""
        if delay is None:
            self._wire.run_until(self._wire.clock.now() + self._period)
        else:
            self._wire.wait_for_answers(self._t_ns + delay, lambda: self._seen == _ALL)

    def _command(self, data: bytes) -> None:
        action = self._faults.find_action("command", self.k)
        if isinstance(action, Delay):
            heapq.heappush(self._held, (self._t_ns + action.ns, self.k, data))
            return
        for what in apply_action(action, data):
            self._master.send(codec.COMMAND, what)

    def _send_held(self, before_ns: int) -> None:
        """Late commands whose time has come."""
        while self._held and self._held[0][0] < before_ns:
            self._master.send(codec.COMMAND, heapq.heappop(self._held)[2])

    def _feedback(self, frame: Frame) -> None:
        if self._open is not None and not self._seen & _XJ and len(frame.data) == 8:
            row = self._open[1]
            row.xj, row.p12 = codec.unpack_feedback(frame.data)
            self._open[2].feedback_response = self._since_sync(frame)
            self._note_answer(_XJ, frame)

    def _valve(self, frame: Frame) -> None:
        if self._open is not None and len(frame.data) == 8:
            _, row, timing = self._open
            state = codec.unpack_valve_state(frame.data)
            if state.cycle == row.cycle & 0xFFFF:
                if not self._seen & _XS:
                    timing.valve_response = self._since_sync(frame)
                row.xs, row.flags = state.spool, state.flags
                self._note_answer(_XS, frame)

    def _drive(self, frame: Frame) -> None:
        if self._open is not None and len(frame.data) == 8:  # of several the last: the plant latches that one
            _, row, timing = self._open
            drive = codec.unpack_drive(frame.data)
            if drive.cycle == row.cycle & 0xFFFF:
                row.cor, row.status = drive.current, drive.status
                if not self._seen & _COR:
                    timing.response = self._since_sync(frame)
                self._note_answer(_COR, frame)

    def _note_answer(self, what: int, frame: Frame) -> None:
        complete, self._seen = self._seen == _ALL, self._seen | what
        if self._seen == _ALL and not complete and self._open is not None:
            self._open[2].work = self._since_sync(frame)

    def _since_sync(self, frame: Frame) -> float:
        """Seconds from SYNC to a frame, by its time of reception; in lockstep, where that is virtual, to now."""
        return ((frame.t_ns if self._realtime else self._wall.now()) - self._sync) * 1e-9

    def _close(self) -> None:
        """The cycle under way is over: the next SYNC is due."""
        if self._open is not None:
            complete, self._open = self._open, None
            self._log.cycle(*complete)


_FIELDS = ("phase", "com", "xj", "cor", "p12", "xs", "load", "flags", "lateness", "response",
           "feedback_response", "valve_response", "execution", "control", "status")


class History:
    """The complete cycles of a run. A field by name is a column, (cycles,) SI; missing samples are NaN."""

    def __init__(self) -> None:
        self._numbers = array("d")

    def __len__(self) -> int:
        return len(self._numbers) // len(_FIELDS)

    def add(self, row: Signals, timing: Timing) -> None:
        """Append one cycle."""
        self._numbers.extend((row.phase, row.com, row.xj, row.cor, row.p12, row.xs, row.load, row.flags,
                              timing.lateness, timing.response, timing.feedback_response, timing.valve_response,
                              timing.execution, row.control, row.status))

    def column(self, name: str, phase: int | None = None) -> Array:
        """All cycles, or those of one phase. Raises ValueError for a name that is no field."""
        table = np.frombuffer(self._numbers).reshape(-1, len(_FIELDS))
        column: Array = table[:, _FIELDS.index(name)]
        return column.copy() if phase is None else column[table[:, 0] == phase]  # no view: it would pin the buffer
