"""A run in the rerun viewer while it runs: the plots and lanes of `rig view`, sent piece by piece."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rig.network.node_objects import NAMES
from rig.recorder import Check, Event, NmtState, Record
from rig.view.live_run import COLUMNS, CheckState, LivePlan, LiveRun
from rig.view.recording import FAIL, MEASURED, NEUTRAL, NOTHING, PASS, Drawing, Lane, LogText, Recording
from rig.view.rerun_log import (
    ACTIVE,
    LANES,
    PHASES,
    PLOTS,
    SECTIONS,
    STATES,
    draw_signals,
    name_node_lane,
    read_fault_event,
)

_WORDS = {"waits": NEUTRAL, "measures": MEASURED, "after the run": NEUTRAL, "PASS": PASS, "FAIL": FAIL}


def draw_plan(plan: LivePlan) -> Drawing:
    """The views of a run that has not begun."""
    lanes = [Lane("run/phase", [], PHASES),
             Lane("run/command", [], PHASES | dict.fromkeys(plan.sections, SECTIONS["dynamic"])),
             *(Lane(name_node_lane(node), [], STATES) for node in NAMES),
             *(Lane(f"fault/{label}", [], ACTIVE) for label in plan.starts),
             *(Lane(f"check/{name}", [], {}) for name in plan.check_names)]
    plots = draw_signals(dict.fromkeys(_list_signals(plan), (NOTHING, NOTHING)))
    return Drawing(plan.title, plots, LANES, lanes, ("Provenance", f"{plan.title}, {plan.pace}"), log=())


def _list_signals(plan: LivePlan) -> list[str]:
    """The signals that are drawn; in lockstep nothing is ever late."""
    left_out = {"lateness": plan.pace == "lockstep", "load": not plan.has_load}
    return [name for name in ("error", *COLUMNS[2:-1]) if not left_out.get(name)]


class LiveView:
    """Sends what is new of a run to a recording. Nothing is sent before main begins, where t = 0 is, or it ends."""

    def __init__(self, recording: Recording, plan: LivePlan) -> None:
        """Use the recording of the drawing of this plan."""
        self._recording, self._plan, self._signals = recording, plan, _list_signals(plan)
        self._rows = 0
        self._waiting: list[tuple[int, Record]] = []
        self._shown: dict[str, str] = {}  # lane -> state

    def update(self, run: LiveRun, new: Sequence[tuple[int, Record]]) -> None:
        """Send the records that have come since the last call, once main has begun."""
        self._waiting += new
        if run.zero_ns is not None:
            self._send_all(run, run.zero_ns)

    def finish(self, run: LiveRun) -> None:
        """Send what a run that ended before main has left waiting; t = 0 is its last record."""
        if run.zero_ns is None and self._waiting:
            self._send_all(run, self._waiting[-1][0])

    def _send_all(self, run: LiveRun, zero_ns: int) -> None:
        for t_ns, record in self._waiting:
            self._send_record(record, (t_ns - zero_ns) / 1e9)
        self._waiting.clear()
        rows = run.read_rows_from(self._rows)
        self._rows += len(rows)
        if len(rows):
            self._send_rows(rows, run, zero_ns)

    def _send_rows(self, rows: NDArray[np.float64], run: LiveRun, zero_ns: int) -> None:
        columns = dict(zip(COLUMNS, rows.T, strict=True))
        columns["error"], t = columns["com"] - columns["xj"], (columns["t_ns"] - (zero_ns - run.first_ns)) / 1e9
        for (origin, _), lines in PLOTS.items():
            for line in lines:
                if line.signal in self._signals:
                    self._recording.send_values(f"{origin}/{line.path}", t, columns[line.signal] * line.scale)
        phases = columns["phase"].astype(int)
        for row in np.flatnonzero(np.diff(phases, prepend=-1)):
            self._send_state("run/phase", float(t[row]), [*PHASES][min(phases[row], 2)])
        self._send_state("run/command", float(t[-1]), run.section)
        for state in run.checks.values():
            if not state.is_final:
                self._send_check(state, float(t[-1]))

    def _send_record(self, record: Record, t: float) -> None:
        if isinstance(record, NmtState):
            self._send_state(name_node_lane(record.node), t, record.name)
        elif isinstance(record, Check):
            state = CheckState.read(record)
            self._send_check(state, t)
            self._recording.send_text(LogText(
                "log/checks", t, f"{state.word} {state.name}:{state.measured} {state.detail}".rstrip(),
                "INFO" if record.passed else "ERROR"))
        elif isinstance(record, Event):
            text = f"{t:8.3f} s  {record.kind}: {record.text}"
            self._recording.send_text(LogText("log/events", t, text, record.level))
            fault = read_fault_event(record.text) if record.kind == "fault" else None
            if fault:
                self._send_state(f"fault/{fault[0]}", t, fault[1])

    def _send_check(self, state: CheckState, t: float) -> None:
        if state.name not in self._plan.check_names:
            return  # the protocol checks are judged after the run: they have no window
        lane, word = f"check/{state.name}", state.word + state.measured if state.is_judged else state.word
        if self._shown.get(lane, "waits") != word:
            self._recording.declare_lane(Lane(lane, [], {**_WORDS, word: _WORDS[state.word]}))
            self._send_state(lane, t, word)

    def _send_state(self, lane: str, t: float, state: str) -> None:
        if self._shown.get(lane) != state:
            self._shown[lane] = state
            self._recording.send_state(lane, t, state)
