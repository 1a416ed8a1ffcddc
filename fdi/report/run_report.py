"""The report of a run: verdict, checks, signals over time, cycle timing, events, NMT states, provenance."""
from __future__ import annotations

import contextlib
import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdi.output import require_writable
from fdi.report.html import write_html
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
)
from fdi.trace.trace import Check, Event, Trace

MOODS: dict[str, Mood] = {"PASS": "good", "FAIL": "bad", "INVALID_TIMING": "doubtful", "ABORTED": "bad",
                          "NOT_JUDGED": "doubtful"}
EVENT_MOODS: dict[str, Mood] = {"ERROR": "bad", "WARN": "doubtful"}


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
    return Report(
        command="run",
        title=trace.provenance.get("sequence", trace.provenance.get("source", "trace")),
        verdict=word, mood=MOODS.get(word, "neutral"),
        sentence=reason or ("Every check passed." if trace.checks else "The trace has no checks."),
        facts=_list_facts(trace), notes=_list_notes(trace),
        sections=[Section("First cause and consequences", _show_cause(trace), medium=Medium.PAGE),
                  Section("Checks", _tabulate_checks(trace.sequence_checks)),
                  Section("Failed checks", _draw_failed_checks(trace), medium=Medium.PAGE),
                  Section("Servovalve", _show_diagnosis(trace), medium=Medium.PAGE),
                  Section("Protocol", _tabulate_protocol(trace.protocol_checks)),
                  Section("Signals", [_draw_signals(trace)]),
                  Section("Cycle timing", _show_timing(trace), medium=Medium.PAGE),
                  Section("Events", _tabulate_events(trace.events)),
                  Section("NMT states", _tabulate_nmt(trace), medium=Medium.PAGE),
                  Section("Provenance", _list_provenance(trace), medium=Medium.PAGE)])


def _list_facts(trace: Trace) -> list[tuple[str, str]]:
    main = int((trace.phase == 1).sum())
    facts = [("main phase", f"{main * trace.period:.3f} s, {main} cycles")]
    if trace.checks:
        facts += [(name, f"{sum(check.passed for check in checks)} of {len(checks)}") for name, checks in (
            ("checks passed", trace.sequence_checks), ("protocol checks passed", trace.protocol_checks)) if checks]
    named = ((name, trace.provenance.get(name, "")) for name in ("model", "seed", "bus", "pace", "started", "host"))
    facts += [(name, text) for name, text in named if text]
    if "differences.text" in trace.provenance:
        facts.append(("differs from nominal", trace.provenance["differences.text"]))
    kind = trace.provenance.get("timing.kind", "")
    if kind not in _KINDS_OF_TIMING:
        return facts
    return [*facts, ("timing", f"{kind}: {trace.provenance.get('timing.reason') or _KINDS_OF_TIMING[kind]}")]


_KINDS_OF_TIMING = {"hard real time": "the rig's cycle ran as compiled code",
                    "soft real time": "the rig's cycle ran in Python, on a bus that compiled code cannot use"}


def _show_cause(trace: Trace) -> list[Item]:
    """The first cause of trouble with its evidence, and what followed from it; nothing without trouble."""
    notes = trace.provenance
    if not notes.get("cause.text"):
        return []
    source = notes.get("cause.source", "")
    items: list[Item] = [Line("first cause", f"t = {notes.get('cause.t', '?')} s: {notes['cause.text']}", "bad")]
    items += [Line("who", source)] if source else []
    items += [Line("evidence", str(text)) for text in _read_list(notes.get("cause.evidence", ""))]
    rows: list[list[Cell | str]] = [
        [format_time(float(each.get("t", math.nan))), str(each.get("source", "")), str(each.get("text", ""))]
        for each in _read_list(notes.get("cause.consequences", "")) if isinstance(each, dict)]
    if rows:
        columns = [Column("t", "s", "right"), Column("node"), Column("consequence")]
        items.append(Table(columns, rows, "What was reported afterwards and follows from the first cause."))
    return items


def _read_list(text: str) -> list[Any]:
    """A list in JSON; empty for another text, for a log may come from another program."""
    try:
        found = json.loads(text)
    except ValueError:
        return []
    return found if isinstance(found, list) else []


def _show_diagnosis(trace: Trace) -> list[Item]:
    """What `rig fdi` found, if the run was asked for it."""
    word, sentence = (trace.provenance.get(f"fdi.{key}", "") for key in ("verdict", "sentence"))
    if not word:
        return []
    moods: dict[str, Mood] = {"ACCEPTABLE": "good", "CANNOT_TELL": "doubtful"}  # all others fail the run
    faults = trace.provenance.get("fdi.faults", "")
    return [Line(word, sentence, moods.get(word, "bad")), *([Line("faults", faults)] if faults else [])]


