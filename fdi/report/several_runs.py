"""What a report on several runs shares: their checks side by side, and tables of facts with a column for each run."""
from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fdi.comparison.matched_checks import MatchedCheck
from fdi.report.report import Cell, Column, Medium, Table
from fdi.report.run_report import format_limits
from fdi.trace.trace import Check, Trace

MISSING = Cell("-", "muted")
TIMINGS = (("SYNC lateness", "lateness"), ("controller's response", "response"), ("bench's own work", "work"))


def tabulate_matched_checks(labels: Sequence[str], checks: Sequence[MatchedCheck], medium: Medium = Medium.BOTH,
                            caption: str = "") -> Table:
    """A row for each check: name, limits, the value of each run, and the verdicts, marked where they changed.

    Args:
        labels: a short name of each run, in the order of the results.
        checks: the matched checks.
        medium: where the table is shown.
        caption: what to see in it.
    """
    columns = [Column("check"), Column("limits", align="right"), Column("unit"),
               *(Column(label, align="right") for label in labels), Column(" -> ".join(labels)), Column("")]
    rows: list[list[Cell | str]] = []
    for check in checks:
        first = check.first
        limits = "differ" if check.has_other_limits else format_limits(first.low, first.high)
        rows.append([check.name, limits, "" if first.unit == "1" else first.unit,
                     *(_format_value(result) for result in check.results), _join_verdicts(check.results),
                     Cell("changed", "bad", True) if check.is_changed else ""])
    return Table(columns, rows, caption, medium=medium)


def _format_value(check: Check | None) -> Cell | str:
    if check is None:
        return MISSING
    return Cell("not measurable", "muted") if math.isnan(check.value) else f"{check.value:.4g}"


def _join_verdicts(results: Sequence[Check | None]) -> Cell:
    words = [_name_verdict(check) for check in results]
    text = " -> ".join(words) if len(set(words)) > 1 else words[0]
    if "FAIL" in words:
        return Cell(text, "bad")
    return Cell(text, "good" if "pass" in words else "muted")


def _name_verdict(check: Check | None) -> str:
    if check is None:
        return "-"
    return "pass" if check.passed else "FAIL"


def tabulate_facts(heading: str, labels: Sequence[str], facts: Mapping[str, Sequence[str]],
                   medium: Medium = Medium.BOTH, caption: str = "") -> Table | None:
    """A row for each fact, with the text of each run; bold where the runs differ. None if there is no row to show."""
    rows: list[list[Cell | str]] = []
    for name, texts in facts.items():
        differs = len(set(texts)) > 1
        if any(texts):
            shown = [text[:12] for text in texts] if name == "commit" else texts  # as git abbreviates it
            rows.append([name, *(Cell(text, is_strong=differs) if text else MISSING for text in shown)])
    columns = [Column(heading), *(Column(label) for label in labels)]
    return Table(columns, rows, caption, medium=medium) if rows else None


def select_changed(facts: Mapping[str, Sequence[str]]) -> dict[str, Sequence[str]]:
    """The facts that two runs or more have, and in which they differ."""
    return {name: texts for name, texts in facts.items() if sum(map(bool, texts)) > 1 and len(set(texts)) > 1}


def describe_timing(traces: Sequence[Trace]) -> dict[str, list[str]]:
    """Percentiles of lateness, response and work, and overruns, of each run; "" where a run has none."""
    out: dict[str, list[str]] = {"kind of timing": [trace.provenance.get("timing.kind", "") for trace in traces]}
    for words, field in TIMINGS:
        out[f"{words}, p50 / p99 / max"] = [_format_percentiles(getattr(trace.timing, field)) for trace in traces]
    out["overruns"] = [f"{int(trace.timing.overrun.sum())} of {len(trace.timing.t)}" if len(trace.timing.t) else ""
                       for trace in traces]
    return out


def _format_percentiles(values: Any) -> str:
    known = values[~np.isnan(values)] * 1e6
    if not len(known) or not known.any():
        return ""
    return f"{np.percentile(known, 50):.0f} / {np.percentile(known, 99):.0f} / {known.max():.0f} us"


def describe_nodes(traces: Sequence[Trace]) -> dict[str, list[str]]:
    """Identity of each node (CiA 301, objects 0x1000, 0x1008 to 0x100A, 0x1018), bus, machine and software versions."""
    fields = ("name", "hardware", "software", "vendor", "product", "revision", "serial")
    texts = {"controller": "controller",
             **{f"node {node}, {field}": f"node{node}.{field}" for node in (2, 3) for field in fields},
             "bus": "bus", "pace": "pace", "host": "host", "started": "started", "eha-rig": "version.eha-rig",
             "commit": "git.commit"}
    return {name: [trace.provenance.get(key, "") for trace in traces] for name, key in texts.items()}


def describe_models(traces: Sequence[Trace]) -> dict[str, list[str]]:
    """Sequence, model, seed, and what differs from nominal (--set, effects, faults) of each run."""
    texts = {"sequence": "sequence", "model": "model", "differs from nominal": "differences.text", "seed": "seed"}
    out = {name: [trace.provenance.get(key, "") for trace in traces] for name, key in texts.items()}
    for kind, start in (("sequence file", "sequence/"), ("effect files", "effects/"), ("model file", "model.toml")):
        out[kind] = [_describe_files(trace, start) for trace in traces]
    return out


def _describe_files(trace: Trace, start: str) -> str:
    """Names of attached files with a checksum, which tells files of one name apart."""
    return ", ".join(f"{name.rpartition('/')[2]} (CRC {zlib.crc32(data):08x})"
                     for name, data in sorted(trace.attachments.items()) if name.startswith(start))
