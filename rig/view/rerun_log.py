"""A trace as a rerun recording: columns sent whole, and a blueprint made for this bench."""
from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.output import require_writable
from fdi.report.run_verdict import read_verdict
from fdi.trace.sections import Section
from fdi.trace.trace import MAIN, Check, Trace
from plant.errors import RigError
from rig.sequences.units import SI_OF_UNIT

if TYPE_CHECKING:
    import rerun as rr

Floats = NDArray[np.float64]
TIMELINE = "run"
COMMAND, MEASURED, LIMIT, PASS, FAIL, NEUTRAL = 0xC9CFD6FF, 0x3D8FE0FF, 0xE5534BFF, 0x3FA65AFF, 0xE5534BFF, 0x6B7785FF
VERDICTS = {"PASS": PASS, "FAIL": FAIL, "ABORTED": FAIL, "INVALID_TIMING": 0xD9A441FF}
STATES = {"operational": PASS, "pre-operational": 0xD9A441FF, "stopped": FAIL, "boot-up": NEUTRAL}


class Line(NamedTuple):
    """One line of a plot."""

    path: str
    name: str
    colour: int
    width: float = 1.5


class Plot(NamedTuple):
    """One time-series view."""

    origin: str
    title: str
    lines: tuple[Line, ...]


PLOTS = (
    Plot("position", "Position [mm]", (Line("command", "Com command [mm]", COMMAND, 4.0),
                                       Line("ram", "XJ ram [mm]", MEASURED))),
    Plot("error", "Following error [um]", (Line("error", "Com - XJ [um]", 0xE8A33DFF),)),
    Plot("current", "Current [mA]", (Line("current", "Cor current [mA]", 0xB57EDCFF),)),
    Plot("pressure", "Differential pressure [bar]", (Line("pressure", "P12 pressure [bar]", 0x45B8ACFF),)),
    Plot("spool", "Spool position [um]", (Line("spool", "XS spool [um]", 0xD96BA0FF),)),
    Plot("timing", "Cycle timing [us]", (Line("lateness", "SYNC lateness [us]", 0xF2C94CFF, 1.0),
                                         Line("response", "controller's response [us]", 0x7FD46BFF, 1.0),
                                         Line("work", "bench's own work [us]", 0x8C7AE6FF, 1.0))),
)
SECTIONS = {"hold": NEUTRAL, "step": MEASURED, "ramp": 0x2A8C82FF, "dynamic": 0x8E5BBFFF}
LANES, TEXTS = "Verdict, phase, NMT states, checks", "Events and checks"  # titles of the views that are no plots
LANE_HEIGHT, LANES_SHARE = 0.039, (0.5, 0.78)  # a lane's and all lanes' least and most part of the window's height
SHOWN_IN = {"xj": ("position", 1e3), "com": ("position", 1e3), "error": ("error", 1e6), "cor": ("current", 1e3),
            "p12": ("pressure", 1e-5), "xs": ("spool", 1e6)}  # signal -> plot, scale from SI
LIMITS_OF = {"never_exceeds", "max_error"}  # kinds of check whose limits are limits of the plotted line


class ViewerError(RigError):
    """The viewer is not installed, or does not show what it should."""

    status = 1


def import_rerun() -> Any:
    """Import the rerun package. Raises ViewerError, which says how to install it."""
    try:
        import rerun as rr
    except ImportError as error:
        raise ViewerError("the viewer is not installed; to get it: pip install 'eha-rig[view]'") from error
    return rr


def write_rrd(trace: Trace, path: Path) -> None:
    """Write a trace with its blueprint as a rerun recording; set-up has negative times, main starts at 0.

    Raises ViewerError without rerun; InputError for a place that cannot be written.
    """
    rr = import_rerun()
    require_writable(path, "the recording")
    with rr.RecordingStream("eha-rig", recording_id=str(path.stem)) as stream:
        stream.save(path, default_blueprint=_build_blueprint(rr, trace))
        stream.send_recording_name(trace.provenance.get("sequence", trace.provenance.get("source", "trace")))
        _send_series(rr, stream, trace)
        _send_limits(rr, stream, trace.checks)
        _send_states(rr, stream, trace)
        _send_texts(rr, stream, trace)
        stream.flush()


