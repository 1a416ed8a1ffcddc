"""Bring-up: the cycle loop is chosen, the nodes are reset, identified, configured and started, the probes are played.

The probes are short plays before and after a sequence that show what its own cycles cannot. In a sequence the
controller is disabled only where demand and position agree, so a firmware that ignores it sends next to no current
there either. A probe asks for a position some way off (of the EHA 1 mm) while the controller is disabled, then steps
the demand while it is enabled. It is played before set-up, on the healthy plant in its initial state. On CANopen it is
played twice, each time after a reset, and the two must be answered alike; the reset that follows brings plant and
controller back to the same state, so the rows of the sequence are those of a run without probes. Plain CAN has no
reset: there it is played once, and the ram goes back to where it began. After clean-up the controller is disabled once
more. A controller that nothing disables is asked for nothing in these steps: it would obey, and its integral remember.

The controller is made ready in cycles that do not count: CiA 402 is enabled step by step, or gets the values of set-up,
until its own words say so.
The run stands still meanwhile: neither its profiles nor its faults go on. In real time the last input is repeated until
the next one, which waits for the answer to it.
"""

from collections.abc import Callable
from math import isclose, nan
from typing import NamedTuple

import numpy as np

from plant import require
from rig.benches import PROFILES, Bench, Flags, Role, State, choose_control, find_state
from rig.network import (
    CONTROLLER,
    HEARTBEAT_LIMIT,
    PATIENT,
    EmbeddedWire,
    Gains,
    Identity,
    LinkWire,
    Master,
    WallClock,
    can_open,
    read_gains,
)
from rig.nodes import Scenario
from rig.run.attribution import find_start_problem
from rig.run.embedded_loop import EmbeddedLoop, Limits, can_play_many, load_code
from rig.run.job import Job
from rig.run.loop import AFTER, BEFORE, BEFORE_MAIN, CycleInput, CycleLoop, CycleObserver, History, Loop, load_parts
from rig.run.state import Journal, SafeState, Stage
from rig.run.watch import PATIENCE, describe_missing
from rig.sequences import Mask, Plan, ProtocolLimits, Rows, Schedule


def compile_loop(job: Job) -> None:
    """Compile the cycle of a job, before any node is started: some seconds on a new machine."""
    if job.realtime and can_open(job.bus):
        from rig.run.hard_loop import compile_cycle  # here: in lockstep a run needs none of it

        compile_cycle()
        return
    load_parts()
    if job.controller == "builtin" and not job.realtime:
        load_code()


def open_loop(master: Master, bench: Bench, scenario: Scenario, faults: Schedule, log: CycleObserver, bus: str,
              realtime: bool, guards: Limits | None = None) -> Loop:
    """The cycle loop for a bus: in real time the hard one where compiled code can use the bus, else one in Python.

    With `guards`, limits of signals, cycles of a run may be played together.

    Raises:
        RigError: the bus cannot be opened.
    """
    is_compiled = bench.has_plant_node or scenario.model.kind.foreign is None  # or Python moves the plant
    if realtime and can_open(bus) and isinstance(master.wire, LinkWire) and is_compiled:
        from rig.run.hard_loop import HardLoop  # here: in lockstep a run needs none of it

        return HardLoop(master, bench, scenario, faults, log, bus)
    if guards is not None and not realtime and can_play_many(master, bench):
        return EmbeddedLoop(master, bench, scenario, faults, log, guards)
    return CycleLoop(master, bench, scenario, faults, log, realtime)


PROBES = 2  # before set-up, of a controller that can be reset
ATTEMPTS = 5  # at each of them, in real time
RETURN_TIME = 0.3  # s: until the ram is back, some time constants of a position loop
RETURN_TIME_OBEYING = 1.0  # s: the same for a controller that nothing disables, and whose integral settles by itself
_MISSED_LIMIT = 5  # cycles in a row without an answer: then the probe ends, because each costs a timeout


class Step(NamedTuple):
    """Some cycles with the same command; `demand` counts from where the plant is meant to be."""

    control: int
    demand: float
    cycles: int
    phase: int = BEFORE
    begins_enabled: bool = False  # before it the controller is enabled, in cycles that do not count


def list_warm_up(bench: Bench) -> tuple[Step, ...]:
    """Real time: the first cycles may be late."""
    words = PROFILES[bench.profile]
    first = Step(find_disabled(bench), find_distance(bench) if bench.can_disable else 0.0, 30)
    return (first,) if words.is_confirmed else (first, Step(words.reset, first.demand, 1))


def find_distance(bench: Bench) -> float:
    """From the position to the demand while the controller is disabled; 1 mm of the EHA."""
    return 500.0 * bench.fineness


def find_disabled(bench: Bench) -> int:
    """The control word of a probe with which the controller is disabled."""
    goal = find_goal(bench, "setup")
    return PROFILES[bench.profile].ladder[goal if goal is State.READY else State.OFF]


