"""A run as a recording for the viewer: its signals, limits, lanes and events, and a layout made for this bench."""
from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from fdi.report.run_report import read_verdict
from fdi.trace.sections import Section
from fdi.trace.trace import MAIN, Check, Trace
from rig.network.node_objects import NAMES
from rig.sequences.measures import SI_OF_UNIT
from rig.view.viewer import (
    COMMAND,
    FAIL,
    LIMIT,
    MEASURED,
    NEUTRAL,
    PASS,
    TIMELINE,
    Floats,
    Lane,
    Line,
    Plot,
    ShownView,
    build_blueprint,
    import_rerun,
    make_lanes_view,
    make_plot_view,
    make_value_axis,
    measure_lanes_view,
    open_recording,
    send_lane,
    send_line,
)

if TYPE_CHECKING:
    import rerun as rr

VERDICTS = {"PASS": PASS, "FAIL": FAIL, "ABORTED": FAIL, "INVALID_TIMING": 0xD9A441FF}
STATES = {"operational": PASS, "pre-operational": 0xD9A441FF, "stopped": FAIL, "boot-up": NEUTRAL}
VALUE = 0x2B3138FF  # of the words beside the window of a check
LEVEL_COLOURS = (0x00DA7EFF, 0xAB0115FF)  # the viewer's colours of INFO and ERROR; WARN's stands in its menu too

PLOTS = (
    Plot("position", "Position [mm]", (Line("command", "Com command [mm]", COMMAND, 4.0),
                                       Line("ram", "XJ ram [mm]", MEASURED))),
    Plot("error", "Following error [um]", (Line("error", "Com - XJ [um]", 0xE8A33DFF),)),
    Plot("current", "Current [mA]", (Line("current", "Cor current [mA]", 0xB57EDCFF),)),
    Plot("pressure", "Differential pressure [bar]", (Line("pressure", "P12 pressure [bar]", 0x45B8ACFF),)),
    Plot("spool", "Spool position [um]", (Line("spool", "XS spool [um]", 0xD96BA0FF),)),
    Plot("load", "Load on the ram [N]", (Line("load", "load [N]", 0xD9A441FF),)),
    Plot("timing", "Cycle timing [us]", (Line("lateness", "SYNC lateness [us]", 0xF2C94CFF, 1.0),
                                         Line("response", "controller's response [us]", 0x7FD46BFF, 1.0),
                                         Line("work", "bench's own work [us]", 0x8C7AE6FF, 1.0))),
)
SECTIONS = {"hold": NEUTRAL, "step": MEASURED, "ramp": 0x2A8C82FF, "dynamic": 0x8E5BBFFF}
LANES, CHECKS, TEXTS = "Faults, nodes, run", "Checks", "Events and checks"  # titles of the views that are no plots
LIMITS = "limits"  # no view: the lines of the limits in all plots, of which some may lie behind a signal
LANE_GROUPS = ("fault", "node", "run")
ACTIVE = "active"  # state of a fault
SHOWN_IN = {"xj": ("position", 1e3), "com": ("position", 1e3), "error": ("error", 1e6), "cor": ("current", 1e3),
            "p12": ("pressure", 1e-5), "xs": ("spool", 1e6)}  # signal -> plot, scale from SI
LIMITS_OF = {"never_exceeds", "max_error"}  # kinds of check whose limits are limits of the plotted line


def write_rrd(trace: Trace, path: Path) -> None:
    """Write a trace with its blueprint as a rerun recording; set-up has negative times, main starts at 0.

    Raises ViewerError without rerun; InputError for a place that cannot be written.
    """
    rr = import_rerun()
    name = trace.provenance.get("sequence", trace.provenance.get("source", "trace"))
    with open_recording(path, name, _build_blueprint(trace)) as stream:
        _send_series(rr, stream, trace)
        _send_limits(rr, stream, trace.checks)
        _send_states(rr, stream, trace)
        _send_texts(rr, stream, trace)


