"""A comparison as a recording for the viewer: each signal measured and replayed, its residual beside the noise floor.

A second comparison of the same trace, with the model as it was before effects were added, is drawn beside it.
"""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fdi.comparison.compare import Comparison
from fdi.report.compare_report import describe_verdict
from fdi.report.drawing import LEVELS, choose_drawn_unit
from fdi.report.numbers import SIGNAL_NAMES, format_ratio, format_signal
from fdi.thresholds import NOISE_BAND_RATIO, SIGNAL_ERROR_RATIO
from rig.view.rerun_log import SECTIONS, make_command_lane
from rig.view.viewer import (
    COMMAND,
    FAIL,
    MEASURED,
    NEUTRAL,
    PASS,
    Floats,
    Lane,
    Line,
    Plot,
    ShownView,
    build_blueprint,
    import_rerun,
    make_lanes_view,
    make_plot_view,
    make_value_axis,
    measure_lanes_view,
    open_recording,
    send_lane,
    send_line,
)

if TYPE_CHECKING:
    import rerun as rr

BEFORE, FLOOR = 0xE5534BFF, MEASURED
# each plot has a colour of its own, so that a picture shows which one is empty
MODELS = {"xj": 0xE8A33DFF, "p12": 0x45B8ACFF, "xs": 0xD96BA0FF}
RESIDUALS = {"xj": 0xC2A83EFF, "p12": 0x7FD46BFF, "xs": 0xB57EDCFF}
LANES, RESULT = "Command and error", "Result"  # titles of the views that are no plots
NOT_JUDGED = "not judged"


def write_comparison_rrd(comparison: Comparison, before: Comparison | None, path: Path) -> None:
    """Write a comparison, and that with the model before a change, with its blueprint as a rerun recording.

    Raises ViewerError without rerun; InputError for a place that cannot be written.
    """
    rr = import_rerun()
    with open_recording(path, f"{comparison.source}, {comparison.model.name}",
                        _build_blueprint(comparison, before)) as stream:
        for plot, drawn in _list_plots(comparison, before):
            for line, t, values in drawn:
                send_line(rr, stream, f"{plot.origin}/{line.path}", line, t, values)
        for lane in _list_lanes(comparison, before):
            send_lane(rr, stream, lane)
        _send_result(rr, stream, comparison, before)


def list_shown_views(comparison: Comparison, before: Comparison | None) -> list[ShownView]:
    """What a picture of the recording must show: in each plot the line that no other has."""
    own = {*MODELS.values(), *RESIDUALS.values()}
    plots = [ShownView(plot.title, tuple({line.colour for line in plot.lines} & own))
             for plot, _ in _list_plots(comparison, before)]
    return [*plots, ShownView(LANES, (PASS, FAIL, *SECTIONS.values()), is_lanes=True)]


Drawn = list[tuple[Line, Floats, Floats]]  # lines with times, s, and values in the unit of the plot


def _list_plots(c: Comparison, before: Comparison | None) -> list[tuple[Plot, Drawn]]:
    """Two plots for each signal, below each other. The viewer draws lines in the order of their paths."""
    out: list[tuple[Plot, Drawn]] = []
    models = ([("before", before)] if before else []) + [("model", c)]
    for name in c.signals:
        unit, scale = LEVELS[name]
        drawn: Drawn = [(Line("1_measured", f"{SIGNAL_NAMES[name]} measured", COMMAND, 4.0), c.trace.t,
                         c.trace.mask_unusable(name) * scale)]
        drawn += [(Line(f"{number}_{word}", "before the change" if word == "before" else "model, from the current",
                        BEFORE if word == "before" else MODELS[name]), found.trace.t, found.replay.model[name] * scale)
                  for number, (word, found) in enumerate(models, 2) if name in found.signals]
        out.append(_make_plot(name, f"{SIGNAL_NAMES[name]} [{unit}]", drawn))
        out.append(_draw_residual(name, models))
    return out


