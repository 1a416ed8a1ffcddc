"""The watch of the nodes of a run: emergencies, heartbeats, states, processes that end, and silence."""

from collections.abc import Collection, Container, Mapping
from math import isnan

from canopen.emcy import EmcyError

from plant import count_nouns
from rig.benches import Bench, Flags, Role, describe_identifier
from rig.device.emcy import EmcyCode
from rig.interrupts import describe_exit
from rig.network import CONTROLLER, HEARTBEAT_LIMIT, PLANT, RIG, Master, NmtState, name_state
from rig.recorder import NmtState as NmtRecord, Signals, Timing
from rig.run.attribution import NO_DRIVE
from rig.run.participants import FRAME_TIMEOUT, NodeProcesses
from rig.run.state import Journal, SafeState, Stage
from rig.sequences import Emergency, Heartbeat, TimingPolicy

PATIENCE = 5  # cycles in lockstep, of which each may wait long, until the first drive frame must have come

SILENCE = "silence"  # kind of the events that say that a controller without a heartbeat is gone, or heard again


class NodeWatch:
    """What the nodes of a run report and whether they still answer. Trouble goes to the safe state."""

    def __init__(self, stage: Stage, journal: Journal, safety: SafeState, master: Master, processes: NodeProcesses,
                 bench: Bench, looks_for_silence: bool, patience: int = PATIENCE) -> None:
        """`looks_for_silence`: in lockstep between processes, where a cycle waits long for a node that is late.

        `patience`: cycles by which the first drive frame must have come, where the rig moves the plant.
        """
        self._stage, self._journal, self._safety, self._processes = stage, journal, safety, processes
        self._master, self._bench, self._looks = master, bench, looks_for_silence
        self.gone: dict[Role, str] = {}  # participants that do not answer any more, and how that is known
        self.emergencies: list[Emergency] = []
        self.heartbeats: dict[Role, list[Heartbeat]] = {role: [] for role in master.watched}
        self.last_answers = {CONTROLLER: -1, PLANT: -1}  # last cycle with a cyclic frame of it
        self._last_row = 0  # the last cycle that is complete
        self._answers = {PLANT: bench.signals.outputs[-1].name, CONTROLLER: bench.signals.drive.name}  # who sends it
        self._operational: set[Role] = set()
        self._patience, self._missed = patience, 0  # cycles in a row for which the rig's own plant had no drive frame
        self._next_look = 0  # when to look again whether the nodes are alive
        self._silence = SilenceWatch(round(FRAME_TIMEOUT * 1e9))
        self._silent: set[Role] = set()  # the nodes among `gone` that are known by their silence in lockstep
        wire = master.wire
        wire.is_node_gone = self.is_node_gone
        master.hooks.on_emcy, master.hooks.on_state = self._note_emergency, self._note_state
        master.hooks.on_lost, master.hooks.on_back = self._handle_silence, self._handle_return
        master.hooks.on_heartbeat = lambda role, t_ns: self.heartbeats[role].append(
            Heartbeat(t_ns * 1e-9, wire.blind_ns * 1e-9))
        master.hooks.on_rival = lambda identifier: safety.handle(
            "bus", f"another node sends {describe_identifier(identifier)}, a frame of {bench.describe_node(RIG)}")

    def begin(self) -> None:
        """Count heartbeats from here on."""
        for times in self.heartbeats.values():
            times.clear()

    def look_again(self) -> bool:
        """Look at once; whether a node will not answer any more."""
        self._next_look = 0
        return self.is_node_gone()

    def add(self, signals: Signals) -> None:
        """Take in a complete cycle: who answered in it."""
        self._last_row = signals.cycle
        self.last_answers |= {role: signals.cycle for role, name in self._answers.items()
                              if not isnan(getattr(signals, name))}
        if not self._bench.has_plant_node and not self._master.is_deaf:
            self._watch_drive(bool(signals.flags & Flags.CURRENT_ZEROED))

    def _watch_drive(self, is_missing: bool) -> None:
        """No frame of the controller for too long: the end of the run if none ever came, else trouble.

        A controller that sends no heartbeat is gone then. In lockstep, where a cycle waits for it, so is any other,
        unless the sequence goes on in the safe state.
        """
        if not is_missing:
            if self._missed and self.gone.pop(CONTROLLER, ""):
                self._journal.log("INFO", SILENCE, f"{self._bench.describe_node(CONTROLLER)} is heard")
            self._missed = 0
            return
        self._missed += 1
        is_first = self.last_answers[CONTROLLER] < 0
        if self._missed != (self._patience if is_first else 1):
            return
        # else in the words of a plant that is a node, which says so by EMCY
        refusal = self._stage.playing.describe_refusal()
        who = f"{self._bench.describe_node(CONTROLLER)}:" if is_first else f"plant 0x{EmcyCode.RPDO_TIMEOUT:04X}"
        missing = describe_missing(self._bench, self._missed if is_first else self._bench.most_missed, refusal)
        self._safety.handle("bring_up" if is_first else NO_DRIVE, f"{who} {missing}", CONTROLLER)
        if CONTROLLER not in self._master.watched or (self._looks and self._safety.aborted):
            how = f"sends no valid frames: {refusal}" if refusal else "is silent"
            self.gone.setdefault(CONTROLLER, f"it {how}")
            self._journal.log("ERROR", SILENCE, f"{self._bench.describe_node(CONTROLLER)} {how}")

    def _note_emergency(self, node: Role, error: EmcyError) -> None:
        if self._stage.is_playing or self._stage.is_probing:
            is_in_run = self._stage.loop is not None and self._stage.is_playing
            self.emergencies.append(Emergency(self._stage.playing.k if is_in_run else -1, node, error.code))
        if error.code & 0xFF00 == 0:
            message = "an error is gone, others stand" if error.register else "no error any more"
            self._journal.log("INFO", "recovered", f"{self._bench.describe_node(node)}: {message}")
        elif error.code == EmcyCode.HEARTBEAT_LOST and self._master.is_behind():
            self._safety.handle("late", f"the rig sent no heartbeat for {self._master.pause:.2f} s, and "
                                        f"{self._bench.describe_node(node)} reports 0x{error.code:04X}", RIG)
        else:
            what = f"{self._bench.describe_node(node)} 0x{error.code:04X} (EMCY) {error.get_desc()}".rstrip()
            self._safety.handle("emcy", what, node, error.code, round(error.timestamp * 1e9))

    def _note_state(self, node: Role, state: int) -> None:
        name = name_state(state).lower()
        self._journal.recorder.put(self._stage.now(), NmtRecord(self._bench.find_number(node), state, name))
        if state == NmtState.OPERATIONAL:
            self._operational.add(node)
        elif node in self._operational:
            self._operational.discard(node)
            if self._stage.is_playing:  # a watchdog reset, a power cycle, or an NMT command of another master
                self._safety.handle("nmt", f"{self._bench.describe_node(node)} left OPERATIONAL: {name}", node, state)

    def _handle_silence(self, node: Role) -> None:
        self.note_ended_processes()
        ago = 1e-9 * (self._stage.clock.now() - self._master.heard_ns[node])
        what = f"no heartbeat any more: last heartbeat {ago:.2f} s ago"
        if self._is_answering(node):
            what += ", although its other frames come"
        else:
            self.gone.setdefault(node, what)
        self._safety.handle("heartbeat", f"{self._bench.describe_node(node)}: {what}", node)

    def _handle_return(self, node: Role) -> None:
        if node not in self._processes.find_ended():
            self.gone.pop(node, None)
        self._journal.log("INFO", "heartbeat", f"{self._bench.describe_node(node)} is heard")

    def _is_answering(self, node: Role) -> bool:
        """Whether a node sent a cyclic frame in one of the last 20 cycles: its heartbeat alone may be missing."""
        return self._stage.loop is not None and self.last_answers[node] >= self._stage.loop.k - 20

    def is_node_gone(self) -> bool:
        """Whether a node will not answer any more; looks every 20 ms."""
        if (now := self._stage.clock.now()) >= self._next_look:
            self._next_look = now + 20_000_000
            self.note_ended_processes()
            if self._stage.is_playing and self._looks:
                self._look_for_silent_nodes(now)
        return bool(self.gone)

    def note_ended_processes(self) -> bool:
        """Note which nodes that the rig started have ended; True if that was not known yet.

        A process that is killed sends nothing more from then on, but takes some ms to end. Other nodes may report the
        missing frames before.
        """
        is_news = False
        for node, status in self._processes.find_ended().items():
            how = describe_exit(status)
            if self.gone.get(node) != how:
                is_news, self.gone[node] = True, how
                self._safety.handle("process", f"{self._bench.describe_node(node)}: {how}", node)
        return is_news

    def _look_for_silent_nodes(self, now: int) -> None:
        """Lockstep between processes: a node that neither beats nor answers is gone, until it is heard again.

        The heartbeat alone is watched with much patience there, and a cycle waits long for a node that is late.
        """
        if self._master.is_deaf:
            return
        heard_ns = self._master.heard_ns  # after a reset a node may have no heartbeat, and answers no SYNC
        answering = [node for node, cycle in self.last_answers.items() if cycle == self._last_row]
        silences = self._silence.find_silent(now, {node: heard_ns[node] for node, state in self._master.states.items()
                                                   if node in heard_ns and state == NmtState.OPERATIONAL}, answering)
        for node in self._silent - silences.keys():
            self._silent.discard(node)
            self._handle_return(node)
        for node in silences.keys() - self.gone.keys():
            self._silent.add(node)
            self.gone[node] = f"no heartbeat for {silences[node]:.1f} s either"
            what = f"{self._bench.describe_node(node)}: no heartbeat for {silences[node]:.1f} s, and no answer"
            self._safety.handle("heartbeat", what, node)
            if not self._safety.aborted:  # no sequence can mean that in lockstep
                self._safety.abort("abort", what)

    def find_silent_nodes(self) -> None:
        """After trouble: find out which nodes still answer, for the first cause depends on it."""
        if self._safety.aborted and not self._safety.interrupted:
            seconds = HEARTBEAT_LIMIT * 1e-3
            silent = [node for node in self._master.find_silent(seconds) if not self._is_answering(node)]
            self._processes.wait(silent)
            self.note_ended_processes()
            for node in silent:
                self.gone.setdefault(node, f"no heartbeat within {seconds:g} s at the end of the run")


