"""The paper's figures redrawn from runs of the rig, as SVG text that stands inside an HTML page.

Figs. 7 and 8: what either fault does to a step and to a slow ramp. Figs. 10 to 12: a trace in the bands, position on a
step, position on a ramp, speed on a ramp. The RMS maps, figs. 14 and 15, are those of `rig fdi`.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fdi.diagnosis.bands import Bands, Excursion, StepBand, place_sections
from fdi.report import COMMAND, GREEN, INK, RED
from fdi.report.drawing import STYLE, thin_line, to_svg
from fdi.trace import Section, Trace

Floats = NDArray[np.float64]
COLOURS = ("#2b8a3e", "#d9730d", "#c93c37", "#1f6feb", "#8250df")
AMBER = "#d9730d"
LABELS = {("step", "position"): "position [mm]", ("ramp", "position"): "departure of\nposition [um]",
          ("ramp", "speed"): "departure of\nspeed [mm/s]"}  # of the bands' axes


def draw_steps(traces: Mapping[str, Trace], number: int = 0) -> str:
    """Fig. 7: position over the first 0.1 s of a step, one line a trace, the same command in each.

    Args:
        traces: by their labels in the legend.
        number: which of the command's steps, from 0.
    """
    with rc_context(STYLE):
        figure = Figure(figsize=(9, 3.6), layout="constrained")
        near, far = figure.subplots(1, 2, width_ratios=(3, 2))
        shown_time = 0.1  # s of a step
        for (label, trace), colour in zip(traces.items(), COLOURS, strict=False):
            s = _select_section(trace, "step", number)
            rows = slice(s.start, s.start + round(shown_time / trace.period))
            t = (np.arange(s.start, rows.stop) - s.start) * trace.period * 1e3
            for ax in (near, far):
                ax.plot(t, trace.xj[rows] * 1e3, color=colour, lw=1.2, label=label)
        for ax in (near, far):
            ax.axhline(s.last * 1e3, color=COMMAND, lw=1.0, ls=":")
            ax.set_xlabel("time from the step [ms]")
        size = s.last - s.first
        far.set_ylim(*sorted(((s.last - 0.02 * size) * 1e3, (s.last + 0.14 * size) * 1e3)))
        far.set_title("overshoot, close up", fontsize=9)
        near.set_ylabel("position [mm]")
        near.legend(loc="center right", frameon=False)
        return to_svg(figure, "steps")


def draw_ramps(traces: Mapping[str, Trace], number: int = 0) -> str:
    """Fig. 8: position over a slow ramp and its error, one line a trace; arguments as for `draw_steps`."""
    with rc_context(STYLE):
        figure = Figure(figsize=(9, 4.6), layout="constrained")
        way, error = figure.subplots(2, 1, sharex=True)
        for (label, trace), colour in zip(traces.items(), COLOURS, strict=False):
            s = _select_section(trace, "ramp", number)
            t, rows = _select_time(trace, s), slice(s.start, s.stop)
            way.plot(*thin_line(t, trace.xj[rows] * 1e3), color=colour, lw=1.0, label=label)
            error.plot(*thin_line(t, (trace.com - trace.xj)[rows] * 1e6), color=colour, lw=1.0)
        way.plot(t, trace.com[rows] * 1e3, color=COMMAND, lw=1.0, ls=":", label="command")
        way.set_ylabel("position [mm]")
        error.set_ylabel("error [um]")
        error.set_xlabel("time [s]")
        way.legend(loc="lower right" if s.rate > 0 else "upper right", frameon=False)
        return to_svg(figure, "ramps")


def draw_bands(excursions: list[Excursion], frictions: Mapping[str, Sequence[float]], bands: Bands, trace: Trace,
               kind: str, signal: str) -> str:
    """Figs. 10 (step, position), 11 (ramp, position) and 12 (ramp, speed): a trace in the bands.

    A step is drawn with the healthy response and its limits, a ramp as its departure from the healthy centre.

    Args:
        excursions: of the trace, from `fdi.diagnosis.bands.find_excursions`; positive is towards the fault.
        frictions: shown by the ramps, from `find_excursions` too.
        bands: the bands that the trace left.
        trace: the trace of the excursions.
        kind: of the sections, "step" or "ramp".
        signal: "position" or "speed".

    Returns:
        SVG, or "" where there is no such section.
    """
    excursions = [e for e in excursions if e.section.kind == kind and e.signal == signal and e.is_judged]
    if not excursions:
        return ""
    with rc_context(STYLE):
        figure = Figure(figsize=(9, 3.2), layout="constrained")
        axes = figure.subplots(1, len(excursions), sharey=kind == "ramp", squeeze=False)[0]
        for ax, e in zip(axes, excursions, strict=True):
            if kind == "step":
                band = _find_step_band(bands, trace, e)
                _draw_step_in_band(ax, trace, e, band, band.compute_centres(frictions, bands)[0][0])
            else:
                _draw_ramp_in_band(ax, trace, e)
            size = (e.section.last - e.section.first) * 1e3
            ax.set_title(f"{kind} of {size:+.2g} mm at {trace.t[e.section.start]:g} s", fontsize=9)
        axes[0].set_ylabel(LABELS[kind, signal])
        entries = axes[0].get_legend_handles_labels()
        figure.legend(*entries, loc="outside upper right", ncols=5, frameon=False, fontsize=8)
        return to_svg(figure, f"banded {kind} {signal}")


def _find_step_band(bands: Bands, trace: Trace, e: Excursion) -> StepBand:
    """The band of the step that an excursion belongs to."""
    return next(step for place in [place_sections(bands, trace.sections())] for step in bands.steps
                if place[step.section] == e.section)


def _draw_step_in_band(ax: Axes, trace: Trace, e: Excursion, band: StepBand, centre: Floats) -> None:
    """Position near a step's end, the healthy response with the measured friction, and the limits where they apply."""
    rows = slice(e.start, e.start + len(e.departure))
    t, x = (trace.t[rows] - trace.t[e.section.start]) * 1e3, trace.xj[rows] * 1e3
    has_limits = np.isfinite(e.departure)
    healthy = np.interp(t * 1e-3, band.t, centre) * 1e3
    side = np.sign(np.interp(t * 1e-3, band.t, band.middle[e.fault])) * 1e3
    ax.plot(t, healthy, color=GREEN, lw=1.0, label="healthy")
    ax.plot(t, x, color=INK, lw=1.0, label="measured")
    for limit, colour, label in ((e.middle, AMBER, "MidBand"), (e.most, RED, "MaxBand")):
        ax.plot(t, np.where(has_limits, healthy + side * limit, np.nan), color=colour, lw=1.6, label=label)
    with np.errstate(invalid="ignore"):
        beyond = np.where(e.departure > e.middle, x, np.nan)
    ax.plot(t, beyond, color=RED, lw=3.5, alpha=0.5, label="outside")
    size = abs(e.section.last - e.section.first) * 1e3
    ax.set_ylim(e.section.last * 1e3 - 0.35 * size, e.section.last * 1e3 + 0.35 * size)
    ax.set_xlabel("time from the step [ms]")


