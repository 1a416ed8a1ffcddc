"""The cycle loop of the embedded bus in lockstep: quiet cycles run together, many a call, all others one by one.

Both give the same rows and frames. A cycle with a fault on the bus, a frame that waits, or a node that is not well is
played by `CycleLoop` and the nodes themselves. Timers, such as those of heartbeats, run in Python between the calls.

A cycle is quiet when nothing happens in it but its frames: all nodes are OPERATIONAL, the loop of the controller is
closed, and no timer runs out. Its frames are packed from the tables of the bench (rig/benches/packing.py), and each
value is what its receiver reads from its frame: rows and payloads are those of the nodes in Python to the last bit.
"""

import ctypes
from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant import Array, ForeignCall, Loop, Model, Signals, compute_current
from rig.benches import (
    ALL_ROLES,
    LAST_CYCLE,
    PAYLOAD,
    ROLES,
    VALUES_AT,
    Bench,
    FrameSpec,
    Layout,
    Role,
    list_frame_places,
    load_bench,
    make_layout,
    pack_frame,
)
from rig.network import EmbeddedWire, Gains, Master, Port, read_gains
from rig.nodes import (
    IN_FORCE,
    READINGS_AT,
    SENSORS,
    CompiledPlant,
    Emulator,
    Firmware,
    Memory,
    Scenario,
    advance_plant,
    fill_noise,
    load_loop,
    make_memory,
    make_port,
    read_plant,
)
from rig.recorder import CycleBlock, make_row_record
from rig.run import cycle as cy
from rig.run.loop import CycleInput, CycleLoop, CycleObserver, CyclicValues
from rig.sequences import BusOff, Foreign, Plan, Reset, Schedule, Silent

# Words: cycles to play and played, the number of the first; address of the C library's clock (0: no times) and its
# answer; places of the frames
ASKED, DONE, FIRST, CLOCK, TIME, FRAMES_AT = 0, 1, 2, 3, 4, 6
DEMAND, LOAD, READINGS, DRIVE_VALUE = range(10, 14)  # places among the values; the readings stand together
COMMAND, FEEDBACK, VALVE, DRIVE = range(4)  # frames, columns of the payloads
# Reals: the controller's loop and gains; then for each signal with limits (readings, demand, drive, load, error) its
# value, the lower and the upper limit
LOOP, GAINS, _LIMITS_AT = 0, 3, 8
_LIMITED = 4  # signals with limits beside the readings
BEGUN_AT, SYNC_AT, PLANT_AT, DRIVE_AT = range(4)  # columns of the times

MOST = 500  # cycles a call
_call_clock = ForeignCall("iiq")
_MONOTONIC = 1


class Buffers(NamedTuple):
    """What Python and the compiled loop share; of a call row i is its cycle i."""

    words: NDArray[np.int64]
    reals: NDArray[np.float64]
    layout: Layout
    inputs: NDArray[np.float64]  # (MOST, 2), SI: demand, load for the rig
    values: NDArray[np.float64]  # (MOST, values of the bench), SI
    payloads: NDArray[np.int64]  # (MOST, 4)
    times: NDArray[np.int64]  # (MOST, 4), ns


def play_quiet_cycles(port: Port, b: Buffers, plant: Memory) -> None:
    """Play the cycles asked for, but none after one whose values are outside a guard, nor one of a plant that diverges.
    """
    words, reals, m = b.words, b.reals, b.layout
    at = m.words[VALUES_AT]
    loop = Loop(reals[LOOP], reals[LOOP + 1], reals[LOOP + 2])
    gains = Gains(reals[GAINS], reals[GAINS + 1], reals[GAINS + 2], reals[GAINS + 3], reals[GAINS + 4])
    readings, words[DONE] = at + words[READINGS], 0
    for i in range(words[ASKED]):
        _note_time(b, i, BEGUN_AT)
        k = words[FIRST] + i
        if _is_outside(b, plant.words[SENSORS]) or not read_plant(plant, k):
            break
        plant.reals[IN_FORCE] = m.doubles[at + words[DRIVE_VALUE]]  # what the controller answered to the cycle before
        m.doubles[at + words[DEMAND]], m.doubles[at + words[LOAD]] = b.inputs[i, 0], b.inputs[i, 1]
        _pack(b, i, COMMAND)
        _note_time(b, i, SYNC_AT)
        for j in range(plant.words[SENSORS]):
            m.doubles[readings + j] = plant.reals[plant.words[READINGS_AT] + j]
        _pack(b, i, FEEDBACK)
        _pack(b, i, VALVE)
        _note_time(b, i, PLANT_AT)
        m.doubles[at + words[DRIVE_VALUE]], loop = compute_current(
            loop, m.doubles[at + words[DEMAND]], m.doubles[readings], gains)
        _pack(b, i, DRIVE)
        _note_time(b, i, DRIVE_AT)
        advance_plant(plant, k)
        for channel in range(b.values.shape[1]):
            b.values[i, channel] = m.doubles[at + channel]
        words[DONE] += 1
    reals[LOOP], reals[LOOP + 1], reals[LOOP + 2] = loop.integral, loop.error, loop.cycles


