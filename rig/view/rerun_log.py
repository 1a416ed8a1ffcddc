"""A run as a drawing for the viewer: its signals, limits, lanes and events, and a layout made for this bench."""
from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from fdi.report.run_report import read_verdict
from fdi.trace.sections import Section
from fdi.trace.trace import MAIN, Check, Trace
from rig.network.node_objects import NAMES
from rig.sequences.measures import SI_OF_UNIT
from rig.view.recording import (
    COMMAND,
    FAIL,
    LIMIT,
    MEASURED,
    NEUTRAL,
    PASS,
    TEXTS,
    Curve,
    Drawing,
    Floats,
    Lane,
    LogText,
    Plot,
)
from rig.view.viewer import ShownView

VERDICTS = {"PASS": PASS, "FAIL": FAIL, "ABORTED": FAIL, "INVALID_TIMING": 0xD9A441FF}
STATES = {"operational": PASS, "pre-operational": 0xD9A441FF, "stopped": FAIL, "boot-up": NEUTRAL}
PHASES = {"set-up": NEUTRAL, "main": MEASURED, "clean-up": NEUTRAL}
SECTIONS = {"hold": NEUTRAL, "step": MEASURED, "ramp": 0x2A8C82FF, "dynamic": 0x8E5BBFFF}
ACTIVE = {"active": FAIL}  # state of a fault
VALUE = 0x2B3138FF  # of the words beside the window of a check
LEVEL_COLOURS = (0x00DA7EFF, 0xAB0115FF)  # the viewer's colours of INFO and ERROR; WARN's stands in its menu too
LANES = "Faults, nodes, run"  # title of a view that is no plot
LIMITS = "limits"  # no view: the lines of the limits in all plots, of which some may lie behind a signal
LIMITS_OF = {"never_exceeds", "max_error"}  # kinds of check whose limits are limits of the plotted line


class RunLine(NamedTuple):
    """A line of a plot of a run: the signal, its scale from SI, and how it is shown."""

    signal: str
    scale: float
    path: str
    name: str
    colour: int
    width: float = 1.5


PLOTS = {  # origin, title -> lines
    ("position", "Position [mm]"): (RunLine("com", 1e3, "command", "Com command [mm]", COMMAND, 4.0),
                                    RunLine("xj", 1e3, "ram", "XJ ram [mm]", MEASURED)),
    ("error", "Following error [um]"): (RunLine("error", 1e6, "error", "Com - XJ [um]", 0xE8A33DFF),),
    ("current", "Current [mA]"): (RunLine("cor", 1e3, "current", "Cor current [mA]", 0xB57EDCFF),),
    ("pressure", "Differential pressure [bar]"): (
        RunLine("p12", 1e-5, "pressure", "P12 pressure [bar]", 0x45B8ACFF),),
    ("spool", "Spool position [um]"): (RunLine("xs", 1e6, "spool", "XS spool [um]", 0xD96BA0FF),),
    ("load", "Load on the ram [N]"): (RunLine("load", 1.0, "load", "load [N]", 0xD9A441FF),),
    ("timing", "Cycle timing [us]"): (
        RunLine("lateness", 1e6, "lateness", "SYNC lateness [us]", 0xF2C94CFF, 1.0),
        RunLine("response", 1e6, "response", "controller's response [us]", 0x7FD46BFF, 1.0),
        RunLine("work", 1e6, "work", "bench's own work [us]", 0x8C7AE6FF, 1.0)),
}


def draw_run(trace: Trace) -> Drawing:
    """Draw a trace; set-up has negative times, main starts at 0."""
    plots = [plot._replace(curves=[*plot.curves, *_list_limits(plot.origin, trace.checks)])
             for plot in draw_signals(list_columns(trace))]
    facts = "\n".join(f"- {key}: {value}" for key, value in trace.provenance.items())
    log = _list_texts(trace)
    shown = [ShownView(plot.title, tuple(curve.colour for curve in plot.curves if curve.colour != LIMIT))
             for plot in plots]
    lanes = {PASS, *SECTIONS.values(), *STATES.values(), *VERDICTS.values()}
    shown.append(ShownView(LANES, tuple(lanes), is_lanes=True))
    shown += [ShownView(TEXTS, LEVEL_COLOURS, 40)] if log else []  # one level in the list of events has some 60
    shown.append(ShownView(LIMITS, (LIMIT,), 0))
    name = trace.provenance.get("sequence", trace.provenance.get("source", "trace"))
    return Drawing(name, plots, LANES, [*_list_lanes(trace)], ("Provenance", facts), shown, log)


