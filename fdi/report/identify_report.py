"""The report of `rig identify`: parameters with intervals, what the runs do not show, errors before and after."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi.identification.identify import Estimate, Identification, RunError
from fdi.report.drawing import (
    ABOVE,
    COMMAND,
    DRAWN_UNITS,
    label_log_axis,
    shade_sections,
    start_figure,
    thin_line,
    to_svg,
)
from fdi.report.explain_report import AFTER, BEFORE, FLOOR, HELD
from fdi.report.numbers import (
    SIGNAL_NAMES,
    format_amount,
    format_interval,
    format_percent,
    format_ratio,
    format_signal,
    join_words,
)
from fdi.report.report import Cell, Column, Figure, Item, Line, Listing, Medium, Mood, Report, Section, Table
from fdi.thresholds import HELD_OUT_UNDECIDED_SHARE, NOISE_BAND_RATIO, RESIDUAL_HELD_OUT
from fdi.trace.trace import Trace

MOODS: dict[str, Mood] = {"IDENTIFIED": "good", "PARTLY": "doubtful", "CANNOT_TELL": "doubtful", "UNEXPLAINED": "bad"}


def build_identification_report(found: Identification, title: str, command: str = "", next_command: str = "",
                                files: Sequence[tuple[str, str]] = ()) -> Report:
    """The report of an identification.

    Args:
        found: the answer.
        title: the name of the model.
        command: what the user typed.
        next_command: what to type next.
        files: (label, path) of what was written.
    """
    facts = [("data sheet", found.before.name)]
    facts += [("held-out run" if e.is_held_out else "run", e.source.file) for e in found.errors]
    notes = [*found.notes] if found.holdouts else [*found.notes, "no held-out run: overfitting is not excluded"]
    sections = [
        Section("Parameters", [_tabulate_parameters(found), Figure(
            "Each free parameter over its data sheet value: grey the range of the data sheet, blue the 95 % interval "
            "that the runs leave, orange where the runs do not show the parameter.",
            partial(draw_estimates, found.estimates))]),
        Section("Error of each run", [_tabulate_errors(found.errors)]),
        Section("Findings", _describe_findings(found)),
        Section("Residual", _show_residuals(found)),
        Section("Provenance", [Listing(command, medium=Medium.PAGE)] if command else [])]
    return Report("identify", title, found.verdict, MOODS[found.verdict], describe_identification(found), facts, notes,
                  sections, next_command, files, collect_data(found))


def describe_identification(found: Identification) -> str:
    """The verdict in a sentence or two: how many parameters, the error before and after beside the noise floor."""
    seen = [e for e in found.estimates if e.is_identifiable]
    if found.verdict == "CANNOT_TELL":
        return f"{found.reason[0].upper()}{found.reason[1:]}."
    if found.verdict == "UNEXPLAINED":
        return (f"No parameters within the ranges explain the runs: {found.reason}. Something is missing in the model, "
                "or a range is too narrow.")
    count = f"{len(seen)} of {len(found.estimates)} free parameters are identified"
    if found.verdict == "IDENTIFIED":
        count = f"All {len(seen)} free parameters are identified"
    sentence = f"{count}: {_describe_change(found)}."
    if found.verdict == "PARTLY" and len(seen) == len(found.estimates):
        sentence += f" But {found.reason}."
    return sentence


def _describe_change(found: Identification) -> str:
    """The error of the worst signal before and after, on a held-out run where there is one."""
    chosen = (found.holdouts or found.errors)[0]
    s = max(chosen.before, key=lambda name: chosen.before[name] / chosen.floor[name])
    where = "held-out run, " if chosen.is_held_out else ""
    return (f"{where}{SIGNAL_NAMES[s]} error {format_signal(chosen.before[s], s)} -> "
            f"{format_signal(chosen.after[s], s)}, noise floor {format_signal(chosen.floor[s], s)}")


def _tabulate_parameters(found: Identification) -> Table:
    rows: list[list[Cell | str]] = []
    for e in found.estimates:
        word, mood = _judge_estimate(e, found.verdict)
        value = format_interval(e.value, e.low, e.high, e.unit)
        if not e.is_identifiable:
            value = f"not identifiable: {format_amount(e.low, e.unit)} .. {format_amount(e.high, e.unit)}"
        rows.append([e.name, Cell(format_amount(e.before, e.unit), "muted"),
                     Cell(value, "" if mood == "good" else mood),
                     f"{e.value / e.before:.3f}" if e.before else "", Cell(word, mood)])
    columns = [Column("parameter"), Column("data sheet", align="right"), Column("found (95 % interval)"),
               Column("over data sheet", align="right", medium=Medium.PAGE), Column("result", medium=Medium.PAGE)]
    note = ("The model file has these values as its nominal ones. What is not identifiable has a value within its "
            "range, and a remark.")
    if found.verdict == "UNEXPLAINED":
        note = "The model does not explain the runs, so these values and intervals may be wrong. " + note
    return Table(columns, rows, note)


def _judge_estimate(e: Estimate, verdict: str) -> tuple[str, Mood]:
    if not e.is_identifiable:
        return "not identifiable", "doubtful"
    if e.is_at_bound:
        return "at the end of its range", "bad"
    return ("not to be trusted", "doubtful") if verdict == "UNEXPLAINED" else ("identified", "good")


def _tabulate_errors(errors: Sequence[RunError]) -> Table:
    columns = [Column("run"), Column(""), Column("signal"), Column("before", align="right"),
               Column("after", align="right"), Column("noise floor", align="right"),
               Column("over floor", align="right")]
    rows: list[list[Cell | str]] = []
    for e in errors:
        kind = "held-out" if e.is_held_out else "fitted"
        for number, s in enumerate(e.after):
            ratio = e.after[s] / e.floor[s]
            file, role = (e.source.file, kind) if number == 0 else ("", "")  # once for the rows of a run
            rows.append([file, Cell(role, "muted"), SIGNAL_NAMES[s],
                         Cell(format_signal(e.before[s], s), "muted"), format_signal(e.after[s], s),
                         Cell(format_signal(e.floor[s], s), "muted"),
                         Cell(format_ratio(ratio), "good" if ratio <= RESIDUAL_HELD_OUT else "bad")])
    return Table(columns, rows, "RMS error of each signal with the data sheet's values (before) and with those found.")


def _describe_findings(found: Identification) -> list[Item]:
    lines: list[Item] = []
    advised: dict[str, list[str]] = {}
    for a in found.advice:
        text = a.what or "no candidate run: give a narrower range"
        advised.setdefault(text, []).append(a.parameter)
    lines += [Line("to identify", f"{join_words(names)}: {text}") for text, names in advised.items()]
    at_bound = [e.name for e in found.estimates if e.is_at_bound]
    if at_bound:
        lines.append(Line("at a bound", f"{join_words(at_bound)}: the interval reaches the end of the data sheet's "
                                        "range; give a wider one", "bad"))
    if found.correlations:
        pairs = join_words(f"{c.first} with {c.second} ({c.value:+.3f})" for c in found.correlations[:4])
        lines.append(Line("correlated", f"{pairs}: the ratio or product is known better than each"))
    lines += [Line("held-out run", text) for text in _describe_undecided(found.holdouts)]
    gains = found.controller
    if gains is not None and gains.is_proportional:
        limit = "" if gains.limit is None else f", limit {format_amount(gains.limit, 'A')}"
        lines.append(Line("controller", f"gain {format_amount(gains.gain, 'A/m', 4)}{limit}; exact in "
                                        f"{format_percent(gains.exact, 3)} of the rows"))
    elif gains is not None:
        lines.append(Line("controller", "no proportional law with a limit: the model keeps its gains"))
    return lines


def _describe_undecided(holdouts: Sequence[RunError]) -> list[str]:
    """Which part of each held-out run no model can predict, and the error of the rest."""
    return [f"{format_percent(e.undecided, 2)} of {e.source.file} cannot be predicted, because stops of ram or spool "
            f"there depend on a thousandth of a friction level; the rest is at {format_ratio(e.decided_ratio)} noise "
            "floors" for e in holdouts if 0.0 < e.undecided <= HELD_OUT_UNDECIDED_SHARE]


def _show_residuals(found: Identification) -> list[Item]:
    place = next((i for i, e in enumerate(found.errors) if e.is_held_out), 0)
    e, trace = found.errors[place], found.runs[place]
    kind = "held-out" if e.is_held_out else "fitted"
    return [Figure(
        f"Residual of each signal of the {kind} run {e.source.file}, with the data sheet's values and with those "
        "found. Where the model is right, the blue line stays between the dotted lines (two noise floors).",
        partial(draw_residuals, trace, *found.residuals[place], e.floor))]


def collect_data(found: Identification) -> dict[str, Any]:
    """The answer of `rig identify --json`; SI units."""
    parameters = {e.name: {"value": e.value, "low": e.low, "high": e.high, "unit": e.unit, "before": e.before,
                           "range": [e.least, e.most], "identifiable": e.is_identifiable, "at_bound": e.is_at_bound}
                  for e in found.estimates}
    runs = [{"file": e.source.file, "sha256": e.source.sha256, "held_out": e.is_held_out, "error_before": e.before,
             "error": e.after, "ratio": {s: x / e.floor[s] for s, x in e.after.items()}, "undecided": e.undecided,
             "ratio_decided": {s: x / e.floor[s] for s, x in e.decided.items()}} for e in found.errors]
    gains = found.controller
    controller = None if gains is None else {"gain": gains.gain, "limit": gains.limit, "exact": gains.exact}
    return {"verdict": found.verdict, "reason": found.reason, "parameters": parameters, "floor": dict(found.floor),
            "runs": runs, "correlations": [c._asdict() for c in found.correlations],
            "advice": [a._asdict() for a in found.advice], "controller": controller}


Floats = NDArray[np.float64]


def draw_estimates(estimates: Sequence[Estimate]) -> str:
    """Range of the data sheet and interval found of each parameter that cannot be zero, over its data sheet value."""
    shown = [e for e in estimates if e.least > 0.0 and e.before > 0.0][::-1]
    if not shown:
        return ""
    with start_figure(0.9 + 0.3 * len(shown)) as figure:
        ax = figure.subplots()
        for row, e in enumerate(shown):
            colour = AFTER if e.is_identifiable else HELD
            ax.plot([e.least / e.before, e.most / e.before], [row, row], color=BEFORE, lw=7.0, solid_capstyle="butt")
            ax.plot([e.low / e.before, e.high / e.before], [row, row], color=colour, lw=3.0, solid_capstyle="butt")
            ax.plot([e.value / e.before], [row], "o", color=colour, ms=5.0)
        ax.axvline(1.0, color=FLOOR, lw=1.2)
        ax.set_xscale("log")
        label_log_axis(ax.xaxis)
        ax.set_yticks(np.arange(len(shown)), [e.name for e in shown])
        ax.set_xlabel("value over that of the data sheet (green line)")
        return to_svg(figure, "estimates")


def draw_residuals(trace: Trace, before: Floats, after: Floats, floor: Mapping[str, float]) -> str:
    """The residual, measured minus model, of each signal over time with both models, below the command.

    `before` and `after` are model minus measured, (s, n) SI.
    """
    with start_figure(1.4 + 1.9 * len(trace.outputs)) as figure:
        axes = figure.subplots(1 + len(trace.outputs), 1, sharex=True, height_ratios=[0.8] + [1.3] * len(trace.outputs))
        axes[0].plot(*thin_line(trace.t, trace.com * 1e3), color=COMMAND, lw=1.6)
        axes[0].set_ylabel("Com [mm]")
        for i, (ax, name) in enumerate(zip(axes[1:], trace.outputs, strict=True)):
            unit, scale = DRAWN_UNITS[name]
            ax.plot(*thin_line(trace.t, -before[i] * scale), color=BEFORE, lw=0.9, label="data sheet")
            ax.plot(*thin_line(trace.t, -after[i] * scale), color=AFTER, lw=0.9, label="identified")
            for side in (-1, 1):
                ax.axhline(side * NOISE_BAND_RATIO * floor[name] * scale, color=FLOOR, lw=0.8, ls=":",
                           label="two noise floors" if side > 0 else None)
            width = 8.0 * floor[name] * scale
            ax.set_ylim(-max(width, 1.2 * scale * float(np.nanmax(np.abs(after[i])))),
                        max(width, 1.2 * scale * float(np.nanmax(np.abs(after[i])))))
            ax.set_ylabel(f"{SIGNAL_NAMES[name]} [{unit}]")
        axes[1].legend(ncols=3, **ABOVE)
        for ax in axes:
            shade_sections(ax, trace)
        axes[-1].set_xlabel("time [s]; what is beyond an axis is cut off")
        axes[-1].set_xlim(float(trace.t[0]), float(trace.t[-1]))
        figure.align_ylabels()
        return to_svg(figure, "identify")