def describe_missing(bench: Bench, cycles: int, refusal: str) -> str:
    """That no drive frame has come for so many cycles; its name and identifier are those of the bench.

    `refusal`: why those that come are not taken, if any do.
    """
    frame = bench.frames.drive
    name = f"{frame.name} ({describe_identifier(frame.identifier)}) for {count_nouns(cycles, 'cycle')}"
    return f"no valid frame {name}: {refusal}" if refusal else f"no frame {name}"


class OverrunWatch:
    """Counts overruns in a row, cycle by cycle. `problem` says when there were too many; empty before that.

    A cycle is an overrun if its SYNC was sent late or the plant's frames came late or not at all. It counts once, or as
    many times as SYNC was whole periods late. Cycles in which the sequence itself disturbs these frames do not count,
    and do not end a row of overruns.
    """

    def __init__(self, policy: TimingPolicy, period: float, injected: Container[int] = ()) -> None:
        """`period` is the length of a cycle in s; `injected`: cycles whose SYNC or plant frames a fault disturbs."""
        self._most = policy.most_in_a_row if policy.overruns == "abort" else None
        self._grace, self._period, self._injected = policy.grace, period, injected
        self._latest_sync, self._latest_feedback = policy.find_limits(period)
        self._in_a_row = 0
        self.problem = ""

    def add(self, timing: Timing) -> None:
        """Take in a complete cycle."""
        if (self._most is None or self.problem or timing.cycle * self._period < self._grace
                or timing.cycle in self._injected):
            return
        is_fed = timing.feedback_response <= self._latest_feedback and not isnan(timing.valve_response)
        is_late = timing.lateness > self._latest_sync or not is_fed
        self._in_a_row = self._in_a_row + max(1, int(timing.lateness / self._period)) if is_late else 0
        if self._in_a_row > self._most:
            self.problem = (f"the bench was late: {count_nouns(self._in_a_row, 'overrun')} in a row up to cycle "
                            f"{timing.cycle}, limit {self._most}")


