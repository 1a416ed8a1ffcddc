"""What is known of a run while it runs: signals of main, states of the nodes, checks as far as they can be judged."""
from __future__ import annotations

import pickle
from collections import deque
from collections.abc import Mapping
from math import isnan, nan
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant import Columns
from plant.segments import RATE
from rig.network.node_objects import CONTROLLER, NAMES, PLANT, RIG
from rig.sequences import Sequence
from rig.sequences.checks import Check
from rig.sequences.measures import MAIN, RunData
from rig.view.live_feed import COLUMNS, Message

PHASES = ("set-up", "main", "clean-up")
_COLUMN = {name: number for number, name in enumerate(COLUMNS)}
_AFTER_RUN = ("shut_off", "recovers")  # kinds that need all drive frames
_GROWS = ("never_exceeds", "max_error", "event_never")  # kinds whose number only grows: a limit passed stays passed


class Event(NamedTuple):
    """An event, `t` in s of main."""

    t: float
    level: str
    kind: str
    text: str


class LivePlan(NamedTuple):
    """What the showing process knows of the run before it begins."""

    title: str
    duration: float  # s of main
    pace: str
    checks: tuple[Check, ...]
    unknown_checks: tuple[str, ...]  # names of checks that only the run itself can judge
    sections: dict[str, slice]
    starts: dict[str, float]
    has_load: bool

    @property
    def check_names(self) -> list[str]:
        """The checks of the sequence, those that only the run itself can judge last."""
        return [*(check.name for check in self.checks), *self.unknown_checks]


def make_live_plan(sequence: Sequence, pace: str) -> LivePlan:
    """The plan of a sequence; checks that cannot be sent to another process (Python of a user) keep their names."""
    known, unknown = [], []
    for check in sequence.checks:
        try:
            pickle.dumps(check)
            known.append(check)
        except (pickle.PicklingError, AttributeError, TypeError):
            unknown.append(check.name)
    return LivePlan(sequence.title, sequence.duration, pace, tuple(known), tuple(unknown), sequence.sections(),
                    dict(sequence.fault_starts()), bool(sequence.load))


class CheckState(NamedTuple):
    """A check on the screen. `word`: waits, measures, PASS, FAIL, or, for one judged at the end only, after the run."""

    name: str
    word: str
    value: float = nan
    unit: str = ""
    is_final: bool = False  # said by the run itself
    detail: str = ""

    @classmethod
    def read(cls, fields: Mapping[str, Any]) -> CheckState:
        """What the run itself says of a check at its end."""
        return cls(fields["name"], "PASS" if fields["passed"] else "FAIL", fields["value"], fields["unit"], True,
                   fields["detail"])

    @property
    def is_judged(self) -> bool:
        """Whether it has a verdict."""
        return self.word in ("PASS", "FAIL")

    @property
    def measured(self) -> str:
        """Value and unit behind a space; empty for none."""
        unit = "" if self.unit in ("", "1") else f" {self.unit}"
        return "" if isnan(self.value) else f" {self.value:.4g}{unit}"


