"""The figures of a diagnosis, as SVG text for an HTML page."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fdi.diagnosis.bands import (
    Bands,
    BandVerdict,
    Event,
    RampBand,
    StepBand,
    Width,
    compute_half_range,
    compute_speed,
    find_lasting_peak,
    read_columns,
    select_ramp_rows,
)
from fdi.diagnosis.faults import CLOGGING, FRICTION, Estimate, Fault
from fdi.diagnosis.precursors import Precursor
from fdi.diagnosis.rms_grid import LOWER_CORNER, UPPER_CORNER, Grid, Map
from fdi.report.drawing import ABOVE, COMMAND, GREEN, INK, RED, STYLE, label_log_axis, thin_line, to_svg
from fdi.thresholds import BAND_NEAREST_LIMIT_SD
from fdi.trace.sections import Section, find_sections
from fdi.trace.trace import Trace

Floats = NDArray[np.float64]

AMBER, BLUE, SPEED = "#d9730d", "#1f6feb", "#0f8b8d"
SHADES = {"middle": AMBER, "most": RED}
MAP_CONTOURS = 7
UM, MM, MS = 1e6, 1e3, 1e3
ENDS = {CLOGGING.name: 0.5, FRICTION.name: 100.0}  # of the axes, at least
FIT_MARKER: dict[str, Any] = {"marker": "o", "ms": 6}
GRID_MARKER: dict[str, Any] = {"marker": "D", "ms": 4}


def draw_overview(trace: Trace, judged: BandVerdict) -> str:
    """Command and position of the whole trace, times outside the bands shaded."""
    with rc_context(STYLE):
        figure = Figure(figsize=(11, 2.4), layout="constrained")
        ax = figure.subplots()
        ax.plot(*thin_line(trace.t, trace.com * MM), color=COMMAND, lw=2.2, label="Com, command")
        ax.plot(*thin_line(trace.t, trace.mask_unusable("xj") * MM), color=BLUE, lw=1.0, label="XJ, ram")
        ax.set_xlim(float(trace.t[0]), float(trace.t[-1]) + trace.period)
        _shade_events(ax, judged.events, 1.0, 0.0)
        ax.set_ylabel("position [mm]")
        ax.set_xlabel("time [s]")
        ax.legend(ncols=2, **ABOVE)
        return to_svg(figure, "overview")


def draw_steps(trace: Trace, bands: Bands, judged: BandVerdict) -> str:
    """Each judged step: position less the healthy response, healthy units' scatter, limits, and events."""
    if not bands.steps:
        return ""
    place = _find_sections(trace, bands)
    with rc_context(STYLE):
        across = min(2, len(bands.steps))
        down = -(-len(bands.steps) // across)
        figure = Figure(figsize=(11, 2.5 * down), layout="constrained")
        axes = figure.subplots(down, across, squeeze=False).ravel()
        for ax, step in zip(axes, bands.steps, strict=False):
            _draw_step(ax, trace, bands, step, place[step.section], judged)
        for ax in axes[len(bands.steps):]:
            ax.set_axis_off()
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=4, frameon=False)
        return to_svg(figure, "steps")


def _draw_step(ax: Axes, trace: Trace, bands: Bands, step: StepBand, s: Section, judged: BandVerdict) -> None:
    xj, t = trace.mask_unusable("xj"), step.t * MS
    centre, spread = step.compute_centre(judged.friction, bands.friction)
    middle, most, there = bands.compute_margins(step, spread)
    rows = s.start + np.rint(step.t / trace.period).astype(int)
    rows = np.minimum(rows, s.stop - 1)
    healthy = BAND_NEAREST_LIMIT_SD * spread * UM
    ax.fill_between(t, -healthy, healthy, color=GREEN, alpha=0.15, lw=0, label="healthy")
    side = np.sign(step.middle)
    for limit, colour, label in ((middle, AMBER, "MidBand"), (most, RED, "MaxBand")):
        ax.plot(t, np.where(there, side * limit, np.nan) * UM, color=colour, lw=1.6, label=label)
    ax.plot(t, (xj[rows] - centre) * UM, color=INK, lw=1.0, label="measured")
    ax.set_xlim(0.0, float(t[-1]))
    _shade_events(ax, judged.events, MS, float(trace.t[s.start]), "position")
    ax.set_title(f"step of {(s.last - s.first) * MM:+.3g} mm at {float(trace.t[s.start]):.4g} s", fontsize=9)
    ax.set_xlabel("time from the step [ms]")
    ax.set_ylabel("off the healthy\nresponse [um]")


