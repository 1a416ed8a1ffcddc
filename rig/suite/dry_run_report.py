"""The report of a dry run for terminal, page and JSON."""
from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fdi.report.drawing import COMMAND, FAULT, GREEN, INK, RED, start_figure, thin_line, to_svg
from fdi.report.json import to_plain
from fdi.report.report import Cell, Column, Figure, Line, Medium, Report, Section, Table, tabulate
from fdi.report.run_report import format_limits
from plant.segments import RATE, Array
from rig.run.job import find_differences
from rig.sequences.checks import CheckResult
from rig.suite.dry_run import SHOWN_UNITS, Demand, DryRun, PlannedFault

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def build_dry_run_report(dry: DryRun, files: Sequence[tuple[str, str]] = ()) -> Report:
    """Report on a dry run; `files` are (label, path) of the files written."""
    sequence = dry.job.sequence
    problems, data = dry.problems, collect_data(dry)
    sentence = "; ".join(problems) if problems else "The actuator can follow this sequence."
    parts = [f"{name} {seconds:g} s" for name, seconds in dry.durations.items() if seconds]
    duration = f"{sum(dry.durations.values()):g} s: {', '.join(parts)}"
    facts = [("model", dry.job.model.name), ("differs from nominal", data["differences"]),
             ("checks", str(len(sequence.checks))), ("guards", str(len(sequence.guards)))]
    facts += [("steps in Python", ", ".join(f"{step.python} {step.when}" for step in sequence.steps))] if (
        sequence.steps) else []
    coloured = " Orange: the faults of the sequence." if dry.faults else ""
    picture = Figure("Position and speed of the command; position, following error and current of the predicted run of "
                     "a healthy actuator. Steps have no speed. Red: limits of the actuator. The bars are the windows "
                     "of the checks, green for a check that passes on the predicted run and red for one that does not."
                     + coloured, lambda: draw_dry_run(dry))
    return Report(
        command="check", title=f"Dry run: {sequence.title}", verdict=data["verdict"],
        mood="bad" if problems else "good", sentence=sentence, facts=facts, notes=_list_notes(dry),
        sections=[Section("Command and load", [Line("duration", duration), *_tabulate_demands(dry.demands)]),
                  Section("Faults", _tabulate_faults(dry.faults)),
                  Section("Predicted run", [Line(name, text) for name, text in describe_prediction(dry)]),
                  Section("Checks", _tabulate_checks(dry.checks)),
                  Section("Picture", [picture])],
        files=files, data=data)


def _list_notes(dry: DryRun) -> list[str]:
    notes = []
    if dry.job.sequence.faults:
        notes.append("the prediction is without the faults of the sequence")
    length = dry.durations["main"]
    notes += [f"fault {fault.label!r} ends with main at {length:g} s, not at {fault.end:g} s"
              for fault in dry.job.sequence.faults if fault.end is not None and fault.end > length + 0.5 / RATE]
    if dry.not_predicted:
        notes.append(f"not predicted, because they judge events: {', '.join(dry.not_predicted)}")
    failing = [check.name for check in dry.checks if not check.passed and check.value == check.value]
    if failing:
        notes.append(f"these checks would fail on the predicted run: {', '.join(failing)}")
    return notes


def _tabulate_demands(demands: Sequence[Demand]) -> list[Table]:
    return [tabulate(
        [each for each in demands if each.value >= 1e-9],
        (Column("largest"), lambda each: each.name),
        (Column("value", align="right"),
         lambda each: Cell(each.show(each.value), "bad" if each.is_violated else "", True)),
        (Column("limit", align="right"), lambda each: "" if each.limit is None else each.show(each.limit)),
        (Column("unit"), lambda each: SHOWN_UNITS[each.unit][0]),
        (Column("limit from"), lambda each: "" if each.limit is None else each.parameter),
        (Column("section"), lambda each: each.section), (Column("t", "s", "right"), lambda each: f"{each.t:.3f}"),
        caption="A jump between two sections is a step and counts neither as speed nor as acceleration.")]


def _tabulate_faults(faults: Sequence[PlannedFault]) -> list[Table]:
    return [tabulate(
        faults,
        (Column("fault"), lambda each: each.name), (Column("kind", medium=Medium.PAGE), lambda each: each.kind),
        (Column("target"), lambda each: each.target),
        (Column("from", "s", "right"), lambda each: f"{each.t0:.3f}"),
        (Column("to", "s", "right"), lambda each: f"{each.t1:.3f}"),
        (Column("duration", "s", "right", Medium.PAGE), lambda each: f"{each.duration:.3f}"),
        (Column("size"), lambda each: each.size),
        caption="Times count from the start of main; all faults end with it.")]


def describe_prediction(dry: DryRun) -> list[tuple[str, str]]:
    """The figures of the predicted run: current, following error, limits that it reaches."""
    run = dry.predicted
    error = run.com - run.xj
    limit = dry.job.model.values.get("controller.current_limit")
    current = f"largest {1e3 * np.abs(run.cor).max():.3g} mA" + (f" of {1e3 * limit:.3g} mA" if limit else "")
    main = (dry.t >= 0.0) & (dry.t < dry.durations["main"])
    lines = [("current", current),
             ("error", f"largest {1e3 * np.abs(error[main]).max():.4g} mm, RMS "
                       f"{1e3 * math.sqrt(float(np.mean(error[main] ** 2))):.4g} mm in main")]
    if dry.limits:
        lines.append(("reaches", "; ".join(each.describe() for each in dry.limits)))
    return lines


