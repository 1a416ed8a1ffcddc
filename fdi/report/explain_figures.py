"""The figures of an explanation and of a model's ledger, as SVG text that stands inside an HTML page."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fdi.discovery.candidates import Candidate
from fdi.discovery.model_file import Row
from fdi.discovery.search import Hypothesis
from fdi.report.drawing import (
    ABOVE,
    COMMAND,
    INK,
    choose_drawn_unit,
    label_log_axis,
    shade_sections,
    start_figure,
    thin_line,
    to_svg,
)
from fdi.report.numbers import SIGNAL_NAMES
from fdi.thresholds import NOISE_BAND_RATIO
from fdi.trace.trace import Trace, rms

if TYPE_CHECKING:
    from fdi.discovery.laws.find_law import LawCurve
    from fdi.discovery.residual_pattern import Pattern

Floats = NDArray[np.float64]

AXES = {"position": (1e3, "mm"), "speed": (1e3, "mm/s"), "pressure": (1e-5, "bar"), "spool": (1e6, "um"),
        "current": (1e3, "mA"), "time": (1.0, "s"), "spool_speed": (1e3, "mm/s"), "way": (1e3, "mm")}
BEFORE, AFTER, HELD, FLOOR = "#9aa4b1", "#1f6feb", "#d9730d", "#2b8a3e"


def draw_residuals(trace: Trace, before: Hypothesis, after: Hypothesis | None, floor: Mapping[str, float],
                   name_of_after: str = "with the missing effect") -> str:
    """The residual, measured minus model, of each signal over time, without and with the effects, below the command.

    (The residuals of a fit have the other sign: model minus measured.)
    """
    t, n = trace.t, len(trace)
    with start_figure(1.4 + 1.7 * len(trace.outputs)) as figure:
        heights = [0.8] + [1.2] * len(trace.outputs)
        axes = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
        axes[0].plot(*thin_line(t, trace.com * 1e3), color=COMMAND, lw=1.6)
        axes[0].set_ylabel("Com [mm]")
        for i, (ax, name) in enumerate(zip(axes[1:], trace.outputs, strict=True)):
            unit, scale = choose_drawn_unit(name, rms(before.fit.residuals[i, :n]))
            line = thin_line(t, -before.fit.residuals[i, :n] * scale)
            ax.plot(*line, color=BEFORE, lw=0.9, label="model as it was")
            if after is not None:
                line = thin_line(t, -after.fit.residuals[i, :n] * scale)
                ax.plot(*line, color=AFTER, lw=0.9, label=name_of_after)
            for side in (-1, 1):
                ax.axhline(side * NOISE_BAND_RATIO * floor[name] * scale, color=FLOOR, lw=0.8, ls=":",
                           label="two noise floors" if side > 0 else None)
            ax.set_ylabel(f"{SIGNAL_NAMES[name]} [{unit}]")
        axes[1].legend(ncols=3, **ABOVE)
        for ax in axes:
            shade_sections(ax, trace)
        axes[-1].set_xlabel("time [s]")
        axes[-1].set_xlim(float(t[0]), float(t[-1]))
        figure.align_ylabels()
        return to_svg(figure, "left")


def draw_ranking(candidates: Sequence[Candidate], floor: Mapping[str, float], most: int = 12) -> str:
    """Error over noise floor of each candidate's worst signal, on the run and on the held-out one."""
    shown = list(candidates[:most])[::-1]
    with start_figure(0.9 + 0.34 * len(shown)) as figure:
        ax = figure.subplots()
        rows = np.arange(len(shown))
        held = [max((x / floor[s] for s, x in c.holdout.items() if s in floor), default=np.nan) for c in shown]
        own = [max(c.ratio, 1e-3) for c in shown]
        ax.barh(rows + 0.19, own, height=0.36, color=AFTER, label="this run")
        ax.barh(rows - 0.19, np.nan_to_num(held, nan=1e-3), height=0.36, color=HELD, label="held-out run")
        ax.axvline(1.0, color=FLOOR, lw=1.2, label="noise floor")
        ax.set_xscale("log")
        ax.set_xlim(0.8, 1.3 * float(np.nanmax([*own, *held, 2.0])))
        label_log_axis(ax.xaxis)
        ax.set_yticks(rows, [" + ".join([*c.beside, c.effect]) for c in shown])
        ax.set_xlabel("error of the worst signal over its noise floor")
        ax.legend(ncols=3, **ABOVE)
        return to_svg(figure, "ranking")


def draw_ledger(rows: Sequence[Row], floor: Mapping[str, float]) -> str:
    """Error over noise floor of each signal after each effect, on the fitted run and on the held-out one."""
    signals = [s for s in floor if s in rows[0].error]
    with start_figure(2.9) as figure:
        axes = figure.subplots(1, len(signals), sharey=True, squeeze=False)[0]
        names = [name_step(row) for row in rows]
        for ax, s in zip(axes, signals, strict=True):
            x = np.arange(len(rows))
            own, held = ([by.get(s, np.nan) / floor[s] for by in side] for side in
                         ([r.error for r in rows], [r.holdout for r in rows]))
            ax.bar(x - 0.19, own, width=0.36, color=AFTER, label="fitted run")
            ax.bar(x + 0.19, held, width=0.36, color=HELD, label="held-out run")
            ax.axhline(1.0, color=FLOOR, lw=1.2)
            ax.set_yscale("log")
            label_log_axis(ax.yaxis)
            ax.set_xticks(x, names, rotation=20, ha="right")
            ax.set_title(SIGNAL_NAMES[s], fontsize=9, color=INK)
        axes[0].set_ylabel("error over noise floor")
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=2, frameon=False)
        return to_svg(figure, "ledger")


def name_step(row: Row) -> str:
    """What a step of the ledger did.

    >>> name_step(Row("null_bias", {}, {}))
    '+ null_bias'
    """
    if row.effect is None:
        return "model as it was"
    return f"{'-' if row.removed else '+'} {row.effect}"


def draw_pattern(p: Pattern, t: Floats) -> str:
    """The missing quantity over the state that it follows, and over time."""
    with start_figure(3.0) as figure:
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
        over.set_ylabel(f"missing {p.place} [{p.unit}]")
        n = min(len(t), len(p.trace))
        along.plot(*thin_line(t[:n], p.trace[:n]), color=HELD, lw=0.8)
        along.set_xlabel("time [s]")
        return to_svg(figure, "shape")


def draw_law(c: LawCurve) -> str:
    """What is missing over the law's first state, in bins with two standard errors, and what the law says there."""
    with start_figure(3.2) as figure:
        ax = figure.subplots()
        scale, unit = AXES.get(c.state, (1e3, "mm"))
        low, high = c.height - 2.0 * c.doubt, c.height + 2.0 * c.doubt
        ax.fill_between(scale * c.at, low, high, color=HELD, alpha=0.25, lw=0.0, label="two standard errors")
        ax.plot(scale * c.at, c.height, "o", color=HELD, ms=3.5, label="measured")
        ax.plot(scale * c.at, c.law, color=AFTER, lw=1.4, label="law")
        name = "distance since the last reversal" if c.state == "way" else c.state.replace("_", " ")
        folded = f", folded on {scale * c.period:.4g} {unit}" if c.period else ""
        ax.set_xlabel(f"{name} [{unit}]{folded}")
        sign = f", times the sign of the {'speed' if c.along == 'direction' else c.along}" if c.along else ""
        ax.set_ylabel(f"missing {c.place} [{c.unit}]{sign}", fontsize=8)
        ax.legend(loc="best", frameon=False)
        return to_svg(figure, "law")
