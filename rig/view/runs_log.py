"""Several runs as a drawing for the viewer: each signal of all runs, and its difference from the first below it."""
from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from fdi.comparison.run_differences import Run, RunDifferences
from fdi.report.diff_report import choose_difference_units, describe_differences
from fdi.report.drawing import LEVELS
from fdi.report.numbers import SIGNAL_NAMES, format_amount, format_ratio, join_words
from fdi.thresholds import NOISE_BAND_RATIO
from rig.view.recording import COMMAND, NEUTRAL, PASS, Curve, Drawing, Lane, Plot
from rig.view.rerun_log import SECTIONS, VERDICTS, list_fault_lanes, list_verdict_lanes, make_command_lane
from rig.view.viewer import ShownView

REFERENCE, NOISE = COMMAND, 0x7FD46BFF
COLOURS = (0xE8A33DFF, 0xD96BA0FF, 0x45B8ACFF, 0xB57EDCFF, 0x3D8FE0FF)  # of the runs after the first, in rotation
SIGNALS, LANES = "signals and differences", "Runs"  # the first is all plots together


def draw_runs(found: RunDifferences) -> Drawing:
    """Draw runs and their differences, on the time of the first run: two plots for each signal, below each other."""
    plots: list[Plot] = []
    for name, (size, unit) in choose_difference_units(found).items():
        shown, scale = LEVELS[name]
        plots.append(Plot(name, f"{SIGNAL_NAMES[name]} [{shown}]", _draw_signal(found, name, scale)))
        plots.append(Plot(f"difference_{name}", f"{SIGNAL_NAMES[name]} minus that of A [{unit}]",
                          _draw_difference(found, name, 1.0 / size)))
    # a run has one colour in all plots, so they are counted together
    colours = {curve.colour for plot in plots for curve in plot.curves} - {NOISE, REFERENCE}
    lanes = {PASS, NEUTRAL, *SECTIONS.values(), *VERDICTS.values()}
    views = [ShownView(SIGNALS, tuple(colours)), ShownView(LANES, tuple(lanes), is_lanes=True)]
    return Drawing(join_words([run.source for run in found.runs]), plots, LANES, _list_lanes(found),
                   ("Result", describe_result(found)), views, verdict=found.verdict)


def _draw_signal(found: RunDifferences, name: str, scale: float) -> list[Curve]:
    offsets = [0.0, *(pair.offset for pair in found.pairs)]
    return [Curve(f"{number:02}_{run.label}", f"{run.label} {_shorten_source(run)}", _choose_colour(number),
                  run.trace.t + offset, run.trace.column(name) * scale, 1.5 if number else 4.0)
            for number, (run, offset) in enumerate(zip(found.runs, offsets, strict=True)) if name in run.trace.signals]


def _draw_difference(found: RunDifferences, name: str, scale: float) -> list[Curve]:
    known = [(number, pair, signal) for number, pair in enumerate(found.pairs, 1) for signal in pair.signals
             if signal.name == name]
    curves = [Curve(f"{number:02}_{pair.run.label}", f"{pair.run.label} - A", _choose_colour(number), pair.t,
                    pair.differences[name] * scale) for number, pair, _ in known]
    band = max((NOISE_BAND_RATIO * math.hypot(*signal.noise) * scale for _, _, signal in known), default=0.0)
    return curves + [Curve(f"noise_{side}", f"noise of both runs, {NOISE_BAND_RATIO:g} SD", NOISE,
                           found.runs[0].trace.t[[0, -1]], np.full(2, sign * band))
                     for side, sign in (("high", 1.0), ("low", -1.0))]


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
    lanes: list[Lane] = []
    for run, pair in zip(found.runs, [None, *found.pairs], strict=True):
        offset = pair.offset if pair else 0.0
        lanes += list_verdict_lanes(run.trace, run.label, offset)
        if pair is None or not pair.has_same_command:
            lanes.append(make_command_lane(run.trace, run.label, offset))
        lanes += list_fault_lanes(run.trace, f"{run.label}/fault ", offset)
    return lanes


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
