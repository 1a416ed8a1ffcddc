"""The report of `rig diff`: runs side by side - signals, checks, timing, nodes and models."""
from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from fdi.comparison.matched_checks import MatchedCheck
from fdi.comparison.run_differences import RunDifferences, RunPair, SignalDifference
from fdi.report import diff_figures
from fdi.report.numbers import SIGNAL_NAMES, count_nouns, format_digits, format_percent, format_ratio, join_words
from fdi.report.report import Cell, Column, Figure, Item, Line, Medium, Report, Section, Table
from fdi.report.run_verdict import read_verdict
from fdi.report.several_runs import (
    describe_models,
    describe_nodes,
    describe_timing,
    select_changed,
    tabulate_facts,
    tabulate_matched_checks,
)
from fdi.thresholds import RUN_DIFFERENCE_RATIO
from fdi.trace.trace import Check


def build_diff_report(found: RunDifferences, files: Sequence[tuple[str, str]] = ()) -> Report:
    """The report of runs side by side; `files` are those that were written."""
    labels = [run.label for run in found.runs]
    traces = [run.trace for run in found.runs]
    return Report(
        "diff", join_words([run.source for run in found.runs]), found.verdict,
        "good" if found.verdict == "SAME" else "bad", describe_differences(found), _list_facts(found),
        list(dict.fromkeys(note for pair in found.pairs for note in pair.notes)),
        [Section("Runs", [_tabulate_runs(found)]),
         Section("Signals", _show_signals(found)),
         Section("Checks", _show_checks(found, labels)),
         Section("Models, sequences and faults", _show_facts("model", labels, describe_models(traces))),
         Section("Nodes and bench", _show_facts("node", labels, describe_nodes(traces))),
         Section("Timing", _show_facts("timing", labels, describe_timing(traces)))],
        files=files, data=collect_data(found))


def describe_differences(found: RunDifferences) -> str:
    """What differs, in a sentence or two."""
    parts = []
    for pair in found.pairs:
        beyond = sorted((s for s in pair.signals if not s.is_within_noise), key=lambda s: -s.ratio)
        where = f"{pair.run.label} against {found.runs[0].label}"
        if not pair.signals:
            parts.append(f"{where}: no signal could be compared")
        elif beyond:
            words = [f"{SIGNAL_NAMES[s.name]} by {format_ratio(s.ratio)}" for s in beyond]
            parts.append(f"{where}: {join_words(words)} times the noise")
        elif all(s.is_equal for s in pair.signals):
            parts.append(f"{where}: every sample is equal")
        else:
            parts.append(f"{where}: noise explains the differences of all signals")
        if not pair.has_same_command:
            parts[-1] += ", where the commands agree; elsewhere they differ"
    changed = [check.name for check in found.checks if check.is_changed]
    if changed:
        more = f" and {len(changed) - 3} more" if len(changed) > 3 else ""
        parts.append(f"{count_nouns(len(changed), 'check')} changed: {', '.join(changed[:3])}{more}")
    elif sum(bool(run.trace.checks) for run in found.runs) > 1:
        parts.append("no check changed its verdict")
    return "; ".join(parts) + "."


def _list_facts(found: RunDifferences) -> list[tuple[str, str]]:
    return [(f"{run.label}{' (reference)' if i == 0 else ''}", run.source) for i, run in enumerate(found.runs)]


def _tabulate_runs(found: RunDifferences) -> Table:
    columns = [Column("run"), Column("file"), Column("verdict"), Column("length", "s", "right"),
               Column("every", "ms", "right"), Column("same command"), Column("offset", "s", "right")]
    rows: list[list[Cell | str]] = []
    for run, pair in zip(found.runs, [None, *found.pairs], strict=True):
        trace, word = run.trace, read_verdict(run.trace).word
        agrees: Cell | str = ""
        offset = ""
        if pair is not None:
            agrees = "yes" if pair.has_same_command else Cell("no", "bad")
            offset = f"{pair.offset:.6g}"
        rows.append([run.label, run.source, word, f"{len(trace) * trace.period:.3f}", f"{1e3 * trace.period:g}", agrees,
                     offset])
    return Table(columns, rows, "Offset: time of A minus time of the run in the same cycle.")