def list_shown_views(trace: Trace) -> list[ShownView]:
    """What a picture of the recording of a trace must show."""
    there = list_lines(trace)
    colours = {plot.title: tuple(line.colour for line in plot.lines if f"{plot.origin}/{line.path}" in there)
               for plot in PLOTS}
    out = [ShownView(title, found) for title, found in colours.items() if found]
    lanes = {PASS, *SECTIONS.values(), *STATES.values(), *VERDICTS.values()}
    out.append(ShownView(LANES, tuple(lanes), is_lanes=True))
    if trace.events or trace.checks:
        out.append(ShownView(TEXTS, LEVEL_COLOURS, 40))  # one level in the list of events has some 60
    return [*out, ShownView(LIMITS, (LIMIT,), 0)]


def list_lines(trace: Trace) -> dict[str, tuple[Floats, Floats]]:
    """Path of each line -> times, s, and values in the plot's unit."""
    timing = trace.timing
    out = {"position/command": trace.com * 1e3, "position/ram": trace.xj * 1e3,
           "error/error": (trace.com - trace.xj) * 1e6, "current/current": trace.cor * 1e3,
           "pressure/pressure": trace.p12 * 1e-5, "spool/spool": trace.xs * 1e6}
    if np.nan_to_num(trace.load).any():
        out["load/load"] = trace.load
    found = {path: (trace.t, values) for path, values in out.items()}
    found |= {f"timing/{name}": (timing.t, column * 1e6) for name, column in
              (("lateness", timing.lateness), ("response", timing.response), ("work", timing.work))}
    known = {path: (t, values) for path, (t, values) in found.items() if not np.isnan(values).all()}
    if not np.nan_to_num(timing.lateness).any():  # in lockstep nothing is ever late
        known.pop("timing/lateness", None)
    return known


def _send_series(rr: Any, stream: rr.RecordingStream, trace: Trace) -> None:
    found = list_lines(trace)
    for plot in PLOTS:
        for line in plot.lines:
            path = f"{plot.origin}/{line.path}"
            if path in found:
                send_line(rr, stream, path, line, *found[path])


def _send_limits(rr: Any, stream: rr.RecordingStream, checks: tuple[Check, ...]) -> None:
    """Limits of a plotted signal as red lines over the check's window."""
    for number, check in enumerate(checks):
        if check.kind not in LIMITS_OF or math.isnan(check.t0):
            continue
        origin, shown = SHOWN_IN.get("error" if check.kind == "max_error" else check.signal, ("", 0.0))
        level = check.high * SI_OF_UNIT.get(check.unit, ("", 1.0))[1] * shown
        if origin and not math.isnan(level):  # both kinds judge the size of the signal
            for name, sign in (("high", 1.0), ("low", -1.0)):
                line = Line(f"limit_{number}_{name}", f"limit: {check.name}", LIMIT)
                send_line(rr, stream, f"{origin}/{line.path}", line, np.array([check.t0, check.t1]),
                          sign * np.array([level, level]))


def _send_states(rr: Any, stream: rr.RecordingStream, trace: Trace) -> None:
    for lane in _list_lanes(trace):
        send_lane(rr, stream, lane)


def _list_lanes(trace: Trace) -> list[Lane]:
    """Verdict, phase, sections of the command, each node's NMT state, each fault, each check over its window."""
    result, first = read_verdict(trace), float(trace.t[0])
    out = []
    if result.word in VERDICTS:
        out.append(Lane("run/verdict", [(first, str(result))], {str(result): VERDICTS[result.word]}))
    names = np.array(["set-up", "main", "clean-up"])
    turns = np.flatnonzero(np.diff(trace.phase, prepend=-1))
    out.append(Lane("run/phase", [(float(trace.t[k]), str(names[trace.phase[k]])) for k in turns],
                    {"set-up": NEUTRAL, "main": MEASURED, "clean-up": NEUTRAL}))
    out.append(make_command_lane(trace))
    out += [Lane(name_node_lane(node), [(s.t, s.name) for s in trace.nmt if s.node == node], STATES)
            for node in sorted({state.node for state in trace.nmt})]
    out += [Lane(name_fault_lane(label), states, {ACTIVE: FAIL}) for label, states in list_fault_states(trace).items()]
    return out + [_make_check_lane(check, trace) for check in trace.sequence_checks]


