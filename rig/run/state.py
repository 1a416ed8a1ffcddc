"""What is true of a run at the moment: its time and stage, the events it reports, and its safe state."""

import bisect

from fdi.trace import Event
from rig.network import Clock
from rig.recorder import Event as EventRecord, Recorder
from rig.run.attribution import Trouble
from rig.run.loop import Loop

_ENDS_BRING_UP = ("bring_up", "late")  # troubles that a run cannot go on with
_ENDS_RUN = ("process", *_ENDS_BRING_UP)  # whatever the sequence tests, it needs its nodes
_MOST_TROUBLES = 1000  # they say enough for the attribution


class Stage:
    """Where a run is: the loop that plays, and what is recorded and watched meanwhile."""

    def __init__(self, clock: Clock, start: int, rate: float) -> None:
        """`clock` is that of the wire; `start` is the first cycle of main; `rate`: cycles a second."""
        self.clock, self._start, self._rate = clock, start, rate
        self.loop: Loop | None = None
        self.is_probing = False  # before set-up
        self.is_watching = False  # from the reset of the nodes for the run until its last cycle
        self.is_playing = False  # from the start of the nodes until the nodes are stopped by us
        self.begun_ns = 0  # when the nodes were started for the run

    @property
    def playing(self) -> Loop:
        """The loop, where there is one."""
        assert self.loop is not None
        return self.loop

    def now(self) -> int:
        """Time for the log, ns since the run began."""
        return self.loop.now() if self.loop else self.clock.now()

    def find_time(self, cycle: int | None = None) -> float:
        """The time of a cycle, by default now, s of main; negative before main."""
        now = self.loop.k if self.loop and not self.is_probing else 0
        return ((now if cycle is None else cycle) - self._start) / self._rate


class Journal:
    """The events of a run, in the log and as a list. An event of a queued cycle waits until that cycle is played."""

    def __init__(self, stage: Stage, recorder: Recorder) -> None:
        self.recorder, self._stage = recorder, stage
        self.events: list[Event] = []
        self._agenda: list[tuple[int, str, str, str]] = []  # events of queued cycles: cycle, level, kind, text

    def log(self, level: str, kind: str, text: str) -> None:
        """Record an event now."""
        self._record(self._stage.now(), Event(self._stage.find_time(), level, kind, text))

    def announce(self, level: str, kind: str, text: str) -> None:
        """Record an event of the next cycle that is given to the loop, when that cycle is played."""
        loop = self._stage.playing
        if loop.queued <= loop.k:
            self.log(level, kind, text)
        else:
            self._agenda.append((loop.queued, level, kind, text))

    def log_due(self, cycle: int, t_ns: int) -> None:
        """Record the announced events up to a cycle that is complete."""
        while self._agenda and self._agenda[0][0] <= cycle:
            due, *words = self._agenda.pop(0)
            self._record(t_ns, Event(self._stage.find_time(due), *words))

    def drop_unplayed(self) -> None:
        """Forget the announced events of cycles that are not queued any more."""
        self._agenda = [event for event in self._agenda if event[0] < self._stage.playing.queued]

    def _record(self, t_ns: int, event: Event) -> None:
        bisect.insort(self.events, event, key=lambda other: other.t)
        self.recorder.put(t_ns, EventRecord(event.level, event.kind, event.text))


class SafeState:
    """What went wrong in a run, whether there may be current, and why main ended early."""

    def __init__(self, stage: Stage, journal: Journal, tests_safe_state: bool) -> None:
        """`tests_safe_state`: the sequence goes on in the safe state, because it tests that response."""
        self._stage, self._journal, self._goes_on = stage, journal, tests_safe_state
        self.troubles: list[Trouble] = []
        self.aborted = ""  # why main ended early
        self.interrupted = False
        self.is_safe = False  # no current from here on, until clean-up

    @property
    def is_cut_short(self) -> bool:
        """Whether the trouble leaves no time for the sequence's own clean-up."""
        return any(trouble.kind in _ENDS_BRING_UP for trouble in self.troubles)

    def abort(self, kind: str, why: str) -> None:
        """End main, or bring-up; the first reason counts."""
        self.aborted = self.aborted or why
        self._journal.log("ERROR", kind, why)

    def stop(self) -> None:
        """End main because the operator asked for it."""
        self.interrupted = True
        self.abort("operator", "stopped by the operator")

    def note(self, kind: str, what: str, node: int = 0, code: int = 0, t_ns: int | None = None) -> None:
        """Keep a trouble for the attribution after the run."""
        if len(self.troubles) < _MOST_TROUBLES:
            self.troubles.append(Trouble(self._stage.now() if t_ns is None else t_ns, node, kind, code, what))

    def handle(self, kind: str, what: str, node: int = 0, code: int = 0, t_ns: int | None = None) -> None:
        """Enter the safe state: no current, and the end of main unless the sequence tests the safe state.

        Before and after the cycles of the run a report of a node ends nothing: SYNC stops after each probe and after
        the run, and on a busy machine a node may report that before it is reset.
        """
        stage = self._stage
        is_foreign = kind == "bus" and not stage.begun_ns  # another rig on the bus is reported once
        if not stage.is_watching and not is_foreign and kind not in _ENDS_RUN:
            self._journal.log("WARN", kind, f"{what} ({'before' if not stage.begun_ns else 'after'} the run)")
            return
        if stage.is_playing or kind in _ENDS_RUN:
            self.note(kind, what, node, code, t_ns)
        self._journal.log("ERROR", kind, what)
        if not self.is_safe:
            self.is_safe = True
            if stage.loop:
                stage.loop.override_control(0)
            self._journal.log("WARN", "safe_state", f"no current from here on: {what}")
        if (kind in _ENDS_RUN or not self._goes_on) and not self.aborted:
            self.abort("abort", what)
