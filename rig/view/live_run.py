"""What is known of a run while it runs: signals of main, states of the nodes, checks as far as they can be judged."""

import pickle
from collections import deque
from collections.abc import Mapping
from math import isnan, nan
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.trace import CheckResult, Event
from plant import EHA, Signals, make_columns_type
from rig import recorder
from rig.benches import Bench
from rig.sequences import Check, RunData, Sequence
from rig.sequences.checks import MAIN

PHASES = ("set-up", "main", "clean-up")
_AFTER_RUN = ("shut_off", "recovers")  # kinds that need all drive frames
_GROWS = ("never_exceeds", "max_error", "event_never")  # kinds whose number only grows: a limit passed stays passed


class LivePlan(NamedTuple):
    """What the showing process knows of the run before it begins."""

    title: str
    duration: float  # s of main
    rate: float  # cycles a second
    pace: str
    checks: tuple[Check, ...]
    unknown_checks: tuple[str, ...]  # names of checks that only the run itself can judge
    sections: dict[str, slice]
    starts: dict[str, float]
    has_load: bool
    nodes: dict[int, str]  # who takes part: number and name
    signals: Signals = EHA  # of the plant

    @property
    def columns(self) -> tuple[str, ...]:
        """Of the table of cycles."""
        return ("t_ns", "phase", *self.signals.names, "lateness", "response", "overrun")

    @property
    def check_names(self) -> list[str]:
        """The checks of the sequence, those that only the run itself can judge last."""
        return [*(check.name for check in self.checks), *self.unknown_checks]


def make_live_plan(sequence: Sequence, pace: str, bench: Bench) -> LivePlan:
    """The plan of a sequence; checks that cannot be sent to another process (Python of a user) keep their names."""
    checks, unknown_checks = [], []
    for check in sequence.checks:
        try:
            pickle.dumps(check)
            checks.append(check)
        except (pickle.PicklingError, AttributeError, TypeError):
            unknown_checks.append(check.name)
    return LivePlan(sequence.title, sequence.duration, sequence.rate, pace, tuple(checks), tuple(unknown_checks),
                    sequence.sections(), dict(sequence.fault_starts()), bool(sequence.load),
                    bench.list_participants(), signals=bench.signals)


class CheckState(NamedTuple):
    """A check on the screen. `word`: waits, measures, a verdict, or, for one judged at the end only, after the run."""

    name: str
    word: str
    result: CheckResult | None = None  # so far
    is_final: bool = False  # said by the run itself

    @property
    def is_judged(self) -> bool:
        """Whether it has a verdict."""
        return self.word in ("PASS", "FAIL", "CANNOT_TELL")

    @property
    def measured(self) -> str:
        """Value and unit behind a space; empty for none."""
        return "" if self.result is None or isnan(self.result.value) else f" {self.result.measured}"


