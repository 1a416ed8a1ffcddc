"""The picture of a dry run: command and predicted run beside the limits of the actuator."""
from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fdi.report.drawing import COMMAND, FAULT, GREEN, INK, RED, start_figure, thin_line, to_svg
from plant.segments import RATE, Array
from rig.studies.dry_run.dry_run import DryRun

if TYPE_CHECKING:
    from matplotlib.axes import Axes


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
