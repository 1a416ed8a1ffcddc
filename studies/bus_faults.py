"""Study of the faults on the bus: every fault in every phase of a motion, in lockstep, beside a run without faults.

A cell of the matrix is one run. It says when the fault first shows in the log (activation), when a node or the rig
first reports trouble (detection), when the controller says zero current (reaction), how long clean-up takes to make it
ACTIVE again (recovery), and how far the position was from that of the sound run.
"""

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdi.progress import Progress, ignore_progress
from fdi.report import Cell as TableCell, Column, Medium, Mood, Report, Section, Table
from fdi.trace import Trace, open_log
from plant import load_model
from rig.run import Job, Outcome, run_job
from rig.sequences import parse_sequence
from studies.command import report_progress, run_study_command

MS = 1e3  # per s
PHASES = {"rest": 0.1, "step": 0.31, "ramp": 0.7, "sine": 1.0}  # s of main at which the fault begins
_DETECTING = {"emcy", "heartbeat", "nmt"}  # kinds of events
_SEQUENCE = """
title = "{title}"
{ends}
setup = [{{ kind = "hold", time = 0.1 }}]
main = [
  {{ name = "rest", kind = "hold", time = 0.3 }},
  {{ name = "step", kind = "step", to = 2e-3, time = 0.3 }},
  {{ name = "ramp", kind = "ramp", to = 0.0, time = 0.3 }},
  {{ name = "sine", kind = "sine", amplitude = 2e-3, frequency = 2.0, time = 0.5 }},
  {{ name = "end", kind = "hold", time = 0.4 }},
]
cleanup = [{{ kind = "hold", time = 0.1 }}, {{ kind = "ramp", to = 0.0, time = 0.2 }}]
faults = [{faults}]
checks = [{checks}]
"""


class BusFault(NamedTuple):
    """A fault of the matrix. `keys`: its TOML without times; `duration`: s. `limit`: of the reaction, s; None: the
    fault must be tolerated, that is no node reports anything and the run goes on."""

    name: str
    keys: str
    duration: float
    limit: float | None


FAULTS = (
    BusFault("lost command", 'kind = "lost", frame = "command"', 0.1, 5e-3),
    BusFault("lost feedback", 'kind = "lost", frame = "feedback"', 0.1, 5e-3),
    BusFault("lost drive", 'kind = "lost", frame = "drive"', 0.1, 6e-3),
    BusFault("lost SYNC", 'kind = "lost", frame = "sync"', 0.15, 0.12),
    BusFault("lost heartbeat of the rig", 'kind = "heartbeat", node = "rig"', 0.5, 0.41),
    BusFault("every tenth drive lost", 'kind = "lost", frame = "drive", every = 10', 0.1, None),
    BusFault("late feedback, 0.3 ms", 'kind = "late", frame = "feedback", delay = 3e-4', 0.1, None),
    BusFault("duplicated feedback", 'kind = "duplicated", frame = "feedback"', 0.1, None),
    BusFault("duplicated SYNC", 'kind = "duplicated", frame = "sync", every = 5', 0.1, None),
    BusFault("corrupted feedback, one frame", 'kind = "corrupted", frame = "feedback", count = 1', 0.1, None),
    BusFault("short command, one frame", 'kind = "short", frame = "command", length = 4, count = 1', 0.1, 5e-3),
    BusFault("unknown frames", 'kind = "foreign", every = 2', 0.1, None),
    BusFault("babbling node, 50 frames a cycle", 'kind = "foreign", cob_id = 0x10, frames = 50', 0.1, None),
    BusFault("SYNC jitter, 0.3 ms", 'kind = "jitter", size = 3e-4', 0.1, None),
    BusFault("plant bus-off", 'kind = "bus_off", node = "plant"', 0.1, 5e-3),
    BusFault("rig bus-off", 'kind = "bus_off", node = "rig"', 0.15, 0.16),  # it hears of the reaction afterwards
    BusFault("reset of the controller", 'kind = "reset"', 0.0, 5e-3),
)


class Cell(NamedTuple):
    """One fault in one phase; times in ms after the begin of the fault, None: did not happen or was not seen."""

    fault: str
    phase: str
    limit_ms: float | None  # of the reaction; None: must be tolerated
    activation_ms: float | None
    detection_ms: float | None
    detected_by: str
    reaction_ms: float | None
    recovery_ms: float | None  # after the begin of clean-up
    deviation_um: float | None  # largest in main, from the sound run
    passed: bool


def study_bus_faults(seed: int = 0, faults: tuple[BusFault, ...] = FAULTS,
                     progress: Progress = ignore_progress) -> list[Cell]:
    """Run the whole matrix on the embedded bus; the same seed gives the same cells."""
    cells = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _run(_SEQUENCE.format(title="sound", ends="", faults="", checks=""), folder / "sound", seed)
        pairs = [(fault, phase) for fault in faults for phase in PHASES]
        for number, (fault, phase) in enumerate(pairs):
            progress(f"{fault.name}, {phase}", number / len(pairs))
            outcome = _run(write_sequence(fault, phase), folder / "faulty", seed)
            cells.append(measure_cell(fault, phase, outcome, folder / "sound", folder / "faulty"))
    return cells