def list_lines(trace: Trace) -> dict[str, tuple[Floats, Floats]]:
    """Path of each line -> times, s, and values in the plot's unit."""
    timing = trace.timing
    out = {"position/command": trace.com * 1e3, "position/ram": trace.xj * 1e3,
           "error/error": (trace.com - trace.xj) * 1e6, "current/current": trace.cor * 1e3,
           "pressure/pressure": trace.p12 * 1e-5, "spool/spool": trace.xs * 1e6}
    found = {path: (trace.t, values) for path, values in out.items()}
    found |= {f"timing/{name}": (timing.t, column * 1e6) for name, column in
              (("lateness", timing.lateness), ("response", timing.response), ("work", timing.work))}
    known = {path: (t, values) for path, (t, values) in found.items() if not np.isnan(values).all()}
    if not np.nan_to_num(timing.lateness).any():  # in lockstep nothing is ever late
        known.pop("timing/lateness", None)
    return known


def _send_series(rr: Any, stream: rr.RecordingStream, trace: Trace) -> None:
    for plot in PLOTS:
        for line in plot.lines:
            path = f"{plot.origin}/{line.path}"
            if path in list_lines(trace):
                t, values = list_lines(trace)[path]
                _send_line(rr, stream, path, line.name, line.colour, line.width, t, values)


def _send_line(rr: Any, stream: rr.RecordingStream, path: str, name: str, colour: int, width: float, t: Floats,
          values: Floats) -> None:
    line = rr.SeriesLines(colors=[colour], widths=[width], names=[name], aggregation_policy="MinMax")  # keeps the peaks
    stream.log(path, line, static=True)
    rr.send_columns(path, [rr.TimeColumn(TIMELINE, duration=t)], rr.Scalars.columns(scalars=values), recording=stream)


def _send_limits(rr: Any, stream: rr.RecordingStream, checks: tuple[Check, ...]) -> None:
    """Limits of a plotted signal as red lines over the check's window."""
    for number, check in enumerate(checks):
        if check.kind not in LIMITS_OF or math.isnan(check.t0):
            continue
        origin, shown = SHOWN_IN.get("error" if check.kind == "max_error" else check.signal, ("", 0.0))
        level = check.high * SI_OF_UNIT.get(check.unit, ("", 1.0))[1] * shown
        if origin and not math.isnan(level):  # both kinds judge the size of the signal
            for name, sign in (("high", 1.0), ("low", -1.0)):
                _send_line(rr, stream, f"{origin}/limit_{number}_{name}", f"limit: {check.name}", LIMIT, 1.5,
                      np.array([check.t0, check.t1]), sign * np.array([level, level]))


def _send_states(rr: Any, stream: rr.RecordingStream, trace: Trace) -> None:
    """Lanes: verdict, phase, sections of the command, each node's NMT state, each check over its window."""
    result, first = read_verdict(trace), float(trace.t[0])
    if result.word in VERDICTS:
        _send_lane(rr, stream, "0 verdict", [(first, str(result))], {str(result): VERDICTS[result.word]})
    names = np.array(["set-up", "main", "clean-up"])
    turns = np.flatnonzero(np.diff(trace.phase, prepend=-1))
    _send_lane(rr, stream, "1 phase", [(float(trace.t[k]), str(names[trace.phase[k]])) for k in turns],
          {"set-up": NEUTRAL, "main": MEASURED, "clean-up": NEUTRAL})
    sections = [(float(trace.t[s.start]), s.kind, _describe_section(s)) for s in trace.sections()]
    _send_lane(rr, stream, "2 command", [(t, text) for t, _, text in sections],
          {text: SECTIONS[kind] for _, kind, text in sections})
    for node in sorted({state.node for state in trace.nmt}):
        _send_lane(rr, stream, f"3 node {node} NMT", [(s.t, s.name) for s in trace.nmt if s.node == node], STATES)
    for number, check in enumerate(trace.sequence_checks, 1):
        _send_check_lane(rr, stream, number, check, trace)


