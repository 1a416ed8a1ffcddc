"""The sequencer: one run from bring-up to clean-up on an open bus.

Set-up, main and clean-up are cycles of one loop. Clean-up always runs. A node in trouble puts the bench into its safe
state (no current). A sequence that must end in the safe state continues with main, because it tests that response;
every other sequence ends main.
"""
from __future__ import annotations

import bisect
from array import array
from collections.abc import Callable, Collection, Container, Mapping
from itertools import filterfalse
from math import isnan
from typing import NamedTuple

import numpy as np
from canopen.emcy import EmcyError

from fdi.progress import Progress
from plant.errors import InputError
from plant.profile import Profile, build_profile
from plant.segments import RATE, Hold
from rig.device.emcy import EmcyCode
from rig.network import codec
from rig.network.clock import WallClock
from rig.network.codec import Control
from rig.network.frame import Frame
from rig.network.link import EmbeddedWire
from rig.network.master import HEARTBEAT, HEARTBEAT_LIMIT, PATIENT, Master
from rig.network.node_objects import CONTROLLER, NAMES, PLANT, RIG, CycleRecord, Gains, Identity, NmtState, read_gains
from rig.nodes.scenario import FORCE_RESOLUTION, Scenario
from rig.recorder import Event, Recorder, Signals, Timing
from rig.recorder import NmtState as NmtRecord
from rig.run.attribution import Mask, Trouble, find_injected, find_start_problem
from rig.run.hard_loop import open_loop
from rig.run.job import Job
from rig.run.loop import CycleInput, History, Loop
from rig.run.participants import FRAME_TIMEOUT, Participants, describe_exit
from rig.run.probe import (
    AFTER,
    ATTEMPTS,
    BEFORE,
    LAST_STEPS,
    PROBES,
    WARM_UP,
    Step,
    count_cycles,
    find_gap,
    find_on_time,
    has_firmware_effects,
    has_no_answers,
    leave_out_gaps,
    list_first_steps,
    list_inputs,
    make_probe_scenario,
    read_rows,
    select_last,
)
from rig.sequences.checks import GuardWatch
from rig.sequences.faults import Schedule
from rig.sequences.measures import DriveFrames
from rig.sequences.protocol import Emergency, Heartbeat, ProtocolRecord, Rows
from rig.sequences.timing import TimingPolicy

SETUP, MAIN, CLEANUP = 0, 1, 2
PHASES = ("setup", "main", "cleanup")
_SETTLING = 20  # cycles of clean-up that nodes started again have to get rid of their errors
_ENDS_BRING_UP = ("bring_up", "late")  # troubles that a run cannot go on with
_ENDS_RUN = ("process", *_ENDS_BRING_UP)  # whatever the sequence tests, it needs its nodes
_ENABLING_STEPS = (Control.DISABLE, Control.DISABLE | Control.HOLD)  # one cycle each on the way to ACTIVE


class SessionEvent(NamedTuple):
    """An event of the run; `t` in s of main."""

    t: float
    level: str
    kind: str
    text: str


