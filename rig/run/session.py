"""The sequencer: one run from bring-up to clean-up on an open bus.

Set-up, main and clean-up are cycles of one loop. Clean-up always runs. A node in trouble puts the bench into its safe
state (no current). A sequence that must end in the safe state continues with main, because it tests that response;
every other sequence ends main.

The parts: `Stage`, `Journal` and `SafeState` (state.py), `BringUp`, `NodeWatch`, and here `CycleLog` (the cycles that
are complete) and `Session`, which plays the phases and announces and injects faults.
"""

from array import array
from collections.abc import Callable
from operator import attrgetter

import numpy as np

from fdi.progress import Progress
from plant import Array, Hold, Profile, build_profile, control_by_pid
from rig.benches import PROFILES, Role, State, unpack
from rig.network import CONTROLLER, NAMES, PLANT, CycleRecord, EmbeddedWire, Frame, Master, NmtState, Wire
from rig.recorder import CycleBlock, Recorder, Signals, Timing
from rig.run.attribution import find_injected
from rig.run.bring_up import (
    BringUp,
    Enabling,
    find_goal,
    list_first_steps,
    list_inputs,
    list_last_steps,
    open_loop,
    read_rows,
)
from rig.run.embedded_loop import MOST, EmbeddedLoop
from rig.run.job import Job
from rig.run.loop import AFTER, CycleInput, History
from rig.run.participants import NodeProcesses, find_firmware_parameters
from rig.run.state import Journal, SafeState, Stage
from rig.run.watch import PATIENCE, NodeWatch, OverrunWatch
from rig.sequences import DriveFrames, Guard, GuardWatch, Mask, ProtocolRecord, Rows

SETUP, MAIN, CLEANUP = 0, 1, 2
PHASES = ("setup", "main", "cleanup")
_SETTLING = 20  # cycles of clean-up that nodes started again have to get rid of their errors
_MOST_DRIVES = 2_000_000  # half an hour; a longer run is judged on what was kept


class CycleLog:
    """The cycles that are complete: recorded, kept for the verdict, and watched for overruns and by the guards."""

    def __init__(self, job: Job, journal: Journal, nodes: NodeWatch, overruns: OverrunWatch) -> None:
        self._journal, self._nodes, self._overruns = journal, nodes, overruns
        self._is_realtime, self._rate, self._start = job.realtime, job.bench.rate, job.scenario.plan.start
        self._period_ns = job.period_ns
        self._guards = GuardWatch(job.sequence.guards)
        self.guarded = self._guards.list_limits()
        self._signals = job.bench.signals
        self.history = History(self._signals)
        self.after = History(self._signals)  # the probe after clean-up
        self._read_row = attrgetter(*self._signals.names)
        self.due_ns = array("q")  # log time of each cycle
        self._drive = job.bench.frames.drive
        self._drives: list[Frame] = []
        self._keeps_drives = job.sequence.disturbs_bus
        self._words = PROFILES[job.bench.profile]
        self._unjudged: list[Signals] = []  # rows that the guards have not seen

    def cycle(self, t_ns: int, signals: Signals, timing: Timing) -> None:
        """Record a complete cycle (called by the loop)."""
        if signals.phase == AFTER:
            self.after.cycle(t_ns, signals, timing)
            return
        self._journal.log_due(signals.cycle, t_ns)
        self.history.cycle(t_ns, signals, timing)
        self.due_ns.append(t_ns)
        self._nodes.add(signals)
        if self._is_realtime:
            self._overruns.add(timing)
        if self._guards and signals.phase != CLEANUP:
            self._unjudged.append(signals)
        self._journal.recorder.cycle(t_ns, signals, timing)

    def cycles(self, block: CycleBlock) -> None:
        """Record complete cycles that were played together, all within the guards (called by the loop)."""
        self.history.cycles(block)
        self.due_ns.frombytes(block.t_ns[:-1].tobytes())
        if self._keeps_drives:
            self._drives += block.list_frames(self._drive.identifier)[:_MOST_DRIVES - len(self._drives)]
        if len(block.t_ns) > 1:
            signals, _ = block.make_row(-2)
            self._nodes.add(signals)
            if self._guards and signals.phase != CLEANUP:
                self._unjudged.append(signals)
        self._journal.recorder.cycles(block)

    def keep_drive(self, frame: Frame) -> None:
        """Record a frame; keep the drive frames for the checks of reactions."""
        self._journal.recorder.frame(frame)
        is_drive = frame.cob_id == self._drive.identifier and len(frame.data) == self._drive.length
        if is_drive and len(self._drives) < _MOST_DRIVES:
            self._drives.append(frame)

    def read_drives(self) -> DriveFrames:
        """The drive frames of a run with faults on the bus; times count cycles, as those of events do."""
        drives = [unpack(self._drive, frame.data) for frame in self._drives]
        came, due = np.array([frame.t_ns for frame in self._drives], np.int64), np.array(self.due_ns, np.int64)
        cycle = np.searchsorted(due, came, "right") - 1
        since = np.clip(came - due[np.maximum(cycle, 0)], 0, self._period_ns - 1) if len(due) else came
        t = np.where(cycle < 0, -np.inf, (cycle - self._start) / self._rate + since * 1e-9)
        return DriveFrames(t, np.array([drive[self._signals.drive.word] for drive in drives]),
                           np.array([drive.get("status_word", 0) for drive in drives]).astype(np.int64), self._words)

    def find_passed_guard(self) -> Guard | None:
        """The first guard that one of the rows since the last call has passed."""
        rows, self._unjudged = self._unjudged, []
        for row in rows:
            values = dict(zip(self._signals.names, self._read_row(row), strict=True))
            error = values[self._signals.command.name] - values[self._signals.controlled.name]
            if guard := self._guards.find_passed({"error": error, **values}):
                return guard
        return None


