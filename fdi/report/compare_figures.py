"""The drawings of a comparison, as SVG text that stands inside an HTML page."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fdi.comparison.compare import Comparison
from fdi.comparison.residual_tests import Depends, ResidualTests
from fdi.report.compare_text import SHOWN
from fdi.report.drawing import COMMAND, INK, RED, STYLE, thin_line, to_svg
from fdi.trace.sections import find_sections

Floats = NDArray[np.float64]

COLOURS = {"xj": "#1f6feb", "p12": "#0f8b8d", "xs": "#bf3989"}
MODEL, NOISE = "#d9730d", "#2b8a3e"
QUANTITIES = {"speed": ("speed [mm/s]", 1e3), "position": ("position [mm]", 1e3), "P12": ("P12 [bar]", 1e-5),
              "acceleration": ("acceleration [m/s2]", 1.0)}
TWICE = 2.0  # floors: noise stays within for 95 % of the time


def overview(found: Comparison) -> str:
    """Command and position, then each signal measured and replayed, and what is left of it beside the floor."""
    c, names = found.trace, list(found.signals)
    with rc_context(STYLE):
        heights = [1.5] + [1.3, 1.3] * len(names)
        figure = Figure(figsize=(11, 0.8 + sum(heights)), layout="constrained")
        axes = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
        axes[0].plot(*thin_line(c.t, c.com * 1e3), color=COMMAND, lw=2.2, label="Com, command")
        axes[0].plot(*thin_line(c.t, c.xj * 1e3), color=COLOURS["xj"], lw=1.0, label="XJ, ram")
        axes[0].set_ylabel("position [mm]")
        axes[0].legend(loc="lower right", bbox_to_anchor=(1, 0.97), ncols=2, frameon=False)
        for i, name in enumerate(names):
            _replayed(axes[1 + 2 * i], found, name)
            _left(axes[2 + 2 * i], found, name)
        for ax in axes:
            _shaded(ax, found)
        axes[-1].set_xlabel("time [s]")
        axes[-1].set_xlim(float(c.t[0]), float(c.t[-1]) + c.period)
        figure.align_ylabels()
        return to_svg(figure, "overview")


def _replayed(ax: Axes, found: Comparison, name: str) -> None:
    label, unit, scale = SHOWN[name]
    t = found.trace.t
    ax.plot(*thin_line(t, found.trace.measured(name) * scale), color=COLOURS[name], lw=1.2, label="measured")
    ax.plot(*thin_line(t, found.replay.model[name] * scale), color=MODEL, lw=0.8, label="model, from the current")
    ax.set_ylabel(f"{label} [{unit}]")
    ax.legend(loc="upper right", ncols=2, frameon=False)


def _left(ax: Axes, found: Comparison, name: str) -> None:
    label, unit, scale = SHOWN[name]
    floor = TWICE * found.signals[name].floor.value * scale
    ax.axhspan(-floor, floor, color=NOISE, alpha=0.25, lw=0)
    ax.plot(*thin_line(found.trace.t, found.replay.residual[name] * scale), color=INK, lw=0.7)
    ax.set_ylabel(f"left of {label}\n[{unit}]")


def _shaded(ax: Axes, found: Comparison) -> None:
    c = found.trace
    for section in find_sections(c.com, c.period):
        if section.kind in ("ramp", "dynamic"):
            ax.axvspan(float(c.t[section.start]), float(c.t[section.stop - 1]),
                       color="#f1f3f8" if section.kind == "ramp" else "#f7f1fa", lw=0, zorder=-1)
    out = (found.replay.undecided | ~c.usable).astype(int)
    for a, b in np.flatnonzero(np.diff(out, prepend=0, append=0)).reshape(-1, 2):
        ax.axvspan(float(c.t[a]), float(c.t[b - 1]), color=RED, alpha=0.12, lw=0, zorder=-1)


def shares(found: Comparison) -> str:
    """Each section's share of the squared error, in the order of time."""
    places = sorted(found.where, key=lambda place: place.t0)
    with rc_context(STYLE):
        figure = Figure(figsize=(11, 0.7 + 0.27 * len(places)), layout="constrained")
        ax = figure.subplots()
        ax.barh(range(len(places)), [100 * p.share for p in places], color=MODEL, height=0.7)
        ax.set_yticks(range(len(places)), [f"{p.section}, {p.t0:.2f}–{p.t1:.2f} s" for p in places])
        for row, place in enumerate(places):
            ax.text(100 * place.share, row, f" {place.ratio:.3g} floors", va="center", fontsize=8)
        ax.invert_yaxis()
        ax.grid(axis="y", visible=False)
        ax.set_xlabel("share of the squared error [%]")
        ax.set_xlim(0, 112 * max(p.share for p in places))
        return to_svg(figure, "shares")


