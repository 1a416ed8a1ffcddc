"""The report of a run: verdict, checks, signals over time, cycle timing, events, NMT states, provenance."""
from __future__ import annotations

import json
import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdi.output import require_writable
from fdi.report.html import write_html
from fdi.report.numbers import list_first
from fdi.report.report import Cell, Column, Figure, Item, Line, Listing, Medium, Mood, Report, Section, Table, tabulate
from fdi.report.run_figures import draw_failed_check, draw_signals, draw_timing
from fdi.trace.trace import Check, Event, Trace

MOODS: dict[str, Mood] = {"PASS": "good", "FAIL": "bad", "INVALID_TIMING": "doubtful", "ABORTED": "bad",
                          "NOT_JUDGED": "doubtful"}
EVENT_MOODS: dict[str, Mood] = {"ERROR": "bad", "WARN": "doubtful"}
KINDS_OF_TIMING = {"hard real time": "the rig's cycle ran as compiled code",
                   "soft real time": "the rig's cycle ran in Python, on a bus that compiled code cannot use"}


def write_run_page(source: str | Path, out: str | Path) -> None:
    """Read a trace (see Trace.read) and write its report as one HTML file.

    Raises:
        InputError: a trace that cannot be read, or a file that cannot be written.
    """
    trace = Trace.read(source, all=True)
    write_html(build_run_report(trace), require_writable(out, "--out", source=source))


def build_run_report(trace: Trace) -> Report:
    """Report on a trace of `Trace.read(..., all=True)`: of a run with its checks, or of any other recording."""
    word, reason = read_verdict(trace)
    page = Medium.PAGE
    sections = [
        Section("First cause and consequences", _show_cause(trace), medium=page),
        Section("Checks", [_tabulate_checks(trace.sequence_checks, "check", Medium.BOTH)]),
        Section("Failed checks", _show_failed_checks(trace), medium=page),
        Section("Servovalve", _show_diagnosis(trace), medium=page),
        Section("Protocol", [_tabulate_checks(trace.protocol_checks, "protocol check", page)]),
        Section("Signals", [Figure(
            "Command, ram position, following error, current, pressure difference and spool position over time. "
            "Shaded: ramps (blue) and dynamic sections (violet) of the command, injected faults (orange). The bars at "
            "the bottom are the windows of the checks, green for passed and red for failed; a check whose window was "
            "not reached has no bar.", partial(draw_signals, trace))]),
        Section("Cycle timing", _show_timing(trace), medium=page),
        Section("Events", _tabulate_events(trace.events)),
        Section("NMT states", [tabulate(
            trace.nmt, (Column("t", "s", "right"), lambda state: f"{state.t:.3f}"),
            (Column("node"), lambda state: str(state.node)), (Column("state"), lambda state: state.name))],
            medium=page),
        Section("Provenance", [
            tabulate([(name, text) for name, text in sorted(trace.provenance.items())
                      if not name.startswith(("cause.", "limits.", "fdi.", "differences."))],
                     (Column(""), lambda row: Cell(row[0], "muted")), (Column(""), lambda row: row[1]), is_list=True),
            *(Listing(data.decode("utf-8", "replace"), f"{name} ({len(data)} bytes)")
              for name, data in sorted(trace.attachments.items()))], medium=page)]
    return Report("run", trace.provenance.get("sequence", trace.provenance.get("source", "trace")), word,
                  MOODS.get(word, "neutral"),
                  reason or ("Every check passed." if trace.checks else "The trace has no checks."),
                  _list_facts(trace), _list_notes(trace), sections)


def _list_facts(trace: Trace) -> list[tuple[str, str]]:
    main, notes = int((trace.phase == 1).sum()), trace.provenance
    judged = (("checks passed", trace.sequence_checks), ("protocol checks passed", trace.protocol_checks))
    passed = [(name, f"{sum(check.passed for check in checks)} of {len(checks)}") for name, checks in judged if checks]
    kind = notes.get("timing.kind", "")
    why = notes.get("timing.reason") or KINDS_OF_TIMING.get(kind)
    facts = [("main phase", f"{main * trace.period:.3f} s, {main} cycles"), *passed,
             *((name, notes.get(name, "")) for name in ("model", "seed", "bus", "pace", "started", "host")),
             ("differs from nominal", notes.get("differences.text", "")),
             ("timing", f"{kind}: {why}" if kind in KINDS_OF_TIMING else "")]
    return [(name, text) for name, text in facts if text]


