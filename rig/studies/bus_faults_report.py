"""The report of `rig bench faults`: the matrix of faults on the bus and phases of the motion."""
from __future__ import annotations

from collections.abc import Sequence

from fdi.report.report import Cell as TableCell
from fdi.report.report import Column, Medium, Mood, Report, Section, Table
from rig.studies.bus_faults import PHASES, Cell, collect_figures


def build_bus_faults_report(cells: Sequence[Cell], seed: int) -> Report:
    """Report on the cells of `rig.studies.bus_faults.study_bus_faults`."""
    figures = collect_figures(list(cells), seed)
    failed = figures["failed"]
    sentence = (f"{len(failed)} of {len(cells)} cells failed: {'; '.join(failed[:4])}" if failed else
                "Every fault was tolerated or answered by zero current in time, and the controller recovered.")
    return Report(
        command="bench", title="faults on the bus", verdict=figures["verdict"], mood="bad" if failed else "good",
        sentence=sentence,
        sections=[Section("Faults and phases", [_tabulate_matrix(cells)]),
                  Section("All figures", [_tabulate_cells(cells)], medium=Medium.PAGE)], data=figures)


def _tabulate_matrix(cells: Sequence[Cell]) -> Table:
    found = {(cell.fault, cell.phase): cell for cell in cells}
    names = list(dict.fromkeys(cell.fault for cell in cells))
    rows: list[list[TableCell | str]] = [
        [name, *(_describe_cell(found[name, phase]) for phase in PHASES if (name, phase) in found)] for name in names]
    caption = ("In ms: time from the begin of the fault to zero current of the controller. Tolerated: nothing was "
               "reported; the figure is the largest deviation of the position from the run without faults.")
    return Table([Column("fault"), *(Column(phase, align="right") for phase in PHASES)], rows, caption)


def _describe_cell(cell: Cell) -> TableCell:
    mood: Mood = "good" if cell.passed else "bad"
    if cell.limit_ms is None:
        said = "tolerated" if cell.passed else "NOT TOLERATED"
        return TableCell(f"{said}, {_format(cell.deviation_um)} um", mood)
    return TableCell(f"{_format(cell.reaction_ms)} ms" + ("" if cell.passed else " FAIL"), mood)


def _tabulate_cells(cells: Sequence[Cell]) -> Table:
    columns = [Column("fault"), Column("phase"), Column("activation", "ms", "right"),
               Column("detection", "ms", "right"), Column("detected by"), Column("reaction", "ms", "right"),
               Column("limit", "ms", "right"), Column("recovery", "ms", "right"), Column("deviation", "um", "right"),
               Column("")]
    rows: list[list[TableCell | str]] = [
        [cell.fault, cell.phase, _format(cell.activation_ms), _format(cell.detection_ms), cell.detected_by,
         _format(cell.reaction_ms), _format(cell.limit_ms), _format(cell.recovery_ms), _format(cell.deviation_um),
         TableCell("pass", "good") if cell.passed else TableCell("FAIL", "bad")] for cell in cells]
    return Table(columns, rows, "Times count from the begin of the fault, recovery from the begin of clean-up. "
                                "Activation: the first frame of the log that differs from the run without faults.")


def _format(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"