def make_command_lane(trace: Trace, path: str = "run/command", offset: float = 0.0) -> Lane:
    """The sections of the command, at the times of the trace plus `offset`, s."""
    sections = [(float(trace.t[s.start]) + offset, s.kind, _describe_section(s)) for s in trace.sections()]
    return Lane(path, [(t, text) for t, _, text in sections], {text: SECTIONS[kind] for _, kind, text in sections})


def name_node_lane(node: int) -> str:
    """Path of the lane of a node.

    >>> name_node_lane(2)
    'node/2 controller'
    """
    return f"node/{node} {NAMES.get(node, '')}".strip()


def name_fault_lane(label: str) -> str:
    """Path of the lane of a fault."""
    return f"fault/{label}"


def read_fault_event(text: str) -> tuple[str, str] | None:
    """Label of a fault and its state from now on, from the text of an event of the kind "fault"; None for other texts.

    >>> read_fault_event("leakage begins"), read_fault_event("leakage ends"), read_fault_event("leakage")
    (('leakage', 'active'), ('leakage', ''), None)
    """
    label, _, word = text.rpartition(" ")
    return (label, ACTIVE if word == "begins" else "") if word in ("begins", "ends") else None


def list_fault_states(trace: Trace) -> dict[str, list[tuple[float, str]]]:
    """Label of each fault -> when it begins and ends, from the events of the run."""
    found: dict[str, list[tuple[float, str]]] = {}
    for event in trace.events:
        fault = read_fault_event(event.text) if event.kind == "fault" else None
        if fault:
            found.setdefault(fault[0], []).append((event.t, fault[1]))
    return found


def _make_check_lane(check: Check, trace: Trace) -> Lane:
    """A lane with the window of a check, failed checks first; grey is a window that the run did not reach.

    Verdict and value stand beside the window, on its longer side, because a window may be too short for a number; in
    the window if it has more room than either side.
    """
    unreached = math.isnan(check.t0) and math.isnan(check.value)
    main = trace.t[trace.phase == MAIN]
    whole = (float(main[0]), float(main[-1]) + trace.period) if len(main) else (float(trace.t[0]), float(trace.t[-1]))
    start, stop = whole if math.isnan(check.t0) else (check.t0, check.t1)
    word, colour = ("PASS", PASS) if check.passed else ("FAIL", NEUTRAL if unreached else FAIL)
    text = f"{word} {_describe_measurement(check)}"
    if math.isnan(check.value) and check.detail:
        text = f"{word} {_format_value(check)}: {check.detail}"
    path = f"check/{'pass' if check.passed else 'FAIL'}/{check.name}"
    first, last = float(trace.t[0]), float(trace.t[-1])
    if stop - start > max(start - first, last - stop):
        return Lane(path, [(start, text), (stop, "")], {text: colour})
    states = [(start, word), (stop, "")]
    if start - first > last - stop:
        states.insert(0, (first, text))
    else:
        states[-1] = (stop, text)
    return Lane(path, states, {text: VALUE, word: colour}, {word: " "})


def _describe_section(section: Section) -> str:
    if section.kind == "ramp":
        return f"ramp {section.rate * 1e3:.3g} mm/s"
    return section.kind if section.kind == "dynamic" else f"{section.kind} {section.last * 1e3:.3g} mm"


def _describe_measurement(check: Check) -> str:
    limits = " and ".join(f"{sign} {limit:.4g}" for sign, limit in (("≥", check.low), ("≤", check.high))
                          if not math.isnan(limit))
    return _format_value(check) + (f" (limit {limits})" if limits else "")


