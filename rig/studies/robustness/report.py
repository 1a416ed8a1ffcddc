"""The report of `rig bench robustness`."""
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fdi.report.report import Cell, Column, Item, Line, Paragraph, Report, Section, Table


def build_robustness_report(figures: Mapping[str, Any]) -> Report:
    """Report on the figures of `rig.studies.robustness.run_study.run_study`, which are its `data`."""
    problems = figures["problems"]
    sentence = f"{len(problems)} problems." if problems else "Nothing hung, crashed, grew or was left behind."
    return Report(
        command="bench", title="robustness", verdict="FAIL" if problems else "PASS", mood="bad" if problems else "good",
        sentence=sentence,
        sections=[Section("Fuzz frames", _tabulate_frames(figures)),
                  Section("Disturbed runs", _tabulate_trials(figures)), Section("Long work", _tabulate_soak(figures)),
                  Section("Problems", [Paragraph(problem, "bad") for problem in problems[:50]])],
        data=dict(figures))


def _tabulate_frames(figures: Mapping[str, Any]) -> list[Item]:
    rows: list[list[Cell | str]] = []
    for count in figures["frames"]:
        rows.append([count["target"], str(count["frames"]), str(len(count["failures"])),
                     Cell("yes", "good") if count["works"] else Cell("NO", "bad"), f"{count['growth'] / 1e6:.1f}"])
    datagrams = figures["datagrams"]
    if datagrams:
        rows.append(["UDP, datagrams", str(datagrams["datagrams"]), str(len(datagrams["problems"])),
                     Cell("yes", "good") if datagrams["verdict"] == "PASS" else Cell("NO", "bad"),
                     f"{max(datagrams['growth'].values(), default=0) / 1e6:.1f}"])
    logs = figures["logs"]
    if logs:
        rows.append(["changed logs", str(logs["logs"]), str(len(logs["failures"])), "", ""])
    columns = [Column("into"), Column("frames", align="right"), Column("exceptions", align="right"),
               Column("works afterwards"), Column("more memory", "MB", "right")]
    return [Table(columns, rows, "Valid, mutated and random frames. Afterwards a node boots, answers SDO and takes "
                                 "part in a cycle; a run passes.")] if rows else []


def _tabulate_trials(figures: Mapping[str, Any]) -> list[Item]:
    rows: list[list[Cell | str]] = []
    for row in figures["disturbed"]:
        is_sound = row["sound"] == row["trials"]
        statuses = ", ".join(f"{count} x {status}" for status, count in sorted(row["statuses"].items()))
        rows.append([f"{row['action']} {row['victim']}", str(row["trials"]), str(row["effective"]),
                     Cell(str(row["sound"]), "good" if is_sound else "bad"), statuses, f"{row['end_p50']:.1f}",
                     f"{row['end_max']:.1f}", str(row["zero_max"]).replace("None", ""), str(row["logs"])])
    columns = [Column("disturbance"), Column("runs", align="right"), Column("effective", align="right"),
               Column("sound", align="right"),
               Column("exit status"), Column("end p50", "s", "right"), Column("end max", "s", "right"),
               Column("zero current max", "SYNCs", "right"), Column("logs read", align="right")]
    caption = ("End: from the disturbance to the end of the last process. Zero current: SYNCs from "
               "the last frame of the killed node. A run is sound if it ended in time with a documented status, its "
               "log could be read or recovered and nothing was left.")
    return [Table(columns, rows, caption)] if rows else []


def _tabulate_soak(figures: Mapping[str, Any]) -> list[Item]:
    soak = figures["soak"]
    if not soak:
        return []
    rows: list[list[Cell | str]] = []
    for name, before in soak["start"].items():
        after = soak["end"][name]
        rows.append([name, f"{before['memory'] / 1e6:.1f}", f"{after['memory'] / 1e6:.1f}",
                     f"{before['files']} -> {after['files']}", f"{before['threads']} -> {after['threads']}"])
    columns = [Column("process"), Column("memory at a tenth", "MB", "right"), Column("at the end", "MB", "right"),
               Column("open files"), Column("threads")]
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in soak["verdicts"].items())
    return [Table(columns, rows, "Run after run on nodes that stay."),
            Line("runs", f"{soak['runs']} in {soak['minutes']:g} minutes, {soak['cycles']} cycles: {verdicts}")]