def find_goal(bench: Bench, phase: str) -> State:
    """What a phase asks for: ACTIVE, or READY where its values take the place of a control word and do not enable."""
    return State.READY if bench.profile == "none" and not bench.is_enabled(phase) else State.ACTIVE


def list_last_steps(bench: Bench) -> tuple[Step, ...]:
    """The probe after clean-up."""
    return (Step(0, find_distance(bench), 8 + _count_release(bench), AFTER),) if bench.can_disable else ()


def list_first_steps(limits: ProtocolLimits, bench: Bench) -> tuple[Step, ...]:
    """The steps of a probe before set-up, whose demand step may be answered as late as the limits say."""
    distance = find_distance(bench)
    step = 0.5 * distance  # the answer to it is far below the limit
    active, off = PROFILES[bench.profile].ladder[State.ACTIVE], find_disabled(bench)
    steps = []
    if bench.profile != "none":
        low, high = PROFILES[bench.profile].ladder[1:3]
        steps = [Step(off, distance, 4), Step(low, distance, 2), Step(high, distance, 2)]
    elif bench.enables:
        steps = [Step(off, distance, 8)]
    steps += [Step(active, 0.0, 3, BEFORE_MAIN, begins_enabled=True),
              Step(active, step, 3 + round(limits.find_step_delay(bench) * bench.rate), BEFORE_MAIN)]
    if not bench.nodes:
        time = RETURN_TIME if bench.can_disable else RETURN_TIME_OBEYING
        steps.append(Step(active, 0.0, round(time * bench.rate), BEFORE_MAIN))
    return (*steps, Step(off, distance, 8 + _count_release(bench))) if bench.can_disable else tuple(steps)


def _count_release(bench: Bench) -> int:
    """Cycles until a controller without a control word has switched its current off."""
    return round(PROFILES["none"].delay * bench.rate) if bench.profile == "none" else 0


def list_inputs(step: Step, demand: float = 0.0) -> list[CycleInput]:
    """The cycles of a step at the position `demand`, SI."""
    return [CycleInput(step.phase, demand + step.demand, 0.0, step.control)] * step.cycles


def has_no_answers(probe: History) -> bool:
    """Whether the last cycles were all without a drive frame."""
    last = probe.column(probe.signals.drive.name)[-_MISSED_LIMIT:]
    return len(last) == _MISSED_LIMIT and bool(np.isnan(last).all())


def find_gap(probe: History, on_time: Mask, cycles: int) -> str:
    """Who left one of the last `cycles` of a probe without a frame: "bench", "controller", "" for nobody.

    An answer that is missing where the bench was not `on_time`, (n,), is the bench's gap.
    """
    missing = np.isnan(probe.column(probe.signals.drive.name)[-cycles:])
    if np.isnan(probe.column(probe.signals.controlled.name)[-cycles:]).any() or (missing & ~on_time[-cycles:]).any():
        return "bench"
    return "controller" if missing.any() else ""


def read_rows(history: History, on_time: Mask) -> Rows:
    """The rows of a history as the protocol checks see them."""
    signals = history.signals
    columns = {"demand": signals.command.name, "position": signals.controlled.name, "drive": signals.drive.name}
    return Rows(on_time=on_time, **{name: history.column(columns.get(name, name)) for name in Rows._fields
                                    if name != "on_time"})


LIMIT = 5.0  # s: a controller that is not ready by then ends the run
TIME_TO_SAY = 1.0  # s, until a controller has said whether the values of set-up make it ready


