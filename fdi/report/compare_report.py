"""The report of `rig compare`: error of a model beside its noise floor, by signal, block, section and condition."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from fdi.comparison.compare import Comparison, ControllerBlock, SignalError
from fdi.comparison.residuals import Depends, ResidualTests, map_deviation
from fdi.estimation import find_controller_gain
from fdi.report.drawing import (
    BLUE,
    COMMAND,
    GREEN,
    INK,
    ORANGE,
    RED,
    Mark,
    Panel,
    area,
    axes,
    band,
    call,
    choose_colour,
    choose_drawn_unit,
    draw_grid,
    draw_over_time,
    draw_panels,
    instant,
    label_signal,
    legend,
    line,
    name_controlled,
    name_rows,
    shade,
)
from fdi.report.numbers import (
    format_amount,
    format_digits,
    format_percent,
    format_ratio,
    join_words,
    list_first,
)
from fdi.report.report import Cell, Column, Figure, Line, Medium, Mood, Report, Section, Table, tabulate
from fdi.thresholds import BLOCK_ERROR_RATIO, CONTROLLER_ERROR_RATIO, DEPENDENCE_SHARE, FLOW_GAIN_FAR, NOISE_BAND_RATIO
from fdi.trace import find_stretches
from plant import Signal, count_nouns

MOODS: dict[str, Mood] = {"WITHIN_FLOOR": "good", "MODEL_INCOMPLETE": "bad", "CANNOT_TELL": "doubtful"}
INPUTS_OF_BLOCKS = {
    "servovalve": "Cor to XS",
    "jack": "XS and P12 to the ram",
    "sensor": "flow of the ram to XJ",
}
OTHER_ACTUATOR = "If the model describes another actuator than the measured one, `rig identify` fits it"
MOTIONS = {"speed": "/s", "position": "", "acceleration": "/s2"}  # and what follows the unit of length
SHAPE_WORDS = {  # how a residual depends on a quantity
    "": "", "proportional to": " (proportional)", "steps with the sign of": " (a step where it changes sign)",
    "even in": " (an even function)",
}


def build_comparison_report(c: Comparison, next_command: str = "", files: Sequence[tuple[str, str]] = ()) -> Report:
    """The report of a comparison; `files` are those that were written."""
    t, changes = c.trace, sorted(c.model.list_changes())
    facts = [("model", c.model.name), ("trace", f"{len(t) * t.period:.3f} s, {len(t)} cycles of {1e3 * t.period:g} ms"),
             ("repeats", str(c.repeats)), ("signals", ", ".join(s.signal.symbol for s in c.signals.values()))]
    sections = [
        Section("Signals", [_tabulate_signals(c)]),
        Section("Blocks", [_tabulate_blocks(c)]),
        Section("Findings", describe_findings(c)),
        Section("Measured and replayed", [Figure(
            f"Each signal as measured and as replayed from the measured {t.declared.drive.phrase}, and its residual "
            "(measured minus model) below. Green: two noise floors on either side; noise stays within for 95 % of the "
            "time. Shaded: ramps (blue) and dynamic sections (violet) of the command. Red: not judged.",
            partial(draw_overview, c))]),
        Section("Where", [_tabulate_places(c), Figure(
            "Share of each section in the squared error. The longest bar shows where to look first.",
            partial(draw_error_shares, c))] if c.where else [], medium=Medium.PAGE),
        Section("By speed and amplitude", [Figure(
            f"Error over noise floor by speed of the {t.declared.controlled.phrase} (over 20 rows) and by amplitude "
            "(half its range within 0.25 s before and after). 1 is noise; dark cells show at which motion the model "
            "fails. Empty: fewer than 30 rows.", partial(draw_deviation_map, c))]),
        Section("Is the residual noise", [Figure(
            "From the left: autocorrelation, cumulative periodogram, correlation with an input. Noise stays within "
            "green: the 99 % band of the correlations and Bartlett's 95 % band of the periodogram. Where a repeat "
            "shows the colour of the noise, the residual is whitened by it.", partial(draw_whiteness, c))]),
        Section("What the residual depends on", [Figure(
            "Mean residual (measured minus model) over each quantity, in bins of equal count with 95 % intervals. A "
            "curve that leaves the green band of two noise floors shows a dependence.", partial(draw_dependence, c))]
            if any(d.depends for d in c.diagnoses.values()) else []),
        Section("Refit within the tolerances", [_list_values(
            "change, in tolerances", {} if c.scatter is None else
            {name: f"{shift:+.2f}" for name, shift in c.scatter.moved.items()},
            "How far each parameter moves when the model is refitted within the tolerances of a healthy unit.")],
            medium=Medium.PAGE),
        Section("Changes of the model", [_list_values(
            "value", {name: c.model.describe_value(name) for name in changes},
            "Parameters that differ from the nominal model.")], medium=Medium.PAGE)]
    return Report("compare", c.source, c.verdict, MOODS[c.verdict], describe_verdict(c), facts, c.notes, sections,
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
    blocks = f"; {_describe_blocks(c)}" if c.model.kind.balances else ""
    return f"The model does not explain this trace: {_error_and_floor(worst)}{blocks}."


def _error_and_floor(s: SignalError) -> str:
    prefix = "at least " if s.floor.lower_bound else ""
    return (f"{s.signal.symbol} error {format_amount(s.error, s.signal.unit)}, "
            f"noise floor {prefix}{format_amount(s.floor.value, s.signal.unit)}")


def _describe_blocks(c: Comparison) -> str:
    """Which blocks disagree with the measurement, the worst first, and which fit."""
    if not c.named:
        return "P12 or XS would show in which block" if len(c.signals) == 1 else "no single block stands out"
    names = list(c.named)
    if c.blocks["jack"] is not None and c.blocks["jack"] == c.blocks["sensor"] and "jack" in names:
        names[names.index("jack")] = "jack or the sensor"
        names.remove("sensor")
    less = f", the {' and the '.join(names[1:])} less" if names[1:] else ""
    text = f"the {names[0]} disagree{'' if ' or ' in names[0] else 's'}{less}"
    fits = [name for name, ratio in c.blocks.items() if ratio is not None and name not in c.named]
    verb = "fits" if len(fits) == 1 else "fit"
    return f"{text}; {join_words(fits)} {verb}" if fits else text


def _tabulate_signals(c: Comparison) -> Table:
    page = Medium.PAGE
    return tabulate(
        c.signals.values(),
        (Column("signal"), lambda s: s.signal.symbol),
        (Column("error", align="right"), lambda s: Cell(format_amount(s.error, s.signal.unit), is_strong=True)),
        (Column("noise floor", align="right"),
         lambda s: (">= " if s.floor.lower_bound else "") + format_amount(s.floor.value, s.signal.unit)),
        (Column("ratio", align="right"), lambda s: Cell(format_ratio(s.ratio), "bad" if s.ratio > s.limit else "good")),
        (Column("floor from", medium=page), lambda s: Cell(s.floor.source, "muted")),
        (Column("error from the command alone", align="right"),
         lambda s: format_amount(s.closed_loop_error, s.signal.unit)),
        (Column("solver error", align="right", medium=page),
         lambda s: Cell(format_amount(s.solver_error, s.signal.unit), "muted")),
        caption="Error: RMS of the residual (measured minus model) with the measured "
                f"{c.trace.declared.drive.phrase} as input. Noise floor: "
                "RMS that noise alone leaves. A perfect model has ratio 1.")


def _tabulate_blocks(c: Comparison) -> Table:
    def show_ratio(name: str) -> Cell:
        ratio = c.blocks[name]
        if ratio is None:
            return Cell("-", "muted")
        return Cell(format_ratio(ratio), "bad" if name in c.named else "good")

    return tabulate(
        c.blocks if any(ratio is not None for ratio in c.blocks.values()) else (),
        (Column("block"), str), (Column("ratio", align="right"), show_ratio),
        (Column("from"), lambda name: Cell(describe_block(c, name), "muted")),
        caption="Ratio: error of the block alone over its noise floor. A block above "
                f"{format_digits(BLOCK_ERROR_RATIO, 2)} disagrees with the measurement.")


def _tabulate_places(c: Comparison) -> Table:
    return tabulate(
        c.where, (Column("section"), lambda p: p.section),
        (Column("time", "s"), lambda p: Cell(f"{p.t0:.2f} - {p.t1:.2f}", "muted")),
        (Column("share of the squared error", align="right"), lambda p: format_percent(p.share, 3)),
        (Column("error over floor", align="right"), lambda p: format_ratio(p.ratio)),
        (Column("condition"), lambda p: p.condition))


def _list_values(heading: str, texts: dict[str, str], caption: str) -> Table:
    return Table([Column("parameter"), Column(heading)], list(texts.items()), caption, is_list=True)


def describe_block(c: Comparison, name: str) -> str:
    """What the ratio of a block was computed from, or what is missing for it."""
    if name == "controller":
        return _describe_controller(c)
    if not c.model.kind.balances:
        return "the signal with the largest ratio" if name == "plant" else "cannot be told from the plant"
    path = INPUTS_OF_BLOCKS[name]
    symbols = [s.signal.symbol for s in reversed([*c.signals.values()]) if s.signal != c.trace.declared.controlled]
    if c.blocks[name] is None:
        needs = {(): "needs XS or P12", ("P12",): "needs XS", ("XS",): "needs P12"}
        return f"{path}: {needs.get(tuple(symbols), 'too little data')}"
    if name == "servovalve" and "XS" not in symbols:
        return "Cor to flow, as XS was not measured"
    if name == "jack" and len(symbols) == 1:
        return f"{symbols[0]} to the ram: {'flow' if symbols == ['XS'] else 'forces'}"
    flow, force = c.parts["flow"], c.parts["force"]
    return path if name != "jack" or flow is None or force is None else (
        f"{path}: flow {format_ratio(flow)}, forces {format_ratio(force)}")


def _describe_controller(c: Comparison) -> str:
    d, a = c.trace.declared, c.answer
    delays = ((d.command.symbol, a.com_lag), (d.controlled.symbol, a.xj_lag))
    lags = [f"{symbol} {count_nouns(lag, 'cycle')} earlier" for symbol, lag in delays if lag > 0]
    path = f"{d.command.symbol} and {d.controlled.symbol} to {d.drive.symbol}" + (
        f" (from {' and '.join(lags)})" if lags else "")
    if not c.model.kind.controller:
        return f"{path}: the firmware is not known"
    if not math.isfinite(a.error):
        is_read = len(c.trace.outputs) == len(d.outputs)
        return f"{path}: its law {'remembers what is not in the log' if is_read else 'needs unknown readings'}"
    if a.ratio <= CONTROLLER_ERROR_RATIO:
        return f"{path}: equal to the last digit"
    factor, error_unit = (1e6, "uA") if d.drive.unit == "A" else (1.0, d.drive.unit)
    gain, gain_unit = find_controller_gain(c.model, c.trace.period)[0], f"{d.drive.unit}/{d.controlled.unit}"
    is_off = math.isfinite(a.gain) and abs(a.gain - gain) > 0.002 * gain
    return (f"{path}: error {factor * a.error:.3g} {error_unit} RMS, floor {factor * a.floor:.3g} {error_unit}"
            + (describe_gains(a) or (f"; its gain is {a.gain:.4g} {gain_unit}, the model's {gain:.4g} {gain_unit}"
                                     if is_off else "")))


def describe_gains(a: ControllerBlock) -> str:
    """With which gains the model's controller would answer as recorded; "" where none were found."""
    return "" if not a.gains else (
        f"; with {' '.join(f'--set {name}={gain:.5g}' for name, gain in a.gains.items())} it is equal to the last "
        "digit")


