"""A run in the rerun viewer while it runs: the plots and lanes of `rig view`, sent piece by piece."""
from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.network.node_objects import NAMES
from rig.view.live_feed import COLUMNS, Message
from rig.view.live_run import CheckState, LivePlan, LiveRun
from rig.view.rerun_log import (
    ACTIVE,
    PLOTS,
    SECTIONS,
    STATES,
    arrange_run,
    name_fault_lane,
    name_node_lane,
    read_fault_event,
)
from rig.view.viewer import (
    FAIL,
    MEASURED,
    NEUTRAL,
    PASS,
    TIMELINE,
    Lane,
    make_lane_path,
    make_plot_view,
    send_lane_style,
    send_line_style,
)

_SENT = {"position/command": ("com", 1e3), "position/ram": ("xj", 1e3), "current/current": ("cor", 1e3),
         "pressure/pressure": ("p12", 1e-5), "spool/spool": ("xs", 1e6), "load/load": ("load", 1.0),
         "timing/lateness": ("lateness", 1e6),
         "timing/response": ("response", 1e6)}  # line of a plot -> column of the feed, scale from SI
_ERROR = "error/error"
_PHASE, _COMMAND = "run/phase", "run/command"
_WORDS = {"waits": NEUTRAL, "measures": MEASURED, "after the run": NEUTRAL, "PASS": PASS, "FAIL": FAIL}


class LiveView:
    """Sends what is new of a run to a recording. Nothing is sent before main begins, where t = 0 is."""

    def __init__(self, rr: Any, stream: Any, plan: LivePlan) -> None:
        """Send the names and colours of all lines and lanes.

        Args:
            rr: the module rerun.
            stream: its recording, with `build_live_blueprint` as blueprint.
            plan: of the run.
        """
        self._rr, self._stream = rr, stream
        self._rows = 0
        self._waiting: list[Message] = []
        self._shown: dict[str, str] = {}  # lane -> state
        self._check_names = list_check_names(plan)
        for plot in PLOTS:
            for line in plot.lines:
                path = f"{plot.origin}/{line.path}"
                if path in _SENT or path == _ERROR:
                    send_line_style(rr, stream, path, line)
        phases = {"set-up": NEUTRAL, "main": MEASURED, "clean-up": NEUTRAL}
        self._declare_lane(_PHASE, phases)
        self._declare_lane(_COMMAND, phases | dict.fromkeys(plan.sections, SECTIONS["dynamic"]))
        for node in NAMES:
            self._declare_lane(name_node_lane(node), STATES)
        for label in plan.starts:
            self._declare_lane(name_fault_lane(label), {ACTIVE: FAIL})

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
            self._send_rows(rows, (rows[:, COLUMNS.index("t_ns")] - zero) * 1e-9, run)

    def _send_rows(self, rows: NDArray[np.float64], t: NDArray[np.float64], run: LiveRun) -> None:
        times = [self._rr.TimeColumn(TIMELINE, duration=t)]
        values = {path: rows[:, COLUMNS.index(name)] * scale for path, (name, scale) in _SENT.items()}
        values[_ERROR] = (rows[:, COLUMNS.index("com")] - rows[:, COLUMNS.index("xj")]) * 1e6
        if run.plan.pace == "lockstep":
            values.pop("timing/lateness")  # in lockstep nothing is ever late
        if not run.plan.has_load:
            values.pop("load/load")
        for path, column in values.items():
            self._rr.send_columns(path, times, self._rr.Scalars.columns(scalars=column), recording=self._stream)
        phases = rows[:, COLUMNS.index("phase")].astype(int)
        for row in np.flatnonzero(np.diff(phases, prepend=-1)):
            self._send_state(_PHASE, ("set-up", "main", "clean-up")[min(phases[row], 2)], float(t[row]))
        self._send_state(_COMMAND, run.section, float(t[-1]))
        for state in run.checks.values():
            if not state.is_final:
                self._send_check(state, float(t[-1]))

    def _send_message(self, message: Message, t: float) -> None:
        fields = message.fields
        if message.kind == "NmtState":
            self._send_state(name_node_lane(int(fields["node"])), str(fields["name"]), t)
        elif message.kind == "Check":
            word = "PASS" if fields["passed"] else "FAIL"
            state = CheckState(fields["name"], word, fields["value"], fields["unit"], True, fields["detail"])
            self._send_check(state, t)
            self._send_text("log/checks", f"{word} {state.name}:{_format_value(state)} {state.detail}".rstrip(),
                            "INFO" if fields["passed"] else "ERROR", t)
        elif message.kind == "Event":
            self._send_text("log/events", f"{t:8.3f} s  {fields['kind']}: {fields['text']}", fields["level"], t)
            fault = read_fault_event(fields["text"]) if fields["kind"] == "fault" else None
            if fault:
                self._send_state(name_fault_lane(fault[0]), fault[1], t)

    def _send_check(self, state: CheckState, t: float) -> None:
        if state.name not in self._check_names:
            return  # the protocol checks are judged after the run: they have no window
        lane = f"check/{state.name}"
        word = f"{state.word}{_format_value(state)}" if state.word in ("PASS", "FAIL") else state.word
        if self._shown.get(lane, "waits") != word:
            self._declare_lane(lane, {**_WORDS, word: _WORDS[state.word]})
            self._send_state(lane, word, t)

    def _declare_lane(self, lane: str, colours: dict[str, int]) -> None:
        send_lane_style(self._rr, self._stream, Lane(lane, [], colours))

    def _send_state(self, lane: str, state: str, t: float) -> None:
        if self._shown.get(lane) != state:
            self._shown[lane] = state
            self._stream.set_time(TIMELINE, duration=t)
            self._stream.log(make_lane_path(lane), self._rr.StateChange(state=state))

    def _send_text(self, path: str, text: str, level: str, t: float) -> None:
        self._stream.set_time(TIMELINE, duration=t)
        self._stream.log(path, self._rr.TextLog(text, level=level))


def build_live_blueprint(plan: LivePlan) -> Any:
    """The views of a run under way: they follow the newest rows."""
    plots = [make_plot_view(plot) for plot in PLOTS if plot.origin != "load" or plan.has_load]
    return arrange_run(plots, 2 + len(NAMES) + len(plan.starts), len(list_check_names(plan)), "following")


def list_check_names(plan: LivePlan) -> list[str]:
    """The checks of the sequence, those that only the run itself can judge last."""
    return [*(check.name for check in plan.checks), *plan.unknown_checks]


def _format_value(state: CheckState) -> str:
    if state.value is None or math.isnan(state.value):
        return ""
    return f" {state.value:.4g}" + ("" if state.unit in ("", "1") else f" {state.unit}")
