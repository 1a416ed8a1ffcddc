"""Loops: what the session needs of the cycle of the bench, and the loop for every bus and both paces.

The cycle itself (command, SYNC, answers, row) is compiled code, cycle.py. Here Python waits, sends and receives for it.
In real time on SocketCAN and the UDP bus the compiled code does that too (hard_loop.py).

Lockstep: the next cycle begins when this one's frames are in. Real time: it begins when it is due; due times are a
fixed grid, and a cycle that is late by whole periods drops the due times it has missed (and counts them) instead of
firing a burst. Either way the plant moves one period a SYNC, so a run that was late is late, not wrong."""

from abc import ABC, abstractmethod
from array import array
from collections.abc import Callable, Collection, Mapping
from functools import partial
from math import nan
from operator import attrgetter
from typing import Any, NamedTuple, Protocol

import numpy as np

from plant import Array, Model, signals as plant_signals
from rig.benches import FD, RIG_OUTPUTS, Bench, Role, load_bench, packing
from rig.network import PAYLOAD_IN, Frame, LinkWire, Master, Port, WallClock
from rig.nodes import Emulator, Scenario, call_loop, emulator_cycle as ec, load_loop, load_plant, make_port
from rig.recorder import CycleBlock, Signals, Timing, make_row_record
from rig.run import cycle as cy
from rig.sequences import CUT, DELAY, DOUBLE, DROP, Plan, Schedule

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
        plant_names = (*self.readings, "flags")
        self.sent = self.given if bench.has_plant_node else (*self.given, *plant_names)
        received_names = [name for name in (*plant_names, self.drive, *RIG_OUTPUTS, *bench.ready)
                          if name not in self.sent and name != "cycle"]
        self.names = (*self.sent, *dict.fromkeys(received_names))
        self.place = {name: i for i, name in enumerate(self.names)}
        feedback_words = {each.name for spec in bench.frames.frames if "feedback" in spec.roles for each in spec.fields}
        role = {signals.drive.name: "drive", **{s.name: "feedback" if s.word in feedback_words else "valve_state"
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
                *(float(values[phase]) for values in self._phases.values())]

    def list_safe(self, control: int) -> list[float]:
        """What replaces the given values in the safe state; NaN where nothing does."""
        return [nan, nan, float(control), nan, *(float(values["safe"]) for values in self._phases.values())]


class CycleObserver(Protocol):
    """Receives each cycle when it is complete."""

    def cycle(self, t_ns: int, signals: Signals, timing: Timing) -> None:
        """A cycle is over."""

    def cycles(self, block: CycleBlock) -> None:
        """Several are over, and the last of the block is under way."""


_AT_REST = Scenario(Model(), Plan(stop=0))  # of a plant that nobody moves


class Loop(ABC):
    """What the session needs of a cycle loop. One that queues its inputs runs behind them and overrides more.

    The cycle is compiled (cycle.py). A loop shares its memory with it: inputs in, rows and frames out.
    """

    kind: str  # "soft" or "hard" real time
    scheduler = ""  # how the kernel schedules the thread of the cycle, if it has one of its own
    problem = ""  # why the plant cannot go on
    _origin = 0  # ns: what the clock of the compiled code says when the run begins
    _idle_phase = 0

    def __init__(self, master: Master, bench: Bench, scenario: Scenario, faults: Schedule, log: CycleObserver,
                 ahead: int) -> None:
        """`ahead`: cycles that can be queued."""
        self._master, self._bench, self._faults, self._log = master, bench, faults, log
        self._period, self._ahead, self._values = bench.cycle_ns, ahead, CyclicValues(bench)
        self._layout = packing.make_layout(bench.frames.list_of(Role.RIG), self._values.names, Role.RIG)
        # where the plant is a node of its own, the cycle does not move this one
        self._code = None if bench.has_plant_node else load_plant(scenario)
        self._plant = ec.make_memory(scenario, *self._code.code) if self._code else ec.make_memory(_AT_REST)
        self._noise = np.random.default_rng(scenario.seed)
        self._draw_noise()
        channels, is_fd = len(self._values.names), any(each.identifier & FD for each in bench.frames.frames)
        late = 100 + 2_000_000_000 // self._period  # a command and a drive each cycle, for the longest delay
        self._buffers = cy.make_buffers(ahead, 8 * ahead, 64 * ahead, late, len(self._values.given), channels, is_fd)
        self._inputs = [CycleInput(0, 0.0, 0.0, 0)] * (9 * ahead)  # of all rows that are not yet logged, and the queue
        # the last values of the bench that are known; `CyclicValues` has the names
        self.outputs: dict[str, float] = dict.fromkeys(self._values.names, 0.0)
        words, place, sync = self._buffers.words, self._values.place, bench.frames.sync
        self._words = words
        words[cy.PERIOD], words[cy.MAY_IDLE_AT], words[cy.SYNC_ID] = self._period, -1, -1 if sync is None else sync
        words[cy.MOVES_PLANT], words[cy.MISSED_LIMIT] = not bench.has_plant_node, bench.most_missed
        words[cy.DRIVEN], words[cy.SENT_CHANNELS] = len(self._values.given), len(self._values.sent)
        words[cy.SENSED_AT], words[cy.DRIVE_VALUE_AT] = place[self._values.readings[0]], place[self._values.drive]
        words[cy.FLAGS_AT] = place["flags"]

    @property
    @abstractmethod
    def k(self) -> int:
        """The cycle to come."""

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

    def wait_until_played(self, stop: Callable[[], bool]) -> None:  # noqa: B027 - nothing is queued
        """Wait until all inputs are taken, or `stop()`."""

    def close(self) -> None:  # noqa: B027 - nothing to give back
        """Give back what the loop holds, whatever happened."""

    @property
    def overruns(self) -> int:
        """Due times missed, cycles late by more than half a period, and cycles for which no input was given in time."""
        return int(self._words[cy.OVERRUNS])

    @property
    def underruns(self) -> int:
        """Cycles for which no input was given in time; they repeat the last one."""
        return int(self._words[cy.UNDERRUNS])

    @property
    def unsound(self) -> int:
        """Frames with a wrong checksum, or an alive counter that is not the next."""
        return sum(int(self._layout.words[at + packing.UNSOUND]) for at in packing.list_frame_places(self._layout))

    def describe_refusal(self) -> str:
        """Why the drive frame that came last was not taken; empty where it was, or none came."""
        words = self._layout.words
        at = next(at for at in packing.list_frame_places(self._layout) if words[at + packing.ROLES] & packing.DRIVE)
        why = {packing.OTHER_LENGTH: f"{words[at + packing.CAME_WITH]} bytes, not {words[at + packing.LENGTH]}",
               packing.WRONG_CHECKSUM: "a wrong checksum", packing.REPEATED: "the alive counter of the one before",
               packing.OTHER_CYCLE: "the number of another cycle"}.get(int(words[at + packing.STATUS]))
        return f"the last that came had {why}" if why else ""

    def _draw_noise(self) -> None:
        """Draw the noise of the plant, 16 s ahead at 1 kHz."""
        if self._code:
            ec.fill_noise(self._plant, self._noise)

    def _push(self, step: CycleInput) -> None:
        """Queue an input."""
        k, position = self.queued, int(self._words[cy.TAIL])
        command, sync = self._faults.find_action("command", k), self._faults.find_action("sync", k)
        self._inputs[position % len(self._inputs)] = step
        queue = self._buffers.inputs
        self._buffers.settings[position % len(queue)] = self._values.list_given(step)
        queue[position % len(queue)] = step.is_counted, *command, *sync, self._faults.is_bus_off("rig", k)
        self._words[cy.TAIL] = position + 1

    def _note_problem(self) -> None:
        if self._code and self._words[cy.DIVERGED]:
            self.problem = self._code.problem or ec.explain_divergence(self._plant, self._bench.signals)

    def _log_rows(self) -> None:
        """Log the cycles that are complete."""
        words, buffers = self._words, self._buffers
        first, last = int(words[cy.ROWS_READ]), int(words[cy.ROWS])
        value_rows = read_ring(buffers.values, first, last)
        for row, values in zip(read_ring(buffers.rows, first, last), value_rows, strict=True):
            words[cy.ROWS_READ] += 1
            self._take_row(row, dict(zip(self._values.names, values, strict=True)))

    def _take_row(self, row: list[int], values: dict[str, float]) -> None:
        """Log a cycle."""
        if not row[cy.IS_COUNTED]:
            return
        step = self._inputs[row[cy.INPUT] % len(self._inputs)]
        phase = self._idle_phase if row[cy.INPUT_HELD] and self._idle_phase else step.phase
        roles = {role for role, bit in packing.BITS.items() if row[cy.ANSWERS] & bit}
        signals = self._values.open_row(row[cy.CYCLE], phase, values[self._values.command], step.load,
                                        int(values["control_word"]))
        self._values.fill_row(signals, values, roles)
        timing = Timing(
            row[cy.CYCLE], bool(row[cy.OVERRUN]), row[cy.LATENESS] * 1e-9,
            row[cy.DRIVE_AT] * 1e-9 if row[cy.DRIVE_AT] else nan,
            row[cy.COMPLETE_AT] * 1e-9 if row[cy.COMPLETE_AT] else nan,
            row[cy.FEEDBACK_AT] * 1e-9 if "feedback" in roles else nan,
            row[cy.VALVE_AT] * 1e-9 if "valve_state" in roles else nan, row[cy.EXECUTION] * 1e-9)
        self._log.cycle(row[cy.DUE_AT] - self._origin, signals, timing)


def read_ring(ring: np.ndarray, first: int, last: int) -> list[list[Any]]:
    """Entries `first` to `last` - 1 of a ring."""
    entries: list[list[Any]] = ring[np.arange(first, last) % len(ring)].tolist()
    return entries


def make_trial() -> tuple[Port, cy.Buffers, packing.Layout, ec.Memory]:
    """Arguments for a part of a cycle of the shipped bench: it sends its command."""
    bench = load_bench()
    values = CyclicValues(bench)
    buffers = cy.make_buffers(1, 2, 8, 1, len(values.given), len(values.names), is_fd=False)
    buffers.words[cy.PART], buffers.words[cy.PERIOD], buffers.words[cy.DRIVEN] = cy.FIRST, 1, len(values.given)
    buffers.settings[:] = 0.0
    layout = packing.make_layout(bench.frames.list_of(Role.RIG), values.names, Role.RIG)
    return make_port(), buffers, layout, ec.make_memory(_AT_REST)


load_parts = partial(load_loop, cy.play_part, make_trial)  # the parts of the cycle, for a loop in Python


class CycleLoop(Loop):
    """Runs cycles one by one and passes each to `log` when it is complete. In real time it is soft: Python is in it."""

    kind = "soft"
    k = 0

    def __init__(self, master: Master, bench: Bench, scenario: Scenario, faults: Schedule, log: CycleObserver,
                 realtime: bool) -> None:
        super().__init__(master, bench, scenario, faults, log, ahead=16)
        self._wire, self._realtime = master.wire, realtime
        self._link = None if realtime or not isinstance(master.wire, LinkWire) else master.wire  # lockstep of programs
        self._port = make_port()
        self._run = load_parts().bind((self._port, self._buffers, self._layout, self._plant))
        answers = [each for each in bench.frames.frames if each.sender is not Role.RIG]
        self._are_sure = all(each.is_answer for each in answers)
        self._places = np.array([at for at in packing.list_frame_places(self._layout)
                                 if not self._layout.words[at + packing.IS_MINE]], np.int64)
        # without a SYNC the controller has its own clock: its frame may slip from one cycle of the rig to the next
        self._words[cy.SLACK] = bench.frames.sync is None and realtime
        self._emulators = [node for node in getattr(self._wire, "nodes", ()) if isinstance(node, Emulator)]
        self._plant_left = self._drives_left = 0  # frames to come in a cycle in which a fault doubles some
        self._wall = WallClock()
        # when the cycle under way, or to come, is due
        self._t_ns = max(self._wire.clock.now(), master.played_until) + self._period
        self._words[cy.DUE] = self._t_ns
        master.hooks.on_cyclic.update({each.identifier: self._receive_answer for each in answers})

    def now(self) -> int:
        """See `Loop`."""
        return self._wire.clock.now() if self._realtime else self._t_ns

    def close(self) -> None:
        """See `Loop`."""
        self._master.played_until = 0 if self._realtime else self._t_ns

    def hold(self, phase: int) -> float:
        """See `Loop`; the next cycle follows at once."""
        last: CycleInput = self._inputs[self._words[cy.POSITION] % len(self._inputs)]
        return last.demand

    def cycle(self, step: CycleInput) -> None:
        """One cycle; the cycle before, which it closes, goes to the log."""
        lateness = self._wait_until_due()
        self._end()
        master, k = self._master, self.k
        begin = self._wall.now()
        self._push(step)
        self._draw_noise()
        set_rig_faults(master, self._faults, k)
        emergencies = master.count_emergencies(Role.PLANT) if self._bench.has_plant_node else 0
        self._play(cy.FIRST)
        fault = self._faults.find_action("sync", k)
        delay = fault.argument if fault.code == DELAY else 0
        if delay and self._realtime:
            self._wire.run_until(self._t_ns + delay)
        self._plant_left, self._drives_left = self._count_repeated_frames(k) if self._link is not None else (0, 0)
        self._play(cy.SYNC, lateness)
        self._words[cy.WORKED] = self._wall.now() - begin
        if not self._realtime:
            self._wait_for_answers(None if fault.code == DROP and self._words[cy.SYNC_ID] >= 0 else delay)
            self._wait_for_report(emergencies)
            self._play(cy.LATE, self._t_ns + self._period)
        master.tick()
        self._finish_cycle()

    def finish(self) -> None:
        """Wait for the answers of the last cycle and close it."""
        self._wait_until_due()
        self._end()

    def _wait_until_due(self) -> int:
        """The next cycle is due; by how much it is late, ns. Lockstep is never late."""
        if not self._realtime:
            return 0
        while self._words[cy.HELD] and (due := int(self._buffers.held[0, cy.HELD_DUE])) < self._t_ns:
            self._wire.run_until(due)
            self._play(cy.LATE, due + 1)
        self._wire.run_until(self._t_ns)
        late = self._wire.clock.now() - self._t_ns
        self._t_ns += late // self._period * self._period
        return late

    def _end(self) -> None:
        """The cycle under way is over: the next SYNC is due."""
        self._play(cy.END)
        self._log_rows()

    def _finish_cycle(self) -> None:
        """What the compiled code has counted is true for all from now on."""
        self._note_problem()
        for emulator in self._emulators:
            self.problem = self.problem or emulator.problem
        at = int(self._layout.words[packing.VALUES_AT])
        self.outputs = dict(zip(self._values.names, self._layout.doubles[at:].tolist(), strict=False))
        self.k, self._t_ns = int(self._words[cy.CYCLES]), int(self._words[cy.DUE])

    # ------------------------------------------------------------------------------------ the compiled code

    def _play(self, part: int, argument: int = 0) -> None:
        """Play a part of the cycle, and send its frames."""
        self._words[cy.PART], self._words[cy.ARGUMENT] = part, argument
        # in lockstep, where the clock is virtual, the wall clock tells how long something took
        now = (self._wire.clock if self._realtime else self._wall).now()
        for identifier, data in call_loop(self._port, self._run, now):
            self._master.send(identifier, data)

    def _receive_answer(self, frame: Frame) -> None:
        """A frame of the controller, or of the plant, has come."""
        words = self._words
        if not words[cy.OPEN]:
            return
        if frame.cob_id == self._bench.frames.drive.identifier:
            self._drives_left -= 1
        else:
            self._plant_left -= 1
        came = frame.t_ns if self._realtime else self._wall.now()
        words[cy.CAME_AT] = frame.t_ns if self._realtime else self._t_ns
        words[cy.CAME_AS], words[cy.CAME_LENGTH] = frame.cob_id, len(frame.data)
        payload = np.frombuffer(frame.data.ljust(8, b"\0"), np.uint8)
        self._port.octets[PAYLOAD_IN:PAYLOAD_IN + len(payload)] = payload
        self._play(cy.ANSWER, came - int(words[cy.SYNC_AT]))

    # ------------------------------------------------------------------------------------ lockstep

    def _wait_for_answers(self, delay: int | None) -> None:
        """Let the answers come in; what is not sure to come is given the time of a cycle."""
        is_sure = self._are_sure and bool((self._layout.words[self._places + packing.LAST_CYCLE] >= 0).all())
        is_open = not cy.is_complete(self._words)
        if delay is None or not (is_sure or is_open):
            self._wire.run_until(self._wire.clock.now() + self._period)
        elif is_open:
            self._wire.wait_for_answers(self._t_ns + delay,
                                        lambda: cy.is_complete(self._words) and self._plant_left <= 0)
            if self._drives_left > 0 and cy.is_complete(self._words):  # not every controller answers twice
                self._wire.wait(lambda: self._drives_left <= 0, _SECOND_ANSWER)

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
        drive_count = sum(copies.get(action.code, 1) for action in feedback if action.code != CUT)
        return sum(copies.get(action.code, 1) for action in feedback + valve), drive_count

    def _wait_for_report(self, emergencies: int) -> None:
        """Lockstep between programs: the first drive frame that a fault cuts is reported by the plant in its own time.

        `emergencies`: EMCYs of the plant before this cycle.
        """
        master, link = self._master, self._link
        if link is None or not self._bench.has_plant_node:
            return
        if [self._faults.find_action("drive", k).code == CUT for k in (self.k - 1, self.k)] == [False, True]:
            link.wait(lambda: master.count_emergencies(Role.PLANT) > emergencies or link.is_node_gone(), link.grace)


def set_rig_faults(master: Master, faults: Schedule, k: int) -> None:
    """The faults of the rig itself that do not concern the cycle: its heartbeat, and what else it hears."""
    master.silent = not faults.is_heartbeat_alive("rig", k)
    master.is_deaf = faults.is_bus_off("rig", k)


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
        # slices are copies: while anything, a debugger perhaps, holds a view of the array, no cycle can be appended
        column: Array = np.array(self._numbers[self._fields.index(name)::len(self._fields)])
        return column if phase is None else column[np.array(self._numbers[::len(self._fields)]) == phase]