def _show_signals(found: RunDifferences) -> list[Item]:
    units = diff_figures.choose_difference_units(found)
    columns = [Column("run"), Column("signal"), Column("unit"), Column("RMS difference", align="right"),
               Column("largest", align="right"), Column("at", "s", "right"), Column("noise, A", align="right"),
               Column("noise, run", align="right"), Column("times the noise", align="right"),
               Column("time within noise", align="right", medium=Medium.PAGE)]
    rows: list[list[Cell | str]] = []
    lines: list[Item] = []
    for pair in found.pairs:
        for s in pair.signals:
            scale, unit = units[s.name]
            rows.append([f"{pair.run.label} - A", SIGNAL_NAMES[s.name], unit,
                         Cell(format_digits(s.rms / scale), is_strong=True),
                         *(("-", "-") if s.is_equal else (format_digits(s.largest / scale), f"{s.t:.3f}")),
                         *(format_digits(noise / scale) for noise in s.noise), _format_ratio(s),
                         Cell(format_percent(s.calm_share), "muted")])
        lines += [Line("left out", f"{SIGNAL_NAMES[name]} of {pair.run.label}: {reason}")
                  for name, reason in pair.not_compared.items()]
    if not rows:
        return lines
    caption = ("RMS and largest difference, run minus A, where both commands agree. Noise: RMS of the noise of each "
               "run, from its own second differences. Up to "
               f"{format_digits(RUN_DIFFERENCE_RATIO, 2)} times the noise of both runs, noise explains a difference.")
    figure = Figure("Each signal of all runs, and below it the difference from A. Green: two noise floors of both runs "
                    "on either side of zero. The circle marks the largest difference. Shaded: ramps (blue) and dynamic "
                    "sections (violet) of the command.", partial(diff_figures.draw_differences, found))
    return [Table(columns, rows, caption), *lines, figure]


def _format_ratio(s: SignalDifference) -> Cell:
    return Cell("equal" if s.is_equal else format_ratio(s.ratio), "good" if s.is_within_noise else "bad")


def _show_checks(found: RunDifferences, labels: Sequence[str]) -> list[Item]:
    """All checks on the page; on the terminal those of the sequence, and the others that changed."""
    judged = [run.label for run in found.runs if run.trace.checks]
    if not judged:
        return []
    if len(judged) == 1:
        return [Line("checks", f"only {judged[0]} has checks: {len(found.checks)}", medium=Medium.TERMINAL),
                tabulate_matched_checks(labels, found.checks, Medium.PAGE, f"Only {judged[0]} has checks.")]
    caption = "Values in the unit of the check. A changed check has another verdict than in A."
    shown = [check for check in found.checks if check.is_changed or not check.first.is_protocol]
    rest = len(found.checks) - len(shown)
    more = f" {count_nouns(rest, 'protocol check')} did not change." if rest else ""
    return [tabulate_matched_checks(labels, found.checks, Medium.PAGE, caption),
            tabulate_matched_checks(labels, shown, Medium.TERMINAL, caption + more)]


def _show_facts(heading: str, labels: Sequence[str], facts: dict[str, list[str]]) -> list[Item]:
    """All facts on the page, those that differ in bold; on the terminal only these."""
    tables = (tabulate_facts(heading, labels, facts, medium=Medium.PAGE, caption="Bold: differs between the runs."),
              tabulate_facts(heading, labels, select_changed(facts), medium=Medium.TERMINAL))
    return [table for table in tables if table is not None]


def collect_data(found: RunDifferences) -> dict[str, Any]:
    """The answer of `rig diff --json`; SI units, checks in their own unit."""
    traces = [run.trace for run in found.runs]
    return {
        "verdict": found.verdict, "reason": describe_differences(found),
        "runs": [{"label": run.label, "source": run.source, "verdict": read_verdict(run.trace).word,
                  "rows": len(run.trace), "period": run.trace.period} for run in found.runs],
        "pairs": [_collect_pair(pair) for pair in found.pairs],
        "checks": [_collect_check(check) for check in found.checks],
        "models": describe_models(traces), "nodes": describe_nodes(traces), "timing": describe_timing(traces)}


def _collect_pair(pair: RunPair) -> dict[str, Any]:
    return {"run": pair.run.label, "same_command": pair.has_same_command, "common": pair.common,
            "overlap": pair.overlap, "offset": pair.offset, "notes": list(pair.notes),
            "signals": {s.name: {
                "unit": s.unit, "rms": s.rms, "largest": s.largest, "t": s.t, "noise_reference": s.noise[0],
                "noise": s.noise[1], "ratio": s.ratio, "samples": s.samples, "share_within_noise": s.calm_share,
                "within_noise": s.is_within_noise, "equal": s.is_equal} for s in pair.signals},
            "not_compared": dict(pair.not_compared)}


def _collect_check(check: MatchedCheck) -> dict[str, Any]:
    def pick(result: Check | None, field: str) -> Any:
        return None if result is None else getattr(result, field)

    first = check.first
    fields = ("value", "passed", "low", "high")
    return {"name": check.name, "kind": first.kind, "unit": first.unit, "changed": check.is_changed,
            "limits_differ": check.has_other_limits,
            **{field: [pick(result, field) for result in check.results] for field in fields}}

