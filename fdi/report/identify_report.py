"""The report of `rig identify`: parameters with intervals, what the runs do not show, errors before and after."""

from collections.abc import Sequence
from functools import partial
from typing import Any

from fdi.identification.identify import Estimate, Identification, RunError
from fdi.report.drawing import (
    AFTER,
    BEFORE,
    GREEN,
    ORANGE,
    axes,
    dot,
    draw_panels,
    draw_residuals,
    instant,
    line,
    name_rows,
)
from fdi.report.numbers import (
    format_amount,
    format_interval,
    format_percent,
    format_ratio,
    join_words,
)
from fdi.report.report import Cell, Column, Figure, Line, Listing, Medium, Mood, Report, Section, Table, tabulate
from fdi.thresholds import HELD_OUT_UNDECIDED_SHARE, RESIDUAL_HELD_OUT
from plant import Signals

MOODS: dict[str, Mood] = {"IDENTIFIED": "good", "PARTLY": "doubtful", "CANNOT_TELL": "doubtful", "UNEXPLAINED": "bad"}


def build_identification_report(identification: Identification, title: str, command: str = "", next_command: str = "",
                                files: Sequence[tuple[str, str]] = ()) -> Report:
    """The report of an identification.

    Args:
        identification: the answer.
        title: the name of the model.
        command: what the user typed.
        next_command: what to type next.
        files: (label, path) of what was written.
    """
    place = next((i for i, e in enumerate(identification.errors) if e.is_held_out), 0)
    run_error = identification.errors[place]
    models = list(zip(("data sheet", "identified"), (BEFORE, AFTER), identification.residuals[place], strict=True))
    notes = [*identification.notes,
             *([] if identification.holdouts else ["no held-out run: overfitting is not excluded"])]
    sections = [
        Section("Parameters", [_tabulate_parameters(identification), Figure(
            "Each free parameter over its data sheet value: grey the range of the data sheet, blue the 95 % interval "
            "that the runs leave, orange where the runs do not show the parameter.",
            partial(draw_estimates, identification.estimates))]),
        Section("Error of each run", [_tabulate_errors(identification.errors, identification.model.kind.signals)]),
        Section("Findings", _describe_findings(identification)),
        Section("Residual", [Figure(
            f"Residual of each signal of the {'held-out' if run_error.is_held_out else 'fitted'} run "
            f"{run_error.source.file}, with the data sheet's values and with those found. Where the model is right, "
            "the blue line is between the dotted lines (two noise floors) for 95 % of the time.",
            partial(draw_residuals, "identify", identification.runs[place], models, run_error.floor, is_cut=True))]),
        Section("Provenance", [Listing(command, medium=Medium.PAGE)] if command else [])]
    facts = [("data sheet", identification.before.name),
             *(("held-out run" if e.is_held_out else "run", e.source.file) for e in identification.errors)]
    return Report("identify", title, identification.verdict, MOODS[identification.verdict],
                  describe_identification(identification), facts, notes, sections, next_command, files,
                  _collect_data(identification))


def describe_identification(identification: Identification) -> str:
    """The verdict in a sentence or two: how many parameters, the error before and after beside the noise floor."""
    number, most = sum(e.is_identifiable for e in identification.estimates), len(identification.estimates)
    if identification.verdict == "CANNOT_TELL":
        return f"{identification.reason[0].upper()}{identification.reason[1:]}."
    if identification.verdict == "UNEXPLAINED":
        return (f"No parameters within the ranges explain the runs: {identification.reason}. Something is missing in "
                "the model, or a range is too narrow.")
    run_error = (identification.holdouts or identification.errors)[0]  # the error of its worst signal
    name = max(run_error.before, key=lambda name: run_error.before[name] / run_error.floor[name])
    s = identification.model.kind.signals.find(name)
    is_cut = 0.0 < run_error.undecided <= HELD_OUT_UNDECIDED_SHARE
    error = format_amount((run_error.decided if is_cut else run_error.after)[name], s.unit)
    where = f" in the {format_percent(1.0 - run_error.undecided, 3)} of the run that can be predicted" if is_cut else ""
    count = f"All {number}" if identification.verdict == "IDENTIFIED" else f"{number} of {most}"
    doubt = f" But {identification.reason}." if identification.verdict == "PARTLY" and number == most else ""
    return (f"{count} free parameters are identified: {'held-out run, ' if run_error.is_held_out else ''}{s.symbol} "
            f"error {format_amount(run_error.before[name], s.unit)} -> {error}{where}, "
            f"noise floor {format_amount(run_error.floor[name], s.unit)}.{doubt}")


def _tabulate_parameters(identification: Identification) -> Table:
    def show_value(e: Estimate) -> Cell:
        mood = _judge_estimate(e, identification.verdict)[1]
        if not e.is_identifiable:
            return Cell(f"not identifiable: {format_amount(e.low, e.unit)} .. {format_amount(e.high, e.unit)}", mood)
        return Cell(format_interval(e.value, e.low, e.high, e.unit), "" if mood == "good" else mood)

    doubt = ("The model does not explain the runs, so these values and intervals may be wrong. "
             if identification.verdict == "UNEXPLAINED" else "")
    return tabulate(
        identification.estimates, (Column("parameter"), lambda e: e.name),
        (Column("data sheet", align="right"), lambda e: Cell(format_amount(e.before, e.unit), "muted")),
        (Column("found (95 % interval)"), show_value),
        (Column("over data sheet", align="right", medium=Medium.PAGE),
         lambda e: f"{e.value / e.before:.3f}" if e.before else ""),
        (Column("result", medium=Medium.PAGE), lambda e: Cell(*_judge_estimate(e, identification.verdict))),
        caption=f"{doubt}The model file has these values as its nominal ones. What is not identifiable has a value "
                "within its range, and a remark.")


