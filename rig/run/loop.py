"""The cycle of the bench: command, SYNC, answers, row. This loop is Python, for every bus and both paces.

SocketCAN and the UDP bus have a compiled one as well (hard_loop.py), which gives the same rows.

Lockstep: the next cycle begins when this one's frames are in. Real time: it begins when it is due; due times are a
fixed grid, and a cycle that is late by whole periods drops the due times it has missed (and counts them) instead of
firing a burst. Either way the plant moves one period a SYNC, so a run that was late is late, not wrong.
"""
from __future__ import annotations

import heapq
from abc import ABC, abstractmethod
from array import array
from collections.abc import Callable
from math import nan
from typing import Any, NamedTuple, Protocol

import numpy as np

from plant.segments import Array
from rig.network import codec
from rig.network.clock import WallClock
from rig.network.frame import Frame
from rig.network.master import Master
from rig.recorder import Signals, Timing
from rig.sequences.faults import DELAY, DROP, Schedule, apply_action

_ANSWERS: dict[int, tuple[int, Callable[[bytes], tuple[Any, ...]], str, str, str, bool]] = {
    # COB-ID: bit, decoder, two fields of the row, field of the timing, whether it carries the number of its cycle
    codec.FEEDBACK: (1, codec.unpack_feedback, "xj", "p12", "feedback_response", False),
    codec.VALVE_STATE: (2, codec.unpack_valve_state, "xs", "flags", "valve_response", True),
    codec.DRIVE: (4, codec.unpack_drive, "cor", "status", "response", True),
}
_ALL = 7  # answers have come


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


class Loop(ABC):
    """What the session needs of a cycle loop. One that queues its inputs runs behind them and overrides more."""

    kind: str  # "soft" or "hard" real time
    scheduler = ""  # how the kernel schedules the thread of the cycle, if it has one of its own

    @property
    @abstractmethod
    def k(self) -> int:
        """The cycle to come."""

    @property
    @abstractmethod
    def overruns(self) -> int:
        """Due times missed, cycles late by more than half a period, and cycles for which no input was given in time."""

    @property
    @abstractmethod
    def underruns(self) -> int:
        """Cycles for which no input was given in time; they repeat the last one."""

    @property
    def queued(self) -> int:
        """The cycle of the input that `cycle` takes next."""
        return self.k

    @abstractmethod
    def now(self) -> int:
        """Time for the log, ns since the run began: in lockstep that of the cycle under way or to come."""

    @abstractmethod
    def cycle(self, step: CycleInput) -> None:
        """Run one cycle, or queue it; cycles that are complete go to the log."""

    @abstractmethod
    def finish(self) -> None:
        """Play what is queued, wait for the answers of the last cycle and log it."""

    @abstractmethod
    def hold(self, phase: int) -> float:
        """Discard the inputs not yet taken and repeat the last one under `phase`; return its demand, m."""

    def override_control(self, word: int) -> None:  # noqa: B027 - nothing is queued
        """Use this control word in all cycles already queued, from the next one on."""

    def wait_until_played(self, stop: Callable[[], bool]) -> bool:
        """Wait until all inputs are taken; False when `stop()` came true before."""
        return True

    def close(self) -> None:  # noqa: B027 - nothing to give back
        """Give back what the loop holds, whatever happened."""


