"""The figure of `rig diff`, as SVG text for an HTML page: each signal of all runs, and its difference below."""
from __future__ import annotations

import math
from typing import TYPE_CHECKING

from fdi.comparison.run_differences import RunDifferences, SignalDifference
from fdi.report.drawing import ABOVE, COMMAND, GREEN, LEVELS, shade_sections, start_figure, thin_line, to_svg
from fdi.report.numbers import SIGNAL_NAMES, choose_unit
from fdi.thresholds import NOISE_BAND_RATIO

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
