"""The figures of a comparison, as SVG text that stands inside an HTML page."""
from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fdi.comparison.compare import Comparison
from fdi.comparison.deviation_map import DeviationMap, map_deviation
from fdi.comparison.residuals import Depends, ResidualTests
from fdi.report.drawing import (
    ABOVE,
    COMMAND,
    INK,
    LEVELS,
    RED,
    choose_drawn_unit,
    shade_sections,
    start_figure,
    thin_line,
    to_svg,
)
from fdi.report.numbers import SIGNAL_NAMES, format_ratio
from fdi.thresholds import NOISE_BAND_RATIO

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

COLOURS = {"xj": "#1f6feb", "p12": "#0f8b8d", "xs": "#bf3989"}
MODEL, NOISE = "#d9730d", "#2b8a3e"
QUANTITIES = {"speed": ("speed [mm/s]", 1e3), "position": ("position [mm]", 1e3), "P12": ("P12 [bar]", 1e-5),
              "acceleration": ("acceleration [m/s2]", 1.0)}


def draw_overview(c: Comparison) -> str:
    """Command and position, then each signal measured and replayed, and its residual beside the noise floor."""
    run, names = c.trace, list(c.signals)
    heights = [1.5] + [1.3, 1.3] * len(names)
    with start_figure(0.8 + sum(heights)) as figure:
        axes = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
        axes[0].plot(*thin_line(run.t, run.com * 1e3), color=COMMAND, lw=2.2, label="Com, command")
        axes[0].plot(*thin_line(run.t, run.xj * 1e3), color=COLOURS["xj"], lw=1.0, label="XJ, ram")
        axes[0].set_ylabel("position [mm]")
        axes[0].legend(ncols=2, **ABOVE)
        for i, name in enumerate(names):
            _draw_replay(axes[1 + 2 * i], c, name)
            _draw_residual(axes[2 + 2 * i], c, name)
        for ax in axes:
            shade_sections(ax, run)
            _shade_rows_left_out(ax, c)
        axes[-1].set_xlabel("time [s]")
        axes[-1].set_xlim(float(run.t[0]), float(run.t[-1]) + run.period)
        figure.align_ylabels()
        return to_svg(figure, "overview")


def _draw_replay(ax: Axes, c: Comparison, name: str) -> None:
    label, (unit, scale) = SIGNAL_NAMES[name], LEVELS[name]
    t = c.trace.t
    ax.plot(*thin_line(t, c.trace.mask_unusable(name) * scale), color=COLOURS[name], lw=1.2, label="measured")
    ax.plot(*thin_line(t, c.replay.model[name] * scale), color=MODEL, lw=0.8, label="model, from the current")
    ax.set_ylabel(f"{label} [{unit}]")
    ax.legend(ncols=2, **ABOVE)


def _draw_residual(ax: Axes, c: Comparison, name: str) -> None:
    label, (unit, scale) = SIGNAL_NAMES[name], choose_drawn_unit(name, c.signals[name].error)
    floor = NOISE_BAND_RATIO * c.signals[name].floor.value * scale
    ax.axhspan(-floor, floor, color=NOISE, alpha=0.25, lw=0)
    ax.plot(*thin_line(c.trace.t, c.replay.residual[name] * scale), color=INK, lw=0.7)
    ax.set_ylabel(f"residual of\n{label} [{unit}]")


def _shade_rows_left_out(ax: Axes, c: Comparison) -> None:
    """Rows that are not judged, in red."""
    t = c.trace.t
    out = (c.replay.undecided | ~c.trace.usable).astype(int)
    for a, b in np.flatnonzero(np.diff(out, prepend=0, append=0)).reshape(-1, 2):
        ax.axvspan(float(t[a]), float(t[b - 1]), color=RED, alpha=0.12, lw=0, zorder=-1)


def draw_error_shares(c: Comparison) -> str:
    """Each section's share of the squared error, in the order of time."""
    places = sorted(c.where, key=lambda place: place.t0)
    with start_figure(0.7 + 0.27 * len(places)) as figure:
        ax = figure.subplots()
        ax.barh(range(len(places)), [100 * p.share for p in places], color=MODEL, height=0.7)
        ax.set_yticks(range(len(places)), [f"{p.section}, {p.t0:.2f}–{p.t1:.2f} s" for p in places])
        for row, place in enumerate(places):
            ax.text(100 * place.share, row, f" {format_ratio(place.ratio)} times the floor", va="center", fontsize=8)
        ax.invert_yaxis()
        ax.grid(axis="y", visible=False)
        ax.set_xlabel("share of the squared error [%]")
        ax.set_xlim(0, 125 * max(p.share for p in places))
        return to_svg(figure, "shares")