def list_columns(trace: Trace) -> dict[str, tuple[Floats, Floats]]:
    """Signal -> times, s, and values in SI; signals without a value are left out, and lateness that is 0 throughout."""
    timing = trace.timing
    columns = {name: (trace.t, trace.column(name)) for name in ("com", "xj", "cor", "p12", "xs", "load")}
    columns["error"] = trace.t, trace.com - trace.xj
    columns |= {name: (timing.t, getattr(timing, name)) for name in ("lateness", "response", "work")}
    return {name: (t, values) for name, (t, values) in columns.items() if not np.isnan(values).all()
            and (name not in ("load", "lateness") or np.nan_to_num(values).any())}  # in lockstep nothing is ever late


def draw_signals(columns: Mapping[str, tuple[Floats, Floats]]) -> list[Plot]:
    """The plots of the signals that there are."""
    plots = [Plot(origin, title, [
        Curve(line.path, line.name, line.colour, columns[line.signal][0], columns[line.signal][1] * line.scale,
              line.width) for line in lines if line.signal in columns]) for (origin, title), lines in PLOTS.items()]
    return [plot for plot in plots if plot.curves]


def _list_limits(origin: str, checks: tuple[Check, ...]) -> Iterator[Curve]:
    """Limits of a plotted signal as red lines over the check's window."""
    scales = {line.signal: line.scale for (own, _), lines in PLOTS.items() for line in lines if own == origin}
    for number, check in enumerate(checks):
        signal = "error" if check.kind == "max_error" else check.signal
        if check.kind in LIMITS_OF and signal in scales and not math.isnan(check.t0 + check.high):
            level = check.high * SI_OF_UNIT.get(check.unit, ("", 1.0))[1] * scales[signal]
            for name, sign in (("high", 1.0), ("low", -1.0)):  # both kinds judge the size of the signal
                yield Curve(f"limit_{number}_{name}", f"limit: {check.name}", LIMIT, np.array([check.t0, check.t1]),
                            np.full(2, sign * level))


def _list_lanes(trace: Trace) -> Iterator[Lane]:
    """Verdict, phase, sections of the command, each node's NMT state, each fault, each check over its window."""
    yield from list_verdict_lanes(trace, "run", 0.0)
    turns = np.flatnonzero(np.diff(trace.phase, prepend=-1))
    yield Lane("run/phase", [(float(trace.t[k]), [*PHASES][trace.phase[k]]) for k in turns], PHASES)
    yield make_command_lane(trace, "run", 0.0)
    for node in sorted({state.node for state in trace.nmt}):
        yield Lane(name_node_lane(node), [(s.t, s.name) for s in trace.nmt if s.node == node], STATES)
    yield from list_fault_lanes(trace, "fault/", 0.0)
    for check in trace.sequence_checks:
        yield _make_check_lane(check, trace)


def list_verdict_lanes(trace: Trace, group: str, offset: float) -> list[Lane]:
    """The verdict of a run, if it has one, `offset` s later than in the trace."""
    result = read_verdict(trace)
    return [Lane(f"{group}/verdict", [(float(trace.t[0]) + offset, str(result))], {str(result): VERDICTS[result.word]})
            ] if result.word in VERDICTS else []


def make_command_lane(trace: Trace, group: str, offset: float) -> Lane:
    """The sections of the command, `offset` s later than in the trace."""
    sections = [(float(trace.t[s.start]) + offset, s.kind, _describe_section(s)) for s in trace.sections()]
    return Lane(f"{group}/command", [(t, text) for t, _, text in sections],
                {text: SECTIONS[kind] for _, kind, text in sections})