def _draw_ramp_in_band(ax: Axes, trace: Trace, e: Excursion) -> None:
    """Departure from the healthy centre over time; positive is towards the fault."""
    scale = 1e6 if e.signal == "position" else 1e3
    t = trace.t[e.start:e.start + len(e.departure)]
    ax.fill_between(t, 0.0 * e.middle, e.middle * scale, color=GREEN, alpha=0.10, lw=0)
    for limit, colour, label in ((e.middle, AMBER, "MidBand"), (e.most, RED, "MaxBand")):
        ax.plot(t[[0, -1]], limit[[0, -1]] * scale, color=colour, lw=1.0, label=label)
    ax.plot(*thin_line(t, e.departure * scale), color=INK, lw=0.8, label="measured")
    with np.errstate(invalid="ignore"):
        beyond = np.where(e.departure > e.middle, e.departure, np.nan)
    ax.plot(*thin_line(t, beyond * scale), color=RED, lw=1.6, label="outside")
    ax.set_ylim(0.0, 1.1 * scale * max(float(np.nanmax(e.departure)), float(e.most[0])))
    ax.set_xlabel("time [s]")






def _select_section(trace: Trace, kind: str, number: int) -> Section:
    return [s for s in trace.sections() if s.kind == kind][number]


def _select_time(trace: Trace, s: Section) -> Floats:
    return trace.t[s.start:s.stop]