def _is_outside(b: Buffers, sensors: int) -> bool:
    """Whether a value of the cycle before is outside the limits of the guards."""
    words, reals, at = b.words, b.reals, b.layout.words[VALUES_AT]
    for i in range(sensors):
        reals[_LIMITS_AT + 3 * i] = b.layout.doubles[at + words[READINGS] + i]
    rest = _LIMITS_AT + 3 * sensors
    reals[rest] = b.layout.doubles[at + words[DEMAND]]
    reals[rest + 3] = b.layout.doubles[at + words[DRIVE_VALUE]]
    reals[rest + 6] = b.layout.doubles[at + words[LOAD]]
    reals[rest + 9] = reals[rest] - reals[_LIMITS_AT]
    for place in range(_LIMITS_AT, rest + 3 * _LIMITED, 3):
        if not reals[place + 1] <= reals[place] <= reals[place + 2]:
            return True
    return False


def _pack(b: Buffers, i: int, what: int) -> None:
    """Pack a frame of cycle i; its values become what the receiver reads."""
    pack_frame(b.layout, b.words[FRAMES_AT + what], b.words[FIRST] + i)
    b.payloads[i, what] = b.layout.words[PAYLOAD]


def _note_time(b: Buffers, i: int, column: int) -> None:
    words = b.words
    if words[CLOCK]:
        _call_clock(words[CLOCK], _MONOTONIC, words.ctypes.data + 8 * TIME)
        b.times[i, column] = words[TIME] * 1_000_000_000 + words[TIME + 1]


# ---------------------------------------------------------------------------------------- made before the start


def make_buffers(bench: Bench, m: Layout, names: Sequence[str], guards: Mapping[str, tuple[float, float]]) -> Buffers:
    """Buffers for a bench with this layout, whose values have these names. `guards`: limits by signal, SI."""
    guarded_signals = list_guarded(bench.signals)
    b = Buffers(np.zeros(16, np.int64), np.zeros(_LIMITS_AT + 3 * len(guarded_signals)), m, np.zeros((MOST, 2)),
                np.zeros((MOST, len(names))), np.zeros((MOST, 4), np.int64), np.zeros((MOST, 4), np.int64))
    places = dict(zip((each.identifier for each in bench.frames.list_of(Role.RIG)), list_frame_places(m), strict=True))
    b.words[FRAMES_AT:FRAMES_AT + 4] = [places[each.identifier] for each in list_frames(bench)]
    values = CyclicValues(bench)
    b.words[DEMAND:DRIVE_VALUE + 1] = [names.index(name) for name in (values.command, values.load, values.readings[0],
                                                                      values.drive)]
    b.reals[_LIMITS_AT:].reshape(-1, 3)[:, 1:] = [guards.get(signal, (-np.inf, np.inf)) for signal in guarded_signals]
    return b


def list_guarded(signals: Signals) -> tuple[str, ...]:
    """What may have limits, in the order of the compiled code."""
    load = "load" if signals.load is None else signals.load.name
    return (*(s.name for s in signals.outputs), signals.command.name, signals.drive.name, load, "error")


def list_frames(bench: Bench) -> list[FrameSpec]:
    """The frames of a cycle in the order of the payloads; empty unless there is one of each kind, in each cycle."""
    frames = [each for role in ("command", "feedback", "valve_state", "drive")
              for each in bench.frames.frames if role in each.roles]
    names = {bench.signals.command.word, *(s.word for s in bench.signals.outputs), bench.signals.drive.word,
             "control_word", "status_word", "flags", "cycle"}  # what our own nodes put into frames
    is_plain = all(each.every == 1 and each.length == 8 and {field.name for field in each.fields} <= names
                   for each in frames)
    return frames if is_plain and len(bench.frames.frames) == len(set(frames)) == len(frames) == 4 else []


