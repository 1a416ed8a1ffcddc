"""The report of `rig add` and `rig remove`: the error after each step, and the fitted parameters."""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from fdi.discovery.model_file import Row
from fdi.discovery.update_model import ModelUpdate
from fdi.report import explain_figures
from fdi.report.explain_report import describe_suspicious, list_parameters, list_sources, list_suspicious
from fdi.report.numbers import (
    NO_NUMBER,
    SIGNAL_NAMES,
    format_interval,
    format_ratio,
    format_signal,
    join_words,
)
from fdi.report.report import Cell, Column, Figure, Item, Line, Listing, Medium, Mood, Report, Section, Table

GOOD_RATIO = 1.15  # error over noise floor up to which a cell is green


def build_model_report(update: ModelUpdate, path: Path | None = None, backup: Path | None = None,
                       page: Path | None = None) -> Report:
    """The report of an update.

    Args:
        update: what was added or removed.
        path: the model file that was written; None for none.
        backup: where the file that was there before is now.
        page: the page to be written.
    """
    title = f"without {update.removed}" if update.removed else " + ".join(update.added)
    mood: Mood = "doubtful" if update.helps is False else "good"
    p = update.provenance
    lines = [Line(name, format_interval(v.value, v.low, v.high, v.unit), medium=Medium.TERMINAL)
             for name, v in update.parameters.items()]
    if update.suspicious:
        lines.append(Line("suspicious", describe_suspicious(update.suspicious), medium=Medium.TERMINAL))
    sections = [Section("Error after each step", _show_ledger(update)),
                Section("Parameters", [*lines, *_tabulate_parameters(update)]),
                Section("Residual", _show_residuals(update)), *list_suspicious(update.suspicious),
                Section("Provenance", [Listing("\n".join(p.history))], medium=Medium.PAGE)]
    files = []
    if path is not None:
        files.append(("model", str(path) + (f" (the one before: {backup})" if backup is not None else "")))
    if page is not None and update.refit is not None:
        files.append(("page", str(page)))
    sources = [s for s in (p.trace, *p.repeats, p.holdout) if s]
    return Report("remove" if update.removed else "add", title, "FITTED" if update.refit is not None else "", mood,
                  describe_update(update), list_sources(sources, bool(p.holdout)), update.notes, sections, files=files,
                  data=collect_data(update, path, page))


def describe_update(update: ModelUpdate) -> str:
    """What the update did to the error of the worst signal, on the fitted and on the held-out run."""
    if update.removed:
        return _describe_removal(update)
    assert update.refit is not None
    before, after = update.refit.steps[-1 - len(update.added)], update.refit.last
    floor = update.floor
    s = max(before.error, key=lambda name: before.error[name] / floor[name])
    sentence = f"{join_words(update.added)} added: {_describe_change(s, before.error, after.error, floor)}"
    if s in after.holdout:
        sentence += f"; held-out run {format_signal(before.holdout[s], s)} -> {format_signal(after.holdout[s], s)}"
    return f"{sentence}." if update.helps else f"{sentence}. {update.added[-1]} explains nothing but noise."


def _describe_removal(update: ModelUpdate) -> str:
    if update.refit is None:
        return f"{update.removed} removed."
    before, after = update.provenance.ledger[-2:]
    floor = update.floor
    s = max(after.error, key=lambda name: after.error[name] / floor[name])
    return f"{update.removed} removed: {_describe_change(s, before.error, after.error, floor)}."


def _describe_change(s: str, before: Mapping[str, float], after: Mapping[str, float],
                     floor: Mapping[str, float]) -> str:
    return (f"{SIGNAL_NAMES[s]} error {format_signal(before[s], s)} -> {format_signal(after[s], s)}, noise floor "
            f"{format_signal(floor[s], s)}")


def _show_ledger(update: ModelUpdate) -> list[Item]:
    if update.refit is None:
        return []
    rows, floor = update.provenance.ledger, update.floor
    return [_tabulate_errors(rows, floor), _draw_bars(rows, floor), Figure(
        "Error over noise floor after each step, on the fitted and on the held-out run. An effect that lowers only the "
        "blue bar is overfitting.", partial(explain_figures.draw_ledger, rows, floor))]