def describe_findings(c: Comparison, most_places: int = 3, most_changes: int = 6) -> list[Line]:
    """Labelled lines: where the floor is from, solver error, where and when the error is large, what it depends on.

    The page and the JSON answer have all places and changes.
    """
    is_wrong = c.verdict != "WITHIN_FLOOR"
    changes = [f"{name} = {c.model.describe_value(name)}" for name, value in sorted(c.model.list_changes().items())
               if c.model.design.get(name) != value]
    errors = ", ".join(f"{s.signal.symbol} by {format_amount(s.solver_error, s.signal.unit)}"
                       for s in c.signals.values())
    return [
        Line("floor", _describe_floor(c)),
        Line("solver", f"halving the step to {1e6 * c.trace.period / c.replay.steps:g} us changes {errors}"
             if c.model.kind.foreign is None else "the FMU's own: its steps, and so its error, are not known here"),
        *(Line("where", f"{p.section}, {p.t0:.2f}-{p.t1:.2f} s: {format_percent(p.share)} of the squared error, "
                        f"{format_ratio(p.ratio)} times the floor" + (f"; {p.condition}" if p.condition else ""),
               medium=Medium.TERMINAL) for p in [p for p in c.where if is_wrong and p.share > 0.05][:most_places]),
        Line("when", c.condition if is_wrong else ""),
        Line("flow", _describe_flow(c)),
        Line("drift", _describe_drift(c)),
        Line("inverse", "" if c.drive_error is None else
             f"{100 * c.drive_error:.2f} % of {c.trace.declared.drive.symbol} is not what the measured motion needs"),
        *(Line("residual", _describe_residual(c.signals[name].signal, d)) for name, d in c.diagnoses.items()
          if c.signals[name].ratio > c.signals[name].limit),
        Line("scatter", _describe_scatter(c)),
        Line("not nominal", list_first(changes, most_changes), medium=Medium.TERMINAL)]


