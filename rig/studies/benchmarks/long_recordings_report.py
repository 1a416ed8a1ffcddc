"""The report of `rig bench recordings`."""
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fdi.report.report import Cell, Column, Report, Section, Table


def build_long_recordings_report(figures: Mapping[str, Any]) -> Report:
    """Report on the figures of `rig.studies.benchmarks.long_recordings.measure_long_recordings`."""
    costs = figures["costs"]
    rows: list[list[Cell | str]] = [
        [c["command"], f"{c['length']:g} s", f"{c['cpu']:.1f} s", f"{1e-9 * c['memory']:.2f} GB", c["verdict"],
         "" if c["interrupted"] is None else f"{c['interrupted']:.1f} s"] for c in costs]
    columns = [Column("command"), Column("recording", align="right"), Column("CPU time", align="right"),
               Column("memory", align="right"), Column("verdict"), Column("ends after Ctrl-C", align="right")]
    largest = max(c["memory"] for c in costs)
    longest = max(c["length"] for c in costs)
    caption = "CPU time: user and system time of the whole process. Memory: largest resident set."
    return Report("bench", "recordings",
                  sentence=f"{longest:g} s of recording at 1 kHz take {1e-9 * largest:.2f} GB at most.",
                  sections=[Section("Cost by length of the recording", [Table(columns, rows, caption)])],
                  data=dict(figures))