def write_sequence(fault: BusFault, phase: str) -> str:
    """The sequence of a cell, as TOML."""
    start = PHASES[phase]
    end = f", end = {start + fault.duration:g}" if fault.duration else ""
    checks = "" if fault.limit is None else (
        f'{{ name = "reaction", kind = "shut_off", after = "fault", high = {fault.limit:g} }}, '
        '{ name = "recovery", kind = "recovers", high = 0.05 }')
    return _SEQUENCE.format(title=f"{fault.name}, {phase}", ends="" if fault.limit is None else 'ends = "safe_state"',
                            faults=f'{{ name = "fault", {fault.keys}, start = {start:g}{end} }}', checks=checks)


def _run(text: str, folder: Path, seed: int) -> Outcome:
    sequence = parse_sequence(text, "bus_faults.toml", lambda name: b"")
    return run_job(Job(sequence=sequence, model=load_model("eha"), seed=seed), folder, ignore_progress, lambda: False)


def measure_cell(fault: BusFault, phase: str, outcome: Outcome, sound: Path, faulty: Path) -> Cell:
    """The figures of a cell from its run and from the run without faults."""
    start = PHASES[phase]
    checks = {check.name: check for check in outcome.checks}
    values = {name: None if name not in checks or np.isnan(checks[name].value) else MS * checks[name].value
              for name in ("reaction", "recovery")}
    troubles = [event for event in outcome.events if event.kind in _DETECTING and event.level == "ERROR"
                and event.t >= start]
    first = min(troubles, key=lambda event: event.t, default=None)
    before, after = (Trace.read(folder).xj for folder in (sound, faulty))
    common = min(len(before), len(after))
    deviation = np.abs(before[:common] - after[:common])
    difference_time = find_first_difference(sound, faulty)
    return Cell(fault.name, phase, None if fault.limit is None else MS * fault.limit,
                None if difference_time is None else round(MS * (difference_time - start), 6),
                None if first is None else round(MS * (first.t - start), 6), "" if first is None else first.text,
                _round(values["reaction"]), _round(values["recovery"]),
                None if np.isnan(deviation).all() else round(1e6 * float(np.nanmax(deviation)), 3),
                outcome.verdict in ("PASS", "NOT_JUDGED"))  # a fault that must not be noticed has no checks


def _round(value: float | None) -> float | None:
    return None if value is None else round(value, 6)


def find_first_difference(sound: Path, faulty: Path) -> float | None:
    """When the frames of two logs first differ, s of main; None if they never do."""
    for one, other in zip_longest(_list_frames(sound), _list_frames(faulty)):
        if one != other:
            return min(frame[0] for frame in (one, other) if frame is not None)
    return None


def _list_frames(folder: Path) -> Iterator[tuple[float, int, bytes]]:
    """Time, s of main, COB-ID and data of the frames from the first cycle of main on."""
    log = open_log(folder / "trace.mcap")
    begin = next(t_ns for _, t_ns, row in log.read_messages("/signals") if row.phase == 1)
    return (((t_ns - begin) * 1e-9, frame.cob_id, frame.data) for _, t_ns, frame in log.read_messages("/can")
            if t_ns >= begin)


def collect_figures(cells: list[Cell], seed: int) -> dict[str, Any]:
    """The JSON answer of the study."""
    failures = [f"{cell.fault}, {cell.phase}" for cell in cells if not cell.passed]
    return {"verdict": "FAIL" if failures else "PASS", "failed": failures, "seed": seed,
            "cells": [cell._asdict() for cell in cells]}


def build_bus_faults_report(cells: Sequence[Cell], seed: int) -> Report:
    """Report on the cells of `studies.bus_faults.study_bus_faults`."""
    figures = collect_figures(list(cells), seed)
    failures = figures["failed"]
    sentence = (f"{len(failures)} of {len(cells)} cells failed: {'; '.join(failures[:4])}" if failures else
                "Every fault was tolerated or answered by zero current in time, and the controller recovered.")
    return Report(
        command="bench", title="faults on the bus", verdict=figures["verdict"], mood="bad" if failures else "good",
        sentence=sentence,
        sections=[Section("Faults and phases", [_tabulate_matrix(cells)]),
                  Section("All figures", [_tabulate_cells(cells)], medium=Medium.PAGE)], data=figures)


def _tabulate_matrix(cells: Sequence[Cell]) -> Table:
    matrix = {(cell.fault, cell.phase): cell for cell in cells}
    names = list(dict.fromkeys(cell.fault for cell in cells))
    rows: list[list[TableCell | str]] = [
        [name, *(_describe_cell(matrix[name, phase]) for phase in PHASES if (name, phase) in matrix)] for name in names]
    caption = ("In ms: time from the begin of the fault to zero current of the controller. Tolerated: nothing was "
               "reported; the figure is the largest deviation of the position from the run without faults.")
    return Table([Column("fault"), *(Column(phase, align="right") for phase in PHASES)], rows, caption)


def _describe_cell(cell: Cell) -> TableCell:
    mood: Mood = "good" if cell.passed else "bad"
    if cell.limit_ms is None:
        word = "tolerated" if cell.passed else "NOT TOLERATED"
        return TableCell(f"{word}, {_format(cell.deviation_um)} um", mood)
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study; see --help."""
    def study(args: argparse.Namespace) -> tuple[Report, bool]:
        cells = study_bus_faults(args.seed, progress=report_progress)
        return build_bus_faults_report(cells, args.seed), all(cell.passed for cell in cells)

    return run_study_command("studies.bus_faults", __doc__, arguments, lambda parser: None, study)


if __name__ == "__main__":
    raise SystemExit(main())