def draw_ramps(trace: Trace, bands: Bands, judged: BandVerdict) -> str:
    """Each judged ramp: following error and speed within their limits, and events."""
    if not bands.ramps:
        return ""
    place = _find_sections(trace, bands)
    with rc_context(STYLE):
        figure = Figure(figsize=(11, 4.6), layout="constrained")
        axes = figure.subplots(2, len(bands.ramps), sharex="col", sharey="row", squeeze=False)
        for pair, ramp in zip(axes.T, bands.ramps, strict=True):
            _draw_ramp(pair, trace, ramp, place[ramp.section], judged)
        axes[0, 0].set_ylabel("error [um]")
        axes[1, 0].set_ylabel("speed beyond the\ndemand's [mm/s]")
        figure.legend(*axes[0, -1].get_legend_handles_labels(), loc="outside upper right", ncols=4, frameon=False)
        return to_svg(figure, "ramps")


def _draw_ramp(axes: Sequence[Axes], trace: Trace, ramp: RampBand, s: Section, judged: BandVerdict) -> None:
    rows, way, xj = select_ramp_rows(s, trace.period), np.sign(s.rate), trace.mask_unusable("xj")
    error = way * (trace.com[rows] - xj[rows])
    fast = way * compute_speed(xj, trace.period)[rows] - abs(s.rate)
    scale = ramp.compute_scale(float(compute_half_range(error)), float(find_lasting_peak(fast)))
    signals = ((error, ramp.position, UM, 1 / scale, "position"), (fast, ramp.speed, MM, 1.0, "speed"))
    for ax, (values, width, unit, nearer, name) in zip(axes, signals, strict=True):
        _draw_limits(ax, width, unit, nearer)
        ax.plot(*thin_line(trace.t[rows], values * unit), color=INK, lw=0.8, label="measured")
        ax.set_xlim(float(trace.t[rows.start]), float(trace.t[rows.stop - 1]))
        _shade_events(ax, judged.events, 1.0, 0.0, name)
    axes[0].set_title(f"ramp at {s.rate * MM:+.3g} mm/s, judged from {float(trace.t[rows.start]):.4g} s", fontsize=9)
    axes[-1].set_xlabel("time [s]")


def _draw_limits(ax: Axes, width: Width, unit: float, nearer: float) -> None:
    middle = width.centre * unit
    ax.axhspan(middle - width.healthy * unit, middle + width.healthy * unit, color=GREEN, alpha=0.15, lw=0,
               label="healthy")
    for limit, colour, label in ((width.middle, AMBER, "MidBand"), (width.most, RED, "MaxBand")):
        if np.isfinite(limit):
            ax.axhline(middle + nearer * limit * unit, color=colour, lw=1.2, label=label)
            ax.axhline(middle - nearer * limit * unit, color=colour, lw=1.2)


def _find_sections(trace: Trace, bands: Bands) -> dict[int, Section]:
    """The trace's sections by their number in the bands."""
    com = read_columns(trace)[0]
    own = [s for s in find_sections(com, trace.period) if s.kind in ("step", "ramp")]
    return dict(zip([i for i, s in enumerate(bands.sections) if s.kind in ("step", "ramp")], own, strict=True))


def _shade_events(ax: Axes, events: Sequence[Event], unit: float, begin: float, signal: str = "") -> None:
    """Shade the times outside over the whole height: one artist per band, as there may be hundreds of events."""
    low, high = ax.get_xlim()
    for band, colour in SHADES.items():
        ends = [((e.t_in - begin) * unit, (e.t_out - begin) * unit) for e in events
                if e.band == band and signal in ("", e.signal)]
        spans = [(a, b - a) for a, b in ends if b > low and a < high]
        if spans:
            ax.broken_barh(spans, (0.0, 1.0), transform=ax.get_xaxis_transform(), color=colour, alpha=0.18, lw=0,
                           zorder=-1)


def draw_sizes(sizes: Mapping[str, Estimate], grid: Grid | None, judged: BandVerdict | None) -> str:
    """Both faults' sizes: refined with its interval, grid, and what the ramps show, over the three levels."""
    marks: dict[str, list[tuple[str, Estimate]]] = {}
    for fault in (CLOGGING, FRICTION):
        own = [("refined", sizes[fault.name])]
        if grid is not None:
            found = (("grid, merged", grid.merged), ("grid, steps", grid.step and grid.step.minimum),
                     ("grid, ramps", grid.ramp and grid.ramp.minimum))
            own += [(label, _make_point_estimate(float(getattr(point, fault.symbol))))
                    for label, point in found if point]
        if judged is not None and fault == FRICTION:
            own.append(("bands, ramps", _make_point_estimate(judged.friction)))
        marks[fault.name] = own
    with rc_context(STYLE):
        figure = Figure(figsize=(11, 1.9), layout="constrained")
        for ax, fault in zip(figure.subplots(1, 2), (CLOGGING, FRICTION), strict=True):
            _draw_sizes_of_fault(ax, fault, marks[fault.name])
        return to_svg(figure, "estimates")