class Session:
    """Runs a job's sequence on a bus. `stop()`, called every cycle, is True when the operator wants to end."""

    def __init__(self, job: Job, participants: Participants, recorder: Recorder, progress: Progress,
                 stop: Callable[[], bool]) -> None:
        wire, self._processes = participants
        self.job, self.recorder, self._progress, self._stop = job, recorder, progress, stop
        self._setup, self._main = job.sequence.setup_profile(), job.sequence.main_profile()  # now, not between cycles
        self.scenario = job.scenario
        self._plan = self.scenario.plan
        self._faults = Schedule(self._plan, self.scenario.model.values)
        self._watch = GuardWatch(job.sequence.guards)
        self.loop: Loop | None = None
        self.events: list[SessionEvent] = []
        self.history = History()
        self.due_ns = array("q")  # log time of each cycle
        self.troubles: list[Trouble] = []
        self.gone: dict[int, str] = {}  # nodes that do not answer any more, and how that is known
        self.plant_record: CycleRecord | None = None  # the plant's own, read after a real-time run with trouble
        self.identities: dict[int, Identity] = {}
        self.start_times: dict[int, float] = {}  # s from NMT start to OPERATIONAL, by node
        injected = find_injected(self._plan, self._faults, self._plan.stop)
        self._overruns = OverrunWatch(job.sequence.timing, job.period_ns * 1e-9,
                                      set(np.flatnonzero(injected.sync | injected.plant).tolist()))
        self._probes: list[History] = []  # played before set-up
        self._probe = History()  # the one being played
        self._after = History()  # the probe after clean-up
        self._is_probing = False  # before set-up
        self._is_watching = False  # from the reset of the nodes for the run until its last cycle
        self._emergencies: list[Emergency] = []
        self._heartbeats: dict[int, list[Heartbeat]] = {node: [] for node in (CONTROLLER, PLANT)}
        self._gains: Gains | None = None  # object 0x2110 of the controller, if it has it
        self._is_embedded = isinstance(wire, EmbeddedWire)
        self._begun_ns = 0  # when the nodes were started for the run
        self._stalled_ns = 0  # how long the rig had not received before that
        self.aborted = ""  # why main ended early
        self.interrupted = False
        self.safe = False  # no current from here on, until clean-up
        self._powered = True  # clean-up may use current
        self._may_power = True  # it may still use it when errors have gone meanwhile
        self._reset_at = 0  # the cycle of clean-up whose control word resets the faults
        self._playing = False  # from the start of the nodes until the nodes are stopped by us
        self._demand = 0.0  # m, of the last cycle
        self._operational: set[int] = set()
        self._edges = sorted(self._faults.edges)
        self._resets = self._faults.resets
        self._injected = 0  # cycles whose frames of other nodes are sent
        self._agenda: list[tuple[int, str, str, str]] = []  # events of cycles that are queued: cycle, level, kind, text
        self._unjudged: list[Signals] = []  # rows that the guards have not seen
        self._clock = wire.clock
        self._last_answers = {CONTROLLER: -1, PLANT: -1}  # last cycle with a cyclic frame of the node
        self._next_look = 0  # when to look again whether the nodes are alive
        self._silence = SilenceWatch(round(FRAME_TIMEOUT * 1e9))
        self._silent: set[int] = set()  # the nodes among `gone` that are known by their silence in lockstep
        wire.is_node_gone = self._is_node_gone
        self._master = Master(wire, self.now, job.realtime)
        self._drives: list[Frame] = []  # drive frames, if faults act on the bus
        self._master.on_frame = self._keep_drive if job.sequence.disturbs_bus else recorder.frame
        self._master.on_emcy = self._emcy
        self._master.on_state = self._state
        self._master.on_heartbeat = lambda node, t_ns: self._heartbeats[node].append(
            Heartbeat(t_ns * 1e-9, wire.blind_ns * 1e-9))
        self._master.on_lost = self._handle_silence
        self._master.on_rival = lambda cob_id: self._handle_trouble(
            "bus", f"another node sends 0x{cob_id:03X}, a frame of node {RIG} {NAMES[RIG]}")
        self._master.on_back = self._handle_return

    def close(self) -> None:
        """Let go of the loop, and of the master and the wire, which report to this session.

        The memory of a run is then free at once, not when Python next looks for reference cycles.
        """
        self._master.close()
        self._master.wire.is_node_gone = lambda: False
        self.loop = None

    def now(self) -> int:
        """Time for the log, ns since the run began."""
        return self.loop.now() if self.loop else self._clock.now()

    def log_event(self, level: str, kind: str, text: str) -> None:
        """Record an event of the run."""
        self._record_event(self.now(), SessionEvent(self._main_time(), level, kind, text))

    def _record_event(self, t_ns: int, event: SessionEvent) -> None:
        bisect.insort(self.events, event, key=lambda other: other.t)
        self.recorder.put(t_ns, Event(event.level, event.kind, event.text))

    def _announce(self, level: str, kind: str, text: str) -> None:
        """Record an event of the next cycle that is given to the loop, when that cycle is played."""
        assert self.loop is not None
        if self.loop.queued <= self.loop.k:
            self.log_event(level, kind, text)
        else:
            self._agenda.append((self.loop.queued, level, kind, text))

    def _keep_drive(self, frame: Frame) -> None:
        """Record a frame; keep the drive frames for the checks of reactions."""
        self.recorder.frame(frame)
        most = 2_000_000  # half an hour; a longer run is judged on what was kept
        if frame.cob_id == codec.DRIVE and len(frame.data) == 8 and len(self._drives) < most:
            self._drives.append(frame)

    def read_drives(self) -> DriveFrames:
        """The drive frames of a run with faults on the bus; times count cycles, as those of events do."""
        drives = [codec.unpack_drive(frame.data) for frame in self._drives]
        came, due = np.array([frame.t_ns for frame in self._drives], np.int64), np.array(self.due_ns, np.int64)
        cycle = np.searchsorted(due, came, "right") - 1
        since = np.clip(came - due[np.maximum(cycle, 0)], 0, self.job.period_ns - 1) if len(due) else came
        t = np.where(cycle < 0, -np.inf, (cycle - self._plan.start) / RATE + since * 1e-9)
        return DriveFrames(t, np.array([drive.current for drive in drives]),
                           np.array([drive.status for drive in drives], np.int64))

    def cycle(self, t_ns: int, signals: Signals, timing: Timing) -> None:
        """Record a complete cycle (called by the loop)."""
        if signals.phase in (BEFORE, AFTER):
            (self._probe if signals.phase == BEFORE else self._after).add(signals, timing)
            return
        while self._agenda and self._agenda[0][0] <= signals.cycle:
            cycle, *words = self._agenda.pop(0)
            self._record_event(t_ns, SessionEvent(self._main_time(cycle), *words))
        self.history.add(signals, timing)
        self.due_ns.append(t_ns)
        if signals.xs == signals.xs:  # not NaN
            self._last_answers[PLANT] = signals.cycle
        if signals.cor == signals.cor:
            self._last_answers[CONTROLLER] = signals.cycle
        if self.job.realtime:
            self._overruns.add(timing)
        if self._watch and signals.phase != CLEANUP:
            self._unjudged.append(signals)
        self.recorder.cycle(t_ns, signals, timing)

    def bring_up(self) -> None:
        """Reset, configure and start the nodes; play the probes first.

        Raises:
            BusError: a node does not answer or refuses.
        """
        self.log_event("INFO", "phase", "bring-up")
        self._master.boot()
        if self.job.sequence.protocol.probe:
            self._play_probes()
        if not self.aborted:
            self._start_nodes(self.scenario, is_run=True)
        self._master.wire.hear_all()
        self.loop = self._make_loop(self._faults)
        for times in self._heartbeats.values():
            times.clear()
        self._begun_ns, self._playing = self._clock.now(), True
        self._stalled_ns = self._master.wire.stalled_ns

    def _start_nodes(self, scenario: Scenario, *, is_run: bool = False) -> None:
        """Reset, identify, configure and start the nodes, for a probe or the run. Raises BusError and InputError."""
        job = self.job
        self._master.reset()
        self._is_watching = is_run
        if not self.identities:
            self._identify_nodes()
        gains = read_gains(job.model) if job.controller != "external" else None
        if self._gains is None:
            self._gains = gains or self._master.read_gains()
        patient = not job.realtime and isinstance(self._clock, WallClock)
        self._master.configure(scenario.to_bytes(), gains,
                               job.sequence.timing.choose_sync_period() if job.realtime or self._is_embedded else 0,
                               PATIENT if patient else HEARTBEAT_LIMIT)
        self._master.start()
        self._wait_for_operational(job.sequence.timing.operational)

    def _make_loop(self, faults: Schedule) -> Loop:
        return open_loop(self._master, faults, self, self.job.bus, self.job.period_ns, self.job.realtime)

    def _play_probes(self) -> None:
        """Play the probes before set-up, each after a reset of the nodes.

        In real time a probe with a gap is repeated. If the bench itself cannot deliver one, none is judged.

        Raises:
            BusError: a node does not answer or refuses.
        """
        steps = list_first_steps(self.job.sequence.protocol.step_delay)
        cycles = count_cycles(steps)
        steps = (*WARM_UP, *steps) if self.job.realtime else steps
        self._is_probing = True
        for _ in range(PROBES):
            probe = self._play_probe(steps)
            attempts = ATTEMPTS if self.job.realtime else 1
            while ((gap := find_gap(probe, self._find_on_time(probe), cycles)) and (attempts := attempts - 1)
                   and not self.aborted):
                probe = self._play_probe(steps)
            if self.aborted:
                break
            if gap == "bench" and self.job.realtime:
                self.log_event("WARN", "probe", f"no probe without a gap in {ATTEMPTS} attempts: the plant was late")
                self._probes.clear()
                break
            self._probes.append(probe)
        self._is_probing = False

    def _play_probe(self, steps: tuple[Step, ...]) -> History:
        """Play one probe after a reset of the nodes. Raises BusError."""
        scenario = make_probe_scenario(self.scenario)
        self._start_nodes(scenario)
        self._probe = History()
        if self.aborted:  # a node did not become OPERATIONAL
            return self._probe
        self.loop = self._make_loop(Schedule(scenario.plan, scenario.model.values))
        try:
            for step in list_inputs(steps, BEFORE, 0.0):
                self.loop.cycle(step)
                if self.job.realtime and self._stop():
                    self.interrupted = True
                    self._abort("operator", "stopped by the operator")
                if self.aborted or has_no_answers(self._probe):
                    self.loop.hold(BEFORE)
                    break
            self.loop.finish()
        except BaseException:
            self._master.stop()
            raise
        finally:
            self.loop.close()
            self.loop = None
        return self._probe

    def _play_last_probe(self) -> None:
        """Play the probe after clean-up, if the controller is still in control."""
        assert self.loop is not None
        if self.safe or self.aborted or not self.job.sequence.protocol.probe:
            return
        self.loop.wait_until_played(lambda: bool(self.aborted))
        for step in list_inputs(LAST_STEPS, AFTER, self._demand):
            self.loop.cycle(step)

    def read_protocol_record(self, judged: Mask) -> ProtocolRecord:
        """All that the protocol checks of this run are judged by; `judged`: cycles in which the bench was on time."""
        job, model = self.job, self.job.model
        cycles = count_cycles(list_first_steps(job.sequence.protocol.step_delay))

        def read(history: History) -> Rows:
            rows = read_rows(history, self._find_on_time(history))
            return leave_out_gaps(rows) if job.realtime else rows

        run = read_rows(self.history, judged & self._find_on_time(self.history, self._faults))
        return ProtocolRecord(
            run=run, probes=[select_last(read(probe), cycles) for probe in self._probes if len(probe)],
            after=read(self._after) if len(self._after) else None, emergencies=self._emergencies,
            heartbeats={NAMES[node]: times for node, times in self._heartbeats.items()},
            heard=(self._begun_ns * 1e-9, self._clock.now() * 1e-9),
            deaf=(self._master.wire.stalled_ns - self._stalled_ns) * 1e-9,
            deaf_cycles=self._faults.list_bus_off_cycles("rig").tolist(), heartbeat_period=HEARTBEAT * 1e-3,
            current_limit=model["controller.current_limit"] if self._gains is None else self._gains.current_limit,
            gains=None if has_firmware_effects(model) else self._gains, realtime=job.realtime,
            is_response_judged=job.realtime and not self._is_embedded)

    def _find_on_time(self, history: History, faults: Schedule | None = None) -> Mask:
        return find_on_time(history, faults, self.job.realtime, self.job.period_ns * 1e-9)

    def _identify_nodes(self) -> None:
        """Read and log what the nodes say about themselves; refuse a firmware that the sequence is not meant for.

        Raises:
            InputError: another firmware.
        """
        for node in (CONTROLLER, PLANT):
            identity = self._master.read_identity(node)
            self.identities[node] = identity
            self.log_event("INFO", "identity", f"node {node} {NAMES[node]}: {identity}")
            self.recorder.metadata(f"node{node}", {key: str(value) for key, value in identity._asdict().items()
                                                   if value is not None})
        sequence = self.job.sequence
        key, difference = sequence.firmware.find_difference(self.identities[CONTROLLER]._asdict())
        if difference:
            raise InputError(sequence.name, f"firmware.{key}", difference)

    def _wait_for_operational(self, limit: float) -> None:
        """Wait until each node says that it is OPERATIONAL, and log how long that took; too long ends the run.

        A node that is too slow is given three times the limit, so that the time it needs is known.
        """
        times = self._master.wait_for_operational(3 * limit)
        self.start_times = {node: time.seconds for node, time in times.items()}
        for node, seconds in sorted(self.start_times.items()):
            self.log_event("INFO", "nmt",
                           f"node {node} {NAMES[node]} is OPERATIONAL {1e3 * seconds:.0f} ms after NMT start")
        if problem := find_start_problem(times, limit):
            self._handle_trouble(problem.kind, problem.text, problem.node)

    def run_phases(self) -> None:
        """Run set-up, main and clean-up. Whatever is raised, clean-up runs and the nodes are stopped."""
        assert self.loop is not None
        try:
            if not self.aborted and self._run(SETUP, self._setup) and self._run(MAIN, self._main):
                self.loop.wait_until_played(self._must_end)
        finally:
            try:
                self._discard_queue()
                self._powered = self._restore_nodes()
                if not self._run(CLEANUP, self._choose_cleanup()):  # a node has died in it
                    self._discard_queue()
                    self._run(CLEANUP, self._choose_cleanup())
                self._play_last_probe()
                self.loop.finish()
            finally:
                self._playing = self._is_watching = False
                self.loop.close()
                self._find_silent_nodes()
                self._master.stop()
                if self.job.realtime and self.troubles and PLANT not in self.gone:  # it takes some seconds on a CAN bus
                    self.plant_record = self._master.read_plant_record()
                for failure in self._master.restore(self.gone):
                    self.log_event("WARN", "restore", failure)
                self.log_event("INFO", "phase", "end")

    def _discard_queue(self) -> None:
        """Discard the cycles that are queued, and their events; clean-up begins with the demand of the last one."""
        assert self.loop is not None
        self._demand = self.loop.hold(CLEANUP)
        self._agenda = [event for event in self._agenda if event[0] < self.loop.queued]

    def _choose_cleanup(self) -> Profile:
        """The clean-up of the sequence; a tenth of a second without current if a node does not answer or came late."""
        self._next_look = 0
        if self._is_node_gone() or any(trouble.kind in _ENDS_BRING_UP for trouble in self.troubles):
            self._powered = self._may_power = False
            return build_profile((Hold(time=0.1),), self._demand)
        return self.job.sequence.cleanup_profile(self._demand)

    def _find_silent_nodes(self) -> None:
        """After trouble: find out which nodes still answer, for the first cause depends on it."""
        if self.aborted and not self.interrupted:
            seconds = HEARTBEAT_LIMIT * 1e-3
            silent = list(filterfalse(self._is_answering, self._master.find_silent(seconds)))
            self._processes.wait(silent)
            self._note_ended_processes()
            for node in silent:
                self.gone.setdefault(node, f"no heartbeat within {seconds:g} s at the end of the run")

    def _restore_nodes(self) -> bool:
        """Try to set all nodes to OPERATIONAL without errors; return whether clean-up may use current."""
        if self.safe and not self.gone and any(state != NmtState.OPERATIONAL for state in self._master.states.values()):
            for failure in self._master.configure_again():
                self.log_event("WARN", "restore", failure)
            self._master.start()
        return not self.safe or not self._master.list_errors()

    def _try_again(self) -> None:
        """Some cycles into clean-up: a node that had to be started again may have no errors any more by now."""
        assert self.loop is not None
        self.loop.wait_until_played(lambda: False)
        self._note_ended_processes()
        self._powered = self._may_power and not self.gone and not self._master.list_errors()
        self._reset_at = _SETTLING

    def _choose_control_word(self, phase: int, i: int) -> int:
        """Control word of the phase's cycle `i`."""
        if self.safe if phase != CLEANUP else not self._powered:
            return 0
        if phase == CLEANUP and self.safe and i == self._reset_at:
            return int(Control.RESET)
        started = self.loop.queued if self.loop else 0  # without set-up main is where it is enabled
        return int(_ENABLING_STEPS[started]) if started < len(_ENABLING_STEPS) else int(Control.ACTIVE)

    def _run(self, phase: int, profile: Profile) -> bool:
        """The cycles of one phase; False when it was ended early."""
        assert self.loop is not None
        self._announce("INFO", "phase", PHASES[phase])
        for section in profile.sections:
            self._announce("INFO", "section", f"{PHASES[phase]}: {section.name}")
            shown = section.name if phase == MAIN else PHASES[phase]
            for i in range(section.start, section.stop):
                self._announce_faults()
                if phase == CLEANUP and i == _SETTLING and not self._powered:
                    self._try_again()
                self._demand = float(profile.command[i])
                load = self._find_load(self.loop.queued) if phase == MAIN else 0.0
                self.loop.cycle(CycleInput(phase, self._demand, load, self._choose_control_word(phase, i)))
                if self.loop.queued % 50 == 0:
                    self._progress(shown, self.loop.k / max(self._plan.stop, self.loop.k))
                if self._note_ended_processes() if phase == CLEANUP else self._must_end():
                    return False
        return True

    def _find_load(self, cycle: int) -> float:
        """Force on the ram from the scenario in a cycle, N."""
        return float(self.scenario.force[cycle] * FORCE_RESOLUTION) if cycle < len(self.scenario.force) else 0.0

    def _inject(self) -> None:
        """Send the resets and the frames of other nodes that are due before the next cycle."""
        assert self.loop is not None
        while self._resets and self._resets[0][0] <= self.loop.k:
            self._master.reset_controller(self._resets.pop(0)[1])
        for k in range(self._injected, self.loop.k + 1):
            for cob_id, data in self._faults.foreign_frames(k):
                self._master.send(cob_id, data)
        self._injected = self.loop.k + 1

    def _must_end(self) -> bool:
        self._inject()
        self._is_node_gone()
        if self._overruns.problem and not self.aborted:
            self._abort("overrun", self._overruns.problem)
        if self._stop() and not self.aborted:
            self.interrupted = True
            self._abort("operator", "stopped by the operator")
        rows, self._unjudged = self._unjudged, []
        for row in rows:
            passed = self._watch.find_passed({"com": row.com, "xj": row.xj, "cor": row.cor, "p12": row.p12,
                                              "xs": row.xs, "load": row.load, "error": row.com - row.xj})
            if passed:
                why = f"guard {passed.name!r} was passed by {passed.signal}"
                self._note_trouble("guard", why)
                self._abort("guard", why)
                break
        return bool(self.aborted)

    def _abort(self, kind: str, why: str) -> None:
        self.aborted = self.aborted or why
        self.log_event("ERROR", kind, why)

    def _note_trouble(self, kind: str, what: str, node: int = 0, code: int = 0, t_ns: int | None = None) -> None:
        """Keep a trouble for the attribution after the run; the first thousand say enough."""
        if len(self.troubles) < 1000:
            self.troubles.append(Trouble(self.now() if t_ns is None else t_ns, node, kind, code, what))

    def _handle_trouble(self, kind: str, what: str, node: int = 0, code: int = 0, t_ns: int | None = None) -> None:
        """Enter the safe state: no current, and the end of main unless the sequence tests the safe state.

        Before and after the cycles of the run a report of a node ends nothing: SYNC stops after each probe and after
        the run, and on a busy machine a node may report that before it is reset.
        """
        is_foreign = kind == "bus" and not self._begun_ns  # another rig on the bus is reported once
        if not self._is_watching and not is_foreign and kind not in _ENDS_RUN:
            self.log_event("WARN", kind, f"{what} ({'before' if not self._begun_ns else 'after'} the run)")
            return
        if self._playing or kind in _ENDS_RUN:
            self._note_trouble(kind, what, node, code, t_ns)
        self.log_event("ERROR", kind, what)
        if not self.safe:
            self.safe = True
            if self.loop:
                self.loop.override_control(0)
            self.log_event("WARN", "safe_state", f"no current from here on: {what}")
        if (kind in _ENDS_RUN or self.job.sequence.ends != "safe_state") and not self.aborted:
            self._abort("abort", what)

    def _emcy(self, node: int, error: EmcyError) -> None:
        if self._playing or self._is_probing:
            self._emergencies.append(Emergency(self.loop.k if self.loop and self._playing else -1, node, error.code))
        if error.code & 0xFF00 == 0:
            left = "an error is gone, others stand" if error.register else "no error any more"
            self.log_event("INFO", "recovered", f"node {node} {NAMES[node]}: {left}")
        elif error.code == EmcyCode.HEARTBEAT_LOST and self._master.is_behind():
            self._handle_trouble("late", f"the rig sent no heartbeat for {self._master.pause:.2f} s, and node {node} "
                                         f"{NAMES[node]} reports 0x{error.code:04X}", RIG)
        else:
            self._handle_trouble("emcy", f"node {node} {NAMES[node]} 0x{error.code:04X} {error.get_desc()}".rstrip(),
                                 node, error.code, round(error.timestamp * 1e9))

    def _handle_silence(self, node: int) -> None:
        self._note_ended_processes()
        limit = "" if node not in self._master.heard_ns else (
            f": last heartbeat {1e-9 * (self._clock.now() - self._master.heard_ns[node]):.2f} s ago")
        if not self._is_answering(node):
            self.gone.setdefault(node, f"no heartbeat any more{limit}")
        self._handle_trouble("heartbeat", f"node {node} {NAMES[node]} is silent", node)

    def _is_answering(self, node: int, recent: int = 20) -> bool:
        """Whether a node sent a cyclic frame in one of the `recent` cycles: its heartbeat alone may be missing."""
        return self.loop is not None and self._last_answers[node] >= self.loop.k - recent

    def _handle_return(self, node: int) -> None:
        if node not in self._processes.find_ended():
            self.gone.pop(node, None)
        self.log_event("INFO", "heartbeat", f"node {node} {NAMES[node]} is heard")

    def _is_node_gone(self) -> bool:
        """Whether a node will not answer any more; looks every 20 ms."""
        now = self._clock.now()
        if now >= self._next_look:
            self._next_look = now + 20_000_000
            self._note_ended_processes()
            if self._playing and not self.job.realtime and not self._is_embedded:
                self._look_for_silent_nodes(now)
        return bool(self.gone)

    def _note_ended_processes(self) -> bool:
        """Note which nodes that the rig started have ended; True if that was not known yet.

        A process that is killed sends nothing more from then on, but takes some ms to end. Other nodes may report the
        missing frames before.
        """
        is_news = False
        for node, status in self._processes.find_ended().items():
            how = describe_exit(status)
            if self.gone.get(node) != how:
                is_news, self.gone[node] = True, how
                self._handle_trouble("process", f"node {node} {NAMES[node]}: {how}", node)
        return is_news

    def _look_for_silent_nodes(self, now: int) -> None:
        """Lockstep between processes: a node that neither beats nor answers is gone, until it is heard again.

        The heartbeat alone is watched with much patience there, and a cycle waits long for a node that is late.
        """
        if self._master.is_deaf:
            return
        heard = self._master.heard_ns  # after a reset a node may have no heartbeat, and answers no SYNC
        self._silence.look(now, {node: heard[node] for node, state in self._master.states.items()
                                 if node in heard and state == NmtState.OPERATIONAL})
        answering = [node for node in self._last_answers if self._is_answering(node, recent=1)]
        found = self._silence.find_silent(answering)
        for node in self._silent - found.keys():
            self._silent.discard(node)
            self._handle_return(node)
        for node in found.keys() - self.gone.keys():
            self._silent.add(node)
            self.gone[node] = f"no heartbeat for {found[node]:.1f} s either"
            what = f"node {node} {NAMES[node]} is silent"
            self._handle_trouble("heartbeat", what, node)
            if not self.aborted:  # no sequence can mean that in lockstep
                self._abort("abort", what)

    def _state(self, node: int, state: int) -> None:
        known = {s.value: s.name.lower().replace("_", "-") for s in NmtState}
        name = known.get(state, f"state {state}") if state else "boot-up"
        self.recorder.put(self.now(), NmtRecord(node, state, name))
        if state == NmtState.OPERATIONAL:
            self._operational.add(node)
        elif node in self._operational:
            self._operational.discard(node)
            if self._playing:  # a watchdog reset, a power cycle, or an NMT command of another master
                self._handle_trouble("nmt", f"node {node} {NAMES[node]} left OPERATIONAL: {name}", node, state)

    def _announce_faults(self) -> None:
        assert self.loop is not None
        while self._edges and self._edges[0].cycle <= self.loop.queued:
            edge = self._edges.pop(0)
            level, word = ("WARN", "begins") if edge.begins else ("INFO", "ends")
            self._announce(level, "fault", f"{edge.label} {word}")

    def _main_time(self, cycle: int | None = None) -> float:
        """The time of a cycle, by default now, s of main; negative before main."""
        now = self.loop.k if self.loop and not self._is_probing else 0
        return ((now if cycle is None else cycle) - self._plan.start) / RATE


