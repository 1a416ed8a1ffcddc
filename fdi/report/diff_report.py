"""The report of `rig diff`: runs side by side - signals, checks, timing, nodes and models."""

import math
import re
import zlib
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from fdi.comparison.run_differences import MatchedCheck, RunDifferences
from fdi.report.drawing import (
    BLUE,
    COMMAND,
    GREEN,
    GREY,
    ORANGE,
    PINK,
    TEAL,
    VIOLET,
    Panel,
    axes,
    band,
    dot,
    draw_over_time,
    label_signal,
    legend,
    line,
)
from fdi.report.numbers import (
    choose_unit,
    format_digits,
    format_percent,
    format_ratio,
    join_words,
    list_first,
)
from fdi.report.report import Cell, Column, Figure, Item, Line, Medium, Report, Section, Table
from fdi.report.run_report import TIMES, read_verdict
from fdi.thresholds import NOISE_BAND_RATIO, RUN_DIFFERENCE_RATIO
from fdi.trace import CheckResult, Trace
from plant import count_nouns

Facts = dict[str, list[str]]  # the text of each run


def build_diff_report(differences: RunDifferences, files: Sequence[tuple[str, str]] = ()) -> Report:
    """The report of runs side by side; `files` are those that were written."""
    facts = _collect_facts([run.trace for run in differences.runs])
    titles = {"model": "Models, sequences and faults", "node": "Nodes and bench", "timing": "Timing"}
    return Report(
        "diff", join_words([run.source for run in differences.runs]), differences.verdict,
        "good" if differences.verdict == "SAME" else "bad", describe_differences(differences),
        [(f"{run.label}{' (reference)' if i == 0 else ''}", run.source) for i, run in enumerate(differences.runs)],
        list(dict.fromkeys(note for pair in differences.pairs for note in pair.notes)),
        [Section("Runs", [_tabulate_runs(differences)]),
         Section("Signals", _show_signals(differences)),
         Section("Checks", _show_checks(differences)),
         *(Section(title, _show_facts(differences, heading, facts[heading])) for heading, title in titles.items())],
        files=files, data=_collect_data(differences, facts))


def describe_differences(differences: RunDifferences) -> str:
    """What differs, in a sentence or two."""
    parts = []
    for pair in differences.pairs:
        beyond = sorted((s for s in pair.signals if not s.is_within_noise), key=lambda s: -s.ratio)
        words = "noise explains the differences of all signals"
        if not pair.signals:
            words = "no signal could be compared"
        elif beyond:
            ratios = join_words(f"{s.signal.symbol} by {format_ratio(s.ratio)}" for s in beyond)
            words = f"{ratios} times the noise"
        elif all(s.is_equal for s in pair.signals):
            words = "every sample is equal"
        more = "" if pair.has_same_command else ", where the commands agree; elsewhere they differ"
        more += f"; {pair.uncovered:.3f} s of the longer run are not in the other" if pair.uncovered else ""
        parts.append(f"{pair.run.label} against {differences.runs[0].label}: {words}{more}")
    changed_checks = [check.name for check in differences.checks if check.is_changed]
    if changed_checks:
        parts.append(f"{count_nouns(len(changed_checks), 'check')} changed: {list_first(changed_checks, 3)}")
    elif sum(bool(run.trace.checks) for run in differences.runs) > 1:
        parts.append("no check changed its verdict")
    return "; ".join(parts) + "."


def _tabulate_runs(differences: RunDifferences) -> Table:
    columns = [Column("run"), Column("file"), Column("verdict"), Column("length", "s", "right"),
               Column("every", "ms", "right"), Column("same command"), Column("offset", "s", "right")]
    rows: list[list[Cell | str]] = [
        [run.label, run.source, read_verdict(run.trace).word, f"{len(run.trace) * run.trace.period:.3f}",
         f"{1e3 * run.trace.period:g}", *(["", ""] if pair is None else [
             "yes" if pair.has_same_command else Cell("no", "bad"), f"{pair.offset:.6g}"])]
        for run, pair in zip(differences.runs, [None, *differences.pairs], strict=True)]
    return Table(columns, rows, "Offset: time of A minus time of the run in the same cycle.")