def draw_deviation_map(c: Comparison) -> str:
    """Error over noise floor of each signal by speed and amplitude of the ram; "" without rows enough."""
    from matplotlib.colors import LogNorm

    found = map_error(c)
    if found is None:
        return ""
    names = list(found.ratio)
    most = max(float(np.nanmax(ratio)) for ratio in found.ratio.values())
    norm = LogNorm(1.0, max(most, 10.0))
    with start_figure(1.2 + 0.42 * len(found.amplitudes)) as figure:
        axes = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
        for ax, name in zip(axes, names, strict=True):
            ratio = found.ratio[name]
            ax.pcolormesh(np.ma.masked_invalid(ratio), cmap="YlOrRd", norm=norm, edgecolors="white", linewidth=1.0)
            for (row, column), value in np.ndenumerate(ratio):
                if np.isfinite(value):
                    colour = "white" if norm(value) > 0.6 else INK
                    ax.text(column + 0.5, row + 0.5, format_ratio(float(value)), ha="center", va="center", fontsize=8,
                            color=colour)
            ax.set_xticks(range(len(found.speeds)), _name_edges(found.speeds))
            ax.set_title(SIGNAL_NAMES[name], fontsize=9)
            ax.set_xlabel("speed [mm/s]")
            ax.grid(visible=False)
        axes[0].set_yticks(range(len(found.amplitudes)), _name_edges(found.amplitudes))
        axes[0].set_ylabel("amplitude [mm]")
        return to_svg(figure, "map")


def map_error(c: Comparison) -> DeviationMap | None:
    """The residuals of a comparison by speed and amplitude, over their noise floors."""
    floor = {name: s.floor.value for name, s in c.signals.items() if s.floor.value > 0.0}
    return map_deviation(c.trace, {name: c.replay.residual[name] for name in floor}, floor) if floor else None


def _name_edges(edges: Floats) -> list[str]:
    return ["" if np.isinf(edge) else f"{1e3 * edge:g}" for edge in edges]


def draw_whiteness(c: Comparison) -> str:
    """One row per signal: autocorrelation, cumulative periodogram, cross-correlation with the current."""
    names = list(c.diagnoses)
    with start_figure(2.4 * len(names)) as figure:
        rows = figure.subplots(len(names), 3, squeeze=False)
        for name, axes in zip(names, rows, strict=True):
            d = c.diagnoses[name]
            _draw_autocorrelation(axes[0], d, c.trace.period, SIGNAL_NAMES[name])
            _draw_periodogram(axes[1], d)
            _draw_cross_correlation(axes[2], d)
        return to_svg(figure, "whiteness")


def _draw_autocorrelation(ax: Axes, d: ResidualTests, period: float, label: str) -> None:
    lags = np.arange(1, len(d.correlation)) * period * 1e3
    ax.axhspan(-d.band, d.band, color=NOISE, alpha=0.25, lw=0)
    ax.vlines(lags, 0.0, d.correlation[1:], color=INK, lw=0.8)
    ax.set_ylabel(f"{label}\nautocorrelation")
    ax.set_xlabel("lag [ms]")


def _draw_periodogram(ax: Axes, d: ResidualTests) -> None:
    f, line = d.frequencies, np.linspace(0.0, 1.0, len(d.frequencies))
    ax.fill_between(f, line - d.allowed, line + d.allowed, color=NOISE, alpha=0.25, lw=0)
    ax.plot(*thin_line(f, d.power), color=INK, lw=1.0)
    ax.set_ylim(0, 1)
    ax.set_ylabel("cumulative power")
    ax.set_xlabel("frequency [Hz]")


def _draw_cross_correlation(ax: Axes, d: ResidualTests) -> None:
    chosen = next((f for f in d.follows if f.input == "Cor"), d.follows[0] if d.follows else None)
    if chosen is None:
        ax.set_axis_off()
        return
    ax.axhspan(-chosen.bound, chosen.bound, color=NOISE, alpha=0.25, lw=0)
    ax.vlines(chosen.lags * 1e3, 0.0, chosen.curve, color=INK, lw=0.8)
    ax.axvline(0.0, color=COMMAND, lw=0.6)
    ax.set_ylabel(f"correlation with {chosen.input}")
    ax.set_xlabel(f"residual later than {chosen.input} by [ms]")


def draw_dependence(c: Comparison) -> str:
    """One row per signal: mean residual over speed, position, P12 and acceleration, with 95 % intervals."""
    names = list(c.diagnoses)
    kinds = [kind for kind in QUANTITIES if any(d.on == kind for n in names for d in c.diagnoses[n].depends)]
    if not kinds:
        return ""
    with start_figure(2.3 * len(names)) as figure:
        rows = figure.subplots(len(names), len(kinds), squeeze=False)
        for name, axes in zip(names, rows, strict=True):
            by = {d.on: d for d in c.diagnoses[name].depends}
            _draw_means(axes, kinds, by, name, NOISE_BAND_RATIO * c.signals[name].floor.value)
        return to_svg(figure, "dependence")


def _draw_means(axes: Sequence[Axes], kinds: Sequence[str], by: dict[str, Depends], name: str, floor: float) -> None:
    label, (unit, scale) = SIGNAL_NAMES[name], choose_drawn_unit(name, max((d.size for d in by.values()), key=abs))
    for ax, kind in zip(axes, kinds, strict=True):
        if kind not in by:
            ax.set_axis_off()
            continue
        d, (words, factor) = by[kind], QUANTITIES[kind]
        ax.axhspan(-floor * scale, floor * scale, color=NOISE, alpha=0.15, lw=0)
        ax.errorbar(d.centres * factor, d.means * scale, d.half * scale, color=COLOURS[name], lw=1.0, marker="o", ms=3)
        ax.set_xlabel(words)
        ax.set_title(f"{100 * d.share:.0f} % of the power", fontsize=8)
    axes[0].set_ylabel(f"mean residual\nof {label} [{unit}]")