def _list_notes(trace: Trace) -> list[str]:
    """What a reader must know before trusting the plots."""
    notes = [*trace.notes, *describe_gaps(trace), *describe_missing_samples(trace)]
    limits = [text for name, text in sorted(trace.provenance.items()) if name.startswith("limits.")]
    if limits:
        notes.append(f"limits reached: {'; '.join(limits)}")
    if "recovered.reason" in trace.provenance:
        notes.append(f"this log was salvaged after its writer died: {trace.provenance['recovered.reason']}")
    return notes


def describe_gaps(trace: Trace, most: int = 5) -> list[str]:
    """A sentence for each of the first `most` gaps, and one for the rest."""
    lines = [f"{gap.cycles} cycles missing between {gap.t0:.3f} and {gap.t1:.3f} s" for gap in trace.gaps[:most]]
    rest = trace.gaps[most:]
    if rest:
        lines.append(f"and {sum(gap.cycles for gap in rest)} cycles in {len(rest)} more gaps")
    return lines


def describe_missing_samples(trace: Trace) -> list[str]:
    """At most one sentence: how many samples of which signals are missing; a load is known or not, never sampled."""
    signals_of_count: dict[int, list[str]] = {}
    for name in trace.signals:
        if name != "load":
            missing = int(np.isnan(trace.column(name)).sum())
            signals_of_count.setdefault(missing, []).append(name)
    parts = [f"{count} of {', '.join(names)}" for count, names in signals_of_count.items() if count]
    return [f"missing samples (red on the page): {'; '.join(parts)} (of {len(trace)})"] if parts else []


def _tabulate_checks(checks: tuple[Check, ...]) -> list[Item]:
    if not checks:
        return []
    columns = [Column("check"), Column("kind", medium=Medium.PAGE), Column(""), Column("measured", align="right"),
               Column("limits", align="right"), Column("unit"), Column("window", medium=Medium.PAGE)]
    rows: list[list[Cell | str]] = [
        [check.name, Cell(_name_measure(check), "muted"), Cell("pass", "good") if check.passed else Cell("FAIL", "bad"),
         Cell(_format_value(check), is_strong=True), format_limits(check.low, check.high),
         "" if check.unit == "1" else check.unit, Cell(_format_window(check), "muted")] for check in checks]
    if any(check.requirement for check in checks):
        columns.append(Column("requirement"))
        rows = [[*row, check.requirement] for row, check in zip(rows, checks, strict=True)]
    if any(check.detail for check in checks):
        columns.append(Column("remark"))
        rows = [[*row, Cell(check.detail, "muted")] for row, check in zip(rows, checks, strict=True)]
    return [Table(columns, rows)]


def _draw_failed_checks(trace: Trace, most: int = 12) -> list[Item]:
    """A close-up of each of the first `most` failed checks that have a window and a signal."""
    failed = [check for check in trace.sequence_checks if not check.passed and not math.isnan(check.t0)]
    return [_draw_failed_check(trace, check, number) for number, check in enumerate(failed[:most])]


def _draw_failed_check(trace: Trace, check: Check, number: int) -> Figure:
    def draw() -> str:
        from fdi.report import run_figures

        return run_figures.draw_failed_check(trace, check, f"check{number}")

    unit = "" if check.unit == "1" else f" {check.unit}"
    measured = check.detail if math.isnan(check.value) else f"{_format_value(check)}{unit} measured"
    limits = f"{format_limits(check.low, check.high)}{unit}"
    return Figure(f"{check.name}: {_name_measure(check)}, {measured}, limit {limits}. "
                  "Dashed: limits; red: what was measured.", draw)


def _tabulate_protocol(checks: tuple[Check, ...]) -> list[Item]:
    """The protocol checks, which have no window: the whole run is judged."""
    if not checks:
        return []
    columns = [Column("protocol check"), Column(""), Column("measured", align="right"),
               Column("limits", align="right"), Column("unit"), Column("remark", medium=Medium.PAGE)]
    rows: list[list[Cell | str]] = [
        [check.name, Cell("pass", "good") if check.passed else Cell("FAIL", "bad"),
         Cell(_format_value(check), is_strong=True), format_limits(check.low, check.high),
         "" if check.unit == "1" else check.unit, Cell(check.detail, "muted")] for check in checks]
    return [Table(columns, rows)]


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
    if math.isnan(high):
        return f">= {low:g}"
    return f"{low:g} .. {high:g}"


def _format_window(check: Check) -> str:
    if math.isnan(check.t0):
        return "not reached" if math.isnan(check.value) else "whole run"
    return f"{check.t0:.3f} – {check.t1:.3f} s"


