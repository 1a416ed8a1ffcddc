"""The report of `rig diff`: runs side by side - signals, checks, timing, nodes and models."""
from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from fdi.comparison.run_differences import MatchedCheck, RunDifferences, RunPair, SignalDifference
from fdi.report.drawing import ABOVE, COMMAND, GREEN, LEVELS, shade_sections, start_figure, thin_line, to_svg
from fdi.report.numbers import (
    SIGNAL_NAMES,
    choose_unit,
    count_nouns,
    format_digits,
    format_percent,
    format_ratio,
    join_words,
)
from fdi.report.report import Cell, Column, Figure, Item, Line, Medium, Report, Section, Table
from fdi.report.run_report import format_limits, read_verdict
from fdi.thresholds import NOISE_BAND_RATIO, RUN_DIFFERENCE_RATIO
from fdi.trace.trace import Check, Trace

if TYPE_CHECKING:
    from matplotlib.axes import Axes


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
    units = choose_difference_units(found)
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
                    "sections (violet) of the command.", partial(draw_differences, found))
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


COLOURS = ("#1f6feb", "#d9730d", "#bf3989", "#0f8b8d", "#8250df", "#57606a")  # of the runs, the reference first


def choose_difference_units(found: RunDifferences) -> dict[str, tuple[float, str]]:
    """SI value and name of the unit in which the differences of each signal are tabulated and drawn."""
    largest: dict[str, tuple[str, float]] = {}
    for pair in found.pairs:
        for s in pair.signals:
            largest[s.name] = s.unit, max(abs(s.largest), largest.get(s.name, ("", 0.0))[1])
    return {name: choose_unit(unit, size) for name, (unit, size) in largest.items()}


def draw_differences(found: RunDifferences) -> str:
    """Command and position, then each signal of all runs, and its difference from the reference below it."""
    units = choose_difference_units(found)
    heights = [1.1] + [1.2, 1.1] * len(units)
    with start_figure(0.8 + sum(heights)) as figure:
        axes = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights, squeeze=False)[:, 0]
        reference = found.runs[0].trace
        axes[0].plot(*thin_line(reference.t, reference.com * 1e3), color=COMMAND, lw=1.6, label="Com A")
        for pair, colour in zip(found.pairs, COLOURS[1:] * len(found.pairs), strict=False):
            if not pair.has_same_command:
                other = pair.run.trace
                axes[0].plot(*thin_line(other.t + pair.offset, other.com * 1e3), color=colour, lw=0.9,
                             label=f"Com {pair.run.label}")
        axes[0].set_ylabel("Com [mm]")
        for i, name in enumerate(units):
            _draw_signal(axes[1 + 2 * i], found, name)
            _draw_difference(axes[2 + 2 * i], found, name, units[name])
        axes[min(1, len(axes) - 1)].legend(ncols=len(found.runs), **ABOVE)
        for ax in axes:
            shade_sections(ax, reference)
        axes[-1].set_xlabel("time of A [s]")
        axes[-1].set_xlim(float(reference.t[0]), float(reference.t[-1]) + reference.period)
        figure.align_ylabels()
        return to_svg(figure, "differences")


def _draw_signal(ax: Axes, found: RunDifferences, name: str) -> None:
    unit, scale = LEVELS[name]
    offsets = [0.0, *(pair.offset for pair in found.pairs)]
    for i, (run, offset) in enumerate(zip(found.runs, offsets, strict=True)):
        if name in run.trace.signals:
            ax.plot(*thin_line(run.trace.t + offset, run.trace.column(name) * scale), color=COLOURS[i % len(COLOURS)],
                    lw=1.3 if i == 0 else 0.8, label=run.label)
    ax.set_ylabel(f"{SIGNAL_NAMES[name]} [{unit}]")


def _draw_difference(ax: Axes, found: RunDifferences, name: str, unit: tuple[float, str]) -> None:
    scale, word = unit
    band = 0.0
    for i, pair in enumerate(found.pairs, start=1):
        signal: SignalDifference | None = next((s for s in pair.signals if s.name == name), None)
        if signal is not None:
            band = max(band, NOISE_BAND_RATIO * math.hypot(*signal.noise) / scale)
            ax.plot(*thin_line(pair.t, pair.differences[name] / scale), color=COLOURS[i % len(COLOURS)], lw=0.7,
                    label=f"{pair.run.label} - A")
            ax.plot([signal.t], [signal.largest / scale], "o", ms=4, mfc="none", color=COLOURS[i % len(COLOURS)])
    ax.axhspan(-band, band, color=GREEN, alpha=0.25, lw=0)
    ax.set_ylabel(f"difference\n{SIGNAL_NAMES[name]} [{word}]")


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