class LiveRun:
    """Collects the records of a run's log."""

    def __init__(self, plan: LivePlan) -> None:
        self.plan = plan
        self._column = {name: number for number, name in enumerate(plan.columns)}
        self._get_values = attrgetter(*plan.signals.names)
        self._table = np.empty((1 << 14, len(plan.columns)))
        self.cycles = 0  # so far, without those that were missed
        self._main_from = self._main_until = -1  # rows
        self.first_ns = 0  # log time of the first row, from which `t_ns` counts: a float64 rounds ns since 1970
        self.zero_ns: int | None = None  # log time at which main began
        self.states = {number: "operational" if name.endswith("rig") else "unknown"
                       for number, name in plan.nodes.items()}
        self.troubles: dict[int, str] = {}  # nodes that are gone, and how that is known
        self._events: deque[tuple[int, recorder.Event]] = deque(maxlen=5000)  # with their log times
        waiting = {check.name for check in plan.checks if check.kind not in _AFTER_RUN}
        self.checks = {name: CheckState(name, "waits" if name in waiting else "after the run")
                       for name in plan.check_names}
        self.overruns = 0
        self._signals: recorder.Signals | None = None

    def add(self, t_ns: int, record: recorder.Record) -> None:
        """Take in a record of the log: the signals of a cycle, of any plant, with the `Timing` that follows are a row.
        """
        if isinstance(record, recorder.Timing):
            self._add_row(t_ns, record)
        elif isinstance(record, recorder.NmtState):
            self.states[record.node] = record.name
        elif isinstance(record, CheckResult):
            self.checks[record.name] = CheckState(record.name, record.verdict, record, True)
        elif not isinstance(record, recorder.Event):
            self._signals = record
        else:
            self._events.append((t_ns, record))
            node = find_named_node(record.kind, record.text, self.plan.nodes)
            if node and record.level == "ERROR":
                self.troubles[node] = record.text.partition(": ")[2] or "is silent"
            elif node and record.level == "INFO":
                self.troubles.pop(node, None)

    def _find_time(self, t_ns: int) -> float:
        """Log time in s of main; NaN before main."""
        return nan if self.zero_ns is None else (t_ns - self.zero_ns) / 1e9

    def _add_row(self, t_ns: int, timing: recorder.Timing) -> None:
        row = self._signals
        if row is None or row.cycle != timing.cycle:
            return
        if self.cycles == len(self._table):
            self._table = np.concatenate((self._table, np.empty_like(self._table)))
        self.first_ns = self.first_ns if self.cycles else t_ns
        self._table[self.cycles] = (t_ns - self.first_ns, row.phase, *self._get_values(row), timing.lateness,
                                    timing.response, timing.overrun)
        if self._main_from < 0 and row.phase >= 1:
            self._main_from, self.zero_ns = self.cycles, t_ns
        if self._main_until < 0 and row.phase >= 2:
            self._main_until = self.cycles
        self.cycles += 1
        self.overruns += timing.overrun

    def read_rows_from(self, first: int) -> NDArray[np.float64]:
        """The rows from this one on, (rows, columns)."""
        return self._table[first:self.cycles]

    def read_last(self, name: str, cycles: int) -> NDArray[np.float64]:
        """The last values of a column, at most so many."""
        return self._table[max(self.cycles - cycles, 0):self.cycles, self._column[name]]

    @property
    def events(self) -> list[Event]:
        """What has happened, `t` in s of main; NaN as long as main has not begun."""
        return [Event(self._find_time(t_ns), each.level, each.kind, each.text) for t_ns, each in self._events]

    @property
    def is_over(self) -> bool:
        """Whether the last cycle has been played."""
        return any(each.kind == "phase" and each.text == "end" for _, each in self._events)

    @property
    def t(self) -> float:
        """Time of the last cycle, s of main; NaN before main."""
        return self._find_time(self.first_ns + int(self.read_last("t_ns", 1)[0])) if self.cycles else nan

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
        signals = self.plan.signals
        columns = [table[:, self._column[name]] for name in signals.names]
        data = RunData(make_columns_type(signals)(np.arange(rows) / self.plan.rate, *columns), self.plan.sections,
                       self.events, self.plan.starts, rate=self.plan.rate, signals=signals)
        for check in self.plan.checks:
            state = self.checks[check.name]
            if state.is_judged or state.word == "after the run":
                continue
            start, stop = _find_window(check, self.plan)
            if rows > start:
                state = state._replace(word="measures")
            if rows >= stop or (rows > start and check.window == MAIN and check.kind in _GROWS):
                result = check.judge(data)
                is_early = rows < stop and (result.passed or isnan(result.value))
                word = "measures" if is_early else "PASS" if result.passed else "FAIL"
                state = CheckState(check.name, word, result)
            self.checks[check.name] = state


def _find_window(check: Check, plan: LivePlan) -> tuple[int, int]:
    """First row of a check's window and the one behind its last."""
    if isinstance(check.window, tuple):
        return round(check.window[0] * plan.rate), round(check.window[1] * plan.rate)
    rows = plan.sections.get(check.window)
    return (rows.start, rows.stop) if rows else (0, round(plan.duration * plan.rate))


def find_named_node(kind: str, text: str, nodes: Mapping[int, str]) -> int:
    """The node that an event reports as dead or alive: its process ended, its frames or its heartbeat stopped; else 0.

    `nodes`: number and name of each.
    """
    is_about_life = kind in ("process", "heartbeat", "silence")
    return next((number for number, name in nodes.items() if is_about_life and text.startswith(name)), 0)
