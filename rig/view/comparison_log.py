"""A comparison as a drawing for the viewer: each signal measured and replayed, its residual beside the noise floor.

A second comparison of the same trace, with the model as it was before effects were added, is drawn beside it.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from fdi.comparison.compare import Comparison
from fdi.report.compare_report import describe_verdict
from fdi.report.drawing import LEVELS, choose_drawn_unit
from fdi.report.numbers import SIGNAL_NAMES, format_ratio, format_signal
from fdi.thresholds import NOISE_BAND_RATIO, SIGNAL_ERROR_RATIO
from rig.view.recording import COMMAND, FAIL, MEASURED, NEUTRAL, PASS, Curve, Drawing, Lane, Plot
from rig.view.rerun_log import SECTIONS, make_command_lane
from rig.view.viewer import ShownView

BEFORE, FLOOR = 0xE5534BFF, MEASURED
# each plot has a colour of its own, so that a picture shows which one is empty
MODELS = {"xj": 0xE8A33DFF, "p12": 0x45B8ACFF, "xs": 0xD96BA0FF}
RESIDUALS = {"xj": 0xC2A83EFF, "p12": 0x7FD46BFF, "xs": 0xB57EDCFF}
LANES = "Command and error"
NOT_JUDGED = "not judged"


def draw_comparison(c: Comparison, before: Comparison | None) -> Drawing:
    """Draw a comparison, and that with the model before a change: two plots for each signal, below each other."""
    models = ([("before", before)] if before else []) + [("model", c)]
    plots = [draw(name, [(word, found) for word, found in models if name in found.signals])
             for name in c.signals for draw in (_draw_signal, _draw_residual)]
    own = {*MODELS.values(), *RESIDUALS.values()}
    shown = [ShownView(plot.title, tuple({curve.colour for curve in plot.curves} & own)) for plot in plots]
    shown.append(ShownView(LANES, (PASS, FAIL, *SECTIONS.values()), is_lanes=True))
    lanes = [make_command_lane(c.trace, "run", 0.0), *(_make_error_lane(word, found) for word, found in models),
             *_list_left_out(c)]
    return Drawing(f"{c.source}, {c.model.name}", plots, LANES, lanes, ("Result", describe_result(c, before)), shown,
                   verdict=c.verdict)


def _draw_signal(name: str, models: Sequence[tuple[str, Comparison]]) -> Plot:
    """Measured, and what each model makes of the measured current."""
    (unit, scale), trace = LEVELS[name], models[-1][1].trace
    curves = [Curve("1_measured", f"{SIGNAL_NAMES[name]} measured", COMMAND, trace.t,
                    trace.mask_unusable(name) * scale, 4.0)]
    curves += [Curve(f"{number}_{word}", "before the change" if word == "before" else "model, from the current",
                     BEFORE if word == "before" else MODELS[name], found.trace.t, found.replay.model[name] * scale)
               for number, (word, found) in enumerate(models, 2)]
    return Plot(name, f"{SIGNAL_NAMES[name]} [{unit}]", curves)


def _draw_residual(name: str, models: Sequence[tuple[str, Comparison]]) -> Plot:
    """Measured minus model, and the band of the noise floor."""
    last = models[-1][1]
    unit, scale = choose_drawn_unit(name, max(found.signals[name].error for _, found in models))
    curves = [Curve(f"{number}_{word}", "before the change" if word == "before" else "residual",
                    BEFORE if word == "before" else RESIDUALS[name], found.trace.t,
                    found.replay.residual[name] * scale) for number, (word, found) in enumerate(models, 1)]
    floor = NOISE_BAND_RATIO * last.signals[name].floor.value * scale
    curves += [Curve(f"3_floor_{side}", f"noise floor, {NOISE_BAND_RATIO:g} SD", FLOOR, last.trace.t[[0, -1]],
                     np.full(2, sign * floor)) for side, sign in (("high", 1.0), ("low", -1.0))]
    return Plot(f"residual_{name}", f"Residual of {SIGNAL_NAMES[name]}, measured minus model [{unit}]", curves)


def _list_left_out(c: Comparison) -> Iterator[Lane]:
    """The rows that are not judged."""
    left_out = c.replay.undecided | ~c.trace.usable
    if left_out.any():
        turns = np.flatnonzero(np.diff(left_out.astype(int), prepend=0))
        states = [(float(c.trace.t[k]), NOT_JUDGED if left_out[k] else "") for k in turns]
        yield Lane(f"run/{NOT_JUDGED}", states, {NOT_JUDGED: NEUTRAL})


def _make_error_lane(word: str, c: Comparison) -> Lane:
    """The error in each section of the command, over its noise floor."""
    places = sorted(c.where, key=lambda place: place.t0)
    colours = {format_ratio(place.ratio): FAIL if place.ratio > SIGNAL_ERROR_RATIO else PASS for place in places}
    states = []
    for place, following in zip(places, [*places[1:], None], strict=True):
        states.append((place.t0, format_ratio(place.ratio)))
        if following is None or following.t0 > place.t1 + 1e-9:  # no state begins where this one ends
            states.append((place.t1, ""))
    return Lane(f"error over floor/{word}", states, colours)


def describe_result(c: Comparison, before: Comparison | None) -> str:
    """Verdict, the errors beside the noise floor, and notes, as Markdown."""
    head = ["signal", *(["error before", "error after"] if before else ["error"]), "noise floor", "ratio"]
    first = [f"Before the change: {before.verdict}. {describe_verdict(before)}", ""] if before else []
    lines = [f"### {c.verdict}", "", f"Model {c.model.name}. {describe_verdict(c)}", "", *first,
             f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    for s in c.signals.values():
        earlier = before.signals.get(s.name) if before else None
        cells = [SIGNAL_NAMES[s.name], *([format_signal(earlier.error, s.name) if earlier else "-"] if before else []),
                 format_signal(s.error, s.name), format_signal(s.floor.value, s.name), format_ratio(s.ratio)]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, "", *(f"- {note}" for note in c.notes)])
