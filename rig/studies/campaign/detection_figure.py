"""The figure of a campaign: detection rate by fault size."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fdi.diagnosis.faults import FAULTS, Fault
from fdi.report.drawing import COMMAND, GREEN, INK, RED, STYLE, to_svg
from rig.studies.campaign.campaign_summary import name_size

BLUE = "#1f6feb"
LINES = (("detected", "maintenance or worse", BLUE), ("most", "non-nominal", RED), ("ruling", "ruling fault", GREEN),
         ("bands", "maintenance or worse, by the bands alone", COMMAND))


def draw_detection_curves(part: Mapping[str, Any]) -> str:
    """Draw the share of plants that are detected, by size of a single fault, with 95 % intervals, as SVG.

    `part` is the element of `summarise_campaign(...)["tolerances"]` for one tolerance.
    """
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