def _send_check_lane(rr: Any, stream: rr.RecordingStream, number: int, check: Check, trace: Trace) -> None:
    """A lane with the window of a check, failed checks first; grey is a window that the run did not reach."""
    unreached = math.isnan(check.t0) and math.isnan(check.value)
    main = trace.t[trace.phase == MAIN]
    whole = (float(main[0]), float(main[-1]) + trace.period) if len(main) else (float(trace.t[0]), float(trace.t[-1]))
    start, stop = whole if math.isnan(check.t0) else (check.t0, check.t1)
    word, colour = f"FAIL {_format_value(check)}", NEUTRAL if unreached else FAIL
    if check.passed:
        word, colour = f"PASS {_format_value(check)}", PASS
    if math.isnan(check.value) and check.detail:
        word += f": {check.detail}"
    _send_lane(rr, stream, f"{5 if check.passed else 4}.{number:02} {check.name}", [(start, word), (stop, "")],
          {word: colour})


def _describe_section(section: Section) -> str:
    if section.kind == "ramp":
        return f"ramp {section.rate * 1e3:.3g} mm/s"
    return section.kind if section.kind == "dynamic" else f"{section.kind} {section.last * 1e3:.3g} mm"


def _send_lane(rr: Any, stream: rr.RecordingStream, name: str, states: list[tuple[float, str]],
          colours: dict[str, int]) -> None:
    path = f"states/{re.sub('[^A-Za-z0-9.]+', '_', name)}"
    if colours:
        stream.log(path, rr.StateConfiguration(values=list(colours), colors=np.array([*colours.values()], np.uint32)),
                   static=True)
    for t, state in states:
        stream.set_time(TIMELINE, duration=t)
        stream.log(path, rr.StateChange(state=state))


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


def _choose_axis(rrb: Any, trace: Trace, plot: Plot) -> Any:
    """The timing view ends where nearly all cycles do: one long pause of the machine must not flatten the rest."""
    if plot.origin != "timing":
        return None
    drawn = [values for path, (_, values) in list_lines(trace).items() if path.startswith("timing/")]
    return rrb.ScalarAxis(range=(0.0, 1.5 * max(float(np.nanpercentile(values, 99.5)) for values in drawn)))


def _build_blueprint(rr: Any, trace: Trace) -> Any:
    import rerun.blueprint as rrb
    from rerun.blueprint.encodings import TextLogColumn, TimelineColumn

    linked = rrb.TimeAxis(link="LinkToGlobal")
    there = {path.split("/")[0] for path in list_lines(trace)}
    plots = [rrb.TimeSeriesView(origin=f"/{p.origin}", name=p.title, axis_x=linked, axis_y=_choose_axis(rrb, trace, p),
                                plot_legend=rrb.PlotLegend("RightTop")) for p in PLOTS if p.origin in there]
    half = (len(plots) + 1) // 2
    columns = rrb.TextLogColumns(timeline_columns=[TimelineColumn(TIMELINE, visible=False)],
                                 text_log_columns=[TextLogColumn("LogLevel"), TextLogColumn("Body")])
    texts = rrb.Tabs(rrb.TextLogView(contents=["/log/events", "/log/checks"], name=TEXTS,
                                     columns=columns),
                     rrb.TextDocumentView(origin="/log/provenance", name="Provenance"))
    states = rrb.StateTimelineView(origin="/states", name=LANES, time_view=linked)
    nodes = {state.node for state in trace.nmt}
    lanes = 5 + len(nodes) + len(trace.sequence_checks)  # 5: three more, a time axis and a title
    share = min(max(LANE_HEIGHT * lanes, LANES_SHARE[0]), LANES_SHARE[1])
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(*plots[:half]), rrb.Vertical(*plots[half:]),
                       rrb.Vertical(states, texts, row_shares=[share, 1 - share])),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="paused"),
        rrb.BlueprintPanel(state="hidden"), rrb.SelectionPanel(state="hidden"))