class SilenceWatch:
    """Adds up for each node how long the rig has listened without a heartbeat of it.

    A look that comes late counts for `step` at most: then the rig stood still, and perhaps the node with it.
    """

    def __init__(self, limit_ns: int, step_ns: int = 100_000_000) -> None:
        """`limit_ns`: silence after which a node counts as gone if it does not take part in the cycles either."""
        self._limit, self._step = limit_ns, step_ns
        self._looked_ns = 0
        self._heard_ns: dict[Role, int] = {}
        self._silent_ns: dict[Role, int] = {}

    def find_silent(self, now_ns: int, heard_ns: Mapping[Role, int], answering: Collection[int] = ()
                    ) -> dict[Role, float]:
        """Nodes that are silent and not `answering`, with the time for which the rig has listened in vain, s.

        Args:
            now_ns: time.
            heard_ns: when the last heartbeat of each node came that is to be watched.
            answering: nodes that take part in the cycles.
        """
        elapsed_ns = min(now_ns - self._looked_ns, self._step)
        self._looked_ns = now_ns
        self._silent_ns = {node: self._silent_ns.get(node, 0) + elapsed_ns if t_ns == self._heard_ns.get(node) else 0
                           for node, t_ns in heard_ns.items()}
        self._heard_ns = dict(heard_ns)
        return {node: silence_ns * 1e-9 for node, silence_ns in self._silent_ns.items()
                if silence_ns >= self._limit and node not in answering}