def _describe_floor(c: Comparison) -> str:
    sources = {s.floor.source for s in c.signals.values()}
    words = {"repeats": f"from {count_nouns(c.repeats, 'repeat')} of the test",
             "model": "the model's sensor noise; a repeat of the test would measure it (--repeat)",
             "data": "a lower bound, from second differences of the data; a repeat of the test would measure it "
                     "(--repeat)"}
    return "; ".join(words[source] for source in words if source in sources)


def _describe_flow(c: Comparison, notable_share: float = 0.005) -> str:
    """A ram that is faster or slower than the flow into it by 0.5 %."""
    flow, gain = c.parts["flow"], c.parts["gain"]
    if flow is None or gain is None or flow <= BLOCK_ERROR_RATIO or abs(gain) <= notable_share:
        return ""
    other = f". {OTHER_ACTUATOR}" if abs(gain) > FLOW_GAIN_FAR else ""
    return (f"the ram moves {format_percent(abs(gain))} {'further' if gain > 0 else 'less'} than the flow through the "
            f"metering edges predicts{other}")


def _describe_drift(c: Comparison, notable: float = 1e-6) -> str:
    """A free replay that drifts by 1 um/s, of a ram."""
    controlled = c.trace.declared.controlled
    if controlled.name not in c.signals or abs(c.drift) <= notable * c.trace.scale or c.trace.filled.any():
        return ""
    return (f"a replay that is not corrected towards the measured {name_controlled(c.trace.declared)} drifts by "
            f"{format_amount(c.drift, f'{controlled.unit}/s')}; its error is "
            f"{format_amount(c.free_error, controlled.unit)} RMS")


