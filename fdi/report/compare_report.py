"""The report of `rig compare`: error of a model beside its noise floor, by signal, block, section and condition."""
from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fdi.comparison.compare import BALANCED, Comparison, SignalError
from fdi.comparison.residuals import Depends, DeviationMap, ResidualTests, map_deviation
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
from fdi.report.numbers import (
    SIGNAL_NAMES,
    count_nouns,
    format_amount,
    format_digits,
    format_percent,
    format_ratio,
    format_signal,
    join_words,
)
from fdi.report.report import Cell, Column, Figure, Item, Line, Medium, Mood, Report, Section, Table
from fdi.thresholds import BLOCK_ERROR_RATIO, CONTROLLER_ERROR_RATIO, DEPENDENCE_SHARE, FLOW_GAIN_FAR, NOISE_BAND_RATIO

if TYPE_CHECKING:
    from matplotlib.axes import Axes


MOODS: dict[str, Mood] = {"WITHIN_FLOOR": "good", "MODEL_INCOMPLETE": "bad", "CANNOT_TELL": "doubtful"}
INPUTS_OF_BLOCKS = {
    "controller": "Com and XJ to Cor",
    "servovalve": "Cor to XS",
    "jack": "XS and P12 to the ram",
    "sensor": "flow of the ram to XJ",
}

OTHER_ACTUATOR = "If the model describes another actuator than the measured one, `rig identify` fits it"

SHAPE_WORDS = {  # how a residual depends on a quantity
    "": "", "proportional to": " (proportional)", "steps with the sign of": " (a step where it changes sign)",
    "even in": " (an even function)",
}


def build_comparison_report(c: Comparison, next_command: str = "", files: Sequence[tuple[str, str]] = ()) -> Report:
    """The report of a comparison; `files` are those that were written."""
    return Report(
        "compare", c.source, c.verdict, MOODS[c.verdict], describe_verdict(c), _list_facts(c), c.notes,
        [Section("Signals", [_tabulate_signals(c)]), Section("Blocks", _tabulate_blocks(c)),
         Section("Findings", describe_findings(c)), *_show_figures(c), *_list_parameters(c)],
        next_command, files, collect_data(c))


def describe_verdict(c: Comparison) -> str:
    """The verdict in a sentence: each error beside its noise floor, and the block that disagrees."""
    if c.verdict == "CANNOT_TELL":
        return f"No verdict is possible: {c.reason}."
    if c.verdict == "WITHIN_FLOOR":
        errors = "; ".join(_error_and_floor(s) for s in c.signals.values())
        return f"The model explains this trace: the residual is noise ({errors})."
    worst = max(c.signals.values(), key=lambda s: s.ratio)
    if c.named == ("controller",) and worst.ratio <= worst.limit:
        return "The plant fits, but the output of the controller differs from the model's."
    error = f"The model does not explain this trace: {_error_and_floor(worst)}"
    return f"{error}; {_describe_blocks(c)}." if c.model.plant == BALANCED else f"{error}."


def _error_and_floor(s: SignalError) -> str:
    bound = "at least " if s.floor.lower_bound else ""
    return (f"{SIGNAL_NAMES[s.name]} error {format_signal(s.error, s.name)}, "
            f"noise floor {bound}{format_signal(s.floor.value, s.name)}")


def _describe_blocks(c: Comparison) -> str:
    """Which blocks disagree with the measurement, the worst first, and which fit."""
    if not c.named:
        if set(c.signals) == {"xj"}:
            return "P12 or XS would show in which block"
        return "no single block stands out"
    names = list(c.named)
    is_jack_or_sensor = c.blocks["jack"] is not None and c.blocks["jack"] == c.blocks["sensor"] and "jack" in names
    if is_jack_or_sensor:
        names[names.index("jack")] = "jack or the sensor"
        names.remove("sensor")
    found = f"the {names[0]} disagree" + ("" if " or " in names[0] else "s")
    if len(names) > 1:
        found += f", the {' and the '.join(names[1:])} less"
    fits = [name for name, ratio in c.blocks.items() if ratio is not None and name not in c.named]
    if not fits:
        return found
    return f"{found}; {join_words(fits)} fit" + ("s" if len(fits) == 1 else "")


