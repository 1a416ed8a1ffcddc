"""The cycle of the bench: command, SYNC, answers, row. This loop is Python, for every bus and both paces.

In real time SocketCAN and the UDP bus have a compiled one (hard_loop.py), which gives the same rows.

Lockstep: the next cycle begins when this one's frames are in. Real time: it begins when it is due; due times are a
fixed grid, and a cycle that is late by whole periods drops the due times it has missed (and counts them) instead of
firing a burst. Either way the plant moves one period a SYNC, so a run that was late is late, not wrong."""

from abc import ABC, abstractmethod
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
from math import isnan, nan
from operator import attrgetter
from typing import Any, NamedTuple, Protocol

import numpy as np

from plant import signals as plant_signals
from plant.segments import Array
from rig.benches.bench import (
    RIG_OUTPUTS,
    Bench,
    Flags,
    FrameSpec,
    Role,
    check_guards,
    pack,
    unpack,
)
from rig.network.bus import LinkWire
from rig.network.frame import Frame, WallClock
from rig.network.master import Master
from rig.nodes.emulator import Emulator
from rig.nodes.scenario import FaultyPlant, Scenario
from rig.recorder import CycleBlock, Signals, Timing
from rig.recorder.schema import make_row_record
from rig.sequences.faults import (
    CUT,
    DELAY,
    DOUBLE,
    DROP,
    NORMAL,
    SENT_NORMALLY,
    Action,
    LateFrames,
    Schedule,
    apply_action,
)

# Numbers of phases: set-up, main, clean-up; then those of the probes, of which the log has the frames only
BEFORE, AFTER, BEFORE_MAIN = 3, 4, 5
_PHASES = ("setup", "main", "cleanup", "setup", "cleanup", "main")  # whose values are sent
_NO_LOAD = "load"  # stands for the load of a plant that has none


class CycleInput(NamedTuple):
    """Inputs of one cycle."""

    phase: int  # 0 set-up, 1 main, 2 clean-up; of the probes see above
    demand: float  # SI, as the load
    load: float  # on the plant, from the scenario
    control: int  # control word; of a controller without one: 0 for the values of the safe state
    is_counted: bool = True  # False: the controller is being enabled, the run has not begun and the plant rests


class CyclicValues:
    """The values of a bench by name, in one order: given by the rig, sent by it besides, received.

    And the rows that these make: a column for each signal of the plant, whatever it is called.
    """

    def __init__(self, bench: Bench) -> None:
        controller, signals = bench.nodes.get(Role.CONTROLLER), bench.signals
        self._mode = 0.0 if controller is None else float(controller.mode or 0)
        self._phases = bench.phases
        self.command, self.drive = signals.command.word, signals.drive.word
        self.load = _NO_LOAD if signals.load is None else signals.load.word
        self.readings = tuple(s.word for s in signals.outputs)  # in the order of the transducers
        self.given = (self.command, self.load, "control_word", "mode", *bench.phases)
        read = (*self.readings, "flags")
        self.sent = self.given if bench.has_plant_node else (*self.given, *read)
        received = [name for name in (*read, self.drive, *RIG_OUTPUTS, *bench.ready)
                    if name not in self.sent and name != "cycle"]
        self.names = (*self.sent, *dict.fromkeys(received))
        self.place = {name: i for i, name in enumerate(self.names)}
        fed = {each.name for spec in bench.frames.frames if "feedback" in spec.roles for each in spec.fields}
        role = {signals.drive.name: "drive", **{s.name: "feedback" if s.word in fed else "valve_state"
                                                for s in signals.outputs}}
        self._columns = [(s.name, s.word, role.get(s.name, "")) for s in signals[1:]]  # and the frame that brings each
        self._given = [s.name for s in (signals.command, signals.load) if s is not None]
        self._record: Any = make_row_record(signals)

    def open_row(self, k: int, phase: int, demand: float, load: float, control: int) -> Signals:
        """The row of cycle k before anything has come."""
        row: Signals = self._record(k, phase, *(nan for _ in self._columns), control, 0, 0)
        setattr(row, self._given[0], demand)
        if len(self._given) > 1:
            setattr(row, self._given[1], load)
        return row

    def fill_row(self, row: Signals, values: Mapping[str, float], came: Collection[str]) -> None:
        """Put the values of the bench into a row that the frames of these roles have brought."""
        for name, word, role in self._columns:
            if role in came:
                setattr(row, name, values[word])
        if "valve_state" in came:
            row.flags = int(values["flags"])
        if "drive" in came:
            row.status = int(values["status_word"])

    def list_given(self, step: CycleInput) -> list[float]:
        """The values that the rig gives in a cycle, SI; of fields of the device the physical value of its DBC."""
        phase = _PHASES[step.phase] if step.control else "safe"
        return [step.demand, step.load, float(step.control), self._mode,
                *(find_phase_value(values, phase) for values in self._phases.values())]

    def list_safe(self, control: int) -> list[float]:
        """What replaces the given values in the safe state; NaN where nothing does."""
        return [nan, nan, float(control), nan, *(find_phase_value(values, "safe") for values in self._phases.values())]