def _describe_scatter(c: Comparison) -> str:
    s = c.scatter
    if s is None:
        return ""
    if s.enough:
        changes = [f"{name} by {shift:+.1f}" for name, shift in s.moved.items() if abs(shift) > 1.0][:2]
        which = f" (in tolerances: {', '.join(changes)})" if changes else ""
        return f"tolerances of the parameters could explain all of the error{which}"
    worst = max(s.ratio, key=lambda name: s.ratio[name])
    signal = c.signals[worst].signal
    return (f"scatter between units does not explain it: with all parameters refitted within their tolerances the "
            f"{signal.symbol} error is still {format_amount(s.error[worst], signal.unit)}, "
            f"{format_ratio(s.ratio[worst])} times the floor")


def _describe_residual(signal: Signal, d: ResidualTests, strong: float = 0.15, long_memory: float = 3.0) -> str:
    """What distinguishes a residual from noise: memory, input it follows, quantity it depends on; "" for nothing.

    A correlation below `strong` explains 2 % of the power or less; `long_memory` is in memories of the noise.
    """
    parts = []
    if d.memory > long_memory * d.noise_memory:
        parts.append(f"keeps its sign for {1e3 * d.memory:.0f} ms (noise: {1e3 * d.noise_memory:.0f} ms), "
                     f"half of its power is below {d.half_power:.2g} Hz")
    if inputs := [f for f in d.follows if abs(f.correlation) > max(strong, 2 * f.bound)]:
        f = max(inputs, key=lambda f: abs(f.correlation))
        parts.append(f"follows {f.input} by {1e3 * f.lag:.3g} ms (correlation {f.correlation:.2f})")
    if d.depends and d.depends[0].share > DEPENDENCE_SHARE:
        first = d.depends[0]
        parts.append(f"{format_percent(first.share)} of its power depends on {first.on}{SHAPE_WORDS[first.shape]}, "
                     f"up to {format_amount(abs(first.size), signal.unit)}")
    return f"{signal.symbol}: {'; '.join(parts)}" if parts else ""