def _list_facts(c: Comparison) -> list[tuple[str, str]]:
    t = c.trace
    length = f"{len(t) * t.period:.3f} s, {len(t)} cycles of {1e3 * t.period:g} ms"
    return [("model", c.model.name), ("trace", length), ("repeats", str(c.repeats)),
            ("signals", ", ".join(SIGNAL_NAMES[name] for name in t.outputs))]


def _tabulate_signals(c: Comparison) -> Table:
    page = Medium.PAGE
    columns = [Column("signal"), Column("error", align="right"), Column("noise floor", align="right"),
               Column("ratio", align="right"), Column("floor from", medium=page),
               Column("error from the command alone", align="right"),
               Column("solver error", align="right", medium=page)]
    rows: list[list[Cell | str]] = []
    for s in c.signals.values():
        bound = ">= " if s.floor.lower_bound else ""
        rows.append([
            SIGNAL_NAMES[s.name], Cell(format_signal(s.error, s.name), is_strong=True),
            bound + format_signal(s.floor.value, s.name),
            Cell(format_ratio(s.ratio), "bad" if s.ratio > s.limit else "good"), Cell(s.floor.source, "muted"),
            format_signal(s.closed_loop_error, s.name), Cell(format_signal(s.solver_error, s.name), "muted")])
    return Table(columns, rows, "Error: RMS of the residual (measured minus model) with the measured current as "
                                "input. Noise floor: RMS that noise alone leaves. A perfect model has ratio 1.")


def _tabulate_blocks(c: Comparison) -> list[Item]:
    if all(ratio is None for ratio in c.blocks.values()):
        return []
    rows: list[list[Cell | str]] = [[name, _block_ratio(c, name), Cell(describe_block(c, name), "muted")]
                                    for name in c.blocks]
    return [Table([Column("block"), Column("ratio", align="right"), Column("from")], rows,
                  "Ratio: error of the block alone over its noise floor. A block above "
                  f"{format_digits(BLOCK_ERROR_RATIO, 2)} disagrees with the measurement.")]


def _block_ratio(c: Comparison, name: str) -> Cell:
    ratio = c.blocks[name]
    if ratio is None:
        return Cell("-", "muted")
    return Cell(format_ratio(ratio), "bad" if name in c.named else "good")


def describe_block(c: Comparison, name: str) -> str:
    """What the ratio of a block was computed from, or what is missing for it."""
    if name == "controller":
        return _describe_controller(c)
    path = INPUTS_OF_BLOCKS[name]
    measured = [SIGNAL_NAMES[s] for s in ("xs", "p12") if s in c.signals]
    if c.blocks[name] is None:
        return f"{path}: {_describe_missing_signal(measured)}"
    if name == "servovalve" and "XS" not in measured:
        return "Cor to flow, as XS was not measured"
    if name == "jack" and len(measured) == 1:
        return f"{measured[0]} to the ram: {'flow' if measured == ['XS'] else 'forces'}"
    flow, force = c.parts["flow"], c.parts["force"]
    if name == "jack" and flow is not None and force is not None:
        return f"{path}: flow {format_ratio(flow)}, forces {format_ratio(force)}"
    return path


def _describe_missing_signal(measured: list[str]) -> str:
    if len(measured) == 2:
        return "too little data"
    if not measured:
        return "needs XS or P12"
    return "needs XS" if measured == ["P12"] else "needs P12"


