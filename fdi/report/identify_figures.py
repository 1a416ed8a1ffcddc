"""The figures of an identification, as SVG text that stands inside an HTML page."""
from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from fdi.identification.identify import Estimate
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
from fdi.report.explain_figures import AFTER, BEFORE, FLOOR, HELD
from fdi.report.numbers import SIGNAL_NAMES
from fdi.thresholds import NOISE_BAND_RATIO
from fdi.trace.trace import Trace

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