class OverrunWatch:
    """Counts overruns in a row, cycle by cycle. `problem` says when there were too many; empty before that.

    A cycle is an overrun if its SYNC was sent late or the plant's frames came late or not at all. It counts once, or as
    many times as SYNC was whole periods late. Cycles in which the sequence itself disturbs these frames do not count,
    and do not end a row of overruns.
    """

    def __init__(self, policy: TimingPolicy, period: float, injected: Container[int] = ()) -> None:
        """`period` is the length of a cycle in s; `injected`: cycles whose SYNC or plant frames a fault disturbs."""
        self._most = policy.most_in_a_row if policy.overruns == "abort" else None
        self._policy, self._period, self._injected = policy, period, injected
        self._in_a_row = 0
        self.problem = ""

    def add(self, timing: Timing) -> None:
        """Take in a complete cycle."""
        if self._most is None or self.problem or timing.cycle * self._period < self._policy.grace:
            return
        if timing.cycle in self._injected:
            return
        is_fed = timing.feedback_response <= self._policy.feedback and not isnan(timing.valve_response)
        is_late = timing.lateness > self._policy.sync or not is_fed
        self._in_a_row = self._in_a_row + max(1, int(timing.lateness / self._period)) if is_late else 0
        if self._in_a_row > self._most:
            self.problem = (f"the bench was late: {self._in_a_row} overruns in a row up to cycle {timing.cycle}, "
                            f"{self._most} are accepted")


