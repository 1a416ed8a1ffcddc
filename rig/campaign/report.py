"""The report of a campaign: its statistics as tables, and the detection curves."""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from fdi.diagnosis.faults import FAULTS, Fault
from fdi.report.drawing import COMMAND, GREEN, INK, RED, STYLE, to_svg
from fdi.report.numbers import NO_NUMBER, format_digits, format_duration
from fdi.report.report import (
    Cell,
    Column,
    Item,
    Line,
    Medium,
    Mood,
    Paragraph,
    Report,
    Section,
    Table,
)
from rig.campaign.batch import BatchProgress
from rig.campaign.summary import FAULT_NAMES, name_size

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def describe_progress(progress: BatchProgress) -> str:
    """How far a campaign is: "120/1400, 2 failed, 35 min left"."""
    failed = f", {progress.failed} failed" if progress.failed else ""
    return f"{progress.done}/{progress.total}{failed}, {format_duration(progress.left)} left"


def build_campaign_report(figures: Mapping[str, Any], title: str = "campaign") -> Report:
    """Report on the figures of `rig.campaign.summary.summarise_campaign`, which are its `data`."""
    status = ", ".join(f"{count} {word}" for word, count in figures["status"].items())
    took = figures["seconds"]
    time = [Line("time a case", f"{took['median']:.2f} s (median), {took['p95']:.2f} s (95th percentile), "
                                f"{took['most']:.2f} s (longest)")] if took else []
    return Report(
        command="campaign", title=title, sentence=f"{figures['cases']} cases: {status or 'none finished'}.",
        sections=[Section("Time", time), *(_build_tolerance_section(part) for part in figures["tolerances"]),
                  Section("Traces", _tabulate_traces(figures["traces"])),
                  Section("Cases without a result", _list_reasons(figures["reasons"]))],
        data=figures)


def _build_tolerance_section(part: Mapping[str, Any]) -> Section:
    tables = [_tabulate_rates(part["rates"]),
              *(_tabulate_detections(fault, part["curves"][fault.name]) for fault in FAULTS),
              *(_tabulate_counts(f"true {fault.name}", part["levels"][fault.name],
                                 f"Cases by true level of {fault.name} (row) and level reported (column).")
                for fault in FAULTS),
              _tabulate_counts("true faults", part["ruling"], "Cases by true faults (row) and ruling fault reported "
                                                              "(column)."),
              _tabulate_errors(part["errors"])]
    title = f"Plants with {100 * part['tolerance']:g} % scatter: {part['cases']} cases"
    return Section(title, [table for table in tables if table.rows], title_medium=Medium.BOTH)


def _number_columns(*titles: str) -> list[Column]:
    """A column of words and columns of numbers."""
    return [Column(titles[0]), *(Column(title, align="right") for title in titles[1:])]


def format_share(count: Mapping[str, Any]) -> tuple[str, str, str]:
    """A share as count, per cent and 95 % interval.

    >>> format_share({"good": 19, "of": 20, "share": 0.95, "low": 0.7513, "high": 0.9987})
    ('19/20', '95.0 %', '75.1 .. 99.9')
    """
    if not count["of"]:
        return "0/0", NO_NUMBER, NO_NUMBER
    return (f"{count['good']}/{count['of']}", f"{100 * count['share']:.1f} %",
            f"{100 * count['low']:.1f} .. {100 * count['high']:.1f}")


def _tabulate_rates(rates: Sequence[Mapping[str, Any]]) -> Table:
    required = [format_requirement(100 * rate["least"], 100 * rate["most"]) for rate in rates]
    rows = [[rate["name"], *format_share(rate["share"]), words, _judge_rate(rate["met"], words)]
            for rate, words in zip(rates, required, strict=True) if rate["share"]["of"]]
    return Table(_number_columns("rate", "count", "share", "95 % interval", "required", "verdict"), rows,
                 "Detection and false-alarm rates beside what is required of them.")


def _judge_rate(met: bool | None, required: str) -> Cell:
    if met is None:
        return Cell("too few" if required else "", "muted")
    return Cell("met", "good") if met else Cell("NOT met", "bad")


def format_requirement(low: float, high: float) -> str:
    """The required range of a share in per cent; "" where nothing is required.

    >>> format_requirement(95.0, 100.0), format_requirement(0.0, 0.5), format_requirement(0.0, 100.0)
    ('>= 95 %', '<= 0.5 %', '')
    """
    if low > 0 and high < 100:
        return f"{low:g} .. {high:g} %"
    if low > 0:
        return f">= {low:g} %"
    return f"<= {high:g} %" if high < 100 else ""


