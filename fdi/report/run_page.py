"""One HTML page about a trace that needs no network: verdict, checks, plots, timing, events, provenance."""
from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from fdi.output import rendered, writable
from fdi.report import figures
from fdi.report.run_verdict import verdict
from fdi.trace.trace import Check, Trace
from plant.errors import InputError

GAPS_LISTED = 5
WORDS = {"PASS": "good", "FAIL": "bad", "INVALID_TIMING": "doubtful", "ABORTED": "bad"}


def write_report(source: str | Path, out: str | Path) -> None:
    """Write the report of a trace (see Trace.read) as one HTML file.

    Raises InputError for a trace that cannot be read and a file that cannot be written.
    """
    trace = Trace.read(source, all=True)
    place = writable(out, "--out", source=source)
    page = render(trace)
    try:
        place.write_text(page, encoding="utf-8")
    except OSError as error:
        raise InputError(out, "--out", f"a place that can be written ({error.strerror})") from error


def render(trace: Trace) -> str:
    """The page as text."""
    word, why = verdict(trace)
    return rendered(
        "report.html",
        title=trace.provenance.get("sequence", trace.provenance.get("source", "trace")),
        verdict=word, mood=WORDS.get(word, "neutral"), why=why,
        facts=_facts(trace), checks=[_row(check) for check in trace.checks], notes=_notes(trace),
        signals=figures.signals(trace), histogram=figures.timing(trace), timing=_timing(trace),
        events=trace.events, nmt=trace.nmt, provenance=sorted(trace.provenance.items()),
        attachments=sorted(trace.attachments.items()))


def _facts(trace: Trace) -> list[tuple[str, str]]:
    """The line under the title."""
    main = int((trace.phase == 1).sum())
    passed = sum(check.passed for check in trace.checks)
    named = [(name, trace.provenance.get(name, "")) for name in ("model", "seed", "bus", "pace", "started", "host")]
    return [("main phase", f"{main * trace.period:.3f} s, {main} cycles"),
            *([("checks passed", f"{passed} of {len(trace.checks)}")] if trace.checks else []),
            *((name, text) for name, text in named if text)]


def _row(check: Check) -> dict[str, Any]:
    unit = "" if check.unit == "1" else check.unit
    return {"name": check.name, "kind": check.kind.replace("_", " "), "signal": check.signal, "passed": check.passed,
            "value": _number(check.value, "not measurable"), "unit": unit, "low": _number(check.low),
            "high": _number(check.high), "detail": check.detail,
            "window": _window(check)}


def _window(check: Check) -> str:
    if math.isnan(check.t0):
        return "not reached" if math.isnan(check.value) else "whole run"
    return f"{check.t0:.3f} – {check.t1:.3f} s"


def _number(value: float, missing: str = "") -> str:
    return missing if math.isnan(value) else f"{value:.4g}"


def _notes(trace: Trace) -> list[str]:
    """What a reader must know before trusting the plots."""
    return [*trace.notes, *_lost_cycles(trace), *_lost_samples(trace),
            *([f"this log was salvaged after its writer died: {trace.provenance['recovered.reason']}"]
              if "recovered.reason" in trace.provenance else [])]


def _lost_cycles(trace: Trace) -> list[str]:
    shown = [f"{gap.cycles} cycles missing between {gap.t0:.3f} and {gap.t1:.3f} s" for gap in trace.gaps[:GAPS_LISTED]]
    rest = trace.gaps[GAPS_LISTED:]
    return [*shown, *([f"and {sum(gap.cycles for gap in rest)} cycles in {len(rest)} more gaps"] if rest else [])]


def _lost_samples(trace: Trace) -> list[str]:
    """One line: how many samples of which signals; a load is known or not, it is not sampled."""
    lost: dict[int, list[str]] = {}
    for name in trace.signals:
        if name != "load":
            lost.setdefault(int(np.isnan(trace.column(name)).sum()), []).append(name)
    parts = [f"{count} of {', '.join(names)}" for count, names in lost.items() if count]
    return [f"missing samples, marked red below the lines: {'; '.join(parts)} (of {len(trace)})"] if parts else []


def _timing(trace: Trace) -> list[tuple[str, ...]]:
    """Rows of the timing table: name, p50, p99, p99.9, max in us."""
    rows = []
    for name, values in (("SYNC lateness", trace.timing.lateness), ("controller's response", trace.timing.response),
                         ("bench's own work", trace.timing.work)):
        known = values[~np.isnan(values)] * 1e6
        if len(known):
            figures_us = [*np.percentile(known, [50, 99, 99.9]), known.max()]
            rows.append((name, *(f"{value:.0f}" for value in figures_us)))
    return [*rows, ("overruns", f"{int(trace.timing.overrun.sum())} of {len(trace.timing.t)}")] if rows else []