def _tabulate_checks(checks: Sequence[CheckResult]) -> list[Table]:
    def show_value(check: CheckResult) -> Cell:
        text = "none" if math.isnan(check.value) else f"{check.value:.4g}"
        return Cell(text, "good" if check.passed else "bad", True)

    return [tabulate(
        checks,
        (Column("check"), lambda check: check.name),
        (Column("window", "s"), lambda check: "-" if math.isnan(check.t0) else f"{check.t0:.3f} .. {check.t1:.3f}"),
        (Column("predicted", align="right"), show_value),
        (Column("limits", align="right"), lambda check: format_limits(check.low, check.high)),
        (Column("unit"), lambda check: "" if check.unit == "1" else check.unit),
        (Column("remark"), lambda check: check.detail))]


def collect_data(dry: DryRun) -> dict[str, Any]:
    """The JSON answer of a dry run."""
    run, error = dry.predicted, dry.predicted.com - dry.predicted.xj
    return {
        "verdict": "BEYOND_LIMITS" if dry.problems else "WITHIN_LIMITS", "problems": dry.problems,
        "sequence": dry.job.sequence.title, "model": dry.job.model.name,
        "differences": find_differences(dry.job).describe(), "durations": dry.durations,
        "faults": [{**each._asdict(), "duration": each.duration} for each in dry.faults],
        "demands": [{**each._asdict(), "violated": each.is_violated} for each in dry.demands],
        "predicted": {"current": float(np.abs(run.cor).max()), "error": float(np.abs(error).max()),
                      "limits": [each._asdict() for each in dry.limits],
                      "guards": [trip._asdict() for trip in dry.trips]},
        "checks": [to_plain(check._asdict()) for check in dry.checks], "not_predicted": dry.not_predicted}


class _Bar(NamedTuple):
    """A span of time with its name, s of main."""

    name: str
    t0: float
    t1: float
    colour: str


def draw_dry_run(dry: DryRun) -> str:
    """Position, speed, following error, current and load over time, with limits in red; faults, windows of checks."""
    limits = {each.name: each.limit for each in dry.demands}
    run = dry.predicted
    current = dry.job.model.values.get("controller.current_limit")
    panels: list[tuple[str, list[tuple[Array, str, str]], float, float | None]] = [
        ("position [mm]", [(run.com, COMMAND, "command"), (run.xj, "#1f6feb", "predicted")], 1e3, limits["position"]),
        ("speed [mm/s]", [(dry.speed, "#57606a", "")], 1e3, limits["speed"]),
        ("error [mm]", [(run.com - run.xj, "#d9730d", "")], 1e3, None),
        ("current [mA]", [(run.cor, "#8250df", "")], 1e3, current)]
    if dry.load.any():
        panels.append(("load [kN]", [(dry.load, "#57606a", "")], 1e-3, limits["load"]))
    faults = [_Bar(each.name, each.t0, each.t1, FAULT) for each in dry.faults]
    checks = [_Bar(check.name, check.t0, check.t1, GREEN if check.passed else RED) for check in dry.checks
              if check.t0 == check.t0]
    bars = [(label, group) for label, group in (("faults", faults), ("checks", checks)) if group]
    heights = [1.6] * len(panels) + [0.15 * len(group) + 0.3 for _, group in bars]
    with start_figure(sum(heights) + 0.6) as figure:
        axes = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
        for ax, (label, lines, scale, limit) in zip(axes, panels, strict=False):
            for values, colour, name in lines:
                ax.plot(*thin_line(dry.t, values * scale), color=colour, lw=1.2, label=name or None)
            if limit is not None:
                largest = max(float(np.nanmax(np.abs(values))) for values, _, _ in lines)
                if largest > 0.3 * limit:  # a limit far away would flatten the line
                    for side in (-limit, limit):
                        ax.axhline(side * scale, color=RED, lw=0.9, ls="--")
                else:
                    ax.text(0.0, 1.02, f"limit {limit * scale:.4g}", transform=ax.transAxes, color=RED, fontsize=8)
            ax.set_ylabel(label, fontsize=8)
            for fault in faults:
                ax.axvspan(fault.t0, fault.t1, color=FAULT, lw=0, alpha=0.5, zorder=-1)
        axes[0].legend(loc="lower right", bbox_to_anchor=(1, 0.98), ncols=2, frameon=False)
        axes[-1].set_xlim(float(dry.t[0]), float(dry.t[-1]) + 1.0 / RATE)
        for ax, (label, group) in zip(axes[len(panels):], bars, strict=True):
            _draw_bars(ax, group)
            ax.set_ylabel(label, fontsize=8)
        axes[-1].set_xlabel("time from the start of the main phase [s]")
        return to_svg(figure, "dry run")


def _draw_bars(ax: Axes, bars: list[_Bar], least: float = 0.004) -> None:
    """A bar in a row of its own for each span; its name stands where there is room.

    `least`: share of the axis that a bar covers, so that a fault of one cycle can be seen.
    """
    start, end = ax.get_xlim()
    for row, bar in enumerate(bars):
        ax.barh(-row, max(bar.t1 - bar.t0, least * (end - start)), 0.7, bar.t0, color=bar.colour, alpha=0.75)
        is_late = bar.t0 > 0.5 * (start + end)  # then the name stands before the bar
        ax.text(bar.t0, -row, f"{bar.name} " if is_late else f" {bar.name}", ha="right" if is_late else "left",
                va="center", fontsize=6.5, color=INK, clip_on=True)
    ax.set_yticks([])