def _show_signals(differences: RunDifferences) -> list[Item]:
    units = choose_difference_units(differences)
    columns = [Column("run"), Column("signal"), Column("unit"), Column("RMS difference", align="right"),
               Column("largest", align="right"), Column("at", "s", "right"), Column("noise, A", align="right"),
               Column("noise, run", align="right"), Column("times the noise", align="right"),
               Column("time within noise", align="right", medium=Medium.PAGE)]
    rows: list[list[Cell | str]] = [
        [f"{pair.run.label} - A", s.signal.symbol, unit, Cell(format_digits(s.rms / scale), is_strong=True),
         *(("-", "-") if s.is_equal else (format_digits(s.largest / scale), f"{s.t:.3f}")),
         *(format_digits(noise / scale) for noise in s.noise),
         Cell("equal" if s.is_equal else format_ratio(s.ratio), "good" if s.is_within_noise else "bad"),
         Cell(format_percent(s.calm_share), "muted")]
        for pair in differences.pairs for s in pair.signals for scale, unit in [units[s.name]]]
    caption = ("RMS and largest difference, run minus A, where both commands agree. Noise: RMS of the noise of each "
               f"run, from its own second differences. Up to {format_digits(RUN_DIFFERENCE_RATIO, 2)} times the noise "
               "of both runs, noise explains a difference.")
    figure = Figure("Each signal of all runs, and below it the difference from A. Green: two noise floors of both runs "
                    "on either side of zero. The circle marks the largest difference. Shaded: ramps (blue) and dynamic "
                    "sections (violet) of the command.", partial(draw_differences, differences))
    symbols = {s.name: s.symbol for s in differences.runs[0].trace.declared}
    return [Table(columns, rows, caption),
            *(Line("left out", f"{symbols[name]} of {pair.run.label}: {reason}")
              for pair in differences.pairs for name, reason in pair.not_compared.items()),
            *([figure] if rows else [])]


def _show_checks(differences: RunDifferences) -> list[Item]:
    """All checks on the page; on the terminal those of the sequence, and the others that changed."""
    labels = [run.label for run in differences.runs if run.trace.checks]
    if len(labels) == 1:
        return [Line("checks", f"only {labels[0]} has checks: {len(differences.checks)}", medium=Medium.TERMINAL),
                _tabulate_checks(differences, differences.checks, Medium.PAGE, f"Only {labels[0]} has checks.")]
    caption = "Values in the unit of the check. A changed check has another verdict than in A."
    terminal_checks = [check for check in differences.checks if check.is_changed or not check.first.is_protocol]
    rest = len(differences.checks) - len(terminal_checks)
    more = f" {count_nouns(rest, 'protocol check')} did not change." if rest else ""
    return [_tabulate_checks(differences, differences.checks, Medium.PAGE, caption),
            _tabulate_checks(differences, terminal_checks, Medium.TERMINAL, caption + more)]


def _tabulate_checks(differences: RunDifferences, checks: Sequence[MatchedCheck], medium: Medium, caption: str
                     ) -> Table:
    """A row for each check: name, limits, the value of each run, and the verdicts, marked where they changed."""
    labels = [run.label for run in differences.runs]
    columns = [Column("check"), Column("limits", align="right"), Column("unit"),
               *(Column(label, align="right") for label in labels), Column(" -> ".join(labels)), Column("")]
    rows: list[list[Cell | str]] = [
        [check.name,
         "differ" if check.has_other_limits else check.first.shown_limits,
         check.first.unit_behind.strip(), *map(_show_value, check.results),
         _join_verdicts(check.results), Cell("changed", "bad", True) if check.is_changed else ""] for check in checks]
    return Table(columns, rows, caption, medium=medium)