def find_phase_value(values: Mapping[str, float], phase: str) -> float:
    """The value of a field in a phase; in the safe state that of clean-up, if the bench file says nothing else."""
    return float(values.get(phase, values.get("cleanup", 0.0)))


_RESPONSES = {"feedback": "feedback_response", "valve_state": "valve_response", "drive": "response"}  # of the timing


class CycleObserver(Protocol):
    """Receives each cycle when it is complete."""

    def cycle(self, t_ns: int, signals: Signals, timing: Timing) -> None:
        """A cycle is over."""

    def cycles(self, block: CycleBlock) -> None:
        """Several are over, and the last of the block is under way."""


class Loop(ABC):
    """What the session needs of a cycle loop. One that queues its inputs runs behind them and overrides more."""

    kind: str  # "soft" or "hard" real time
    scheduler = ""  # how the kernel schedules the thread of the cycle, if it has one of its own
    problem = ""  # why the plant cannot go on
    plays_many = False  # whether `play_many` is worth a call
    outputs: dict[str, float]  # the last values of the bench that are known; `CyclicValues` has the names

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
    @abstractmethod
    def unsound(self) -> int:
        """Frames with a wrong checksum, or an alive counter that is not the next."""

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

    def play_many(self, phase: int, demands: Array, loads: Array, control: int) -> int:
        """Run several cycles under one control word, as many of these as are possible at once; returns how many.

        `demands` in m, `loads` in N. The rows of all but the last go to the log.
        """
        return 0

    @abstractmethod
    def finish(self) -> None:
        """Play what is queued, wait for the answers of the last cycle and log it."""

    @abstractmethod
    def hold(self, phase: int) -> float:
        """Discard the inputs not yet taken and repeat the last one under `phase`; return its demand, m."""

    def override_control(self, word: int) -> None:  # noqa: B027 - nothing is queued
        """Use this control word in all cycles already queued, from the next one on."""

    def wait_until_played(self, stop: Callable[[], bool]) -> None:  # noqa: B027 - nothing is queued
        """Wait until all inputs are taken, or `stop()`."""

    def close(self) -> None:  # noqa: B027 - nothing to give back
        """Give back what the loop holds, whatever happened."""


class _Answer:
    """A frame that comes in: what it says, and the last one of it."""

    def __init__(self, spec: FrameSpec) -> None:
        self.spec, self.roles = spec, set(spec.roles)
        self.cycle_mask = max(((1 << each.length) - 1 for each in spec.fields if each.name == "cycle"), default=0)
        self.is_guarded = any(each.guard for each in spec.fields)
        self.last = -1  # the cycle in which it came