def _describe_controller(c: Comparison) -> str:
    path = INPUTS_OF_BLOCKS["controller"]
    if c.blocks["controller"] is None:
        return f"{path}: the firmware is not known"
    a = c.answer
    lags = [f"{name} {count_nouns(lag, 'cycle')} earlier" for name, lag in (("Com", a.com_lag), ("XJ", a.xj_lag))
            if lag > 0]
    if lags:
        path += f" (from {' and '.join(lags)})"
    if a.ratio <= CONTROLLER_ERROR_RATIO:
        return f"{path}: equal to the last digit"
    found = f"{path}: error {1e6 * a.error:.3g} uA RMS, floor {1e6 * a.floor:.3g} uA"
    gain = c.model["controller.proportional_gain"]
    if math.isfinite(a.gain) and abs(a.gain / gain - 1) > 0.002:
        found += f"; its gain is {a.gain:.4g} A/m, the model's {gain:.4g} A/m"
    return found


def describe_findings(c: Comparison) -> list[Line]:
    """Labelled lines: where the floor is from, solver error, where and when the error is large, what it depends on."""
    lines = [Line("floor", _describe_floor(c)), Line("solver", _describe_solver(c))]
    if c.verdict != "WITHIN_FLOOR":
        lines += _describe_places(c)
        if c.condition:
            lines.append(Line("when", c.condition))
    lines += _describe_flow_and_drift(c)
    for name, d in c.diagnoses.items():
        found = _describe_residual(name, d)
        if c.signals[name].ratio > c.signals[name].limit and found:
            lines.append(Line("residual", f"{SIGNAL_NAMES[name]}: {'; '.join(found)}"))
    if c.scatter is not None:
        lines.append(Line("scatter", _describe_scatter(c)))
    if changes := _describe_changes(c):
        lines.append(Line("not nominal", changes, medium=Medium.TERMINAL))
    return lines


def _describe_changes(c: Comparison, most: int = 6) -> str:
    """The parameters of the model that are not nominal; the page has a table of them."""
    changes = [f"{name} = {value:g}" for name, value in sorted(c.model.list_changes().items())]
    more = f" and {len(changes) - most} more" if len(changes) > most else ""
    return ", ".join(changes[:most]) + more


def _describe_floor(c: Comparison) -> str:
    sources = {s.floor.source for s in c.signals.values()}
    words = {"repeats": f"from {count_nouns(c.repeats, 'repeat')} of the test",
             "model": "the model's sensor noise; a repeat of the test would measure it (--repeat)",
             "data": "a lower bound, from second differences of the data; a repeat of the test would measure it "
                     "(--repeat)"}
    return "; ".join(words[source] for source in words if source in sources)


def _describe_solver(c: Comparison) -> str:
    errors = ", ".join(f"{SIGNAL_NAMES[s.name]} by {format_signal(s.solver_error, s.name)}" for s in c.signals.values())
    step = 1e6 * c.trace.period / c.replay.steps
    return f"halving the step to {step:g} us changes {errors}"


def _describe_places(c: Comparison, most: int = 3) -> list[Line]:
    """The sections with the largest shares of the squared error; the page and the JSON answer have all."""
    lines = []
    for place in [p for p in c.where if p.share > 0.05][:most]:
        text = (f"{place.section}, {place.t0:.2f}-{place.t1:.2f} s: {format_percent(place.share)} of the squared "
                f"error, {format_ratio(place.ratio)} times the floor")
        if place.condition:
            text += f"; {place.condition}"
        lines.append(Line("where", text, medium=Medium.TERMINAL))
    return lines