def collect_data(c: Comparison) -> dict[str, Any]:
    """The answer of `rig compare --json`; SI units."""
    controlled = c.signals.get(c.trace.declared.controlled.name)
    return {
        "verdict": c.verdict, "reason": c.reason or describe_verdict(c), "trace": c.source, "model": c.model.name,
        "signals": {name: {
            "unit": s.signal.unit, "error": s.error, "floor": s.floor.value, "ratio": s.ratio,
            "closed_loop_error": s.closed_loop_error, "solver_error": s.solver_error, "limit": s.limit,
            "floor_source": s.floor.source, "sensor_noise": s.sensor_noise, "lower_bound": s.floor.lower_bound,
            "hum": s.floor.hum, "difference": s.floor.difference} for name, s in c.signals.items()},
        "solver_error": controlled.solver_error if controlled else None,
        "steps": c.replay.steps,
        "where": [p._asdict() for p in c.where],
        "condition": c.condition, "blocks": dict(c.blocks), "disagree": list(c.named), "parts": dict(c.parts),
        "controller": {"error": c.answer.error, "floor": c.answer.floor, "com_lag": c.answer.com_lag,
                       "xj_lag": c.answer.xj_lag, "gain": c.answer.gain,
                       "gains": dict(c.answer.gains or {})},
        "drift": {"speed": c.drift, "free_error": c.free_error}, "drive_error": c.drive_error,
        "tolerances": None if c.scatter is None else {
            "enough": c.scatter.enough, "error": c.scatter.error, "ratio": c.scatter.ratio, "moved": c.scatter.moved},
        "diagnostics": {name: {
            "memory": d.memory, "noise_memory": d.noise_memory, "half_power": d.half_power,
            "periodogram": {"distance": d.departs, "band": d.allowed},
            "autocorrelation": {"lag_1": d.correlation[1], "band": d.band},
            "inputs": {f.input: {"correlation": f.correlation, "lag": f.lag, "bound": f.bound} for f in d.follows},
            "depends_on": [{"on": x.on, "share": x.share, "shape": x.shape, "size": x.size} for x in d.depends]}
            for name, d in c.diagnoses.items()},
        "repeats": c.repeats, "notes": list(c.notes)}


