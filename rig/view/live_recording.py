"""A run in the rerun viewer while it runs: the plots and lanes of `rig view`, sent piece by piece."""
from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rig.network.node_objects import NAMES
from rig.view.live_feed import COLUMNS, Message
from rig.view.live_run import CheckState, LivePlan, LiveRun
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
    return [name for name in ("error", *COLUMNS[3:-1]) if not left_out.get(name)]


class LiveView:
    """Sends what is new of a run to a recording. Nothing is sent before main begins, where t = 0 is."""

    def __init__(self, recording: Recording, plan: LivePlan) -> None:
        """Use the recording of the drawing of this plan."""
        self._recording, self._plan, self._signals = recording, plan, _list_signals(plan)
        self._rows = 0
        self._waiting: list[Message] = []
        self._shown: dict[str, str] = {}  # lane -> state

    def update(self, run: LiveRun, messages: list[Message], *, is_last: bool = False) -> None:
        """Send the rows and messages that have come since the last call; before main only if it is the last one."""
        self._waiting += messages
        zero = run.zero_ns
        if math.isnan(zero):
            if not is_last:
                return
            zero = self._waiting[-1].t_ns if self._waiting else 0.0
        for message in self._waiting:
            self._send_message(message, (message.t_ns - zero) * 1e-9)
        self._waiting.clear()
        rows = run.read_rows_from(self._rows)
        self._rows += len(rows)
        if len(rows):
            self._send_rows(rows, zero, run)

    def _send_rows(self, rows: NDArray[np.float64], zero: float, run: LiveRun) -> None:
        columns = dict(zip(COLUMNS, rows.T, strict=True))
        columns["error"], t = columns["com"] - columns["xj"], (columns["t_ns"] - zero) * 1e-9
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

    def _send_message(self, message: Message, t: float) -> None:
        fields = message.fields
        if message.kind == "NmtState":
            self._send_state(name_node_lane(int(fields["node"])), t, str(fields["name"]))
        elif message.kind == "Check":
            state = CheckState.read(fields)
            self._send_check(state, t)
            self._recording.send_text(LogText(
                "log/checks", t, f"{state.word} {state.name}:{state.measured} {state.detail}".rstrip(),
                "INFO" if state.word == "PASS" else "ERROR"))
        elif message.kind == "Event":
            text = f"{t:8.3f} s  {fields['kind']}: {fields['text']}"
            self._recording.send_text(LogText("log/events", t, text, fields["level"]))
            fault = read_fault_event(fields["text"]) if fields["kind"] == "fault" else None
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