def _describe_flow_and_drift(c: Comparison, notable_share: float = 0.005, notable_drift: float = 1e-6) -> list[Line]:
    """A ram that is faster or slower than the flow into it by 0.5 %; a free replay that drifts by 1 um/s."""
    lines = []
    flow, gain = c.parts["flow"], c.parts["gain"]
    if flow is not None and gain is not None and flow > BLOCK_ERROR_RATIO and abs(gain) > notable_share:
        direction = "further" if gain > 0 else "less"
        other = f". {OTHER_ACTUATOR}" if abs(gain) > FLOW_GAIN_FAR else ""
        lines.append(Line("flow", f"the ram moves {format_percent(abs(gain))} {direction} than the flow through the "
                                  f"metering edges predicts{other}"))
    if "xj" in c.signals and abs(c.drift) > notable_drift and not c.trace.filled.any():
        lines.append(Line("drift", "a replay that is not corrected towards the measured position drifts by "
                                   f"{format_amount(c.drift, 'm/s')}"))
    return lines


def _describe_scatter(c: Comparison) -> str:
    s = c.scatter
    assert s is not None
    if s.enough:
        changed = [f"{name} by {moved:+.1f}" for name, moved in s.moved.items() if abs(moved) > 1.0][:2]
        which = f" (in tolerances: {', '.join(changed)})" if changed else ""
        return f"tolerances of the parameters could explain all of the error{which}"
    worst = max(s.ratio, key=lambda name: s.ratio[name])
    return (f"scatter between units does not explain it: with all parameters refitted within their tolerances the "
            f"{SIGNAL_NAMES[worst]} error is still {format_signal(s.error[worst], worst)}, "
            f"{format_ratio(s.ratio[worst])} times the floor")


def _describe_residual(name: str, d: ResidualTests, strong: float = 0.15, long_memory: float = 3.0) -> list[str]:
    """What distinguishes a residual from noise: memory, input it follows, quantity it depends on.

    A correlation below `strong` explains 2 % of the power or less; `long_memory` is in memories of the noise.
    """
    found = []
    if d.memory > long_memory * d.noise_memory:
        found.append(f"keeps its sign for {1e3 * d.memory:.0f} ms (noise: {1e3 * d.noise_memory:.0f} ms), "
                     f"half of its power is below {d.half_power:.2g} Hz")
    followed = [f for f in d.follows if abs(f.correlation) > max(strong, 2 * f.bound)]
    if followed:
        f = max(followed, key=lambda f: abs(f.correlation))
        found.append(f"follows {f.input} by {1e3 * f.lag:.3g} ms (correlation {f.correlation:.2f})")
    if d.depends and d.depends[0].share > DEPENDENCE_SHARE:
        first = d.depends[0]
        found.append(f"{format_percent(first.share)} of its power depends on {first.on}{SHAPE_WORDS[first.shape]}, "
                     f"up to {format_signal(abs(first.size), name)}")
    return found


def _show_figures(c: Comparison) -> list[Section]:
    sections = [Section("Measured and replayed", [Figure(
        "Each signal as measured and as replayed from the measured current, and its residual (measured minus model) "
        "below. Green: two noise floors on either side; noise stays within for 95 % of the time. Shaded: ramps (blue) "
        "and dynamic sections (violet) of the command. Red: not judged.", partial(draw_overview, c))])]
    if c.where:
        sections.append(Section("Where", [_tabulate_places(c), Figure(
            "Share of each section in the squared error. The longest bar shows where to look first.",
            partial(draw_error_shares, c))], medium=Medium.PAGE))
    sections.append(Section("By speed and amplitude", [Figure(
        "Error over noise floor by speed of the ram (over 20 rows) and by amplitude (half its range within 0.25 s "
        "before and after). 1 is noise; dark cells show at which motion the model fails. Empty: fewer than 30 rows.",
        partial(draw_deviation_map, c))]))
    sections.append(Section("Is the residual noise", [Figure(
        "From the left: autocorrelation, cumulative periodogram, correlation with an input. Noise stays within green: "
        "the 99 % band of the correlations and Bartlett's 95 % band of the periodogram. Where a repeat shows the "
        "colour of the noise, the residual is whitened by it.", partial(draw_whiteness, c))]))
    if any(d.depends for d in c.diagnoses.values()):
        sections.append(Section("What the residual depends on", [Figure(
            "Mean residual (measured minus model) over each quantity, in bins of equal count with 95 % intervals. A "
            "curve that leaves the green band of two noise floors shows a dependence.",
            partial(draw_dependence, c))]))
    return sections