def _judge_estimate(e: Estimate, verdict: str) -> tuple[str, Mood]:
    if not e.is_identifiable:
        return "not identifiable", "doubtful"
    if e.is_at_bound:
        return "at the end of its range", "bad"
    return ("not to be trusted", "doubtful") if verdict == "UNEXPLAINED" else ("identified", "good")


def _tabulate_errors(errors: Sequence[RunError], signals: Signals) -> Table:
    columns = [Column("run"), Column(""), Column("signal"), Column("before", align="right"),
               Column("after", align="right"), Column("noise floor", align="right"),
               Column("over floor", align="right")]
    rows: list[list[Cell | str]] = [
        [*(run if number == 0 else ("", "")),
         s.symbol, Cell(format_amount(e.before[s.name], s.unit), "muted"), format_amount(e.after[s.name], s.unit),
         Cell(format_amount(e.floor[s.name], s.unit), "muted"),
         Cell(format_ratio(ratio), "good" if ratio <= RESIDUAL_HELD_OUT else "bad")]
        for e in errors for run in [(e.source.file, Cell("held-out" if e.is_held_out else "fitted", "muted"))]
        for number, s in enumerate(map(signals.find, e.after))
        for ratio in [e.after[s.name] / e.floor[s.name]]]
    return Table(columns, rows, "RMS error of each signal with the data sheet's values (before) and with those found.")


def _describe_findings(identification: Identification) -> list[Line]:
    names_of_advice: dict[str, list[str]] = {}
    for a in identification.advice:
        names_of_advice.setdefault(a.what or "no candidate run: give a narrower range", []).append(a.parameter)
    at_bound = join_words(e.name for e in identification.estimates if e.is_at_bound)
    pairs = join_words(f"{c.first} with {c.second} ({c.value:+.3f})" for c in identification.correlations[:4])
    gains = identification.controller
    law = "" if gains is None else "no proportional law with a limit: the model keeps its gains"
    drive, controlled = identification.model.kind.signals.drive.unit, identification.model.kind.signals.controlled.unit
    if gains is not None and gains.is_proportional:
        limit = "" if gains.limit is None else f", limit {format_amount(gains.limit, drive)}"
        gain = format_amount(gains.gain, f"{drive}/{controlled}", 4)
        law = f"gain {gain}{limit}; exact in {format_percent(gains.exact, 3)} of the rows"
    return [
        *(Line("to identify", f"{join_words(names)}: {text}") for text, names in names_of_advice.items()),
        Line("at a bound", f"{at_bound}: the interval reaches the end of the data sheet's range; give a wider one"
             if at_bound else "", "bad"),
        Line("correlated", f"{pairs}: the ratio or product is known better than each" if pairs else ""),
        *(Line("held-out run", f"{format_percent(e.undecided, 2)} of {e.source.file} cannot be predicted, because "
                               "stops there depend on a thousandth of a friction level; the rest is at "
                               f"{format_ratio(e.decided_ratio)} noise floors")
          for e in identification.holdouts if 0.0 < e.undecided <= HELD_OUT_UNDECIDED_SHARE),
        Line("controller", law)]


def _collect_data(identification: Identification) -> dict[str, Any]:
    """The answer of `rig identify --json`; SI units."""
    gains = identification.controller
    return {
        "verdict": identification.verdict, "reason": identification.reason,
        "parameters": {e.name: {
            "value": e.value, "low": e.low, "high": e.high, "unit": e.unit, "before": e.before,
            "range": [e.least, e.most], "identifiable": e.is_identifiable, "at_bound": e.is_at_bound}
            for e in identification.estimates},
        "floor": identification.floor,
        "runs": [{
            "file": e.source.file, "sha256": e.source.sha256, "held_out": e.is_held_out, "error_before": e.before,
            "error": e.after, "ratio": {s: x / e.floor[s] for s, x in e.after.items()}, "undecided": e.undecided,
            "ratio_decided": {s: x / e.floor[s] for s, x in e.decided.items()}} for e in identification.errors],
        "correlations": [c._asdict() for c in identification.correlations],
        "advice": [a._asdict() for a in identification.advice],
        "controller": None if gains is None else {"gain": gains.gain, "limit": gains.limit, "exact": gains.exact}}


def draw_estimates(estimates: Sequence[Estimate]) -> str:
    """Range of the data sheet and interval found of each parameter that cannot be zero, over its data sheet value."""
    nonzero_estimates = [e for e in estimates if e.least > 0.0 and e.before > 0.0]
    if not nonzero_estimates:
        return ""
    panel = [instant(1.0, GREEN, width=1.2), *name_rows([e.name for e in nonzero_estimates]),
             axes(xscale="log", xlabel="value over that of the data sheet (green line)")]
    for row, e in enumerate(nonzero_estimates):
        colour = AFTER if e.is_identifiable else ORANGE
        panel += [*(line([low / e.before, high / e.before], [row, row], paint, width=width, solid_capstyle="butt")
                    for low, high, paint, width in ((e.least, e.most, BEFORE, 7.0), (e.low, e.high, colour, 3.0))),
                  dot(e.value / e.before, row, colour, ms=5.0)]
    return draw_panels("estimates", [[panel]], 0.9 + 0.3 * len(nonzero_estimates))