def find_quantity_axis(c: Comparison, kind: str) -> tuple[str, float]:
    """Label and scale of the axis of a quantity that a residual is drawn over."""
    controlled = c.trace.declared.controlled
    if kind in MOTIONS and kind != "acceleration":
        return f"{kind} [{controlled.shown_unit}{MOTIONS[kind]}]", controlled.shown_scale
    if kind in MOTIONS:
        return f"{kind} [{controlled.unit}{MOTIONS[kind]}]", 1.0
    signal = next(s for s in c.trace.declared.outputs if s.symbol == kind)
    return label_signal(signal), signal.shown_scale


def draw_overview(c: Comparison) -> str:
    """Command and position, then each signal measured and replayed, and its residual beside the noise floor."""
    t = c.trace.t
    shades = [shade(float(t[a]), float(t[b - 1]), RED, 0.12)
              for a, b in find_stretches(c.replay.undecided | ~c.trace.usable)]
    d = c.trace.declared
    command, controlled = d.command, d.controlled
    panels: list[Panel] = [[line(t, c.trace.command * command.shown_scale, COMMAND, f"{command.symbol}, command", 2.2),
                            line(t, c.trace.controlled * controlled.shown_scale, BLUE,
                                 f"{controlled.symbol}, {controlled.phrase}"),
                            axes(ylabel=f"{name_controlled(d)} [{controlled.shown_unit}]"), legend(2), *shades]]
    for name, s in c.signals.items():
        scale, (fine, small) = s.signal.shown_scale, choose_drawn_unit(s.signal, s.error)
        floor = NOISE_BAND_RATIO * s.floor.value * small
        panels += [[line(t, c.trace.mask_unusable(name) * scale, choose_colour(d, name), "measured", 1.2),
                    line(t, c.replay.model[name] * scale, ORANGE, f"model, from the {d.drive.phrase}", 0.8),
                    axes(ylabel=label_signal(s.signal)), legend(2), *shades],
                   [band(-floor, floor, GREEN), line(t, c.replay.residual[name] * small, INK, width=0.7),
                    axes(ylabel=f"residual of\n{s.signal.symbol} [{fine}]"), *shades]]
    return draw_over_time("overview", c.trace, panels, [1.5] + [1.3, 1.3] * len(c.signals))


def draw_error_shares(c: Comparison) -> str:
    """Each section's share of the squared error, in the order of time."""
    places = sorted(c.where, key=lambda place: place.t0)
    shares = [100 * p.share for p in places]
    return draw_panels("shares", [[[
        call("barh", range(len(places)), shares, color=ORANGE, height=0.7),
        *name_rows([f"{p.section}, {p.t0:.2f}–{p.t1:.2f} s" for p in places]),
        *(call("annotate", f"{format_ratio(place.ratio)} times the floor", (share, row), (3, 0),
               textcoords="offset points", va="center", fontsize=8)
          for row, (share, place) in enumerate(zip(shares, places, strict=True))),
        axes(xlabel="share of the squared error [%]", xlim=(0, 1.25 * max(shares)))]]], 0.7 + 0.27 * len(places))


def draw_deviation_map(c: Comparison) -> str:
    """Error over noise floor of each signal by speed and amplitude of the ram; "" without rows enough."""
    from matplotlib.colors import LogNorm

    floor = {name: s.floor.value for name, s in c.signals.items() if s.floor.value > 0.0}
    deviations = map_deviation(c.trace, {name: c.replay.residual[name] for name in floor}, floor) if floor else None
    if deviations is None:
        return ""
    controlled = c.trace.declared.controlled
    unit = controlled.shown_unit
    norm = LogNorm(1.0, max(10.0, *(float(np.nanmax(ratio)) for ratio in deviations.ratio.values())))
    speeds, amplitudes = ([["" if np.isinf(edge) else f"{controlled.shown_scale * edge:g}" for edge in edges]
                           for edges in (deviations.speeds, deviations.amplitudes)])
    return draw_panels("map", [[[
        call("pcolormesh", np.ma.masked_invalid(ratio), cmap="YlOrRd", norm=norm, edgecolors="white", linewidth=1.0),
        *(call("text", column + 0.5, row + 0.5, format_ratio(float(value)), ha="center", va="center", fontsize=8,
               color="white" if norm(value) > 0.6 else INK)
          for (row, column), value in np.ndenumerate(ratio) if np.isfinite(value)),
        call("set_xticks", range(len(speeds)), speeds), call("set_yticks", range(len(amplitudes)), amplitudes),
        axes(title=c.signals[name].signal.symbol, xlabel=f"speed [{unit}/s]",
             ylabel="" if number else f"amplitude [{unit}]"),
        call("grid", False)] for number, (name, ratio) in enumerate(deviations.ratio.items())]],
        1.2 + 0.42 * len(deviations.amplitudes), sharey=True)