def _show_value(check: CheckResult | None) -> Cell:
    if check is None:
        return Cell("-", "muted")
    return Cell(check.shown_value, "muted" if math.isnan(check.value) else "")


def _join_verdicts(results: Sequence[CheckResult | None]) -> Cell:
    words = ["-" if check is None else check.verdict.replace("PASS", "pass") for check in results]
    text = " -> ".join(words) if len(set(words)) > 1 else words[0]
    if "FAIL" in words:
        return Cell(text, "bad")
    return Cell(text, "good" if "pass" in words else "muted")


def _show_facts(differences: RunDifferences, heading: str, facts: Facts) -> list[Item]:
    """All facts on the page, those that differ in bold; on the terminal only those that two runs or more have."""
    columns = [Column(heading), *(Column(run.label) for run in differences.runs)]
    rows: dict[str, list[Cell | str]] = {}
    for name, texts in facts.items():
        short_texts = [text[:12] for text in texts] if name == "commit" else texts  # as git abbreviates it
        if any(texts):
            rows[name] = [name, *(Cell(text or "-", "" if text else "muted", bool(text) and len(set(texts)) > 1)
                                  for text in short_texts)]
    changed_rows = [row for name, row in rows.items() if len(set(facts[name])) > 1 and sum(map(bool, facts[name])) > 1]
    return [Table(columns, list(rows.values()), "Bold: differs between the runs.", medium=Medium.PAGE),
            Table(columns, changed_rows, medium=Medium.TERMINAL)]


def _collect_data(differences: RunDifferences, facts: Mapping[str, Facts]) -> dict[str, Any]:
    """The answer of `rig diff --json`; SI units, checks in their own unit."""
    return {
        "verdict": differences.verdict, "reason": describe_differences(differences),
        "runs": [{"label": run.label, "source": run.source, "verdict": read_verdict(run.trace).word,
                  "rows": len(run.trace), "period": run.trace.period} for run in differences.runs],
        "pairs": [{
            "run": pair.run.label, "same_command": pair.has_same_command, "common": pair.common,
            "overlap": pair.overlap, "offset": pair.offset, "notes": pair.notes,
            "signals": {s.name: {
                "unit": s.signal.unit, "rms": s.rms, "largest": s.largest, "t": s.t, "noise_reference": s.noise[0],
                "noise": s.noise[1], "ratio": s.ratio, "samples": s.samples, "share_within_noise": s.calm_share,
                "within_noise": s.is_within_noise, "equal": s.is_equal} for s in pair.signals},
            "not_compared": pair.not_compared} for pair in differences.pairs],
        "checks": [{
            "name": check.name, "kind": check.first.kind, "unit": check.first.unit, "changed": check.is_changed,
            "limits_differ": check.has_other_limits,
            **{field: [getattr(result, field, None) for result in check.results]
               for field in ("value", "passed", "low", "high")}} for check in differences.checks],
        "models": facts["model"], "nodes": facts["node"], "timing": facts["timing"]}


COLOURS = (BLUE, ORANGE, PINK, TEAL, VIOLET, GREY)  # of the runs, the reference first


def choose_difference_units(differences: RunDifferences) -> dict[str, tuple[float, str]]:
    """SI value and name of the unit in which the differences of each signal are tabulated and drawn."""
    signals = [s for pair in differences.pairs for s in pair.signals]
    return {s.name: choose_unit(s.signal.unit, max(abs(other.largest) for other in signals if other.name == s.name))
            for s in signals}