def _draw_residual(name: str, models: Sequence[tuple[str, Comparison]]) -> tuple[Plot, Drawn]:
    """Measured minus model, and the band of the noise floor."""
    known = [(word, found) for word, found in models if name in found.signals]
    last = known[-1][1]
    unit, scale = choose_drawn_unit(name, max(found.signals[name].error for _, found in known))
    drawn: Drawn = [(Line(f"{number}_{word}", "before the change" if word == "before" else "residual",
                          BEFORE if word == "before" else RESIDUALS[name]), found.trace.t,
                     found.replay.residual[name] * scale) for number, (word, found) in enumerate(known, 1)]
    floor = NOISE_BAND_RATIO * last.signals[name].floor.value * scale
    drawn += [(Line(f"3_floor_{side}", f"noise floor, {NOISE_BAND_RATIO:g} SD", FLOOR), last.trace.t[[0, -1]],
               sign * np.full(2, floor)) for side, sign in (("high", 1.0), ("low", -1.0))]
    return _make_plot(f"residual_{name}", f"Residual of {SIGNAL_NAMES[name]}, measured minus model [{unit}]", drawn)


def _make_plot(origin: str, title: str, drawn: Drawn) -> tuple[Plot, Drawn]:
    return Plot(origin, title, tuple(line for line, _, _ in drawn)), drawn


def _list_lanes(c: Comparison, before: Comparison | None) -> list[Lane]:
    """The sections of the command, the error in each section over the noise floor, and rows that are not judged."""
    out = [make_command_lane(c.trace), _make_error_lane("model", c)]
    if before:
        out.append(_make_error_lane("before", before))
    left_out = c.replay.undecided | ~c.trace.usable
    if left_out.any():
        turns = np.flatnonzero(np.diff(left_out.astype(int), prepend=0))
        states = [(float(c.trace.t[k]), NOT_JUDGED if left_out[k] else "") for k in turns]
        out.append(Lane(f"run/{NOT_JUDGED}", states, {NOT_JUDGED: NEUTRAL}))
    return out


def _make_error_lane(word: str, c: Comparison) -> Lane:
    """The error in each section of the command, over its noise floor."""
    states: list[tuple[float, str]] = []
    colours: dict[str, int] = {}
    for place in sorted(c.where, key=lambda place: place.t0):
        text = format_ratio(place.ratio)
        states += [(place.t0, text), (place.t1, "")]
        colours[text] = FAIL if place.ratio > SIGNAL_ERROR_RATIO else PASS
    return Lane(f"error over floor/{word}", _drop_overwritten(states), colours)


def _drop_overwritten(states: list[tuple[float, str]]) -> list[tuple[float, str]]:
    """The states without ends at which another begins."""
    begins = [t for t, text in states if text]
    return [(t, text) for t, text in states if text or not any(abs(t - begin) < 1e-9 for begin in begins)]


def _send_result(rr: Any, stream: rr.RecordingStream, c: Comparison, before: Comparison | None) -> None:
    stream.log("log/result", rr.TextDocument(describe_result(c, before), media_type="text/markdown"), static=True)


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


def _build_blueprint(c: Comparison, before: Comparison | None) -> Any:
    import_rerun()
    import rerun.blueprint as rrb

    plots = [make_plot_view(plot, make_value_axis([values for _, _, values in drawn]))
             for plot, drawn in _list_plots(c, before)]
    lanes = make_lanes_view(LANES, ["run", "error_over_floor"])
    result = rrb.TextDocumentView(origin="/log/result", name=RESULT)
    share = max(measure_lanes_view(len(_list_lanes(c, before))), 0.3)
    signals = rrb.Horizontal(*(rrb.Vertical(*plots[k:k + 2]) for k in range(0, len(plots), 2)))
    return build_blueprint(rrb.Vertical(signals, rrb.Horizontal(lanes, result, column_shares=[3, 2]),
                                        row_shares=[1 - share, share]))