def draw_whiteness(c: Comparison) -> str:
    """One row per signal: autocorrelation, cumulative periodogram, cross-correlation with the current."""
    return draw_grid("whiteness", [_draw_tests(d, c.trace.period, c.signals[name].signal.symbol,
                                               c.trace.declared.drive.symbol) for name, d in c.diagnoses.items()],
                     2.4 * len(c.diagnoses), 0.85)


def _draw_tests(d: ResidualTests, period: float, label: str, drive: str) -> list[Panel]:
    rise = np.linspace(0.0, 1.0, len(d.frequencies))
    cross_correlation = next((f for f in d.follows if f.input == drive), d.follows[0] if d.follows else None)
    return [
        [*_draw_correlation(np.arange(1, len(d.correlation)) * period, d.correlation[1:], d.band),
         axes(ylabel=f"{label}\nautocorrelation", xlabel="lag [ms]")],
        [area(d.frequencies, rise - d.allowed, rise + d.allowed, GREEN), line(d.frequencies, d.power, INK),
         axes(ylim=(0, 1), ylabel="cumulative power", xlabel="frequency [Hz]")],
        [] if cross_correlation is None else
        [*_draw_correlation(cross_correlation.lags, cross_correlation.curve, cross_correlation.bound),
         instant(0.0, COMMAND, width=0.6),
         axes(ylabel=f"correlation with {cross_correlation.input}",
              xlabel=f"residual later than {cross_correlation.input} by [ms]")]]


def _draw_correlation(lags: Any, values: Any, bound: float) -> list[Mark]:
    return [band(-bound, bound, GREEN), call("vlines", lags * 1e3, 0.0, values, color=INK, lw=0.8)]


def draw_dependence(c: Comparison) -> str:
    """One row per signal: mean residual over motion and other outputs, with 95 % intervals."""
    by = {name: {x.on: x for x in d.depends} for name, d in c.diagnoses.items()}
    possible = ("speed", "position", *(s.symbol for s in c.trace.declared.outputs), "acceleration")
    kinds = [kind for kind in possible if any(kind in dependences for dependences in by.values())]
    if not kinds:
        return ""
    return draw_grid("dependence", [_draw_means(c, name, kinds, dependences) for name, dependences in by.items()],
                     2.3 * len(by), 0.55)


def _draw_means(c: Comparison, name: str, kinds: Sequence[str], by: dict[str, Depends]) -> list[Panel]:
    signal, places = c.signals[name].signal, {kind: find_quantity_axis(c, kind) for kind in kinds}
    unit, scale = choose_drawn_unit(signal, max((d.size for d in by.values()), key=abs, default=0.0))
    floor = NOISE_BAND_RATIO * c.signals[name].floor.value * scale
    return [[band(-floor, floor, GREEN, alpha=0.15),
             call("errorbar", by[kind].centres * places[kind][1], by[kind].means * scale, by[kind].half * scale,
                  color=choose_colour(c.trace.declared, name), lw=1.0, marker="o", ms=3),
             axes(xlabel=places[kind][0], title=f"{100 * by[kind].share:.0f} % of the power",
                  ylabel=f"mean residual\nof {signal.symbol} [{unit}]" if kind == kinds[0] else "")]
            if kind in by else [] for kind in kinds]