@dataclass(slots=True)
class Seen:
    """What of the cycle under way has come."""

    came: set[str] = field(default_factory=set)  # roles of the frames
    awaited: set[FrameSpec] = field(default_factory=set)  # frames that are sure to come, and have not
    plant_left: int = 0  # of the frames that come in a cycle in which a fault doubles some: of the plant
    drives_left: int = 0  # and of the controller
    is_late: bool = False  # a drive frame has come that answers an earlier cycle


class CycleLoop(Loop):
    """Runs cycles one by one and passes each to `log` when it is complete. In real time it is soft: Python is in it."""

    kind = "soft"
    k = overruns = underruns = unsound = 0

    def __init__(self, master: Master, bench: Bench, scenario: Scenario, faults: Schedule, log: CycleObserver,
                 realtime: bool) -> None:
        self._master, self._wire = master, master.wire
        self._link = None if realtime or not isinstance(master.wire, LinkWire) else master.wire  # lockstep of programs
        self._faults, self._log, self._period, self._realtime = faults, log, bench.cycle_ns, realtime
        self._values, self._bench = CyclicValues(bench), bench
        self._sent = Counter[int]()  # by identifier: the pages of a multiplexed message have one alive counter
        self._counters: dict[int, int] = {}  # the last alive counter of each identifier
        self._answers = {each: _Answer(each) for each in bench.frames.frames if each.sender is not Role.RIG}
        self._plant = None if bench.has_plant_node else FaultyPlant(scenario)
        self._emulators = [node for node in getattr(self._wire, "nodes", ()) if isinstance(node, Emulator)]
        self.outputs = dict.fromkeys(self._values.names, 0.0)
        self._open: tuple[int, Signals, Timing] | None = None  # the cycle under way
        self._step = CycleInput(0, 0.0, 0.0, 0)  # its inputs
        self._seen = Seen()
        self._begun = 0  # cycles in which answers were expected, those that do not count among them
        self._played = 0  # cycles
        self._missed = 0  # drive frames in a row
        self._wall = WallClock()
        # when the cycle under way, or to come, is due
        self._t_ns = max(self._wire.clock.now(), master.played_until) + self._period
        self._sync = 0
        self._late = LateFrames()
        master.hooks.on_cyclic.update({each.identifier: self._receive_answer for each in self._answers})

    def now(self) -> int:
        """See `Loop`."""
        return self._wire.clock.now() if self._realtime else self._t_ns

    def close(self) -> None:
        """See `Loop`."""
        self._master.played_until = 0 if self._realtime else self._t_ns

    def hold(self, phase: int) -> float:
        """See `Loop`; the next cycle follows at once."""
        return self._step.demand

    def cycle(self, step: CycleInput) -> None:
        """One cycle; the cycle before, which it closes, goes to the log."""
        lateness = self._wait_until_due()
        self._close()
        self._step = step
        master, k = self._master, self.k
        began = self._wall.now()
        self.outputs.update(zip(self._values.given, self._values.list_given(step), strict=True))
        if self._plant is not None:
            self._read_plant(self._plant, k)
        is_overrun = 2 * lateness > self._period  # it leaves the controller too little of the cycle to answer in
        timing = Timing(k, is_overrun, lateness * 1e-9, nan, nan)
        set_rig_faults(master, self._faults, k)
        reported = master.count_emergencies(Role.PLANT) if self._bench.has_plant_node else 0
        self._send_frames(is_before_sync=True)
        delay = self._send_sync()
        if self._plant is not None:
            self.outputs["flags"] = self._judge_drive(self._plant)
        row = self._values.open_row(k, step.phase, self.outputs[self._values.command], step.load, step.control)
        self._open = self._t_ns, row, timing
        self._expect_answers(delay is not None)
        self._send_frames(is_before_sync=False)
        if self._plant is not None:
            self._values.fill_row(row, self.outputs, _OF_PLANT)
            timing.feedback_response = timing.valve_response = 0.0
            if step.is_counted and not self.problem:
                if k == 0:  # the plant rests until the run begins: no answer from before drives it
                    self._plant.drive = 0.0
                self._plant.move(k)
        timing.execution = (self._wall.now() - began) * 1e-9
        if not self._realtime:
            self._wait_for_answers(delay)
            self._wait_for_report(reported)
            self._late.release(self._t_ns + self._period)
        master.tick()
        for emulator in self._emulators:
            self.problem = self.problem or emulator.plant.problem
        self.k += step.is_counted
        self._played += 1
        self._t_ns += self._period

    def finish(self) -> None:
        """Wait for the answers of the last cycle and close it."""
        self._wait_until_due()
        self._close()

    def _wait_until_due(self) -> int:
        """The next cycle is due; by how much it is late, ns. Lockstep is never late."""
        if not self._realtime:
            return 0
        while self._late and self._late.due < self._t_ns:
            due = self._late.due
            self._wire.run_until(due)
            self._late.release(due + 1)
        self._wire.run_until(self._t_ns)
        late = self._wire.clock.now() - self._t_ns
        lost = late // self._period
        self.overruns += max(lost, 2 * late > self._period)
        self._t_ns += lost * self._period
        return late

    # ------------------------------------------------------------------------------------ the rig's own plant

    def _read_plant(self, plant: FaultyPlant, k: int) -> None:
        """The readings of the cycle to come."""
        if self.problem:
            return
        readings = plant.read(k)
        if readings is None:
            self.problem = plant.problem
            return
        self.outputs.update(zip(self._values.readings, readings, strict=True))

    def _judge_drive(self, plant: FaultyPlant) -> int:
        """Flags of this cycle, and the current until the next one: see hard_cycle.py."""
        if not self._begun:
            return 0
        if "drive" in self._seen.came:
            plant.drive, self._missed = self.outputs[self._values.drive], 0
            return 0
        self._missed += 1
        flags = int(Flags.DRIVE_LATE if self._seen.is_late else Flags.DRIVE_MISSING)
        if self._missed >= self._bench.most_missed:
            plant.drive = 0.0
            flags |= int(Flags.CURRENT_ZEROED)
        return flags

    # ------------------------------------------------------------------------------------ frames out

    def _send_sync(self) -> int | None:
        """Send SYNC; returns how late a fault makes it, ns, or None where it is lost."""
        identifier, action = self._bench.frames.sync, self._faults.find_action("sync", self.k)
        delay = action.argument if action.code == DELAY else 0
        if delay and self._realtime:
            self._wire.run_until(self._t_ns + delay)
        self._sync = self._wire.clock.now() if self._realtime else self._wall.now()
        if identifier is None:
            return delay
        for _ in apply_action(action, b""):
            self._master.send(identifier, b"")
        return None if action.code == DROP else delay

    def _send_frames(self, *, is_before_sync: bool) -> None:
        """Send the frames of this cycle that go before SYNC, or those that follow it."""
        for spec in self._bench.frames.list_from(Role.RIG):
            if spec.is_before_sync is is_before_sync and self._played % spec.every == 0:
                data = pack(spec, {**self.outputs, "cycle": self.k}, self._sent[spec.identifier])
                self._sent[spec.identifier] += 1
                self.outputs.update(unpack(spec, data))  # what the receiver will read
                self._late.pass_on(self._find_fault(spec), data, self._t_ns, partial(self._master.send, spec.sent_as))

    def _find_fault(self, spec: FrameSpec) -> Action:
        """What a fault does to a frame that the rig sends: to the command, or to the feedback of its own plant."""
        action = self._faults.find_action("command", self.k) if "command" in spec.roles else NORMAL
        if action.code == SENT_NORMALLY and self._plant is not None and "feedback" in spec.roles:
            return self._faults.find_action("feedback", self.k)
        return action

    # ------------------------------------------------------------------------------------ frames in

    def _expect_answers(self, is_synced: bool) -> None:
        """Which answers are sure to come in this cycle, and which values of earlier frames still count."""
        self._seen = Seen()
        if self._link is not None:
            self._seen.plant_left, self._seen.drives_left = self._count_repeated_frames(self.k)
        if self._plant is not None:
            self._seen.came |= {"feedback", "valve_state"}
        if not is_synced:
            return
        # without a SYNC the controller has its own clock: its frame may slip from one cycle of the rig to the next
        slack = int(self._bench.frames.sync is None and self._realtime)
        for spec, answer in self._answers.items():
            age = self._begun - answer.last
            if answer.last >= 0 and age < spec.every + (slack if spec.is_answer else self._bench.most_missed):
                self._seen.came |= answer.roles
            elif spec.is_answer and age >= spec.every:
                self._seen.awaited.add(spec)
        self._begun += 1

    def _wait_for_answers(self, delay: int | None) -> None:
        """Lockstep: let the answers come in; what is not sure to come is given the time of a cycle."""
        seen = self._seen
        is_unsure = any(answer.last < 0 or not spec.is_answer for spec, answer in self._answers.items())
        if delay is None or (is_unsure and not seen.awaited):
            self._wire.run_until(self._wire.clock.now() + self._period)
        elif seen.awaited:
            self._wire.wait_for_answers(self._t_ns + delay, lambda: not seen.awaited and seen.plant_left <= 0)
            if seen.drives_left > 0 and not seen.awaited:  # not every controller answers twice
                self._wire.wait(lambda: seen.drives_left <= 0, _SECOND_ANSWER)

    def _count_repeated_frames(self, k: int) -> tuple[int, int]:
        """How many frames of the plant and of the controller come in a cycle in which a fault doubles some.

        Zeros where none is doubled. Lockstep between programs waits for all of them, for feedback of the cycle before
        would count as that of the next one.
        """
        is_second = self._faults.find_action("sync", k).code == DOUBLE
        cycles = (k, k + 1) if is_second else (k,)  # the second answer is under the faults of the cycle to come
        feedback, valve = ([self._faults.find_action(name, each) for each in cycles]
                           for name in ("feedback", "valve_state"))
        if not (is_second or any(each[0].code == DOUBLE for each in (feedback, valve))):
            return 0, 0
        copies = {DROP: 0, DELAY: 0, DOUBLE: 2}
        answered = sum(copies.get(action.code, 1) for action in feedback if action.code != CUT)
        return sum(copies.get(action.code, 1) for action in feedback + valve), answered

    def _wait_for_report(self, reported: int) -> None:
        """Lockstep between programs: the first drive frame that a fault cuts is reported by the plant in its own time.

        `reported`: EMCYs of the plant before this cycle.
        """
        master, link = self._master, self._link
        if link is None or not self._bench.has_plant_node:
            return
        if [self._faults.find_action("drive", k).code == CUT for k in (self.k - 1, self.k)] == [False, True]:
            link.wait(lambda: master.count_emergencies(Role.PLANT) > reported or link.is_node_gone(), link.grace)

    def _receive_answer(self, frame: Frame) -> None:
        """A frame of the controller, or of the plant, has come."""
        spec = self._bench.frames.find(frame.cob_id, frame.data)
        if self._open is None or spec not in self._answers:
            return
        answer = self._answers[spec]
        if "drive" in answer.roles:
            self._seen.drives_left -= 1
        else:
            self._seen.plant_left -= 1
        if self._plant is None or "drive" not in answer.roles:
            self._take_answer(answer, frame.data, frame.t_ns)
            return
        action = self._faults.find_action("drive", self._open[1].cycle)
        if self._faults.is_bus_off("plant", self._open[1].cycle):
            return
        is_late = action.code == DELAY
        self._late.pass_on(action, frame.data, frame.t_ns if self._realtime else self._t_ns, lambda data:
                           self._take_answer(answer, data, self._wire.clock.now() if is_late else frame.t_ns))

    def _is_sound(self, spec: FrameSpec, data: bytes) -> bool:
        """Whether alive counter and checksum of an answer let it be taken."""
        last = self._counters.get(spec.identifier, -1)
        problem, self._counters[spec.identifier] = check_guards(spec, data, last)
        self.unsound += bool(problem)
        return problem in ("", "jump")

    def _take_answer(self, answer: _Answer, data: bytes, t_ns: int) -> None:
        """Take the values of an answer: the first feedback, and of the others the last of this cycle."""
        if self._open is None or len(data) != answer.spec.length:
            return
        _, row, timing = self._open
        is_first = answer.last != self._begun - 1
        if not (answer.cycle_mask or is_first or "drive" in answer.roles) or (
                answer.is_guarded and not self._is_sound(answer.spec, data)):
            return
        values = unpack(answer.spec, data)
        if answer.cycle_mask and values["cycle"] != row.cycle & answer.cycle_mask:
            self._seen.is_late |= "drive" in answer.roles
            return
        self.outputs.update(values)
        answer.last = self._begun - 1
        self._seen.came |= answer.roles
        self._seen.awaited.discard(answer.spec)
        if is_first:
            # by its time of reception; in lockstep, where that is virtual, to now
            since = ((t_ns if self._realtime else self._wall.now()) - self._sync) * 1e-9
            for role in answer.roles & _RESPONSES.keys():
                setattr(timing, _RESPONSES[role], since)
            if not self._seen.awaited and isnan(timing.work):
                timing.work = since

    def _close(self) -> None:
        """The cycle under way is over: the next SYNC is due."""
        if self._open is None:
            return
        (t_ns, row, timing), self._open = self._open, None
        if not self._step.is_counted:
            return
        self._values.fill_row(row, self.outputs, self._seen.came - (_OF_PLANT if self._plant is not None else set()))
        self._log.cycle(t_ns, row, timing)


