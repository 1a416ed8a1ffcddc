"""Bring-up: the nodes are reset, identified, configured and started, and the probes before set-up are played."""
from __future__ import annotations

from collections.abc import Callable

from plant.errors import InputError
from rig.benches.frame_map import Role
from rig.benches.profiles import PROFILES, State
from rig.network.clock import WallClock
from rig.network.link import EmbeddedWire
from rig.network.master import HEARTBEAT_LIMIT, PATIENT, Master
from rig.network.node_objects import CONTROLLER, Gains, Identity, read_gains
from rig.nodes.scenario import Scenario
from rig.run.attribution import Mask, find_start_problem
from rig.run.cyclic_values import BEFORE
from rig.run.enabling import Enabling
from rig.run.job import Job
from rig.run.loop import History, Loop
from rig.run.loops import open_loop
from rig.run.probe import (
    ATTEMPTS,
    PROBES,
    Step,
    count_cycles,
    find_disabled,
    find_gap,
    find_on_time,
    has_no_answers,
    list_first_steps,
    list_inputs,
    list_warm_up,
)
from rig.run.state import Journal, SafeState, Stage
from rig.sequences.faults import Plan, Schedule


class BringUp:
    """Starts the nodes of a job, for a probe or the run. `stop()` is True when the operator wants to end."""

    def __init__(self, job: Job, stage: Stage, journal: Journal, safety: SafeState, master: Master,
                 stop: Callable[[], bool]) -> None:
        self._job, self._stage, self._journal, self._safety = job, stage, journal, safety
        self._master, self._stop = master, stop
        self._is_embedded = isinstance(master.wire, EmbeddedWire)
        self.identities: dict[Role, Identity] = {}
        self.start_times: dict[Role, float] = {}  # s from NMT start to OPERATIONAL
        self.gains: Gains | None = None  # of the controller, if its objects hold them
        self.probes: list[History] = []  # played before set-up

    def start_nodes(self, scenario: Scenario, *, is_run: bool = False) -> None:
        """Reset, identify, configure and start the nodes, for a probe or the run. Raises BusError and InputError."""
        job = self._job
        self._master.reset()
        self._stage.is_watching = is_run
        is_first = not self.identities
        if is_first:
            self._identify_nodes()
        has_objects = job.controller != "external" and CONTROLLER in job.bench.nodes
        parameters = job.model.values if has_objects else None
        if self.gains is None:
            self.gains = read_gains(self._master.read_parameters() if parameters is None else parameters)
        patient = not job.realtime and isinstance(self._stage.clock, WallClock)
        self._master.configure(scenario.to_bytes(), parameters,
                               job.sequence.timing.choose_sync_period(job.period_ns / 1e9)
                               if job.realtime or self._is_embedded else 0,
                               PATIENT if patient else HEARTBEAT_LIMIT)
        if is_first:
            for role in self.identities:
                self._master.require_pdos(role)
        self._master.start()
        self._wait_for_operational(job.sequence.timing.operational)

    def play_probes(self) -> None:
        """Play the probes before set-up, each after a reset of the nodes, if there are nodes.

        In real time a probe with a gap is repeated. If the bench itself cannot deliver one, none is judged.

        Raises:
            BusError: a node does not answer or refuses.
        """
        bench = self._job.bench
        steps = list_first_steps(self._job.sequence.protocol, bench)
        cycles = count_cycles(steps)
        steps = (*list_warm_up(bench), *steps) if self._job.realtime else steps
        self._stage.is_probing = True
        for _ in range(PROBES if bench.nodes else 1):
            probe = self._play_probe(steps)
            attempts = ATTEMPTS if self._job.realtime else 1
            while ((gap := find_gap(probe, self.find_on_time_of(probe), cycles)) and (attempts := attempts - 1)
                   and not self._safety.aborted):
                probe = self._play_probe(steps)
            if self._safety.aborted:
                break
            if gap == "bench" and self._job.realtime:
                self._journal.log("WARN", "probe", f"no probe without a gap in {ATTEMPTS} attempts: the plant was late")
                self.probes.clear()
                break
            self.probes.append(probe)
        self._stage.is_probing = False

    def _play_probe(self, steps: tuple[Step, ...]) -> History:
        """Play one probe after a reset of the nodes. Raises BusError."""
        # The plant of the run in its initial state, without faults and loads.
        bench = self._job.bench
        scenario, probe = Scenario(self._job.scenario.model, Plan(stop=0), (), self._job.seed), History(bench.signals)
        self.start_nodes(scenario)
        if self._safety.aborted:  # a node did not become OPERATIONAL
            return probe
        loop = self._stage.loop = open_loop(self._master, self._job.bench, scenario, Schedule(scenario.plan), probe,
                                            self._job.bus, self._job.realtime)
        try:
            for step in steps:
                if problem := self._enable(loop) if step.begins_enabled else "":
                    self._journal.log("WARN", "probe", problem)
                if problem or not self._play_step(loop, step, probe):
                    loop.hold(BEFORE)
                    break
            loop.finish()
        except BaseException:
            self._master.stop()
            raise
        finally:
            loop.close()
            self._stage.loop = None
        return probe

    def _play_step(self, loop: Loop, step: Step, probe: History) -> bool:
        """Play a step of a probe; False when that is to end."""
        for each in list_inputs(step):
            loop.cycle(each)
            if self._job.realtime and self._stop():
                self._safety.stop()
            if self._safety.aborted or has_no_answers(probe):
                return False
        return True

    def _enable(self, loop: Loop) -> str:
        """Enable the controller for a probe; why that failed, or ""."""
        bench = self._job.bench
        enabling = Enabling(bench, loop, self._job.realtime, lambda: bool(self._safety.aborted) or self._stop())
        has_word, active = bench.profile != "none", PROFILES[bench.profile].ladder[State.ACTIVE]
        problem = enabling.enable(0.0) if has_word else ""
        if problem or not bench.ready:
            return problem
        return enabling.await_ready(0.0, active if has_word else find_disabled(bench), active)

    def _identify_nodes(self) -> None:
        """Read and log what the nodes say about themselves; refuse another device, and a firmware that the sequence is
        not meant for.

        Raises:
            InputError: another device or firmware.
        """
        bench, sequence = self._job.bench, self._job.sequence
        for role in sorted(bench.nodes):
            identity = self._master.read_identity(role)
            self.identities[role] = identity
            self._journal.log("INFO", "identity", f"{bench.describe_node(role)}: {identity}")
            known = {key: str(value) for key, value in identity._asdict().items() if value is not None}
            self._journal.recorder.metadata(f"node{bench.find_number(role)}", known)
        for role in self.identities:
            self._master.require_identity(role)
        identity = self.identities.get(CONTROLLER, Identity())
        key, difference = sequence.firmware.find_difference(identity._asdict())
        if difference:
            raise InputError(sequence.name, f"firmware.{key}", difference)

    def _wait_for_operational(self, limit: float) -> None:
        """Wait until each node says that it is OPERATIONAL, and log how long that took; too long ends the run.

        A node that is too slow is given three times the limit, so that the time it needs is known.
        """
        times = self._master.wait_for_operational(3 * limit)
        bench = self._job.bench
        self.start_times = {role: time.seconds for role, time in times.items()}
        for role, seconds in sorted(self.start_times.items()):
            self._journal.log("INFO", "nmt",
                              f"{bench.describe_node(role)} is OPERATIONAL {1e3 * seconds:.0f} ms after NMT start")
        if problem := find_start_problem(times, limit, {role: bench.describe_node(role)
                                                        for role in self._master.watched}):
            self._safety.handle(*problem)

    def find_on_time_of(self, history: History, faults: Schedule | None = None) -> Mask:
        """The cycles of a play in which the bench was on time."""
        # a frame that comes every n-th cycle is missing until the next but one
        slowest = max(frame.every for frame in self._job.bench.frames.frames)
        reach = 1 if slowest == 1 else 2 * slowest
        return find_on_time(history, faults, self._job.realtime, self._job.period_ns * 1e-9, reach)
