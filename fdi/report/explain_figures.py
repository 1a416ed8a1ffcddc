"""The drawings of an explanation and of a ledger, as SVG text that stands inside an HTML page."""
from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fdi.discovery.candidates import Candidate
from fdi.discovery.model_file import Row
from fdi.discovery.residual_pattern import Pattern
from fdi.discovery.search import Hypothesis
from fdi.report.drawing import COMMAND, INK, STYLE, thin_line, to_svg
from fdi.report.numbers import SIGNAL_NAMES
from fdi.trace.sections import find_sections
from fdi.trace.trace import Trace

Floats = NDArray[np.float64]

AXES = {"position": (1e3, "mm"), "speed": (1e3, "mm/s"), "pressure": (1e-5, "bar"), "spool": (1e6, "µm"),
        "current": (1e3, "mA"), "time": (1.0, "s")}
SCALES = {"xj": (1e6, "µm"), "p12": (1e-5, "bar"), "xs": (1e6, "µm")}
BEFORE, AFTER, HELD, FLOOR = "#c9ced6", "#1f6feb", "#d9730d", "#2b8a3e"
TWICE = 2.0  # floors: noise stays within for 95 % of the time
BARS = 12


def left_over(trace: Trace, before: Hypothesis, after: Hypothesis | None, floor: Mapping[str, float],
              name_of_after: str = "with what was found") -> str:
    """What the model leaves of each signal over time, without and with the effects, over the command."""
    t, n = trace.t, len(trace)
    with rc_context(STYLE):
        figure = Figure(figsize=(11, 1.4 + 1.7 * len(trace.outputs)), layout="constrained")
        heights = [0.8] + [1.2] * len(trace.outputs)
        axes = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
        axes[0].plot(*thin_line(t, trace.com * 1e3), color=COMMAND, lw=1.6)
        axes[0].set_ylabel("Com [mm]")
        for i, (ax, name) in enumerate(zip(axes[1:], trace.outputs, strict=True)):
            scale, unit = SCALES[name]
            line = thin_line(t, before.fit.residuals[i, :n] * scale)
            ax.plot(*line, color=BEFORE, lw=0.9, label="the model as it was")
            if after is not None:
                line = thin_line(t, after.fit.residuals[i, :n] * scale)
                ax.plot(*line, color=AFTER, lw=0.9, label=name_of_after)
            for side in (-1, 1):
                ax.axhline(side * TWICE * floor[name] * scale, color=FLOOR, lw=0.8, ls=":",
                           label="twice the floor" if side > 0 else None)
            ax.set_ylabel(f"{SIGNAL_NAMES[name]} [{unit}]")
        axes[1].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False, borderaxespad=0.0)
        for ax in axes:
            _shaded(ax, trace)
        axes[-1].set_xlabel("time [s]")
        axes[-1].set_xlim(float(t[0]), float(t[-1]))
        figure.align_ylabels()
        return to_svg(figure, "left")


def _shaded(ax: Axes, trace: Trace) -> None:
    """Ramps and dynamic sections of the command."""
    for s in find_sections(trace.com, trace.period):
        if s.kind in ("ramp", "dynamic"):
            ax.axvspan(float(trace.t[s.start]), float(trace.t[s.stop - 1]),
                       color="#f1f3f8" if s.kind == "ramp" else "#f7f1fa", lw=0, zorder=-1)


def ranking(candidates: Sequence[Candidate], floor: Mapping[str, float]) -> str:
    """What each candidate leaves, worst signal over its floor, on the run and on the held-out one."""
    shown = list(candidates[:BARS])[::-1]
    with rc_context(STYLE):
        figure = Figure(figsize=(11, 0.9 + 0.34 * len(shown)), layout="constrained")
        ax = figure.subplots()
        rows = np.arange(len(shown))
        held = [max((x / floor[s] for s, x in c.holdout.items() if s in floor), default=np.nan) for c in shown]
        own = [max(c.ratio, 1e-3) for c in shown]
        ax.barh(rows + 0.19, own, height=0.36, color=AFTER, label="this run, what repeats")
        ax.barh(rows - 0.19, np.nan_to_num(held, nan=1e-3), height=0.36, color=HELD, label="held-out run")
        ax.axvline(1.0, color=FLOOR, lw=1.2, label="floor")
        ax.set_xscale("log")
        ax.set_xlim(0.8, 1.3 * float(np.nanmax([*own, *held, 2.0])))
        ax.set_yticks(rows, [" + ".join([*c.beside, c.effect]) for c in shown])
        ax.set_xlabel("what is left, worst signal, in floors")
        ax.legend(loc="lower right", frameon=False)
        return to_svg(figure, "ranking")


def ledger(rows: Sequence[Row], floor: Mapping[str, float]) -> str:
    """The error of each signal after each effect, in floors, on the run and on the held-out one."""
    signals = [s for s in floor if s in rows[0].error]
    with rc_context(STYLE):
        figure = Figure(figsize=(11, 2.9), layout="constrained")
        axes = figure.subplots(1, len(signals), sharey=True, squeeze=False)[0]
        names = [_step(row) for row in rows]
        for ax, s in zip(axes, signals, strict=True):
            x = np.arange(len(rows))
            own, held = ([by.get(s, np.nan) / floor[s] for by in side] for side in
                         ([r.error for r in rows], [r.holdout for r in rows]))
            ax.bar(x - 0.19, own, width=0.36, color=AFTER, label="fitted run")
            ax.bar(x + 0.19, held, width=0.36, color=HELD, label="held-out run")
            ax.axhline(1.0, color=FLOOR, lw=1.2)
            ax.set_yscale("log")
            ax.set_xticks(x, names, rotation=20, ha="right")
            ax.set_title(SIGNAL_NAMES[s], fontsize=9, color=INK)
        axes[0].set_ylabel("error, in floors")
        axes[0].legend(loc="upper right", frameon=False)
        return to_svg(figure, "ledger")


def _step(row: Row) -> str:
    return "model as it was" if row.effect is None else f"{'-' if row.removed else '+'} {row.effect}"


def shape(p: Pattern, t: Floats) -> str:
    """What is missing: over the state that it follows, and over time."""
    with rc_context(STYLE):
        figure = Figure(figsize=(11, 3.0), layout="constrained")
        over, along = figure.subplots(1, 2, width_ratios=[1.0, 1.6])
        if len(p.at):
            state = p.state or "position"
            scale, unit = AXES[state]
            over.errorbar(scale * p.at, p.height, yerr=2.0 * p.doubt, color=HELD, lw=1.2, elinewidth=0.8)
            over.locator_params(axis="x", nbins=5)
            over.set_xlabel(f"{state} [{unit}]")
            if p.wave:
                amplitude, length, phase = p.wave
                x = np.linspace(0.0, length, 100)
                over.plot(scale * x, amplitude * np.sin(2.0 * np.pi * x / length + phase), color=AFTER, lw=1.0, ls="--")
                over.set_xlabel(f"{state} within a period of {scale * length:.4g} {unit}; dashed: a wave")
        over.set_ylabel(f"what is missing [{p.unit}]")
        n = min(len(t), len(p.trace))
        along.plot(*thin_line(t[:n], p.trace[:n]), color=HELD, lw=0.8)
        along.set_xlabel("time [s]")
        return to_svg(figure, "shape")