def _draw_sizes_of_fault(ax: Axes, fault: Fault, marks: list[tuple[str, Estimate]]) -> None:
    end = max(ENDS[fault.name], *(1.05 * e.high for _, e in marks))
    for low, high, colour in ((0.0, fault.middle, GREEN), (fault.middle, fault.most, AMBER), (fault.most, end, RED)):
        ax.axvspan(low, high, color=colour, alpha=0.13, lw=0)
    for row, (label, e) in enumerate(marks):
        ax.errorbar(e.value, row, xerr=[[max(e.value - e.low, 0.0)], [max(e.high - e.value, 0.0)]], color=INK,
                    capsize=3, **FIT_MARKER if label == "refined" else GRID_MARKER)
    ax.set_yticks(range(len(marks)), [label for label, _ in marks])
    ax.set_ylim(len(marks) - 0.5, -0.5)
    ax.set_xlim(0.0, end)
    ax.grid(axis="y", visible=False)
    ax.set_xlabel("Kintas" if fault == CLOGGING else "FSS [N]")


def _make_point_estimate(value: float) -> Estimate:
    return Estimate(value, value, value)


def draw_precursor_shifts(found: Mapping[str, Precursor]) -> str:
    """How many healthy standard deviations Table 2's lesser faults move each precursor by; "" without bands."""
    known = [p for p in found.values() if np.isfinite(p.clogging_ratio) and np.isfinite(p.friction_ratio)]
    if not known:
        return ""
    with rc_context(STYLE):
        figure = Figure(figsize=(11, 0.8 + 0.3 * len(known)), layout="constrained")
        ax = figure.subplots()
        rows = np.arange(len(known))
        series = ((f"Kintas {CLOGGING.middle:g}", [abs(p.clogging_ratio) for p in known], BLUE, -0.2),
                  (f"FSS {FRICTION.middle:g} N", [abs(p.friction_ratio) for p in known], AMBER, 0.2))
        for label, values, colour, offset in series:
            ax.barh(rows + offset, values, height=0.38, color=colour, label=label)
        ax.axvline(3.0, color=INK, lw=0.8, ls=":")
        ax.set_xscale("log")
        ax.set_xlim(left=0.1)
        label_log_axis(ax.xaxis)
        ax.set_yticks(rows, [p.words for p in known])
        ax.invert_yaxis()
        ax.grid(axis="y", visible=False)
        ax.set_xlabel("shift / healthy standard deviation [1] (dotted: 3, below it one test does not show the fault)")
        ax.legend(ncols=2, **ABOVE)
        return to_svg(figure, "telling")


def draw_maps(grid: Grid, truth: tuple[float, float] | None = None) -> str:
    """Figs. 14 and 15: the maps with their minima A and B, the first bisector and the centre of gravity G.

    Args:
        grid: from `fdi.diagnosis.rms_grid.search_grid`.
        truth: the faults' sizes (Kintas, FSS in N), where they are known.
    """
    drawn = [(name, m, letter) for name, m, letter in (
        ("step sections", grid.step, "A"), ("ramp sections", grid.ramp, "B"), ("both", grid.joint, "C")) if m]
    with rc_context(STYLE):
        figure = Figure(figsize=(3.7 * len(drawn), 3.5), layout="constrained")
        axes = figure.subplots(1, len(drawn), sharey=True, squeeze=False)[0]
        for ax, (name, m, letter) in zip(axes, drawn, strict=True):
            _draw_map(ax, grid, m, letter)
            if m is grid.joint:
                ax.plot(grid.best.kintas, grid.best.fss, "*", color="#ffd33d", ms=9, mec=INK, label="between cells")
            ax.set_title(f"{name}: {m.minimum.rms * 1e6:.1f} um at {letter}", fontsize=9)
            ax.set_xlabel("Kintas")
            if truth:
                ax.plot(*truth, "X", color="white", ms=9, mec=INK, mew=0.8, label="injected")
        if grid.step and grid.ramp:
            for ax in axes[:2]:
                ax.plot(*zip(LOWER_CORNER, UPPER_CORNER, strict=True), color="white", lw=0.8, ls="--")
                ax.plot(grid.merged.kintas, grid.merged.fss, "D", color="#ffd33d", ms=5, mec=INK, label="G")
        axes[0].set_ylabel("FSS [N]")
        for ax in axes:
            ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=3, frameon=False)
        return to_svg(figure, "maps")


def _draw_map(ax: Axes, grid: Grid, m: Map, letter: str) -> None:
    """One map as an image of its logarithm, with contours and its minimum."""
    half_k, half_f = (0.5 * float(axis[1] - axis[0]) if len(axis) > 1 else 0.5 for axis in (grid.kintas, grid.fss))
    box = (grid.kintas[0] - half_k, grid.kintas[-1] + half_k, grid.fss[0] - half_f, grid.fss[-1] + half_f)
    level: Any = np.log10(m.rms.T * 1e6)
    ax.imshow(level, origin="lower", extent=box, aspect="auto", cmap="viridis", interpolation="none")
    if min(level.shape) > 1:
        ax.contour(grid.kintas, grid.fss, level, MAP_CONTOURS, colors="white", linewidths=0.4, alpha=0.6)
    ax.plot(m.minimum.kintas, m.minimum.fss, "o", color=RED, ms=6, mec="white", label=letter)
    ax.grid(False)