class SilenceWatch:
    """Adds up for each node how long the rig has listened without a heartbeat of it.

    A look that comes late counts for `step` at most: then the rig stood still, and perhaps the node with it.
    """

    def __init__(self, limit_ns: int, step_ns: int = 100_000_000) -> None:
        """`limit_ns`: silence after which a node counts as gone if it does not take part in the cycles either."""
        self._limit, self._step = limit_ns, step_ns
        self._looked_ns = 0
        self._heard_ns: dict[int, int] = {}
        self._silent_ns: dict[int, int] = {}

    def look(self, now_ns: int, heard_ns: Mapping[int, int]) -> None:
        """Take note of the last heartbeats.

        Args:
            now_ns: time.
            heard_ns: when the last heartbeat of each node came that is to be watched.
        """
        passed = min(now_ns - self._looked_ns, self._step)
        self._looked_ns = now_ns
        self._silent_ns = {node: self._silent_ns.get(node, 0) + passed if heard == self._heard_ns.get(node) else 0
                           for node, heard in heard_ns.items()}
        self._heard_ns = dict(heard_ns)

    def find_silent(self, answering: Collection[int] = ()) -> dict[int, float]:
        """Nodes that are silent and not `answering`, with the time for which the rig has listened in vain, s."""
        return {node: silent * 1e-9 for node, silent in self._silent_ns.items()
                if silent >= self._limit and node not in answering}