def _tabulate_detections(fault: Fault, points: Sequence[Mapping[str, Any]]) -> Table:
    unit = f" [{fault.unit}]" if fault.unit != "1" else ""
    columns = _number_columns(f"{fault.name}{unit}", "detected", "share", "95 % interval", "non-nominal", "ruling",
                              "by bands")
    rows = [[f"{point['size']:g}", *format_share(point["detected"]),
             *(format_share(point[key])[1] for key in ("most", "ruling", "bands"))]
            for point in points if len(points) > 1]
    return Table(columns, rows, f"Detected: {fault.name} judged maintenance or worse, by true size; then the shares "
                                "judged non-nominal, named as ruling fault, and detected by the bands alone.")


def _tabulate_counts(title: str, counts: Mapping[str, Mapping[str, int]], caption: str) -> Table:
    answers = list(dict.fromkeys(word for row in counts.values() for word, count in row.items() if count))
    rows = [[truth, *(str(row.get(word, 0)) for word in answers)] for truth, row in counts.items() if any(row.values())]
    return Table(_number_columns(title, *answers), rows, caption)


def _tabulate_errors(errors: Sequence[Mapping[str, Any]]) -> Table:
    rows = []
    for error in errors:
        plant = error["label"]
        for other in FAULTS:
            plant = plant.replace(f"{other.name}=", f"{name_size(other)} ")
        rows.append([plant, name_size(FAULT_NAMES[error["fault"]]), str(error["cases"]),
                     *(f"{error[key]:.2g}" for key in ("bias", "rms", "most")), *format_share(error["covered"])[1:]])
    columns = _number_columns("plant", "estimate", "cases", "bias", "RMS", "p95", "covered", "95 % interval")
    return Table(columns, rows, "Errors of the estimated sizes (FSS in N); covered: share of 95 % intervals that "
                                "contain the true size.")


def _tabulate_traces(traces: Sequence[Mapping[str, Any]]) -> list[Item]:
    if not traces:
        return []
    columns = [Column("trace"), *(Column(fault.name) for fault in FAULTS), Column("ruling"),
               *(Column(name_size(fault), align="right") for fault in FAULTS)]
    rows = []
    for trace in traces:
        levels = [trace[f"level_{fault.name}"] or trace["status"] for fault in FAULTS]
        sizes = [trace[fault.symbol] for fault in FAULTS]
        rows.append([trace["label"], *levels, trace["ruling"] or NO_NUMBER,
                     *(format_digits(math.nan if size is None else size) for size in sizes)])
    return [Table(columns, rows, "Levels, ruling fault and fault sizes of each recorded trace.")]


def _list_reasons(reasons: Sequence[Mapping[str, Any]], most: int = 10) -> list[Item]:
    moods: dict[str, Mood] = {"failed": "bad", "refused": "doubtful"}
    items: list[Item] = [Line(reason["status"], f"{reason['case']}, seed {reason['seed']}: {reason['reason']}",
                              moods.get(reason["status"], "")) for reason in reasons[:most]]
    if len(reasons) > most:
        items.append(Paragraph(f"and {len(reasons) - most} more"))
    return items


BLUE = "#1f6feb"
LINES = (("detected", "maintenance or worse", BLUE), ("most", "non-nominal", RED), ("ruling", "ruling fault", GREEN),
         ("bands", "maintenance or worse, by the bands alone", COMMAND))


def draw_detection_curves(part: Mapping[str, Any]) -> str:
    """Draw the share of plants that are detected, by size of a single fault, with 95 % intervals, as SVG.

    `part` is the element of `summarise_campaign(...)["tolerances"]` for one tolerance.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        figure = Figure(figsize=(10, 3.6), layout="constrained")
        axes = figure.subplots(1, len(FAULTS), sharey=True)
        for ax, fault in zip(axes, FAULTS, strict=True):
            _draw_fault(ax, fault, part["curves"][fault.name])
        axes[0].set_ylabel("share of plants [%]")
        axes[0].set_ylim(-3, 103)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(LINES), frameon=False)
        return to_svg(figure, "detection")


def _draw_fault(ax: Axes, fault: Fault, points: Sequence[Mapping[str, Any]]) -> None:
    span = max([fault.most, *(point["size"] for point in points)]) - fault.healthy
    for i, (key, label, colour) in enumerate(LINES):
        known = [point for point in points if point[key]["of"]]
        x = [point["size"] + 0.004 * (i - 1.5) * span for point in known]  # beside one another
        y = [100 * point[key]["share"] for point in known]
        ends = [[100 * abs(point[key]["share"] - point[key][end]) for point in known] for end in ("low", "high")]
        ax.errorbar(x, y, ends, color=colour, lw=1.4, marker="o", ms=3.5, elinewidth=0.9, capsize=2, label=label)
    for size, word in ((fault.middle, "MidBand"), (fault.most, "MaxBand")):
        ax.axvline(size, color=COMMAND, lw=0.9, ls="--", zorder=0)
        ax.text(size, 50, f" {word}", color=INK, fontsize=8, rotation=90, va="center", ha="right")
    unit = f" [{fault.unit}]" if fault.unit != "1" else ""
    ax.set_xlabel(f"{fault.name}, {name_size(fault)}{unit}")