def _format_value(check: Check) -> str:
    if math.isnan(check.value):
        return "not measured"
    return f"{check.value:.4g}" + ("" if check.unit in ("", "1") else f" {check.unit}")


def _send_texts(rr: Any, stream: rr.RecordingStream, trace: Trace) -> None:
    for event in trace.events:
        stream.set_time(TIMELINE, duration=event.t)
        text = f"{event.t:8.3f} s  {event.kind}: {event.text}"
        stream.log("log/events", rr.TextLog(text, level=event.level))
    for check in trace.checks:
        t = check.t0 if not math.isnan(check.t0) else float(trace.t[-1])
        stream.set_time(TIMELINE, duration=t)
        verdict_word = "PASS" if check.passed else "FAIL"
        text = f"{t:8.3f} s  {verdict_word} {check.name}: {_describe_measurement(check)} {check.detail}"
        stream.log("log/checks", rr.TextLog(text.rstrip(), level="INFO" if check.passed else "ERROR"))
    facts = [f"{key}: {value}" for key, value in trace.provenance.items()]
    stream.log("log/provenance", rr.TextDocument("\n".join(f"- {fact}" for fact in facts), media_type="text/markdown"),
               static=True)


def _choose_axis(trace: Trace, plot: Plot) -> Any:
    """The timing view ends where nearly all cycles do: one long pause of the machine must not flatten the rest."""
    import rerun.blueprint as rrb

    drawn = [values for path, (_, values) in list_lines(trace).items() if path.startswith(f"{plot.origin}/")]
    if plot.origin == "timing":
        return rrb.ScalarAxis(range=(0.0, 1.5 * max(float(np.nanpercentile(values, 99.5)) for values in drawn)))
    return make_value_axis(drawn)


def _build_blueprint(trace: Trace) -> Any:
    there = {path.split("/")[0] for path in list_lines(trace)}
    plots = [make_plot_view(p, _choose_axis(trace, p)) for p in PLOTS if p.origin in there]
    lanes = 3 + len({state.node for state in trace.nmt}) + len(list_fault_states(trace))
    return arrange_run(plots, lanes, len(trace.sequence_checks))


def arrange_run(plots: list[Any], lanes: int, checks: int,
                play_state: Literal["paused", "following"] = "paused") -> Any:
    """The window of a run: plots in columns and the checks beside them, below them the other lanes and the texts.

    Args:
        plots: views of the plots.
        lanes: number of the lanes without the checks.
        checks: number of the checks.
        play_state: whether the viewer stands at the beginning, "paused", or follows new data, "following".
    """
    import_rerun()
    import rerun.blueprint as rrb
    from rerun.blueprint.encodings import TextLogColumn, TimelineColumn

    columns = rrb.TextLogColumns(timeline_columns=[TimelineColumn(TIMELINE, visible=False)],
                                 text_log_columns=[TextLogColumn("LogLevel"), TextLogColumn("Body")])
    texts = rrb.Tabs(rrb.TextLogView(contents=["/log/events", "/log/checks"], name=TEXTS, columns=columns),
                     rrb.TextDocumentView(origin="/log/provenance", name="Provenance"))
    signals: list[Any] = [rrb.Vertical(*plots[k:k + 2]) for k in range(0, len(plots), 2)]  # lower ones lack numbers
    widths = [1.0] * len(signals)
    if checks:
        signals.append(make_lanes_view(CHECKS, ["check"]))
        widths.append(1.3)
    share = min(measure_lanes_view(lanes), 0.4)
    return build_blueprint(
        rrb.Vertical(rrb.Horizontal(*signals, column_shares=widths),
                     rrb.Horizontal(make_lanes_view(LANES, LANE_GROUPS), texts, column_shares=[2, 3]),
                     row_shares=[1 - share, share]), play_state)