def _tabulate_places(c: Comparison) -> Table:
    columns = [Column("section"), Column("time", "s"), Column("share of the squared error", align="right"),
               Column("error over floor", align="right"), Column("condition")]
    return Table(columns, [[p.section, Cell(f"{p.t0:.2f} - {p.t1:.2f}", "muted"), format_percent(p.share, 3),
                            format_ratio(p.ratio), p.condition] for p in c.where])


def _list_parameters(c: Comparison) -> list[Section]:
    sections = []
    if c.scatter is not None:
        rows = [[name, f"{moved:+.2f}"] for name, moved in c.scatter.moved.items()]
        sections.append(Section("Refit within the tolerances", [Table(
            [Column("parameter"), Column("change, in tolerances")], rows,
            "How far each parameter moves when the model is refitted within the tolerances of a healthy unit.",
            is_list=True)], medium=Medium.PAGE))
    changes = sorted(c.model.list_changes().items())
    if changes:
        rows = [[name, f"{value:g}"] for name, value in changes]
        sections.append(Section("Changes of the model", [Table(
            [Column("parameter"), Column("value, SI")], rows, "Parameters that differ from the nominal model.",
            is_list=True)], medium=Medium.PAGE))
    return sections


def collect_data(c: Comparison) -> dict[str, Any]:
    """The answer of `rig compare --json`; SI units."""
    return {
        "verdict": c.verdict, "reason": c.reason or describe_verdict(c), "trace": c.source, "model": c.model.name,
        "signals": {name: _signal_data(s) for name, s in c.signals.items()},
        "solver_error": c.signals["xj"].solver_error if "xj" in c.signals else None,
        "steps": c.replay.steps,
        "where": [{"section": p.section, "t0": p.t0, "t1": p.t1, "share": p.share, "ratio": p.ratio,
                   "condition": p.condition} for p in c.where],
        "condition": c.condition, "blocks": dict(c.blocks), "disagree": list(c.named), "parts": dict(c.parts),
        "controller": {"error": c.answer.error, "floor": c.answer.floor, "com_lag": c.answer.com_lag,
                       "xj_lag": c.answer.xj_lag, "gain": c.answer.gain},
        "drift": {"speed": c.drift, "free_error": c.free_error},
        "tolerances": None if c.scatter is None else {
            "enough": c.scatter.enough, "error": c.scatter.error, "ratio": c.scatter.ratio, "moved": c.scatter.moved},
        "diagnostics": {name: _diagnosis_data(d) for name, d in c.diagnoses.items()},
        "repeats": c.repeats, "notes": list(c.notes)}


def _signal_data(s: SignalError) -> dict[str, Any]:
    return {"unit": s.unit, "error": s.error, "floor": s.floor.value, "ratio": s.ratio,
            "closed_loop_error": s.closed_loop_error, "solver_error": s.solver_error, "limit": s.limit,
            "floor_source": s.floor.source, "sensor_noise": s.sensor_noise, "lower_bound": s.floor.lower_bound,
            "hum": s.floor.hum, "difference": s.floor.difference}


def _diagnosis_data(d: ResidualTests) -> dict[str, Any]:
    return {"memory": d.memory, "noise_memory": d.noise_memory, "half_power": d.half_power,
            "periodogram": {"distance": d.departs, "band": d.allowed},
            "autocorrelation": {"lag_1": d.correlation[1], "band": d.band},
            "inputs": {f.input: {"correlation": f.correlation, "lag": f.lag, "bound": f.bound} for f in d.follows},
            "depends_on": [{"on": x.on, "share": x.share, "shape": x.shape, "size": x.size} for x in d.depends]}


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
