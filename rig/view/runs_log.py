"""Several runs as a recording for the viewer: each signal of all runs, and its difference from the first below it."""
from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from fdi.comparison.run_differences import Run, RunDifferences
from fdi.report.diff_report import choose_difference_units, describe_differences
from fdi.report.drawing import LEVELS
from fdi.report.numbers import SIGNAL_NAMES, format_amount, format_ratio, join_words
from fdi.report.run_report import read_verdict
from fdi.thresholds import NOISE_BAND_RATIO
from rig.view.rerun_log import ACTIVE, SECTIONS, VERDICTS, list_fault_states, make_command_lane
from rig.view.viewer import (
    COMMAND,
    FAIL,
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

REFERENCE, NOISE = COMMAND, 0x7FD46BFF
COLOURS = (0xE8A33DFF, 0xD96BA0FF, 0x45B8ACFF, 0xB57EDCFF, 0x3D8FE0FF)  # of the runs after the first, in rotation
SIGNALS, LANES, RESULT = "signals and differences", "Runs", "Result"  # the first is all plots together
Drawn = list[tuple[Line, Floats, Floats]]  # lines with times of the first run, s, and values in the unit of the plot


def write_runs_rrd(found: RunDifferences, path: Path) -> None:
    """Write runs and their differences with a blueprint as a rerun recording, on the time of the first run.

    Raises ViewerError without rerun; InputError for a place that cannot be written.
    """
    rr = import_rerun()
    with open_recording(path, join_words([run.source for run in found.runs]), _build_blueprint(found)) as stream:
        for plot, drawn in _list_plots(found):
            for line, t, values in drawn:
                send_line(rr, stream, f"{plot.origin}/{line.path}", line, t, values)
        for lane in _list_lanes(found):
            send_lane(rr, stream, lane)
        stream.log("log/result", rr.TextDocument(describe_result(found), media_type="text/markdown"), static=True)


def list_shown_views(found: RunDifferences) -> list[ShownView]:
    """What a picture of the recording must show. A run has one colour in all plots, so they are counted together."""
    colours = {line.colour for plot, _ in _list_plots(found) for line in plot.lines} - {NOISE, REFERENCE}
    lanes = {PASS, NEUTRAL, *SECTIONS.values(), *VERDICTS.values()}
    return [ShownView(SIGNALS, tuple(colours)), ShownView(LANES, tuple(lanes), is_lanes=True)]


def _list_plots(found: RunDifferences) -> list[tuple[Plot, Drawn]]:
    """The signals that can be compared: two plots each, below each other."""
    units = choose_difference_units(found)
    out: list[tuple[Plot, Drawn]] = []
    for name, (size, unit) in units.items():
        shown, scale = LEVELS[name]
        out.append(_make_plot(name, f"{SIGNAL_NAMES[name]} [{shown}]", _draw_signal(found, name, scale)))
        out.append(_make_plot(f"difference_{name}", f"{SIGNAL_NAMES[name]} minus that of A [{unit}]",
                              _draw_difference(found, name, 1.0 / size)))
    return out


def _draw_signal(found: RunDifferences, name: str, scale: float) -> Drawn:
    offsets = [0.0, *(pair.offset for pair in found.pairs)]
    return [(Line(f"{number:02}_{run.label}", f"{run.label} {_shorten_source(run)}", _choose_colour(number),
                  1.5 if number else 4.0), run.trace.t + offset, run.trace.column(name) * scale)
            for number, (run, offset) in enumerate(zip(found.runs, offsets, strict=True)) if name in run.trace.signals]


def _draw_difference(found: RunDifferences, name: str, scale: float) -> Drawn:
    drawn: Drawn = []
    band = 0.0
    for number, pair in enumerate(found.pairs, 1):
        for signal in pair.signals:
            if signal.name == name:
                band = max(band, NOISE_BAND_RATIO * math.hypot(*signal.noise) * scale)
                drawn.append((Line(f"{number:02}_{pair.run.label}", f"{pair.run.label} - A", _choose_colour(number)),
                              pair.t, pair.differences[name] * scale))
    ends = found.runs[0].trace.t[[0, -1]]
    return drawn + [(Line(f"noise_{side}", f"noise of both runs, {NOISE_BAND_RATIO:g} SD", NOISE), ends,
                     sign * np.full(2, band)) for side, sign in (("high", 1.0), ("low", -1.0))]


def _make_plot(origin: str, title: str, drawn: Drawn) -> tuple[Plot, Drawn]:
    return Plot(origin, title, tuple(line for line, _, _ in drawn)), drawn


def _choose_colour(number: int) -> int:
    return COLOURS[(number - 1) % len(COLOURS)] if number else REFERENCE


def _shorten_source(run: Run) -> str:
    """The last folder or file name of the user's text.

    >>> _shorten_source(Run("B", "runs/clogged/trace.mcap", None)), _shorten_source(Run("B", "before.csv", None))
    ('clogged', 'before.csv')
    """
    path = Path(run.source)
    return path.parent.name or path.name if path.name == "trace.mcap" else path.name


def _list_lanes(found: RunDifferences) -> list[Lane]:
    """Verdict and faults of each run, and the command of each run that has another one than the first."""
    out = [make_command_lane(found.runs[0].trace, "A/command")]
    for run, pair in zip(found.runs, [None, *found.pairs], strict=True):
        offset = pair.offset if pair else 0.0
        verdict = read_verdict(run.trace)
        if verdict.word in VERDICTS:
            out.append(Lane(f"{run.label}/verdict", [(float(run.trace.t[0]) + offset, str(verdict))],
                            {str(verdict): VERDICTS[verdict.word]}))
        if pair and not pair.has_same_command:
            out.append(make_command_lane(run.trace, f"{run.label}/command", offset))
        out += [Lane(f"{run.label}/fault {label}", [(t + offset, state) for t, state in states], {ACTIVE: FAIL})
                for label, states in list_fault_states(run.trace).items()]
    return out


def describe_result(found: RunDifferences) -> str:
    """Verdict, differences beside the noise, checks that changed, and notes, as Markdown."""
    runs = [f"- {run.label}: {run.source}" for run in found.runs]
    lines = [f"### {found.verdict}", "", describe_differences(found), "", *runs, "",
             "| run | signal | RMS difference | largest | times the noise |", "|---|---|---|---|---|"]
    lines += [f"| {pair.run.label} - A | {SIGNAL_NAMES[s.name]} | {format_amount(s.rms, s.unit)} | "
              f"{format_amount(s.largest, s.unit)} at {s.t:.3f} s | {format_ratio(s.ratio)} |"
              for pair in found.pairs for s in pair.signals]
    changed = [check for check in found.checks if check.is_changed]
    if changed:
        labels = [run.label for run in found.runs]
        lines += ["", f"| check | {' | '.join(labels)} |", f"|{'---|' * (1 + len(labels))}"]
        lines += [f"| {check.name} | {' | '.join(_judge(result) for result in check.results)} |" for check in changed]
    notes = dict.fromkeys(note for pair in found.pairs for note in pair.notes)
    return "\n".join([*lines, "", *(f"- {note}" for note in notes)])


def _judge(result: Any) -> str:
    return "-" if result is None else "pass" if result.passed else "FAIL"


def _build_blueprint(found: RunDifferences) -> Any:
    import_rerun()
    import rerun.blueprint as rrb

    plots = [make_plot_view(plot, make_value_axis([values for _, _, values in drawn]))
             for plot, drawn in _list_plots(found)]
    lanes = make_lanes_view(LANES, [run.label for run in found.runs])
    result = rrb.TextDocumentView(origin="/log/result", name=RESULT)
    share = min(max(measure_lanes_view(len(_list_lanes(found))), 0.3), 0.45)
    below = rrb.Horizontal(lanes, result)
    if not plots:
        return build_blueprint(below)
    signals = rrb.Horizontal(*(rrb.Vertical(*plots[k:k + 2]) for k in range(0, len(plots), 2)))
    return build_blueprint(rrb.Vertical(signals, below, row_shares=[1 - share, share]))