class Session:
    """Runs a job's sequence on a bus. `stop()`, called every cycle, is True when the operator wants to end."""

    def __init__(self, job: Job, wire: Wire, processes: NodeProcesses, recorder: Recorder, progress: Progress,
                 stop: Callable[[], bool]) -> None:
        self.job, self._progress, self._stop = job, progress, stop
        # now, not between cycles
        self._setup, self._main = job.sequence.build_setup_profile(), job.sequence.build_main_profile()
        self.scenario = job.scenario
        plan = self.scenario.plan
        self._loads = np.array(self.scenario.list_loads())
        self.faults = self.scenario.make_schedule()
        self._is_embedded = isinstance(wire, EmbeddedWire)
        self.stage = Stage(wire.clock, plan.start, plan.rate)
        self.journal = Journal(self.stage, recorder)
        self.safety = SafeState(self.stage, self.journal, job.sequence.ends == "safe_state")
        self._master = Master(wire, self.stage.now, job.realtime, job.bench)
        patience = round(job.sequence.timing.operational * plan.rate) if job.realtime else PATIENCE
        self.nodes = NodeWatch(self.stage, self.journal, self.safety, self._master, processes, job.bench,
                               looks_for_silence=not job.realtime and not self._is_embedded, patience=patience)
        injected = find_injected(plan, self.faults, plan.stop)
        self._overruns = OverrunWatch(job.sequence.timing, job.period_ns * 1e-9,
                                      set(np.flatnonzero(injected.sync | injected.plant).tolist()))
        self.log = CycleLog(job, self.journal, self.nodes, self._overruns)
        self._master.hooks.on_frame = self.log.keep_drive if job.sequence.disturbs_bus else recorder.frame
        self._edges, self._resets = sorted(self.faults.edges), list(self.faults.resets)  # those to come
        self._injected = 0  # cycles whose frames of other nodes are sent
        self.starter = BringUp(job, self.stage, self.journal, self.safety, self._master, stop)
        self.plant_record: CycleRecord | None = None  # the plant's own, read after a real-time run with trouble
        self._stalled_ns = 0  # how long the rig had not received before the nodes were started
        self._powered = True  # clean-up may use current
        self._may_power = True  # it may still use it when errors have gone meanwhile
        self._reset_at = 0  # the cycle of clean-up whose control word resets the faults
        self._demand = 0.0  # m, of the last cycle
        self._enablings: list[tuple[int, Enabling]] = []  # all, with the cycle before which they were played
        self._words = PROFILES[job.bench.profile]

    def close(self) -> None:
        """Let go of the loop, and of the master and the wire, which report to this session.

        The memory of a run is then free at once, not when Python next looks for reference cycles.
        """
        self._master.close()
        self._master.wire.is_node_gone = lambda: False
        self._enablings.clear()
        self.stage.loop = None

    def bring_up(self) -> None:
        """Reset, configure and start the nodes; play the probes first.

        Raises:
            BusError: a node does not answer or refuses.
        """
        self.journal.log("INFO", "phase", "bring-up")
        self._master.boot()
        if self.job.sequence.protocol.probe:
            self.starter.play_probes()
        if not self.safety.aborted:
            self.starter.start_nodes(self.scenario, is_run=True)
        self._master.wire.hear_all()
        self.stage.loop = open_loop(self._master, self.job.bench, self.scenario, self.faults, self.log, self.job.bus,
                                    self.job.realtime, self.log.guarded)
        self._enablings.append((0, Enabling(self.job.bench, self.stage.loop, self.job.realtime, self._must_end)))
        self.nodes.begin()
        self.stage.begun_ns, self.stage.is_playing = self.stage.clock.now(), True
        self._stalled_ns = self._master.wire.stalled_ns

    def run_phases(self) -> None:
        """Run set-up, main and clean-up. Whatever is raised, clean-up runs and the nodes are stopped."""
        loop = self.stage.playing
        try:
            if self._enable() and self._run(SETUP, self._setup) and self._await_ready() and self._run(MAIN, self._main):
                loop.wait_until_played(self._must_end)
        finally:
            try:
                self._discard_queue()
                self._powered = self._restore_nodes()
                self._enable_again()
                if not self._run(CLEANUP, self._choose_cleanup()):  # a node has died in it
                    self._discard_queue()
                    self._run(CLEANUP, self._choose_cleanup())
                self._play_last_probe()
                loop.finish()
            finally:
                self.stage.is_playing = self.stage.is_watching = False
                loop.close()
                self.nodes.find_silent_nodes()
                self._master.stop()
                if self.job.realtime and self.safety.troubles and PLANT not in self.nodes.gone:
                    self.plant_record = self._master.read_plant_record()  # it takes some seconds on a CAN bus
                for failure in self._master.restore(self.nodes.gone):
                    self.journal.log("WARN", "restore", failure)
                self.journal.log("INFO", "phase", "end")

    def _enable(self) -> bool:
        """Enable a controller that confirms each step; False when the run is to end."""
        demand = float(self._setup.command[0]) if len(self._setup.command) else 0.0
        return self._go_on("ready", self._enablings[0][1].enable(demand), CONTROLLER)

    def _enable_again(self) -> None:
        """After the safe state: a controller that confirms each step climbs once more, and its fault is reset."""
        if not (self.safety.is_safe and self._powered and self._words.is_confirmed) or self.nodes.look_again():
            return
        again = Enabling(self.job.bench, self.stage.playing, self.job.realtime, self.nodes.note_ended_processes)
        self._enablings.append((self.stage.playing.k, again))
        if problem := again.enable(self._demand):
            self.journal.log("WARN", "restore", problem)
            self._powered = False

    def _await_ready(self) -> bool:
        """Between set-up and main: wait until the controller says that it is ready; False when the run is to end."""
        if not self.job.bench.ready:
            return True
        words = [self._choose_control_word(phase, 0) for phase in (SETUP, MAIN)]
        return self._go_on("ready", self._enablings[0][1].await_ready(self._demand, *words), CONTROLLER)

    def _go_on(self, kind: str, problem: str, node: Role) -> bool:
        """End the run because of a problem of a node; whether it goes on."""
        if problem and not self.safety.aborted:
            self.safety.note(kind, problem, node)
            self.safety.abort(kind, problem)
        return not self.safety.aborted

    def _run(self, phase: int, profile: Profile) -> bool:
        """The cycles of one phase; False when it was ended early."""
        loop = self.stage.playing
        self.journal.announce("INFO", "phase", PHASES[phase])
        for section in profile.sections:
            self.journal.announce("INFO", "section", f"{PHASES[phase]}: {section.name}")
            label = section.name if phase == MAIN else PHASES[phase]
            i = section.start
            while i < section.stop:
                self._announce_faults()
                if phase == CLEANUP and i == _SETTLING and not self._powered:
                    self._try_again()
                control, before = self._choose_control_word(phase, i), loop.queued
                i += self._play_many(phase, profile.command[i:section.stop], control)
                if loop.queued == before:
                    load = self._loads[before] if phase == MAIN and before < len(self._loads) else 0.0
                    loop.cycle(CycleInput(phase, float(profile.command[i]), float(load), control))
                    i += 1
                self._demand = float(profile.command[i - 1])
                if loop.queued // 50 > before // 50:
                    self._progress(label, loop.k / max(self.scenario.plan.stop, loop.k))
                if self.nodes.note_ended_processes() if phase == CLEANUP else self._must_end():
                    return False
        return True

    def _play_many(self, phase: int, demands: Array, control: int) -> int:
        """Play several cycles at once, if the loop can and nothing is to be decided between them; returns how many."""
        loop = self.stage.playing
        if not isinstance(loop, EmbeddedLoop) or self.safety.is_safe or not self._powered:
            return 0
        demands, k = demands[:MOST], loop.queued
        loads, scenario_loads = np.zeros(len(demands)), self._loads[k:k + len(demands)]
        if phase == MAIN:
            loads[:len(scenario_loads)] = scenario_loads
        return loop.play_many(phase, demands, loads, control)

    def _must_end(self) -> bool:
        """Before each cycle of set-up and main: whether something ends main."""
        self._inject_faults()
        self.nodes.is_node_gone()
        self._go_on("plant", self.stage.playing.problem, PLANT)
        if self._overruns.problem and not self.safety.aborted:
            self.safety.abort("overrun", self._overruns.problem)
        if self._stop() and not self.safety.aborted:
            self.safety.stop()
        if guard := self.log.find_passed_guard():
            why = f"guard {guard.name!r} was passed by {guard.signal}"
            self.safety.note("guard", why)
            self.safety.abort("guard", why)
        return bool(self.safety.aborted)

    def _announce_faults(self) -> None:
        """Announce the faults that begin or end in the next cycle that is given to the loop."""
        while self._edges and self._edges[0].cycle <= self.stage.playing.queued:
            edge = self._edges.pop(0)
            level, word = ("WARN", "begins") if edge.begins else ("INFO", "ends")
            self.journal.announce(level, "fault", f"{edge.label} {word}")

    def _inject_faults(self) -> None:
        """Send the resets of the controller and the frames of other nodes that are due before the next cycle."""
        k = self.stage.playing.k
        while self._resets and self._resets[0][0] <= k:
            self._master.reset_controller(self._resets.pop(0)[1])
        for cycle in range(self._injected, k + 1):
            for cob_id, data in self.faults.foreign_frames(cycle):
                self._master.send(cob_id, data)
        self._injected = k + 1

    def _choose_control_word(self, phase: int, i: int) -> int:
        """Control word of the phase's cycle `i`."""
        if self.safety.is_safe if phase != CLEANUP else not self._powered:
            return 0
        words = self._words
        if phase == CLEANUP and self.safety.is_safe and i == self._reset_at and not words.is_confirmed:
            return words.reset
        # without set-up main is where it is enabled; one cycle each on the way to ACTIVE where nothing is confirmed
        state = find_goal(self.job.bench, PHASES[phase]) if words.is_confirmed else self.stage.playing.queued + 1
        return words.ladder[min(state, State.ACTIVE)]

    def _discard_queue(self) -> None:
        """Discard the cycles that are queued, and their events; clean-up begins with the demand of the last one."""
        self._demand = self.stage.playing.hold(CLEANUP)
        self.journal.drop_unplayed()

    def _choose_cleanup(self) -> Profile:
        """The clean-up of the sequence; a tenth of a second without current if a node does not answer or came late, or
        where nothing was played that the log could show.
        """
        if self.nodes.look_again() or self.safety.is_cut_short or not self.stage.playing.queued:
            self._powered = self._may_power = False
            rate = self.job.bench.rate
            return build_profile((Hold(time=max(1, round(0.1 * rate)) / rate),), self._demand, rate)
        return self.job.sequence.build_cleanup_profile(self._demand)

    def _restore_nodes(self) -> bool:
        """Try to set all nodes to OPERATIONAL without errors; return whether clean-up may use current."""
        is_lost = any(state != NmtState.OPERATIONAL for state in self._master.states.values())
        if self.safety.is_safe and not self.nodes.gone and is_lost:
            for failure in self._master.configure_again():
                self.journal.log("WARN", "restore", failure)
            self._master.start()
        return not self.safety.is_safe or not self._master.list_errors()

    def _try_again(self) -> None:
        """Some cycles into clean-up: a node that had to be started again may have no errors any more by now."""
        self.stage.playing.wait_until_played(lambda: False)
        self.nodes.note_ended_processes()
        self._powered = self._may_power and not self.nodes.gone and not self._master.list_errors()
        self._reset_at = _SETTLING
        self._enable_again()

    def _play_last_probe(self) -> None:
        """Play the probe after clean-up, if the controller is still in control."""
        if self.safety.is_safe or self.safety.aborted or not self.job.sequence.protocol.probe:
            return
        self.stage.playing.wait_until_played(lambda: bool(self.safety.aborted))
        for step in list_last_steps(self.job.bench):
            for each in list_inputs(step, self._demand):
                self.stage.playing.cycle(each)

    def read_protocol_record(self, is_judged: Mask) -> ProtocolRecord:
        """All that the protocol checks of this run are judged by; `is_judged`: cycles with the bench on time."""
        job, model, starter = self.job, self.job.model, self.starter
        cycles = sum(step.cycles for step in list_first_steps(job.sequence.protocol, job.bench))

        def read(history: History) -> Rows:
            rows = read_rows(history, starter.find_on_time_of(history))
            if job.realtime:  # without feedback there is nothing to answer to
                return rows._replace(drive=np.where(np.isnan(rows.position), np.nan, rows.drive))
            return rows

        history, after = self.log.history, self.log.after
        run = read_rows(history, is_judged & starter.find_on_time_of(history, self.faults))
        return ProtocolRecord(
            enabling=[(cycle, each.rows) for cycle, each in self._enablings],
            run=Rows._make(map(np.concatenate, zip(run, read(after), strict=True))),
            probes=[Rows._make(column[-cycles:] for column in read(probe)) for probe in starter.probes if len(probe)],
            emergencies=self.nodes.emergencies,
            heartbeats={NAMES[node]: times for node, times in self.nodes.heartbeats.items()},
            heard=(self.stage.begun_ns * 1e-9, self.stage.clock.now() * 1e-9),
            deaf=(self._master.wire.stalled_ns - self._stalled_ns) * 1e-9,
            unsound=None if job.sequence.disturbs_bus else self.stage.playing.unsound,
            deaf_cycles=self.faults.list_frame_hits("rig")[:, 0].tolist(), heartbeat_periods={
                NAMES[node]: self._master.find_heartbeat(node) * 1e-3 for node in self.nodes.heartbeats},
            bench=job.bench,
            drive_limit=model.values.get(model.kind.signals.drive.limit, np.nan) if starter.gains is None
            else starter.gains.current_limit,
            still_limit=50.0 * job.bench.fineness if model.kind.control is control_by_pid else np.nan,
            gains=None if find_firmware_parameters(model) else starter.gains, realtime=job.realtime,
            is_response_judged=job.realtime and not self._is_embedded)
