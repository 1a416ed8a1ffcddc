"""The cycle loop of the embedded bus in lockstep: quiet cycles run compiled, many at a time, all others in Python.

Both give the same rows and frames. A cycle with a fault that begins, acts or ends, a frame that waits, or a node that
is not well is played by `CycleLoop` and the nodes themselves. Timers, such as those of heartbeats, run in Python
between the compiled cycles.
"""
from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from functools import cache
from math import ceil

import numpy as np
from numpy.typing import NDArray

from plant.controller import Loop
from plant.segments import Array
from rig.benches.bench import Bench
from rig.network.link import EmbeddedWire
from rig.network.master import Master
from rig.nodes.emulator import Emulator
from rig.nodes.firmware import Firmware
from rig.nodes.scenario import Scenario
from rig.recorder import CycleBlock
from rig.recorder.schema import make_row_record
from rig.run import embedded_cycle as ec
from rig.run.cyclic_values import CycleInput
from rig.run.loop import CycleLoop, CycleObserver, Seen
from rig.sequences.faults import Frames, Jitter, Parameter, Plan, Schedule

FRAMES = ("command", "sync", "feedback", "valve_state", "drive")  # that faults act on
Limits = Mapping[str, tuple[float, float]]  # of signals, SI


class EmbeddedLoop(CycleLoop):
    """`CycleLoop` that plays quiet cycles together."""

    plays_many = True

    def __init__(self, master: Master, bench: Bench, scenario: Scenario, faults: Schedule, log: CycleObserver,
                 guards: Limits) -> None:
        """`guards`: limits of signals; a cycle after one in which a signal was outside is played alone."""
        super().__init__(master, bench, scenario, faults, log, realtime=False)
        assert isinstance(master.wire, EmbeddedWire)
        self._embedded = master.wire
        self._busy = find_busy_cycles(scenario.plan, faults)
        self._buffers = ec.make_buffers(bench, self._values.names, guards)
        self._buffers.words[ec.CLOCK] = find_clock()
        self._frames, self._sync_id = ec.list_frames(bench), bench.frames.sync or 0
        self._lent: object = None  # the actuator that the compiled code works on
        self._run: Callable[[], object] | None = None
        self._roles = {role for answer in self._answers.values() for role in answer.roles}

    def play_many(self, phase: int, demands: Array, loads: Array, control: int) -> int:
        """See `Loop`."""
        emulator, firmware = self._embedded.nodes
        assert isinstance(emulator, Emulator)
        assert isinstance(firmware, Firmware)
        most = self._count_quiet(emulator, firmware, control, min(len(demands), ec.MOST))
        run = self._bind(emulator) if most > 1 else None
        if run is None:
            return 0
        self._close()
        b, k = self._buffers, self.k
        step = CycleInput(phase, 0.0, 0.0, control)
        self.outputs.update(zip(self._values.given[2:], self._values.list_given(step)[2:], strict=True))
        ec.set_values(b, [self.outputs[name] for name in self._values.names])
        b.words[ec.ASKED], b.words[ec.FIRST], b.words[ec.PLANT_CYCLE] = most, k, emulator.plant.actuator.cycle
        b.reals[ec.LOOP:ec.GAINS], b.reals[ec.GAINS:ec.PERIOD] = firmware.loop, firmware.gains
        on_plant = emulator.plant.list_loads(k, most)
        b.inputs[:most, 0], b.inputs[:most, 1], b.inputs[:most, 2] = demands[:most], loads[:most], 0.0
        b.inputs[:len(on_plant), 2] = on_plant
        b.noise[:most] = emulator.plant.actuator.noise.look_ahead(most)
        run()
        played = int(b.words[ec.DONE])
        if played:
            firmware.loop = Loop(*b.reals[ec.LOOP:ec.GAINS].tolist())
            emulator.pass_quiet(played, int(b.payloads[played - 1, ec.DRIVE]).to_bytes(8, "little", signed=True))
            self._take_cycles(phase, control, played)
            self._run_timers(emulator, firmware)
        return played

    def _count_quiet(self, emulator: Emulator, firmware: Firmware, control: int, most: int) -> int:
        """How many of the cycles to come are quiet, at most `most`; the last may be one in which a timer runs out."""
        if (self._open is None or self._seen.came != self._roles or self._held or self.problem
                or not self._embedded.is_idle or not emulator.is_quiet(self.k) or not firmware.is_quiet(control)):
            return 0
        due = min(self._master.find_due(), *(node.device.find_due() for node in (emulator, firmware)))
        busy = self._busy[np.searchsorted(self._busy, self.k):][:1]
        return int(min(most, max(due - self._t_ns, 0) // self._period + 1, *(busy - self.k).tolist()))

    def _bind(self, emulator: Emulator) -> Callable[[], object] | None:
        """The compiled code on the plant of the emulator, which is another one after each reset."""
        actuator = emulator.plant.actuator
        if self._lent is not actuator:
            self._lent, self._run = actuator, ec.bind_code(self._buffers, actuator)
        return self._run

    def _take_cycles(self, phase: int, control: int, played: int) -> None:
        """Log the cycles that were played, all but the last, which is the cycle under way now."""
        b, names, first, signals = self._buffers, self._values.names, self.k, self._bench.signals
        begun, sync, plant, drive = (b.times[:played, i] for i in (ec.BEGUN_AT, ec.SYNC_AT, ec.PLANT_AT, ec.DRIVE_AT))
        values = dict(zip(names, b.values[:played].T.copy(), strict=True))
        fed, answered = (plant - sync) * 1e-9, (drive - sync) * 1e-9
        columns = {
            "cycle": first + np.arange(played), "phase": phase,
            **{s.name: values[s.word] for s in signals[1:] if s.role != "load"},
            **({signals.load.name: b.inputs[:played, 1].copy()} if signals.load else {}), "control": control,
            "status": values["status_word"].astype(np.int64), "flags": values["flags"].astype(np.int64),
            "overrun": False, "lateness": 0.0, "response": answered, "work": answered, "feedback_response": fed,
            "valve_response": fed, "execution": (sync - begun) * 1e-9}
        payloads = iter(b.payloads[:played].T.copy())
        command = next(payloads)
        answers = ((frame.identifier, payload) for frame, payload in zip(self._frames[1:], payloads, strict=True))
        frames = [(self._frames[0].identifier, command), (self._sync_id, None), *answers]
        block = CycleBlock(self._t_ns + self._period * np.arange(played), frames, columns, make_row_record(signals))
        self._log.cycles(block)
        self.outputs.update({name: float(column[-1]) for name, column in values.items()})
        self._step = CycleInput(phase, float(b.inputs[played - 1, 0]), float(b.inputs[played - 1, 1]), control)
        self._open = int(block.t_ns[-1]), *block.make_row(-1)
        self._sent[self._mine[0][0]] += played
        self._begun += played
        self._played += played
        for answer in self._answers.values():
            answer.last = self._begun - 1
        self._seen = Seen(set(self._roles))
        self.k, self._t_ns = first + played - 1, int(block.t_ns[-1])

    def _run_timers(self, emulator: Emulator, firmware: Firmware) -> None:
        """End the cycle under way: its frames are there, and the timers of nodes and rig run."""
        for node in (emulator, firmware):
            node.device.sync.notice(self._t_ns)
        self._embedded.wait_for_answers(self._t_ns, lambda: True)
        self._master.tick()
        self.k += 1
        self._t_ns += self._period
        self._embedded.deliver(self._t_ns)  # the heartbeat of the rig


@cache
def find_clock() -> int:
    """Address of clock_gettime of the C library."""
    return ctypes.cast(ctypes.CDLL(None).clock_gettime, ctypes.c_void_p).value or 0


def find_busy_cycles(plan: Plan, schedule: Schedule) -> NDArray[np.int64]:
    """The cycles that Python plays because of faults, in order: where one begins, acts or ends, and their neighbours.

    A parameter acts on the plant by itself, but where it changes; a frame that is lost or late concerns the cycles to
    come as well, until the nodes are well again.
    """
    ranges = [range(edge.cycle - 1, edge.cycle + 2) for edge in schedule.edges]
    ranges += [range(k - 1, k + 3) for name in FRAMES for k in schedule.list_frame_hits(name)[:, 0].tolist()]
    for fault in plan.faults:
        first, last = plan.find_cycles(fault)
        if isinstance(fault, Parameter):
            ranges.append(range(first, min(first + ceil(fault.ramp * plan.rate) + 2, last)))
        elif not isinstance(fault, Frames | Jitter):
            ranges.append(range(first, last))
    return np.array(sorted({k for each in ranges for k in each}), np.int64)


def can_play_many(master: Master, bench: Bench) -> bool:
    """Whether cycles of a bench can be played together: on the embedded bus, with our own nodes and the shipped frames.
    """
    nodes = master.wire.nodes if isinstance(master.wire, EmbeddedWire) else []
    is_own = [type(node) for node in nodes] == [Emulator, Firmware]
    return is_own and bool(ec.list_frames(bench)) and bench.frames.sync is not None and ec.is_compiled()