class Enabling:
    """Gets the controller of a bench ready on a loop. `stop()` is True when the run is to end."""

    def __init__(self, bench: Bench, loop: Loop, realtime: bool, stop: Callable[[], bool]) -> None:
        self._bench, self._loop, self._realtime, self._stop = bench, loop, realtime, stop
        self._words = PROFILES[bench.profile]
        self._said: list[tuple[int, float, float]] = []  # control word, status word and current of the cycles
        self._silent = 0  # cycles in a row for which the rig's own plant has had no drive frame

    @property
    def rows(self) -> Rows:
        """What was sent and answered, for the protocol checks; the bench need not have been on time."""
        control, status, current = np.array(self._said, float).reshape(-1, 3).T
        zero = np.zeros(len(control))
        return Rows(zero, zero, current, control, status, zero, zero, on_time=zero > 0)

    def enable(self, demand: float) -> str:
        """Climb as far as set-up asks, with fault reset, holding `demand`, m; why that failed, or ""."""
        if not self._words.is_confirmed:
            return ""
        control, goal = 0, find_goal(self._bench, "setup")

        def step() -> CycleInput:
            nonlocal control
            control = choose_control(self._words, goal, self._find_state(), control, resets=True)
            return CycleInput(0, demand, 0.0, control, is_counted=False)

        for _ in range(2):  # the second shows whether the first was answered: a status word from before says nothing
            self._play(step())
        if self._play_until(lambda: self._find_state() == State.ACTIVE, step, LIMIT):
            return ""
        status = int(self._loop.outputs.get("status_word", 0))
        return self._describe_silence() or (
            f"the controller is not enabled after {LIMIT:g} s: status word 0x{status:04X}, "
            f"{State(self._find_state()).name.lower().replace('_', ' ')}")

    def await_ready(self, demand: float, control: int, main_control: int) -> str:
        """Wait, at a `demand` in m, until the controller is ready; why it is not, or "".

        A controller that is not ready with the values of set-up and `control`, although it had the time to say so, gets
        the values of main and `main_control`: it may say that it is ready as soon as it is enabled.
        """
        def is_ready() -> bool:
            return all(self._has(name, value) for name, value in self._bench.ready.items())

        at_rest = CycleInput(0, demand, 0.0, control, is_counted=False)
        self._play(at_rest)
        self._play_until(is_ready, lambda: at_rest, TIME_TO_SAY)
        if self._play_until(is_ready, lambda: CycleInput(1, demand, 0.0, main_control, is_counted=False), LIMIT):
            return ""
        details = ", ".join(f"{name} is {self._loop.outputs.get(name, 0.0):g}, not {value:g}"
                            for name, value in self._bench.ready.items() if not self._has(name, value))
        return self._describe_silence() or f"the controller is not ready after {LIMIT:g} s: {details}"

    def _describe_silence(self) -> str:
        missing = describe_missing(self._bench, self._silent, self._loop.describe_refusal())
        return f"{self._bench.describe_node(CONTROLLER)}: {missing}" if self._silent else ""

    def _play_until(self, is_done: Callable[[], bool], make_step: Callable[[], CycleInput], most: float) -> bool:
        """Play cycles until `is_done()`; False if that takes more than `most` s, True also when the run is to end."""
        clock, remaining_cycles = WallClock(), round(most * 1e9 / self._bench.cycle_ns)
        while not is_done():
            remaining_cycles -= 1
            is_over = clock.now() > most * 1e9 if self._realtime else self._silent >= PATIENCE
            if remaining_cycles < 0 or is_over:
                return False
            self._play(make_step())
            if self._stop():
                return True
        return True

    def _play(self, step: CycleInput) -> None:
        self._loop.cycle(step)
        self._loop.wait_until_played(self._stop)
        outputs = self._loop.outputs
        current = nan if self._has_flag(Flags.DRIVE_MISSING) else outputs.get(self._bench.signals.drive.word, nan)
        self._said.append((step.control, outputs.get("status_word", 0.0), current))
        is_silent = self._has_flag(Flags.CURRENT_ZEROED) and not self._bench.has_plant_node
        self._silent = self._silent + 1 if is_silent else 0

    def _find_state(self) -> int:
        word = int(self._loop.outputs.get("status_word", 0))
        return State.UNKNOWN if self._has_flag(Flags.DRIVE_MISSING) else find_state(self._words, word)

    def _has_flag(self, flag: Flags) -> bool:
        return bool(int(self._loop.outputs.get("flags", 0)) & flag)

    def _has(self, name: str, value: float) -> bool:
        return isclose(self._loop.outputs.get(name, 0.0), value, rel_tol=1e-9, abs_tol=1e-12)


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
        cycles = sum(step.cycles for step in steps)
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
        scenario = Scenario(self._job.scenario.model, Plan(stop=0), (), self._job.seed)
        probe = History(self._job.bench.signals)
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
        problem = enabling.enable(0.0)
        if problem or not bench.ready:
            return problem
        return enabling.await_ready(0.0, *(PROFILES[bench.profile].ladder[find_goal(bench, phase)]
                                           for phase in ("setup", "main")))

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
            self._journal.recorder.metadata(f"node{bench.find_number(role)}",
                                            {key: str(value) for key, value in identity.known.items()})
        for role in self.identities:
            self._master.require_identity(role)
        key, difference = sequence.firmware.find_difference(self.identities.get(CONTROLLER, Identity()))
        require(not difference, sequence.name, f"firmware.{key}", difference)

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
        """The cycles of a play that the bench delivered: neither this SYNC nor the next was late, feedback came within
        half a cycle, and no injected fault touched a frame of this cycle or of those before it that count.
        """
        on_time: Mask = ~np.isnan(history.column(history.signals.controlled.name))
        if self._job.realtime:
            period = self._job.period_ns * 1e-9
            on_time &= history.column("feedback_response") <= 0.5 * period
            late = history.column("lateness") > 0.1 * period
            on_time &= ~late & ~np.append(late[1:], False)
        if faults is not None:
            # a frame that comes every n-th cycle is missing until the next but one
            slowest = max(frame.every for frame in self._job.bench.frames.frames)
            reach = 1 if slowest == 1 else 2 * slowest
            on_time &= ~faults.find_disturbed(len(on_time), reach)
        return on_time
