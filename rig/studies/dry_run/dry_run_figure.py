"""The picture of a dry run: command and predicted run beside the limits of the actuator."""
from __future__ import annotations

import numpy as np

from fdi.report.drawing import COMMAND, GREEN, INK, RED, start_figure, thin_line, to_svg
from plant.segments import RATE, Array
from rig.studies.dry_run.dry_run import DryRun


def draw_dry_run(dry: DryRun) -> str:
    """Position, speed, following error, current and load over time, with limits in red; the windows of the checks."""
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
    heights = [1.6] * len(panels) + [0.15 * len(dry.checks) + 0.3] * bool(dry.checks)
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
                    ax.text(0.995, 0.06, f"limit {limit * scale:.4g}", transform=ax.transAxes, ha="right", color=RED,
                            fontsize=8)
            ax.set_ylabel(label, fontsize=8)
        axes[0].legend(loc="lower right", bbox_to_anchor=(1, 0.98), ncols=2, frameon=False)
        if dry.checks:
            for row, check in enumerate(dry.checks):
                if check.t0 == check.t0:
                    colour = GREEN if check.passed else RED
                    axes[-1].barh(-row, check.t1 - check.t0, 0.7, check.t0, color=colour, alpha=0.75)
                    axes[-1].text(check.t0, -row, f" {check.name}", va="center", fontsize=6.5, color=INK, clip_on=True)
            axes[-1].set_yticks([])
            axes[-1].set_ylabel("checks", fontsize=8)
        axes[-1].set_xlabel("time from the start of the main phase [s]")
        axes[-1].set_xlim(float(dry.t[0]), float(dry.t[-1]) + 1.0 / RATE)
        return to_svg(figure, "dry run")
