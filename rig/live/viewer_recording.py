"""A run in the rerun viewer while it runs: the plots and lanes of `rig view`, sent piece by piece."""
from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.live.feed import COLUMNS, Message
from rig.live.live_run import CheckState, LivePlan, LiveRun
from rig.network.node_objects import NAMES
from rig.view.rerun_log import FAIL, LANES, MEASURED, NEUTRAL, PASS, PLOTS, SECTIONS, STATES, TEXTS, TIMELINE

_SENT = {"position/command": ("com", 1e3), "position/ram": ("xj", 1e3), "current/current": ("cor", 1e3),
         "pressure/pressure": ("p12", 1e-5), "spool/spool": ("xs", 1e6), "timing/lateness": ("lateness", 1e6),
         "timing/response": ("response", 1e6)}  # line of a plot -> column of the feed, scale from SI
_ERROR = "error/error"
_PHASE, _COMMAND = "1 phase", "2 command"
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
        self._checks = {name: f"4.{number:02} {name}" for number, name in enumerate(list_check_names(plan), 1)}
        for plot in PLOTS:
            for line in plot.lines:
                path = f"{plot.origin}/{line.path}"
                if path in _SENT or path == _ERROR:
                    stream.log(path, rr.SeriesLines(colors=[line.colour], widths=[line.width], names=[line.name],
                                                    aggregation_policy="MinMax"), static=True)
        self._declare_lane(_PHASE, {"set-up": NEUTRAL, "main": MEASURED, "clean-up": NEUTRAL})
        self._declare_lane(_COMMAND, dict.fromkeys(plan.sections, SECTIONS["dynamic"]))
        for node in NAMES:
            self._declare_lane(_name_node_lane(node), STATES)

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
            self._send_state(_name_node_lane(int(fields["node"])), str(fields["name"]), t)
        elif message.kind == "Check":
            word = "PASS" if fields["passed"] else "FAIL"
            state = CheckState(fields["name"], word, fields["value"], fields["unit"], True, fields["detail"])
            self._send_check(state, t)
            self._send_text("log/checks", f"{word} {state.name}:{_format_value(state)} {state.detail}".rstrip(),
                            "INFO" if fields["passed"] else "ERROR", t)
        elif message.kind == "Event":
            self._send_text("log/events", f"{t:8.3f} s  {fields['kind']}: {fields['text']}", fields["level"], t)

    def _send_check(self, state: CheckState, t: float) -> None:
        lane = self._checks.setdefault(state.name, f"4.{len(self._checks) + 1:02} {state.name}")
        word = f"{state.word}{_format_value(state)}" if state.word in ("PASS", "FAIL") else state.word
        if self._shown.get(lane, "waits") != word:
            self._declare_lane(lane, {**_WORDS, word: _WORDS[state.word]})
            self._send_state(lane, word, t)

    def _declare_lane(self, lane: str, colours: dict[str, int]) -> None:
        if colours:
            values = self._rr.StateConfiguration(values=list(colours), colors=np.array([*colours.values()], np.uint32))
            self._stream.log(_make_path(lane), values, static=True)

    def _send_state(self, lane: str, state: str, t: float) -> None:
        if self._shown.get(lane) != state:
            self._shown[lane] = state
            self._stream.set_time(TIMELINE, duration=t)
            self._stream.log(_make_path(lane), self._rr.StateChange(state=state))

    def _send_text(self, path: str, text: str, level: str, t: float) -> None:
        self._stream.set_time(TIMELINE, duration=t)
        self._stream.log(path, self._rr.TextLog(text, level=level))


def build_live_blueprint(rr: Any, plan: LivePlan) -> Any:
    """The views of a run under way: they follow the newest rows."""
    import rerun.blueprint as rrb

    linked = rrb.TimeAxis(link="LinkToGlobal")
    plots = [rrb.TimeSeriesView(origin=f"/{plot.origin}", name=plot.title, axis_x=linked,
                                plot_legend=rrb.PlotLegend("RightTop")) for plot in PLOTS]
    half = (len(plots) + 1) // 2
    states = rrb.StateTimelineView(origin="/states", name=LANES, time_view=linked)
    texts = rrb.TextLogView(contents=["/log/events", "/log/checks"], name=TEXTS)
    share = min(max(0.039 * (5 + len(NAMES) + len(list_check_names(plan))), 0.5), 0.78)
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(*plots[:half]), rrb.Vertical(*plots[half:]),
                       rrb.Vertical(states, texts, row_shares=[share, 1 - share])),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        rrb.BlueprintPanel(state="hidden"), rrb.SelectionPanel(state="hidden"))


def list_check_names(plan: LivePlan) -> list[str]:
    """The checks of the sequence, those that only the run itself can judge last."""
    return [*(check.name for check in plan.checks), *plan.unknown_checks]


def _name_node_lane(node: int) -> str:
    return f"3 node {node} NMT"


def _make_path(lane: str) -> str:
    return f"states/{re.sub('[^A-Za-z0-9.]+', '_', lane)}"


def _format_value(state: CheckState) -> str:
    if state.value is None or math.isnan(state.value):
        return ""
    return f" {state.value:.4g}" + ("" if state.unit in ("", "1") else f" {state.unit}")