def _tabulate_errors(rows: Sequence[Row], floor: Mapping[str, float]) -> Table:
    """RMS error of each signal after each step, on the fitted run and on the held-out one."""
    columns = [Column("step"), Column("run")]
    for s in floor:
        columns += [Column(SIGNAL_NAMES[s], align="right"), Column("over floor", align="right", medium=Medium.PAGE)]
    cells: list[list[Cell | str]] = []
    for row in rows:
        cells.append([explain_figures.name_step(row), "fitted", *_error_cells(row.error, floor)])
        if row.holdout:
            cells.append(["", Cell("held-out", "muted"), *_error_cells(row.holdout, floor)])
    floors = [Cell(text, "muted") for s, x in floor.items() for text in (format_signal(x, s), "1")]
    cells.append([Cell("noise floor", "muted"), "", *floors])
    return Table(columns, cells, f"RMS error of each signal. Green: at most {GOOD_RATIO:g} times the noise floor.")


def _error_cells(by_signal: Mapping[str, float], floor: Mapping[str, float]) -> list[Cell]:
    cells = []
    for s in floor:
        if s not in by_signal:
            cells += [Cell(NO_NUMBER), Cell(NO_NUMBER)]
            continue
        ratio = by_signal[s] / floor[s]
        cells += [Cell(format_signal(by_signal[s], s), _choose_mood(ratio)), Cell(format_ratio(ratio), "muted")]
    return cells


def _choose_mood(ratio: float) -> Mood:
    return "good" if ratio <= GOOD_RATIO else "bad"


def _draw_bars(rows: Sequence[Row], floor: Mapping[str, float], width: int = 30) -> Table:
    """The worst signal's error over its noise floor, as bars of characters on a logarithmic scale."""
    ratios = [[max((x / floor[s] for s, x in by_signal.items() if s in floor), default=math.nan)
               for by_signal in (row.error, row.holdout)] for row in rows]
    largest = max((x for pair in ratios for x in pair if math.isfinite(x)), default=1.0)
    cells: list[list[Cell | str]] = []
    for row, (fitted, holdout) in zip(rows, ratios, strict=True):
        step = explain_figures.name_step(row)
        cells.append([step, "fitted", _draw_bar(fitted, largest, width), format_ratio(fitted)])
        if math.isfinite(holdout):
            cells.append(["", Cell("held-out", "muted"), _draw_bar(holdout, largest, width), format_ratio(holdout)])
    return Table([Column("step"), Column("run"), Column("worst signal"), Column("over floor", align="right")], cells,
                 "Error of the worst signal over its noise floor, on a logarithmic scale.", medium=Medium.TERMINAL)


def _draw_bar(ratio: float, largest: float, width: int) -> Cell:
    length = max(1, round(width * math.log(max(ratio, 1.0)) / math.log(max(largest, 1.1))))
    return Cell("█" * length, _choose_mood(ratio))


def _tabulate_parameters(update: ModelUpdate) -> list[Table]:
    if not update.parameters:
        return []
    table = list_parameters(update.parameters.items())
    return [Table(table.columns, table.rows, is_list=True, medium=Medium.PAGE)]


def _show_residuals(update: ModelUpdate) -> list[Item]:
    if update.refit is None:
        return []
    r = update.refit
    first, last = r.steps[0].hypothesis, r.last.hypothesis
    return [Figure(
        "Residual (measured minus model) of each signal, before and after. Where the model is complete, the blue line "
        "stays between the dotted lines (two noise floors). Shaded: ramps (blue) and dynamic sections (violet) of the "
        "command.",
        partial(explain_figures.draw_residuals, r.search.problem.trace, first, last if last is not first else None,
                update.floor))]


def collect_data(update: ModelUpdate, path: Path | None, page: Path | None) -> dict[str, Any]:
    """The answer of `rig add --json` and `rig remove --json`; SI units."""
    is_fitted = update.refit is not None
    return {"model": None if path is None else str(path),
            "ledger": [row.to_json() for row in update.provenance.ledger],
            "floor": dict(update.provenance.floor or {}),
            "parameters": {name: v._asdict() for name, v in update.parameters.items()},
            "effects": list(update.provenance.effects), "helps": update.helps,
            "suspicious": [s._asdict() for s in update.suspicious], "notes": list(update.notes),
            "report": str(page) if page is not None and is_fitted else None}