class CycleLoop(Loop):
    """Runs cycles one by one and passes each to `log` when it is complete. In real time it is soft: Python is in it."""

    kind = "soft"
    k = overruns = underruns = 0

    def __init__(self, master: Master, faults: Schedule, log: CycleObserver, period_ns: int, realtime: bool) -> None:
        self._master, self._wire = master, master.wire
        self._faults, self._log, self._period, self._realtime = faults, log, period_ns, realtime
        self._open: tuple[int, Signals, Timing] | None = None  # the cycle under way
        self._seen = 0
        self._wall = WallClock()
        self._t_ns = self._wire.clock.now() + period_ns  # when the cycle under way, or to come, is due
        self._sync = 0
        self._held: list[tuple[int, int, bytes]] = []  # late commands: due, cycle, frame
        self._demand = 0.0  # m, of the last cycle
        master.hooks.on_cyclic.update(dict.fromkeys(_ANSWERS, self._take_answer))

    def now(self) -> int:
        """See `Loop`."""
        return self._wire.clock.now() if self._realtime else self._t_ns

    def hold(self, phase: int) -> float:
        """See `Loop`; the next cycle follows at once."""
        return self._demand

    def cycle(self, step: CycleInput) -> None:
        """One cycle; the cycle before, which it closes, goes to the log."""
        lateness = self._wait_until_due()
        self._close()
        self._demand = step.demand
        master, k = self._master, self.k
        began = self._wall.now()
        row = Signals(k, step.phase, codec.position(codec.raw_position(step.demand)), nan, nan, nan, nan,
                      step.load, step.control, 0, 0)
        is_overrun = 2 * lateness > self._period  # it leaves the controller too little of the cycle to answer in
        timing = Timing(k, is_overrun, lateness * 1e-9, nan, nan)
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
        self.overruns += max(lost, 2 * late > self._period)
        self._t_ns += lost * self._period
        return late

    def _send_sync(self) -> int | None:
        """Send SYNC; returns how late a fault makes it, ns, or None where it is lost."""
        action = self._faults.find_action("sync", self.k)
        delay = action.argument if action.code == DELAY else 0
        if delay and self._realtime:
            self._wire.run_until(self._t_ns + delay)
        self._sync = self._wire.clock.now() if self._realtime else self._wall.now()
        for _ in apply_action(action, b""):
            self._master.send(codec.SYNC, b"")
        return None if action.code == DROP else delay

    def _wait_for_answers(self, delay: int | None) -> None:
        """Lockstep: let the answers come in; without a SYNC there are none, and a cycle's time passes."""
        if delay is None:
            self._wire.run_until(self._wire.clock.now() + self._period)
        else:
            self._wire.wait_for_answers(self._t_ns + delay, lambda: self._seen == _ALL)

    def _command(self, data: bytes) -> None:
        action = self._faults.find_action("command", self.k)
        if action.code == DELAY:
            heapq.heappush(self._held, (self._t_ns + action.argument, self.k, data))
            return
        for what in apply_action(action, data):
            self._master.send(codec.COMMAND, what)

    def _send_held(self, before_ns: int) -> None:
        """Late commands whose time has come."""
        while self._held and self._held[0][0] < before_ns:
            self._master.send(codec.COMMAND, heapq.heappop(self._held)[2])

    def _take_answer(self, frame: Frame) -> None:
        """Put an answer into the row under way: the first feedback, and of the others the last of this cycle."""
        if self._open is None or len(frame.data) != 8:
            return
        _, row, timing = self._open
        bit, decode, first, second, response, is_numbered = _ANSWERS[frame.cob_id]
        values, seen = decode(frame.data), self._seen
        is_first = not seen & bit
        if values[2] != row.cycle & 0xFFFF if is_numbered else not is_first:
            return
        setattr(row, first, values[0])
        setattr(row, second, values[1])
        self._seen = seen | bit
        if is_first:
            setattr(timing, response, self._since_sync(frame))
            if self._seen == _ALL:
                timing.work = self._since_sync(frame)

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

    def cycle(self, t_ns: int, row: Signals, timing: Timing) -> None:
        """Append one cycle (called by a loop)."""
        self._numbers.extend((row.phase, row.com, row.xj, row.cor, row.p12, row.xs, row.load, row.flags,
                              timing.lateness, timing.response, timing.feedback_response, timing.valve_response,
                              timing.execution, row.control, row.status))

    def column(self, name: str, phase: int | None = None) -> Array:
        """All cycles, or those of one phase. Raises ValueError for a name that is no field."""
        table = np.frombuffer(self._numbers).reshape(-1, len(_FIELDS))
        column: Array = table[:, _FIELDS.index(name)]
        return column.copy() if phase is None else column[table[:, 0] == phase]  # no view: it would pin the buffer