def whiteness(found: Comparison) -> str:
    """A row a signal: autocorrelation, cumulative periodogram, cross-correlation with the current."""
    names = list(found.diagnoses)
    with rc_context(STYLE):
        figure = Figure(figsize=(11, 2.4 * len(names)), layout="constrained")
        rows = figure.subplots(len(names), 3, squeeze=False)
        for name, axes in zip(names, rows, strict=True):
            d = found.diagnoses[name]
            _autocorrelation(axes[0], d, found.trace.period, SHOWN[name][0])
            _periodogram(axes[1], d)
            _cross(axes[2], d)
        return to_svg(figure, "whiteness")


def _autocorrelation(ax: Axes, d: ResidualTests, period: float, label: str) -> None:
    lags = np.arange(1, len(d.correlation)) * period * 1e3
    ax.axhspan(-d.band, d.band, color=NOISE, alpha=0.25, lw=0)
    ax.vlines(lags, 0.0, d.correlation[1:], color=INK, lw=0.8)
    ax.set_ylabel(f"{label}\nautocorrelation")
    ax.set_xlabel("lag [ms]")


def _periodogram(ax: Axes, d: ResidualTests) -> None:
    f, line = d.frequencies, np.linspace(0.0, 1.0, len(d.frequencies))
    ax.fill_between(f, line - d.allowed, line + d.allowed, color=NOISE, alpha=0.25, lw=0)
    ax.plot(*thin_line(f, d.power), color=INK, lw=1.0)
    ax.set_ylim(0, 1)
    ax.set_ylabel("cumulative power")
    ax.set_xlabel("frequency [Hz]")


def _cross(ax: Axes, d: ResidualTests) -> None:
    chosen = next((f for f in d.follows if f.input == "Cor"), d.follows[0] if d.follows else None)
    if chosen is None:
        ax.set_axis_off()
        return
    ax.axhspan(-chosen.bound, chosen.bound, color=NOISE, alpha=0.25, lw=0)
    ax.vlines(chosen.lags * 1e3, 0.0, chosen.curve, color=INK, lw=0.8)
    ax.axvline(0.0, color=COMMAND, lw=0.6)
    ax.set_ylabel(f"correlation with {chosen.input}")
    ax.set_xlabel(f"residual later than {chosen.input} by [ms]")


def dependence(found: Comparison) -> str:
    """A row a signal: means of the residual over speed, position, P12 and acceleration, with their 95 % intervals."""
    names = list(found.diagnoses)
    kinds = [kind for kind in QUANTITIES if any(d.on == kind for n in names for d in found.diagnoses[n].depends)]
    if not kinds:
        return ""
    with rc_context(STYLE):
        figure = Figure(figsize=(11, 2.3 * len(names)), layout="constrained")
        rows = figure.subplots(len(names), len(kinds), squeeze=False)
        for name, axes in zip(names, rows, strict=True):
            by = {d.on: d for d in found.diagnoses[name].depends}
            _means(axes, kinds, by, name, TWICE * found.signals[name].floor.value)
        return to_svg(figure, "dependence")


def _means(axes: Sequence[Axes], kinds: Sequence[str], by: dict[str, Depends], name: str, floor: float) -> None:
    label, unit, scale = SHOWN[name]
    for ax, kind in zip(axes, kinds, strict=True):
        if kind not in by:
            ax.set_axis_off()
            continue
        d, (words, factor) = by[kind], QUANTITIES[kind]
        ax.axhspan(-floor * scale, floor * scale, color=NOISE, alpha=0.15, lw=0)
        ax.errorbar(d.centres * factor, d.means * scale, d.half * scale, color=COLOURS[name], lw=1.0, marker="o", ms=3)
        ax.set_xlabel(words)
        ax.set_title(f"{100 * d.share:.0f} % of the square", fontsize=8)
    axes[0].set_ylabel(f"left of {label}, mean\n[{unit}]")