def _show_cause(trace: Trace) -> list[Item]:
    """The first cause of trouble with its evidence, and what followed from it; nothing without trouble."""
    notes = trace.provenance
    if not notes.get("cause.text"):
        return []
    lines = [Line("first cause", f"t = {notes.get('cause.t', '?')} s: {notes['cause.text']}", "bad"),
             Line("who", notes.get("cause.source", "")),
             *(Line("evidence", str(text)) for text in _read_list(notes.get("cause.evidence", "")))]
    consequences = [each for each in _read_list(notes.get("cause.consequences", "")) if isinstance(each, dict)]
    return [*(line for line in lines if line.text), tabulate(
        consequences, (Column("t", "s", "right"), lambda each: f"{float(each.get('t', math.nan)):.3f}"),
        (Column("node"), lambda each: str(each.get("source", ""))),
        (Column("consequence"), lambda each: str(each.get("text", ""))),
        caption="What was reported afterwards and follows from the first cause.")]


def _read_list(text: str) -> list[Any]:
    """A list in JSON; empty for another text, for a log may come from another program."""
    try:
        found = json.loads(text)
    except ValueError:
        return []
    return found if isinstance(found, list) else []


def _show_diagnosis(trace: Trace) -> list[Item]:
    """What `rig fdi` found, if the run was asked for it."""
    word, sentence, faults = (trace.provenance.get(f"fdi.{key}", "") for key in ("verdict", "sentence", "faults"))
    moods: dict[str, Mood] = {"ACCEPTABLE": "good", "CANNOT_TELL": "doubtful"}  # all others fail the run
    lines = (Line(word, sentence, moods.get(word, "bad")), Line("faults", faults))
    return [line for line in lines if word and line.text]


def _list_notes(trace: Trace, most: int = 5) -> list[str]:
    """What a reader must know before trusting the plots: of missing cycles the first `most` gaps, missing samples."""
    rest = trace.gaps[most:]
    notes = [*trace.notes,
             *(f"{gap.cycles} cycles missing between {gap.t0:.3f} and {gap.t1:.3f} s" for gap in trace.gaps[:most])]
    if rest:
        notes.append(f"and {sum(gap.cycles for gap in rest)} cycles in {len(rest)} more gaps")
    names_of_count: dict[int, list[str]] = {}
    for name in (name for name in trace.signals if name != "load"):  # which is known or not, never sampled
        names_of_count.setdefault(int(np.isnan(trace.column(name)).sum()), []).append(name)
    parts = [f"{count} of {', '.join(names)}" for count, names in names_of_count.items() if count]
    if parts:
        notes.append(f"missing samples (red on the page): {'; '.join(parts)} (of {len(trace)})")
    limits = [text for name, text in sorted(trace.provenance.items()) if name.startswith("limits.")]
    if limits:
        notes.append(f"limits reached: {'; '.join(limits)}")
    if "recovered.reason" in trace.provenance:
        notes.append(f"this log was salvaged after its writer died: {trace.provenance['recovered.reason']}")
    return notes


def _tabulate_checks(checks: Sequence[Check], heading: str, remark: Medium) -> Table:
    """The checks of a sequence, or the protocol checks, which judge the whole run."""
    page = Medium.PAGE
    is_windowed = heading == "check"
    columns = [
        (True, Column(heading), lambda check: check.name),
        (is_windowed, Column("kind", medium=page), lambda check: Cell(_name_measure(check), "muted")),
        (True, Column(""), lambda check: Cell("pass", "good") if check.passed else Cell("FAIL", "bad")),
        (True, Column("measured", align="right"), lambda check: Cell(_format_value(check), is_strong=True)),
        (True, Column("limits", align="right"), lambda check: format_limits(check.low, check.high)),
        (True, Column("unit"), lambda check: "" if check.unit == "1" else check.unit),
        (is_windowed, Column("window", medium=page), lambda check: Cell(_format_window(check), "muted")),
        (any(check.requirement for check in checks), Column("requirement"), lambda check: check.requirement),
        (any(check.detail for check in checks), Column("remark", medium=remark),
         lambda check: Cell(check.detail, "muted"))]
    return tabulate(checks, *((column, show) for is_shown, column, show in columns if is_shown))