def draw_differences(differences: RunDifferences) -> str:
    """Command and position, then each signal of all runs, and its difference from the reference below it."""
    reference = differences.runs[0].trace
    offsets = [0.0, *(pair.offset for pair in differences.pairs)]
    runs = list(zip(differences.runs, offsets, COLOURS * len(offsets), strict=False))
    command = reference.declared.command
    panels: list[Panel] = [[
        line(reference.t, reference.command * command.shown_scale, COMMAND, f"{command.symbol} A", 1.6),
        axes(ylabel=label_signal(command)),
        *(line(run.trace.t + offset, run.trace.command * command.shown_scale, colour, f"{command.symbol} {run.label}",
               0.9)
          for (run, offset, colour), pair in zip(runs[1:], differences.pairs, strict=True)
          if not pair.has_same_command)]]
    for number, (name, (size, word)) in enumerate(choose_difference_units(differences).items()):
        signal = reference.declared.find(name)
        curves = [(pair, colour, s) for pair, (_, _, colour) in zip(differences.pairs, runs[1:], strict=True)
                  for s in pair.signals if s.name == name]
        half = max(NOISE_BAND_RATIO * math.hypot(*s.noise) / size for _, _, s in curves)
        panels += [
            [*(line(run.trace.t + offset, run.trace.column(name) * signal.shown_scale, colour, run.label,
                    1.3 if run is differences.runs[0] else 0.8)
               for run, offset, colour in runs if name in run.trace.signals),
             axes(ylabel=label_signal(signal)), *([] if number else [legend(len(runs))])],
            [band(-half, half, GREEN), axes(ylabel=f"difference\n{signal.symbol} [{word}]"),
             *(line(pair.t, pair.differences[name] / size, colour, f"{pair.run.label} - A", 0.7)
               for pair, colour, _ in curves),
             *(dot(s.t, s.largest / size, colour, ms=4, mfc="none") for _, colour, s in curves)]]
    return draw_over_time("differences", reference, panels, [1.1] + [1.2, 1.1] * (len(panels) // 2),
                          xlabel="time of A [s]")


def _collect_facts(traces: Sequence[Trace]) -> dict[str, Facts]:
    """What is recorded of each run, "" where it has none: of the model, of the nodes and the bench, of the timing.

    What differs from nominal: by --set, effects and faults. A checksum tells attached files of one name apart. A node's
    identity: CiA 301, objects 0x1000, 0x1008 to 0x100A, 0x1018.
    """
    fields = ("name", "hardware", "software", "vendor", "product", "revision", "serial")
    nodes = sorted({int(key[4:key.index(".")]) for trace in traces for key in trace.provenance
                    if re.match(r"node\d+\.", key)})
    keys = {
        "model": {"sequence": "sequence", "model": "model", "differs from nominal": "differences.text", "seed": "seed"},
        "node": {"controller": "controller",
                 **{f"node {node}, {field}": f"node{node}.{field}" for node in nodes for field in fields},
                 "bus": "bus", "pace": "pace", "host": "host", "started": "started", "eha-rig": "version.eha-rig",
                 "commit": "git.commit"},
        "timing": {"kind of timing": "timing.kind"}}
    facts = {heading: {name: [trace.provenance.get(key, "") for trace in traces] for name, key in key_by_name.items()}
             for heading, key_by_name in keys.items()}
    facts["model"] |= {name: [", ".join(f"{file.rpartition('/')[2]} (CRC {zlib.crc32(data):08x})"
                                        for file, data in sorted(trace.attachments.items()) if file.startswith(start))
                              for trace in traces]
                       for name, start in (("sequence file", "sequence/"), ("effect files", "effects/"),
                                           ("model file", "model.toml"))}
    facts["timing"] |= {
        **{f"{words}, p50 / p99 / max": [_format_percentiles(getattr(trace.timing, field)) for trace in traces]
           for words, field in TIMES.items()},
        "overruns": [f"{int(trace.timing.overrun.sum())} of {len(trace.timing.t)}" if len(trace.timing.t) else ""
                     for trace in traces]}
    return facts


def _format_percentiles(values: Any) -> str:
    times = values[~np.isnan(values)] * 1e6
    return " / ".join(f"{x:.0f}" for x in np.percentile(times, (50, 99, 100))) + " us" if times.any() else ""
