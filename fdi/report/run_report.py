"""The report of a run: verdict, checks, signals over time, cycle timing, events, NMT states, provenance."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdi.output import require_writable
from fdi.report.drawing import (
    AMBER,
    BLUE,
    COMMAND,
    FAULT,
    GREEN,
    GREY,
    INK,
    ORANGE,
    RED,
    VIOLET,
    Mark,
    Panel,
    axes,
    call,
    choose_colour,
    dot,
    draw_over_time,
    draw_panels,
    instant,
    label_signal,
    legend,
    level,
    levels,
    line,
    name_controlled,
    shade,
    spans,
)
from fdi.report.numbers import choose_unit, list_first
from fdi.report.report import (
    Cell,
    Column,
    Figure,
    Item,
    Line,
    Listing,
    Medium,
    Mood,
    Report,
    Section,
    Table,
    tabulate,
    write_html,
)
from fdi.trace import (
    CheckResult,
    Event,
    Floats,
    Trace,
    compute_speed,
    fill_gaps,
    filter_median,
    find_stretches,
)
from plant import EHA, UNITS, Signals, count_nouns

MOODS: dict[str, Mood] = {"PASS": "good", "FAIL": "bad", "INVALID_TIMING": "doubtful", "ABORTED": "bad",
                          "NOT_JUDGED": "doubtful", "CANNOT_TELL": "doubtful"}
DECISIONS = {"simple": "simple acceptance: by the value alone, U is not used",
             "guarded": "guard band of U at each limit",
             "shared": "shared risk: by the value alone, if U is small against the limits"}
_SKIPPED = "not_applicable."  # before the names of checks that do not apply to the bench, in the provenance
EVENT_MOODS: dict[str, Mood] = {"ERROR": "bad", "WARN": "doubtful"}
TIMES = {"SYNC lateness": "lateness", "controller's response": "response", "bench's own work": "work"}  # of `Timing`
KINDS_OF_TIMING = {"hard real time": "the rig's cycle ran as compiled code",
                   "soft real time": "the rig's cycle ran in Python, on a bus that compiled code cannot use"}


def write_run_page(source: str | Path, out: str | Path, signals: Signals = EHA) -> None:
    """Read a trace (see Trace.read) and write its report as one HTML file; `signals` are those of a CSV.

    Raises:
        InputError: a trace that cannot be read, or a file that cannot be written.
    """
    trace = Trace.read(source, all=True, signals=signals)
    write_html(build_run_report(trace), require_writable(out, "--out", source=source))


def build_run_report(trace: Trace) -> Report:
    """Report on a trace of `Trace.read(..., all=True)`: of a run with its checks, or of any other recording."""
    word, reason = read_verdict(trace)
    page = Medium.PAGE
    sections = [
        Section("First cause and consequences", _show_cause(trace), medium=page),
        Section("Checks", [_tabulate_checks(trace.sequence_checks, "check", Medium.BOTH)]),
        Section("Failed checks", _show_failed_checks(trace), medium=page),
        Section("Faults found by rig fdi", _show_diagnosis(trace), medium=page),
        Section("Protocol", [_tabulate_checks(trace.protocol_checks, "protocol check", page),
                             _tabulate_skipped(trace)]),
        Section("Signals", [Figure(
            "Command, controlled signal, following error, drive and other measured signals over time. "
            "Shaded: ramps (blue) and dynamic sections (violet) of the command, injected faults (orange). The bars at "
            "the bottom are the windows of the checks, green for passed, red for failed and amber for CANNOT_TELL; a "
            "check whose window was not reached has no bar.", partial(draw_signals, trace))]),
        Section("Cycle timing", _show_timing(trace), medium=page),
        Section("Events", _tabulate_events(trace.events)),
        Section("NMT states", [tabulate(
            trace.nmt, (Column("t", "s", "right"), lambda state: f"{state.t:.3f}"),
            (Column("node"), lambda state: str(state.node)), (Column("state"), lambda state: state.name))],
            medium=page),
        Section("Provenance", [
            tabulate([(name, text) for name, text in sorted(trace.provenance.items())
                      if not name.startswith(("cause.", "limits.", "fdi.", "differences.", _SKIPPED))],
                     (Column(""), lambda row: Cell(row[0], "muted")), (Column(""), lambda row: row[1]), is_list=True),
            *(Listing(data.decode("utf-8", "replace"), f"{name} ({len(data)} bytes)")
              for name, data in sorted(trace.attachments.items()))], medium=page)]
    return Report("run", trace.provenance.get("sequence", trace.provenance.get("source", "trace")), word,
                  MOODS.get(word, "neutral"),
                  reason or ("Every check passed." if trace.checks else "The trace has no checks."),
                  _list_facts(trace), _list_notes(trace), sections)


def _list_facts(trace: Trace) -> list[tuple[str, str]]:
    main, notes = int((trace.phase == 1).sum()), trace.provenance
    groups = (("checks passed", trace.sequence_checks), ("protocol checks passed", trace.protocol_checks))
    counts = [(name, f"{sum(check.passed for check in checks)} of {len(checks)}") for name, checks in groups if checks]
    kind = notes.get("timing.kind", "")
    why = notes.get("timing.reason") or KINDS_OF_TIMING.get(kind)
    facts = [("main phase", f"{main * trace.period:.3f} s, {main} cycles"), *counts,
             *((name, notes.get(name, "")) for name in ("model", "seed", "bus", "pace", "started", "host")),
             ("differs from nominal", notes.get("differences.text", "")),
             ("decision rule", DECISIONS.get(notes.get("metrology.decision", ""), "")),
             ("timing", f"{kind}: {why}" if kind in KINDS_OF_TIMING else "")]
    return [(name, text) for name, text in facts if text]


def _show_cause(trace: Trace) -> list[Item]:
    """The first cause of trouble with its evidence, and what followed from it; nothing without trouble."""
    notes = trace.provenance
    if not notes.get("cause.text"):
        return []
    consequences = [each for each in _read_list(notes.get("cause.consequences", "")) if isinstance(each, dict)]
    return [Line("first cause", f"t = {notes.get('cause.t', '?')} s: {notes['cause.text']}", "bad"),
            Line("who", notes.get("cause.source", "")),
            *(Line("evidence", str(text)) for text in _read_list(notes.get("cause.evidence", ""))), tabulate(
        consequences, (Column("t", "s", "right"),
                       lambda each: f"{each['t']:.3f}" if isinstance(each.get("t"), float | int) else ""),
        (Column("node"), lambda each: str(each.get("source", ""))),
        (Column("consequence"), lambda each: str(each.get("text", ""))),
        caption="What was reported afterwards and follows from the first cause.")]


def _read_list(text: str) -> list[Any]:
    """A list in JSON; empty for another text, for a log may come from another program."""
    try:
        entries = json.loads(text)
    except (ValueError, RecursionError):
        return []
    return entries if isinstance(entries, list) else []


def _show_diagnosis(trace: Trace) -> list[Item]:
    """What `rig fdi` found, if the run was asked for it."""
    word, sentence, faults = (trace.provenance.get(f"fdi.{key}", "") for key in ("verdict", "sentence", "faults"))
    moods: dict[str, Mood] = {"ACCEPTABLE": "good", "CANNOT_TELL": "doubtful"}  # all others fail the run
    return [Line(word, sentence, moods.get(word, "bad")), Line("faults", faults)] if word else []


def _list_notes(trace: Trace, most: int = 5) -> list[str]:
    """What a reader must know before trusting the plots: of missing cycles the first `most` gaps, missing samples."""
    rest = trace.gaps[most:]
    names_of_count: dict[int, list[str]] = {}
    load = trace.declared.load  # which is known or not, never sampled
    for name in (name for name in trace.signals if load is None or name != load.name):
        names_of_count.setdefault(int(np.isnan(trace.column(name)).sum()), []).append(name)
    parts = [f"{count} of {', '.join(names)}" for count, names in names_of_count.items() if count]
    limits = [text for name, text in sorted(trace.provenance.items()) if name.startswith("limits.")]
    recovered = trace.provenance.get("recovered.reason")
    return [*trace.notes,
            *(f"{count_nouns(gap.cycles, 'cycle')} missing between {gap.t0:.3f} and {gap.t1:.3f} s"
              for gap in trace.gaps[:most]),
            *([f"and {count_nouns(sum(gap.cycles for gap in rest), 'cycle')} in {count_nouns(len(rest), 'more gap')}"]
              if rest else []),
            *([f"missing samples (red on the page): {'; '.join(parts)} (of {len(trace)})"] if parts else []),
            *([f"limits reached: {'; '.join(limits)}"] if limits else []),
            *([] if recovered is None else [f"this log was salvaged after its writer died: {recovered}"])]


def _tabulate_checks(checks: Sequence[CheckResult], heading: str, remark: Medium) -> Table:
    """The checks of a sequence, or the protocol checks, which judge the whole run."""
    page = Medium.PAGE
    is_windowed, is_uncertain = heading == "check", any(check.uncertainty < math.inf for check in checks)
    columns = [
        (True, Column(heading), lambda check: check.name),
        (is_windowed, Column("kind", medium=page), lambda check: Cell(_name_measure(check), "muted")),
        (True, Column(""), lambda check: Cell(check.verdict.replace("PASS", "pass"), MOODS[check.verdict])),
        (True, Column("measured", align="right"), lambda check: Cell(check.shown_value, is_strong=True)),
        (is_uncertain, Column("U", align="right"), lambda check: check.shown_uncertainty),
        (True, Column("limits", align="right"), lambda check: check.shown_limits),
        (True, Column("unit"), lambda check: check.unit_behind.strip()),
        (is_windowed, Column("window", medium=page), lambda check: Cell(_format_window(check), "muted")),
        (any(check.requirement for check in checks), Column("requirement"), lambda check: check.requirement),
        (any(check.detail for check in checks), Column("remark", medium=remark),
         lambda check: Cell(check.detail, "muted"))]
    caption = "U: expanded uncertainty of the measured number (k = 2, about 95 %)." if is_uncertain else ""
    return tabulate(checks, *((column, show) for is_shown, column, show in columns if is_shown), caption=caption)


def _tabulate_skipped(trace: Trace) -> Table:
    """The protocol checks that do not apply to the bench of the run."""
    return tabulate(
        [(name.removeprefix(_SKIPPED), why) for name, why in trace.provenance.items() if name.startswith(_SKIPPED)],
        (Column("not applicable"), lambda row: row[0]), (Column("reason"), lambda row: Cell(row[1], "muted")))


def _show_failed_checks(trace: Trace, most: int = 12) -> list[Item]:
    """A close-up of each of the first `most` failed checks that have a window and a signal."""
    checks = [check for check in trace.sequence_checks if check.verdict == "FAIL" and not math.isnan(check.t0)]
    return [Figure(f"{check.name}: {_name_measure(check)}, "
                   f"{check.detail if math.isnan(check.value) else f'{check.measured} measured'}, limit "
                   f"{check.shown_limits}{check.unit_behind}. Dashed: limits; red: what was measured.",
                   partial(draw_failed_check, trace, check, f"check{number}"))
            for number, check in enumerate(checks[:most])]


def _name_measure(check: CheckResult) -> str:
    """What a check measures: "steady error of xj", "largest size of cor", "number of EMCY events"."""
    if check.kind in ("event_occurs", "event_never"):
        return f"number of {check.signal} events" if check.signal else "number of events"
    quantity = {"never_exceeds": "largest size", "response_within": "response time"}.get(check.kind)
    return " of ".join(filter(None, (quantity or check.kind.replace("_", " "), check.signal)))


def _format_window(check: CheckResult) -> str:
    if math.isnan(check.t0):
        return "not reached" if math.isnan(check.value) else "whole run"
    return f"{check.t0:.3f} – {check.t1:.3f} s"


def _show_timing(trace: Trace) -> list[Item]:
    series = ((name, getattr(trace.timing, field)) for name, field in TIMES.items())
    times = [(name, values[~np.isnan(values)] * 1e6) for name, values in series if not np.isnan(values).all()]
    if not times:
        return []
    columns = [Column("wall clock"), *(Column(name, "us", "right") for name in ("p50", "p99", "p99.9", "max"))]
    return [Figure("Number of cycles by duration, both axes logarithmic; the dotted line is the 99th percentile.",
                   partial(draw_timing, trace)),
            Table(columns, [[name, *(f"{x:.0f}" for x in np.percentile(values, [50, 99, 99.9, 100]))]
                            for name, values in times], "p99 is the time that 99 of 100 cycles stay below."),
            Line("overruns", f"{int(trace.timing.overrun.sum())} of {len(trace.timing.t)}")]


def _tabulate_events(events: Sequence[Event], most: int = 12, most_on_page: int = 2000) -> list[Item]:
    """The events on the page; warnings and errors on the terminal.

    A node can send a thousand a second: equal ones are a line, in the place of the first.
    """
    equal: dict[tuple[str, ...], list[Event]] = {}
    for event in events:
        equal.setdefault(event[1:], []).append(event)
    events = [group[0] if len(group) == 1 else group[0]._replace(
        text=f"{group[0].text} ({len(group)} times, the last at {group[-1].t:.3f} s)") for group in equal.values()]
    columns = ((Column("t", "s", "right"), lambda event: f"{event.t:.3f}"),
               (Column("level", medium=Medium.PAGE), lambda event: Cell(event.level, EVENT_MOODS.get(event.level, ""))),
               (Column("kind"), lambda event: event.kind), (Column("event"), lambda event: event.text))
    return [tabulate(events[:most_on_page], *columns, medium=Medium.PAGE,
                     caption=f"The first {most_on_page} of {len(events)} events."
                     if len(events) > most_on_page else ""),
            tabulate([event for event in events if event.level != "INFO"], *columns, terminal_rows=most,
                     medium=Medium.TERMINAL)]


class Verdict(NamedTuple):
    """The result of a run."""

    word: str  # PASS, FAIL, CANNOT_TELL, INVALID_TIMING, ABORTED; NOT_JUDGED without checks
    why: str  # the reason; empty if the run passed

    def __str__(self) -> str:
        return f"{self.word}: {self.why}" if self.why else self.word


def read_verdict(trace: Trace) -> Verdict:
    """The verdict in the log of the run; of a trace without one (recovered, CSV) that of its checks."""
    notes = trace.provenance
    failed_names = [check.name for check in trace.checks if check.verdict == "FAIL"]
    words = {check.verdict for check in trace.checks}
    default_word = next((word for word in ("FAIL", "CANNOT_TELL", "PASS") if word in words), "NOT_JUDGED")
    word, why = notes.get("verdict.verdict") or default_word, notes.get("verdict.why", "")
    match word:
        case "INVALID_TIMING":
            why = notes.get("verdict.timing", why)
        case "FAIL" if failed_names and not why:
            why = f"{len(failed_names)} of {len(trace.checks)} checks failed: {list_first(failed_names, 4)}"
        case "FAIL" if not why:
            why = "the checks passed, but the run did not end as the sequence says"
    return Verdict(word, why)


BRIDGED = 5  # cycles
CHECK_COLOURS = {"PASS": GREEN, "FAIL": RED, "CANNOT_TELL": AMBER}


def draw_signals(trace: Trace) -> str:
    """Command and controlled signal, error, drive, other outputs and load over one time axis, with sections and checks.
    """
    d, t, error, half = trace.declared, trace.t, trace.command - trace.controlled, _choose_close_up(trace)
    size, fine = choose_unit(d.controlled.unit, 0.0)
    plots = [(trace.controlled, f"{name_controlled(d)} [{d.controlled.shown_unit}]", d.controlled.shown_scale, BLUE),
             (error, f"error [{fine}]", 1.0 / size, ORANGE),
             (error if half else np.full_like(error, math.nan), f"error, close up [{fine}]", 1.0 / size, ORANGE),
             (trace.drive, f"{d.drive.phrase} [{d.drive.shown_unit}]", d.drive.shown_scale, VIOLET),
             *((trace.column(s.name), label_signal(s), s.shown_scale, choose_colour(d, s.name)) for s in d.outputs[1:]),
             *([(trace.load, label_signal(d.load), d.load.shown_scale, GREY)]
               if d.load and np.nan_to_num(trace.load).any() else [])]
    faults = list_faults(trace)
    legends = f"{d.controlled.symbol}, {d.controlled.phrase}", f"{d.command.symbol}, command"
    panels = [[line(t, _bridge_short_gaps(values) * scale, colour, None if number else legends[0]),
               _mark_missing(trace, values), *(shade(t0, t1, FAULT, 0.5) for _, t0, t1 in faults),
               axes(ylabel=label, **{"ylim": (-half * scale, half * scale)} if number == 2 else {})]
              for number, (values, label, scale, colour) in enumerate(plots)
              if number == 0 or not np.isnan(values).all()]  # the first one has the command
    panels[0] = [line(t, trace.command * d.command.shown_scale, COMMAND, legends[1], 2.4), *panels[0], legend(2),
                 call("margins", y=0.13),  # room for the names of faults above the lines
                 *(call("annotate", f" {fault}", (t0, 0.92), xycoords=("data", "axes fraction"), fontsize=7)
                   for fault, t0, _ in faults)]
    checks = trace.sequence_checks
    heights = [1.7] * len(panels) + [0.15 * len(checks) + 0.25] * bool(checks)
    return draw_over_time("signals", trace, [*panels, *([_draw_checks(trace)] if checks else [])], heights, gap=0.12,
                          xlabel="time from the start of the main phase [s]")


def list_faults(trace: Trace) -> list[tuple[str, float, float]]:
    """The faults that the run injected: name, begin and end in s; one that never ends lasts to the end of the trace."""
    starts: dict[str, float] = {}
    faults = []
    for event in trace.events:
        name, _, word = event.text.rpartition(" ")
        if event.kind == "fault" and word == "begins":
            starts[name] = event.t
        elif event.kind == "fault" and name in starts:
            faults.append((name, starts.pop(name), event.t))
    return faults + [(name, t0, float(trace.t[-1])) for name, t0 in starts.items()]


def draw_timing(trace: Trace) -> str:
    """Histograms of lateness, response and work; "" for a trace without timing."""
    shortest_time = 0.1  # us, the left end of a histogram: the resolution of the clock
    panels: list[Panel] = []
    for (name, field), colour in zip(TIMES.items(), (BLUE, ORANGE, GREY), strict=True):
        values = getattr(trace.timing, field)
        if (values > 0).any():
            times = np.maximum(values[~np.isnan(values)] * 1e6, shortest_time)
            bins = np.logspace(math.log10(times.min()), math.log10(max(float(times.max()), 1.0)) + 0.02, 60)
            panels.append([call("hist", times, bins=bins.tolist(), color=colour, log=True, histtype="stepfilled"),
                           instant(float(np.percentile(times, 99)), INK, width=0.8, style=":"),
                           axes(xscale="log", xlabel=f"{name} [us]",
                                ylabel="" if panels else "cycles (dotted: p99)")])
    if not panels:
        return ""
    return draw_panels("timing", [panels], 2.5, layout=None, gridspec_kw={
        "left": 0.08, "right": 0.99, "top": 0.96, "bottom": 0.2, "wspace": 0.16})


def _bridge_short_gaps(values: Floats) -> Floats:
    """Straight lines over up to BRIDGED missing samples: single samples between gaps would be invisible."""
    shown = fill_gaps(values)
    for first, stop in find_stretches(np.isnan(values)):
        if stop - first > BRIDGED or first == 0 or stop == len(values):
            shown[first:stop] = np.nan
    return shown


def _mark_missing(trace: Trace, values: Floats, columns: int = 1400) -> Mark:
    """A red mark at the foot of the panel in each of so many columns in which samples are missing."""
    starts = np.linspace(0, len(values), min(columns, len(values)) + 1).astype(int)
    is_missing = np.logical_or.reduceat(np.isnan(values), starts[:-1])
    ends = [(float(trace.t[starts[a]]), float(trace.t[starts[b] - 1]) + trace.period)
            for a, b in find_stretches(is_missing)]
    return spans(ends, RED, 0.04, lw=0.5, zorder=3)


def _choose_close_up(trace: Trace) -> float:
    """Half the height, SI, that shows the error on the ramps well; 0 without ramps. Steps dwarf it."""
    ramps = [np.abs(trace.command - trace.controlled)[s.start:s.stop] for s in trace.sections() if s.kind == "ramp"]
    error = np.concatenate([np.empty(0), *ramps])
    return 0.0 if np.isnan(error).all() else 2.0 * float(np.nanpercentile(error, 99))


def _draw_checks(trace: Trace) -> Panel:
    """A bar for each check over its window, green or red, with its name beside it; only a name where there is none."""
    first, last = float(trace.t[0]), float(trace.t[-1])
    room, far = 0.005 * (last - first), 0.25 * (last - first)
    panel = [axes(ylim=(len(trace.sequence_checks) - 0.4, -0.6), yticks=[], ylabel="checks")]
    bars: list[tuple[float, float, float, str]] = []
    for row, check in enumerate(trace.sequence_checks):
        t0, t1 = (first, last) if math.isnan(check.t0) else (check.t0, check.t1)
        name, x, side, colour = check.name, t0 + room, "left", "white"
        if math.isnan(check.t0) and math.isnan(check.value):
            name, colour = f"{check.name}: not measured", RED
        else:
            bars.append((row, t1 - t0, t0, CHECK_COLOURS[check.verdict]))
            if last - t1 > far:
                x, colour = t1 + room, INK
            elif t0 - first > far:
                x, side, colour = t0 - room, "right", INK
        panel.append(call("text", x, row, name, va="center", ha=side, color=colour, fontsize=7, clip_on=True))
    rows, widths, lefts, colours = zip(*bars, strict=True) if bars else ((),) * 4
    return [*panel, call("barh", rows, widths, left=lefts, height=0.7, color=colours)]


UNIT_SIZES = {name: float(unit.factor) for name, unit in UNITS.items()}
Place = Callable[[float, str, str, float, str], Sequence[Mark]]  # of a number: colour, label, width and style of lines


class _View(NamedTuple):
    """The rows of a check, which its close-up shows."""

    trace: Trace
    check: CheckResult
    rows: slice

    @property
    def shown(self) -> Trace:
        """The trace of these rows alone."""
        return self.trace.take_rows(self.rows)

    def read(self, name: str) -> Floats:
        """A signal over the window; `error` is command less controlled signal, `speed` that of the latter over 20 ms.
        """
        trace = self.trace
        if name in trace.columns:
            return trace.column(name)[self.rows]
        if name == "speed":
            return compute_speed(trace.controlled, 1.0 / trace.period)[self.rows]
        return (trace.command - trace.controlled)[self.rows]

    @property
    def known(self) -> tuple[str, ...]:
        return (*self.trace.declared.names, "error", "speed")

    def find_unit(self, name: str) -> str:
        """The unit in which a signal, `error` or `speed` is shown."""
        d = self.trace.declared
        if name in self.trace.columns:
            return d.find(name).shown_unit
        return {"error": choose_unit(d.controlled.unit, 0.0)[1], "speed": f"{d.controlled.shown_unit}/s"}[name]

    @property
    def step(self) -> tuple[float, float]:
        """Demand before the window, and what the step adds to it."""
        command = self.trace.command
        before = float(command[self.rows.start - 1] if self.rows.start else fill_gaps(self.trace.controlled)[0])
        return before, float(command[self.rows.stop - 1]) - before

    def to_seconds(self, value: float) -> float:
        """A time in the unit of the check."""
        return value * UNIT_SIZES.get(self.check.unit, 1.0)

    @property
    def longest(self) -> float:
        """The longest of the measured time and its limits, s; 0 without any."""
        values = (x for x in (self.check.value, self.check.high, self.check.low) if not math.isnan(x))
        return max((abs(self.to_seconds(x)) for x in values), default=0.0)


def draw_failed_check(trace: Trace, check: CheckResult, salt: str = "check") -> str:
    """The window of a check with its limits and what was measured; "" for a check without window or signal.

    Sizes are horizontal lines in the unit of the check, times are vertical ones after the instant from which they
    count. `salt` keeps the ids of the figure apart from those of other figures of the page.
    """
    draw = DRAWERS.get(check.kind)
    if draw is None or math.isnan(check.t0):
        return ""
    first, stop = np.searchsorted(trace.t, [check.t0 - 0.5 * trace.period, check.t1 - 0.5 * trace.period])
    view = _View(trace, check, slice(int(first), int(stop)))
    if stop - first < 2 or (draw is not _draw_reaction and check.signal and (
            check.signal not in view.known or np.isnan(view.read(check.signal)).all())):
        return ""
    if draw is _draw_step and abs(view.step[1]) <= 1e-6 * trace.scale:
        draw = _draw_response
    return draw_panels(salt, [[[axes(xlim=(check.t0, check.t1), xlabel="time [s]"), *draw(view), legend(6)]]], 2.3)


def _draw_step(view: _View) -> Panel:
    """What is left of a step, % of it: the overshoot at its peak, or the times of rising and of settling."""
    check, t, (before, size) = view.check, view.shown.t, view.step
    filtered = filter_median(fill_gaps(view.shown.controlled), 1.0 / view.trace.period)  # as the check did
    beyond = 100.0 * ((filtered - before) / size - 1.0)
    panel = [line(t, beyond, BLUE, f"{view.trace.declared.controlled.symbol} less the target", 1.2),
             axes(ylabel="beyond the\ntarget [%]")]
    if check.kind == "overshoot":
        row = int(np.nanargmax(beyond))
        high = 1.5 * max(float(beyond[row]), np.nan_to_num(check.high))
        return [*panel, *_draw_lines(check, lambda y, *style: [level(y, *style)]), dot(t[row], beyond[row], RED),
                axes(ylim=(-high, high), xlim=(t[0], min(t[-1], t[0] + max(0.06, 4.0 * (t[row] - t[0])))))]
    is_rise = check.kind == "rise_time"
    start = next(iter(t[beyond >= -90.0]), t[0]) if is_rise else t[0]
    return [*panel, *_draw_times(view, start), axes(ylim=(-110.0 if is_rise else -25.0, 25.0), xlim=(
        t[0], min(t[-1], start + 3.0 * view.longest)))]


def _draw_size(view: _View) -> Panel:
    """Position error or a signal with its limits and the measured mean, RMS, band or largest size.

    They stand on both sides of zero; around the middle of the band at break-away.
    """
    check, is_error, d, t = view.check, view.check.kind != "never_exceeds", view.trace.declared, view.shown.t
    name = "error" if is_error else check.signal
    values = view.read(name) / UNIT_SIZES.get(check.unit, 1.0)
    filtered = filter_median(fill_gaps(values), 1.0 / view.trace.period) if is_error else values
    middle = 0.5 * float(np.nanpercentile(filtered, (1, 99)).sum()) if check.kind == "break_away" else 0.0
    row = int(np.nanargmax(np.abs(filtered)))
    return [line(t, values, BLUE, f"error, {d.command.symbol} - {d.controlled.symbol}" if is_error else name, 0.9),
            *_draw_lines(check, partial(levels, middle=middle)), axes(ylabel=f"{name} [{check.unit}]"),
            *([dot(t[row], filtered[row], RED)] if check.kind in ("max_error", "never_exceeds") else [])]


def _draw_response(view: _View) -> Panel:
    """Demand and position; for a gain also the amplitudes that the limits allow, and the measured one."""
    d, window = view.trace.declared, view.shown
    scale, com = d.controlled.shown_scale, d.controlled.shown_scale * window.command
    middle, amplitude = 0.5 * (np.nanmax(com) + np.nanmin(com)), 0.5 * (np.nanmax(com) - np.nanmin(com))

    def place(value: float, colour: str, label: str, width: float, style: str) -> list[Mark]:
        if view.check.kind != "amplitude_ratio":  # all others have no height here
            return [line([], [], colour, label, ls=style)]
        return levels(value * amplitude, colour, label, width, style, middle)

    return [line(window.t, com, COMMAND, d.command.symbol, 1.6),
            line(window.t, scale * window.controlled, BLUE, d.controlled.symbol), *_draw_lines(view.check, place),
            axes(ylabel=f"{name_controlled(d)} [{d.controlled.shown_unit}]")]


def _draw_reaction(view: _View) -> Panel:
    """The signal, or the current where the check is about none, around the instant from which the reaction counts.

    From half its longest time before that instant to three times that after it; where it did not come, ten times.
    """
    check, trace = view.check, view.trace
    name = check.signal if check.signal in view.known else trace.declared.drive.name
    unit, least = view.find_unit(name), 0.02  # s after the instant that are shown
    size = UNIT_SIZES.get(unit, 1.0)
    after = max((10.0 if math.isnan(check.value) else 3.0) * view.longest, least)
    first, stop = np.searchsorted(trace.t, [check.after - 0.5 * max(view.longest, least), check.after + after])
    rows = slice(int(first), int(stop)) if stop - first > 1 else view.rows
    t = trace.t[rows]
    begin = "clean-up begins" if check.kind == "recovers" else f"from {check.after:g} s"
    bounds = ((x / size, word) for x, word in ((check.above, "above"), (check.below, "below")))
    return [line(t, view._replace(rows=rows).read(name) / size, BLUE, name, 1.2),
            instant(check.after, COMMAND, begin, 1.2, ":"),
            *(level(x, COMMAND, f"{word} {x:g} {unit}", 1.2, "--") for x, word in bounds if not math.isnan(x)),
            *_draw_times(view, check.after), axes(xlim=(t[0], t[-1]), ylabel=f"{name} [{unit}]")]


def _draw_times(view: _View, start: float) -> list[Mark]:
    """The limits and the measured time as vertical lines, s after `start`."""
    return _draw_lines(view.check, lambda x, *style: [instant(start + view.to_seconds(x), *style)])


def _draw_lines(check: CheckResult, place: Place) -> list[Mark]:
    """The limits, dashed, and the measured value where `place` puts them; a word where nothing was measured."""
    lines = ((check.low, AMBER, f"least {check.low:g}{check.unit_behind}", "--"),
             (check.high, AMBER, f"most {check.high:g}{check.unit_behind}", "--"),
             (check.value, RED, f"measured {check.measured}", "-"))
    unmeasured = [line([], [], INK, check.measured, ls="")] if math.isnan(check.value) else []
    return [*(mark for x, colour, label, style in lines if not math.isnan(x)
              for mark in place(x, colour, label, 1.4, style)), *unmeasured]


DRAWERS: Mapping[str, Callable[[_View], Panel]] = {
    **dict.fromkeys(("overshoot", "rise_time", "settling_time"), _draw_step),
    **dict.fromkeys(("steady_error", "ramp_error", "max_error", "rms_error"), _draw_size),
    **dict.fromkeys(("break_away", "never_exceeds"), _draw_size),
    **dict.fromkeys(("amplitude_ratio", "phase_lag"), _draw_response),
    **dict.fromkeys(("response_within", "shut_off", "recovers"), _draw_reaction)}