def list_fault_lanes(trace: Trace, prefix: str, offset: float) -> list[Lane]:
    """When each fault begins and ends, from the events of the run, `offset` s later than in the trace."""
    found: dict[str, list[tuple[float, str]]] = {}
    for event in trace.events:
        fault = read_fault_event(event.text) if event.kind == "fault" else None
        if fault:
            found.setdefault(fault[0], []).append((event.t + offset, fault[1]))
    return [Lane(f"{prefix}{label}", states, ACTIVE) for label, states in found.items()]


def name_node_lane(node: int) -> str:
    """Path of the lane of a node.

    >>> name_node_lane(2)
    'node/2 controller'
    """
    return f"node/{node} {NAMES.get(node, '')}".strip()


def read_fault_event(text: str) -> tuple[str, str] | None:
    """Label of a fault and its state from now on, from the text of an event of the kind "fault"; None for other texts.

    >>> read_fault_event("leakage begins"), read_fault_event("leakage ends"), read_fault_event("leakage")
    (('leakage', 'active'), ('leakage', ''), None)
    """
    label, _, word = text.rpartition(" ")
    return (label, "active" if word == "begins" else "") if word in ("begins", "ends") else None


def _make_check_lane(check: Check, trace: Trace) -> Lane:
    """A lane with the window of a check, failed checks first; grey is a window that the run did not reach.

    Verdict and value stand beside the window, on its longer side, because a window may be too short for a number; in
    the window if it has more room than either side.
    """
    unreached = math.isnan(check.t0) and math.isnan(check.value)
    first, last = float(trace.t[0]), float(trace.t[-1])
    start, stop = check.t0, check.t1
    if math.isnan(start):
        main = trace.t[trace.phase == MAIN]
        start, stop = (float(main[0]), float(main[-1]) + trace.period) if len(main) else (first, last)
    word, colour = ("PASS", PASS) if check.passed else ("FAIL", NEUTRAL if unreached else FAIL)
    text = f"{word} {_describe_measurement(check)}"
    if math.isnan(check.value) and check.detail:
        text = f"{word} {describe_value(check.value, check.unit)}: {check.detail}"
    path = f"check/{'pass' if check.passed else 'FAIL'}/{check.name}"
    if stop - start > max(start - first, last - stop):
        return Lane(path, [(start, text), (stop, "")], {text: colour})
    states = [(first, text), (start, word), (stop, "")] if start - first > last - stop else [(start, word),
                                                                                             (stop, text)]
    return Lane(path, states, {text: VALUE, word: colour}, {word: " "})


def _describe_section(section: Section) -> str:
    if section.kind == "ramp":
        return f"ramp {section.rate * 1e3:.3g} mm/s"
    return section.kind if section.kind == "dynamic" else f"{section.kind} {section.last * 1e3:.3g} mm"


def _describe_measurement(check: Check) -> str:
    limits = " and ".join(f"{sign} {limit:.4g}" for sign, limit in (("≥", check.low), ("≤", check.high))
                          if not math.isnan(limit))
    return describe_value(check.value, check.unit) + (f" (limit {limits})" if limits else "")


def describe_value(value: float, unit: str) -> str:
    """What a check measured.

    >>> describe_value(7.44213, "%"), describe_value(math.nan, "um")
    ('7.442 %', 'not measured')
    """
    if math.isnan(value):
        return "not measured"
    return f"{value:.4g}" + ("" if unit in ("", "1") else f" {unit}")


def _list_texts(trace: Trace) -> list[LogText]:
    texts = [LogText("log/events", event.t, f"{event.t:8.3f} s  {event.kind}: {event.text}", event.level)
             for event in trace.events]
    for check in trace.checks:
        t = float(trace.t[-1]) if math.isnan(check.t0) else check.t0
        word, level = ("PASS", "INFO") if check.passed else ("FAIL", "ERROR")
        text = f"{t:8.3f} s  {word} {check.name}: {_describe_measurement(check)} {check.detail}".rstrip()
        texts.append(LogText("log/checks", t, text, level))
    return texts