def _show_failed_checks(trace: Trace, most: int = 12) -> list[Item]:
    """A close-up of each of the first `most` failed checks that have a window and a signal."""
    failed = [check for check in trace.sequence_checks if not check.passed and not math.isnan(check.t0)]
    items: list[Item] = []
    for number, check in enumerate(failed[:most]):
        unit = "" if check.unit == "1" else f" {check.unit}"
        measured = check.detail if math.isnan(check.value) else f"{_format_value(check)}{unit} measured"
        items.append(Figure(f"{check.name}: {_name_measure(check)}, {measured}, limit "
                            f"{format_limits(check.low, check.high)}{unit}. Dashed: limits; red: what was measured.",
                            partial(draw_failed_check, trace, check, f"check{number}")))
    return items


def _name_measure(check: Check) -> str:
    """What a check measures: "steady error of xj", "largest size of cor", "number of EMCY events"."""
    if check.kind in ("event_occurs", "event_never"):
        return f"number of {check.signal} events" if check.signal else "number of events"
    quantity = {"never_exceeds": "largest size", "response_within": "response time"}.get(check.kind)
    return " of ".join(word for word in (quantity or check.kind.replace("_", " "), check.signal) if word)


def _format_value(check: Check) -> str:
    return "not measurable" if math.isnan(check.value) else f"{check.value:.4g}"


def format_limits(low: float, high: float) -> str:
    """The limits of a check.

    >>> format_limits(float("nan"), 5.0), format_limits(1.0, 2.0), format_limits(1.0, float("nan"))
    ('<= 5', '1 .. 2', '>= 1')
    """
    if math.isnan(low):
        return f"<= {high:g}"
    return f">= {low:g}" if math.isnan(high) else f"{low:g} .. {high:g}"


def _format_window(check: Check) -> str:
    if math.isnan(check.t0):
        return "not reached" if math.isnan(check.value) else "whole run"
    return f"{check.t0:.3f} – {check.t1:.3f} s"


def _show_timing(trace: Trace) -> list[Item]:
    timed = (("SYNC lateness", trace.timing.lateness), ("controller's response", trace.timing.response),
             ("bench's own work", trace.timing.work))
    known = [(name, values[~np.isnan(values)] * 1e6) for name, values in timed if not np.isnan(values).all()]
    if not known:
        return []
    columns = [Column("wall clock"), *(Column(name, "us", "right") for name in ("p50", "p99", "p99.9", "max"))]
    return [Figure("Number of cycles by duration, both axes logarithmic; the dotted line is the 99th percentile.",
                   partial(draw_timing, trace)),
            Table(columns, [[name, *(f"{x:.0f}" for x in np.percentile(values, [50, 99, 99.9, 100]))]
                            for name, values in known], "p99 is the time that 99 of 100 cycles stay below."),
            Line("overruns", f"{int(trace.timing.overrun.sum())} of {len(trace.timing.t)}")]


def _tabulate_events(events: Sequence[Event], most: int = 12, most_on_page: int = 2000) -> list[Item]:
    """The events on the page, of which a node can send a thousand a second; warnings and errors on the terminal."""
    columns = ((Column("t", "s", "right"), lambda event: f"{event.t:.3f}"),
               (Column("level", medium=Medium.PAGE), lambda event: Cell(event.level, EVENT_MOODS.get(event.level, ""))),
               (Column("kind"), lambda event: event.kind), (Column("event"), lambda event: event.text))
    is_cut = len(events) > most_on_page
    return [tabulate(events[:most_on_page], *columns, medium=Medium.PAGE,
                     caption=f"The first {most_on_page} of {len(events)} events." if is_cut else ""),
            tabulate([event for event in events if event.level != "INFO"], *columns, terminal_rows=most,
                     medium=Medium.TERMINAL)]


class Verdict(NamedTuple):
    """The result of a run."""

    word: str  # PASS, FAIL, INVALID_TIMING, ABORTED; NOT_JUDGED without checks
    why: str  # the reason; empty if the run passed

    def __str__(self) -> str:
        return f"{self.word}: {self.why}" if self.why else self.word


def read_verdict(trace: Trace) -> Verdict:
    """The verdict in the log of the run; of a trace without one (recovered, CSV) that of its checks."""
    notes = trace.provenance
    failed = [check.name for check in trace.checks if not check.passed]
    judged = ("FAIL" if failed else "PASS") if trace.checks else "NOT_JUDGED"
    word, why = notes.get("verdict.verdict") or judged, notes.get("verdict.why", "")
    if word == "INVALID_TIMING":
        why = notes.get("verdict.timing", why)
    elif word == "FAIL" and not why and failed:
        why = f"{len(failed)} of {len(trace.checks)} checks failed: {list_first(failed, 4)}"
    elif word == "FAIL" and not why:
        why = "the checks passed, but the run did not end as the sequence says"
    return Verdict(word, why)