def _draw_signals(trace: Trace) -> Figure:
    def draw() -> str:
        from fdi.report import run_figures  # here: matplotlib takes half a second to import

        return run_figures.draw_signals(trace)

    return Figure("Command, ram position, following error, current, pressure difference and spool position over time. "
                  "Shaded: ramps (blue) and dynamic sections (violet) of the command, injected faults (orange). The "
                  "bars at the bottom are the windows of the checks, green for passed and red for failed; a check "
                  "whose window was not reached has no bar.", draw)


def _show_timing(trace: Trace) -> list[Item]:
    rows = []
    for name, values in (("SYNC lateness", trace.timing.lateness), ("controller's response", trace.timing.response),
                         ("bench's own work", trace.timing.work)):
        known = values[~np.isnan(values)] * 1e6
        if len(known):
            rows.append([name, *(f"{x:.0f}" for x in np.percentile(known, [50, 99, 99.9])), f"{known.max():.0f}"])
    if not rows:
        return []

    def draw() -> str:
        from fdi.report import run_figures

        return run_figures.draw_timing(trace)

    columns = [Column("wall clock"), *(Column(name, "us", "right") for name in ("p50", "p99", "p99.9", "max"))]
    caption = "Number of cycles by duration, both axes logarithmic; the dotted line is the 99th percentile."
    return [Figure(caption, draw),
            Table(columns, rows, caption="p99 is the time that 99 of 100 cycles stay below."),
            Line("overruns", f"{int(trace.timing.overrun.sum())} of {len(trace.timing.t)}")]


def _tabulate_events(events: tuple[Event, ...], most: int = 12) -> list[Item]:
    """The first 2000 events on the page; warnings and errors on the terminal, at most `most`."""
    columns = [Column("t", "s", "right"), Column("level", medium=Medium.PAGE), Column("kind"), Column("event")]

    def tabulate(chosen: list[Event]) -> list[list[Cell | str]]:
        return [[format_time(event.t), Cell(event.level, EVENT_MOODS.get(event.level, "")), event.kind, event.text]
                for event in chosen]

    items: list[Item] = []
    if events:
        shown = list(events[:2000])  # a node can send a thousand emergencies a second
        rest = f"The first {len(shown)} of {len(events)} events." if len(shown) < len(events) else ""
        items.append(Table(columns, tabulate(shown), rest, medium=Medium.PAGE))
    notable = [event for event in events if event.level != "INFO"]
    if notable:
        items.append(Table(columns, tabulate(notable), terminal_rows=most, medium=Medium.TERMINAL))
    return items


def format_time(t: float) -> str:
    """A time of a trace, s, with the milliseconds of its cycles."""
    return f"{t:.3f}"


def _tabulate_nmt(trace: Trace) -> list[Item]:
    if not trace.nmt:
        return []
    rows = [[format_time(state.t), str(state.node), state.name] for state in trace.nmt]
    return [Table([Column("t", "s", "right"), Column("node"), Column("state")], rows)]


def _list_provenance(trace: Trace) -> list[Item]:
    rows: list[list[Cell | str]] = [[Cell(name, "muted"), text] for name, text in sorted(trace.provenance.items())
                                    if not name.startswith(("cause.", "limits.", "fdi.", "differences."))]
    items: list[Item] = [Table([Column(""), Column("")], rows, is_list=True)] if rows else []
    return [*items, *(Listing(data.decode("utf-8", "replace"), f"{name} ({len(data)} bytes)")
                      for name, data in sorted(trace.attachments.items()))]


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
    word, why = notes.get("verdict.verdict") or _judge_checks(trace), notes.get("verdict.why", "")
    if word == "INVALID_TIMING" and notes.get("verdict.timing"):
        return Verdict(word, notes["verdict.timing"])
    if word == "INVALID_TIMING":  # logs of earlier versions
        late = notes.get("verdict.overruns") or str(int(trace.timing.overrun.sum()))
        limit = ""
        with contextlib.suppress(KeyError, ValueError):  # a log of another program may lack it
            limit = f", more than {100 * float(notes['max_overruns']):g} %"
        lateness = f"the bench itself was late: {late} overruns in {len(trace)} cycles{limit}"
        return Verdict(word, f"{lateness}; {why}" if why else lateness)
    if word == "FAIL" and not why and failed:
        return Verdict(word, f"{len(failed)} of {len(trace.checks)} checks failed: {_list_names(failed)}")
    if word == "FAIL" and not why:
        return Verdict(word, "the checks passed, but the run did not end as the sequence says")
    return Verdict(word, why)


def _judge_checks(trace: Trace) -> str:
    if not trace.checks:
        return "NOT_JUDGED"
    return "PASS" if all(check.passed for check in trace.checks) else "FAIL"


def _list_names(names: list[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