class LiveRun:
    """Collects rows and messages of a run."""

    def __init__(self, plan: LivePlan) -> None:
        self.plan = plan
        self._table = np.empty((1 << 14, len(COLUMNS)))
        self.cycles = 0  # so far, without those that were missed
        self._main_from = self._main_until = -1  # rows
        self.zero_ns = nan  # log time at which main began
        self.states = {RIG: "operational", CONTROLLER: "unknown", PLANT: "unknown"}
        self.troubles: dict[int, str] = {}  # nodes that are gone, and how that is known
        self.events: deque[Event] = deque(maxlen=5000)
        waiting = {check.name for check in plan.checks if check.kind not in _AFTER_RUN}
        self.checks = {name: CheckState(name, "waits" if name in waiting else "after the run")
                       for name in plan.check_names}
        self.overruns = 0

    # ------------------------------------------------------------------------------------ what comes in

    def add_rows(self, rows: NDArray[np.float64]) -> None:
        """Append cycles."""
        first, self.cycles = self.cycles, self.cycles + len(rows)
        while self.cycles > len(self._table):
            self._table = np.concatenate((self._table, np.empty_like(self._table)))
        self._table[first:self.cycles] = rows
        self.overruns += int(rows[:, _COLUMN["overrun"]].sum())
        phase = rows[:, _COLUMN["phase"]]
        if self._main_from < 0 and (phase >= 1).any():
            self._main_from = first + int(np.argmax(phase >= 1))
            self.zero_ns = float(self._table[self._main_from, _COLUMN["t_ns"]])
        if self._main_until < 0 and (phase >= 2).any():
            self._main_until = first + int(np.argmax(phase >= 2))

    def add_message(self, message: Message) -> None:
        """Take in an event, a state of a node or a check."""
        fields = message.fields
        if message.kind == "NmtState":
            self.states[int(fields["node"])] = str(fields["name"])
        elif message.kind == "Check":
            self.checks[fields["name"]] = CheckState.read(fields)
        elif message.kind == "Event":
            event = Event((message.t_ns - self.zero_ns) * 1e-9, fields["level"], fields["kind"], fields["text"])
            self.events.append(event)
            node = find_dead_node(event.level, event.kind, event.text)
            if node:
                self.troubles[node] = event.text.partition(": ")[2] or "is silent"
            elif event.kind == "heartbeat" and event.level == "INFO" and event.text.startswith("node "):
                self.troubles.pop(int(event.text.split()[1]), None)

    # ------------------------------------------------------------------------------------ what is shown

    def read_rows_from(self, first: int) -> NDArray[np.float64]:
        """The rows from this one on, (rows, columns)."""
        return self._table[first:self.cycles]

    def read_last(self, name: str, cycles: int) -> NDArray[np.float64]:
        """The last values of a column, at most so many."""
        return self._table[max(self.cycles - cycles, 0):self.cycles, _COLUMN[name]]

    @property
    def is_over(self) -> bool:
        """Whether the last cycle has been played."""
        return any(event.kind == "phase" and event.text == "end" for event in self.events)

    @property
    def t(self) -> float:
        """Time of the last cycle, s of main; NaN before main."""
        return float(self._table[self.cycles - 1, _COLUMN["t_ns"]] - self.zero_ns) * 1e-9

    @property
    def section(self) -> str:
        """The section of main that is played, else the phase."""
        if not self.cycles:
            return "bring-up"
        phase = PHASES[min(int(self.read_last("phase", 1)[0]), 2)]
        row = self.cycles - 1 - self._main_from
        sections = self.plan.sections.items() if phase == "main" else ()
        return next((name for name, rows in sections if rows.start <= row < rows.stop), phase)

    def judge_checks(self) -> None:
        """Judge the checks whose window is over, and those whose number has passed its limit already."""
        rows = (self._main_until if self._main_until >= 0 else self.cycles) - self._main_from
        if self._main_from < 0 or rows < 1:
            return
        table = self._table[self._main_from:self._main_from + rows]
        columns = [table[:, _COLUMN[name]] for name in Columns._fields[1:]]
        data = RunData(Columns(np.arange(rows) / RATE, *columns), self.plan.sections, tuple(self.events),
                       self.plan.starts)
        for check in self.plan.checks:
            state = self.checks[check.name]
            if state.is_judged or state.word == "after the run":
                continue
            start, stop = _find_window(check, self.plan.sections, self.plan.duration)
            if rows > start:
                state = state._replace(word="measures")
            if rows >= stop or (rows > start and check.window == MAIN and check.kind in _GROWS):
                result = check.judge(data)
                is_early = rows < stop and (result.passed or isnan(result.value))
                word = "measures" if is_early else "PASS" if result.passed else "FAIL"
                state = CheckState(check.name, word, result.value, result.unit, detail=result.detail)
            self.checks[check.name] = state


def _find_window(check: Check, sections: dict[str, slice], duration: float) -> tuple[int, int]:
    """First row of a check's window and the one behind its last."""
    if isinstance(check.window, tuple):
        return round(check.window[0] * RATE), round(check.window[1] * RATE)
    rows = sections.get(check.window)
    return (rows.start, rows.stop) if rows else (0, round(duration * RATE))


def find_dead_node(level: str, kind: str, text: str) -> int:
    """The node that an event reports as dead: its process ended, or its heartbeat stopped; else 0."""
    for node, name in NAMES.items():
        if level == "ERROR" and kind in ("process", "heartbeat") and text.startswith(f"node {node} {name}"):
            return node
    return 0