def set_rig_faults(master: Master, faults: Schedule, k: int) -> None:
    """The faults of the rig itself that do not concern the cycle: its heartbeat, and what else it hears."""
    master.silent = not faults.is_heartbeat_alive("rig", k)
    master.is_deaf = faults.is_bus_off("rig", k)


_OF_PLANT = frozenset({"feedback", "valve_state"})
_SECOND_ANSWER = 0.08  # s: how long the second drive frame of a cycle is waited for
_TIMES = ("lateness", "response", "feedback_response", "valve_response", "execution")


class History:
    """The complete cycles of a run. A field by name is a column, (cycles,) SI; missing samples are NaN."""

    def __init__(self, signals: plant_signals.Signals = plant_signals.EHA) -> None:
        """`signals`: of the plant."""
        self.signals, row = signals, ("phase", *signals.names, "flags", "control", "status")
        self._fields = (*row, *_TIMES)
        self._read_row, self._read_times = attrgetter(*row), attrgetter(*_TIMES)
        self._numbers = array("d")

    def __len__(self) -> int:
        return len(self._numbers) // len(self._fields)

    def cycle(self, t_ns: int, row: Signals, timing: Timing) -> None:
        """Append one cycle (called by a loop)."""
        self._numbers.extend((*self._read_row(row), *self._read_times(timing)))

    def cycles(self, block: CycleBlock) -> None:
        """Append several cycles (called by a loop)."""
        table = np.empty((len(block.t_ns), len(self._fields)))
        for i, name in enumerate(self._fields):
            table[:, i] = block.columns[name]
        self._numbers.frombytes(table[:-1].tobytes())

    def column(self, name: str, phase: int | None = None) -> Array:
        """All cycles, or those of one phase. Raises ValueError for a name that is no field."""
        table = np.frombuffer(self._numbers).reshape(-1, len(self._fields))
        column: Array = table[:, self._fields.index(name)]
        return column.copy() if phase is None else column[table[:, 0] == phase]  # no view: it would pin the buffer