def make_trial() -> tuple[Port, Buffers, Memory]:
    """Arguments of some cycles of the shipped bench, without times."""
    bench, model = load_bench(), Model()
    names = CyclicValues(bench).names
    b = make_buffers(bench, make_layout(bench.frames.list_of(Role.RIG), names, Role.RIG), names, {})
    b.words[ASKED], b.inputs[:, 0] = 20, 1e-3
    b.reals[GAINS:_LIMITS_AT] = read_gains(model.values)
    plant = make_memory(Scenario(model, Plan(stop=0)), *CompiledPlant(model).code)
    fill_noise(plant, np.random.default_rng(0))
    return make_port(), b, plant


load_code = partial(load_loop, play_quiet_cycles, make_trial)  # the compiled cycles, for any plant


FRAMES = ("command", "sync", "feedback", "valve_state", "drive")  # that faults act on
Limits = Mapping[str, tuple[float, float]]  # of signals, SI


class EmbeddedLoop(CycleLoop):
    """`CycleLoop` that plays quiet cycles together."""

    def __init__(self, master: Master, bench: Bench, scenario: Scenario, faults: Schedule, log: CycleObserver,
                 guards: Limits) -> None:
        """`guards`: limits of signals; a cycle after one in which a signal was outside is played alone."""
        super().__init__(master, bench, scenario, faults, log, realtime=False)
        assert isinstance(master.wire, EmbeddedWire)
        self._embedded = master.wire
        self._busy = find_busy_cycles(scenario.plan, faults)
        self._quiet = make_buffers(bench, self._layout, self._values.names, guards)
        # address of that of the C library
        self._quiet.words[CLOCK] = ctypes.cast(ctypes.CDLL(None).clock_gettime, ctypes.c_void_p).value or 0
        self._frames, self._sync_id = list_frames(bench), bench.frames.sync or 0
        self._shared: Memory | None = None  # the plant that the compiled code moves
        # identifiers of the answers and their roles, as words have them
        self._answered = int(np.bitwise_or.reduce(self._layout.words[self._places + ROLES]))

    def play_many(self, phase: int, demands: Array, loads: Array, control: int) -> int:
        """Run several cycles under one control word, as many of these as are possible at once; returns how many.

        `demands` and `loads` in SI units. The rows of all but the last go to the log.
        """
        emulator, firmware = self._embedded.nodes
        assert isinstance(emulator, Emulator)
        assert isinstance(firmware, Firmware)
        plant = emulator.share_memory(self.k)
        most = self._count_quiet(emulator, firmware, control, min(len(demands), MOST))
        if plant is None or most < 2:
            return 0
        if plant is not self._shared:  # another one after each reset
            self._shared, self._run_quiet = plant, load_code().bind((self._port, self._quiet, plant))
        self._end()
        b = self._quiet
        values = self._values.list_given(CycleInput(phase, 0.0, 0.0, control))
        at = b.layout.words[VALUES_AT] + 2  # demand and load are those of each cycle
        b.layout.doubles[at:at + len(values) - 2] = values[2:]
        b.words[ASKED], b.words[FIRST] = most, self.k
        b.reals[LOOP:GAINS], b.reals[GAINS:_LIMITS_AT] = firmware.loop, firmware.gains
        b.inputs[:most, 0], b.inputs[:most, 1] = demands[:most], loads[:most]
        self._run_quiet()
        count = int(b.words[DONE])
        if count:
            firmware.loop = Loop(*b.reals[LOOP:GAINS].tolist())
            emulator.pass_quiet(count, int(b.payloads[count - 1, DRIVE]))
            self._take_cycles(phase, control, count)
            self._run_timers(emulator, firmware)
        return count

    def _count_quiet(self, emulator: Emulator, firmware: Firmware, control: int, most: int) -> int:
        """How many of the cycles to come are quiet, at most `most`; the last may be one in which a timer runs out."""
        words = self._words
        is_answered = words[cy.OPEN] and words[cy.CAME] & ALL_ROLES == self._answered & ALL_ROLES
        if (not is_answered or words[cy.HELD] or self.problem
                or not self._embedded.bus.is_empty or not firmware.is_quiet(control)):
            return 0
        due = min(self._master.find_due(), *(node.device.find_due() for node in (emulator, firmware)))
        busy = self._busy[np.searchsorted(self._busy, self.k):][:1]
        return int(min(most, max(due - self._t_ns, 0) // self._period + 1, *(busy - self.k).tolist()))

    def _take_cycles(self, phase: int, control: int, count: int) -> None:
        """Log the cycles that were played, all but the last, which is the cycle under way now."""
        b, names, first, signals = self._quiet, self._values.names, self.k, self._bench.signals
        begin, sync, plant, drive = b.times[:count].T
        values = dict(zip(names, b.values[:count].T.copy(), strict=True))
        feedback, response = (plant - sync) * 1e-9, (drive - sync) * 1e-9
        columns = {
            "cycle": first + np.arange(count), "phase": phase,
            **{s.name: values[s.word] for s in signals[1:] if s.role != "load"},
            **({signals.load.name: b.inputs[:count, 1].copy()} if signals.load else {}), "control": control,
            "status": values["status_word"].astype(np.int64), "flags": values["flags"].astype(np.int64),
            "overrun": False, "lateness": 0.0, "response": response, "work": response, "feedback_response": feedback,
            "valve_response": feedback, "execution": (sync - begin) * 1e-9}
        identifiers = [frame.identifier for frame in self._frames]
        command, *answers = zip(identifiers, b.payloads[:count].T.copy(), strict=True)
        frames = [command, (self._sync_id, None), *answers]
        block = CycleBlock(self._t_ns + self._period * np.arange(count), frames, columns, make_row_record(signals))
        self._log.cycles(block)
        demand, load = b.inputs[count - 1, :2].tolist()
        self._open_last(CycleInput(phase, demand, load, control), count)

    def _open_last(self, step: CycleInput, count: int) -> None:
        """The last of the cycles that were played is the cycle under way now, whose answers have come."""
        words, b, last = self._words, self._quiet, count - 1
        self._push(step)
        words[cy.POSITION] = words[cy.HEAD]
        words[cy.HEAD] = words[cy.TAIL]
        self.k, self._t_ns = self.k + last, self._t_ns + last * self._period
        number = words[cy.ROWS] % len(self._buffers.rows)
        begin, sync, plant, drive = b.times[last]
        self._buffers.rows[number] = (self.k, words[cy.POSITION], 0, 1, self._t_ns, 0, 0, 0, plant - sync, plant - sync,
                                      drive - sync, drive - sync, 0)
        self._buffers.values[number] = b.values[last]
        words[cy.OPEN], words[cy.ROW_CYCLE], words[cy.WORKED] = 1, self.k, sync - begin
        words[cy.CAME], words[cy.AWAITED], words[cy.IS_LATE] = self._answered, 0, 0
        words[cy.HAS_BEGUN] += count
        words[cy.PLAYED] += count
        words[cy.CYCLES] += count
        words[cy.DUE] += count * self._period
        self._layout.words[self._places + LAST_CYCLE] = words[cy.HAS_BEGUN] - 1

    def _run_timers(self, emulator: Emulator, firmware: Firmware) -> None:
        """End the cycle under way: its frames are there, and the timers of nodes and rig run."""
        for node in (emulator, firmware):
            node.device.sync.notice(self._t_ns)
        self._embedded.wait_for_answers(self._t_ns, lambda: True)
        self._master.tick()
        self._finish_cycle()
        self._embedded.bus.deliver(self._t_ns)  # the heartbeat of the rig


def find_busy_cycles(plan: Plan, schedule: Schedule) -> NDArray[np.int64]:
    """The cycles that are played alone because of faults, in order: where one begins, acts or ends, and neighbours.

    Parameters and sensors change in quiet cycles too; a frame that is lost or late concerns the cycles to come as
    well, until the nodes are well again.
    """
    ranges = [*(range(edge.cycle - 1, edge.cycle + 2) for edge in schedule.edges),
              *(range(k - 1, k + 3) for name in FRAMES for k in schedule.list_frame_hits(name)[:, 0].tolist())]
    for fault in plan.faults:
        first, last = plan.find_cycles(fault)
        if isinstance(fault, Foreign | BusOff | Reset | Silent):
            ranges.append(range(first, last))
    return np.array(sorted({k for each in ranges for k in each}), np.int64)


def can_play_many(master: Master, bench: Bench) -> bool:
    """Whether cycles of a bench can be played together: on the embedded bus, with our own nodes and the shipped frames.
    """
    nodes = master.wire.nodes if isinstance(master.wire, EmbeddedWire) else []
    is_own = [type(node) for node in nodes] == [Emulator, Firmware]
    return is_own and bool(list_frames(bench)) and bench.frames.sync is not None
