"""`rig doctor`: what this machine can do, and how to get the rest."""
from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from fdi.report.report import Cell, Column, Mood, Report, Section, Table
from plant.errors import InputError
from rig import doctor
from rig.cli.answer import Places, give_answer

MOODS: dict[doctor.Status, Mood] = {"ok": "good", "limited": "doubtful", "missing": "bad"}


def run_command(args: argparse.Namespace) -> int:
    """Exit status 1 if the embedded bench cannot run here."""
    if not 0 <= args.seconds <= 3600:
        raise InputError("--seconds", "", f"between 0 and 3600 s, not {args.seconds:g}")
    report = build_doctor_report(doctor.examine_machine(args.seconds))
    places = Places(answer=None if args.out is None else Path(args.out))
    return give_answer(report, args, int(report.verdict != "PASS"), places)


def build_doctor_report(findings: Sequence[doctor.Finding]) -> Report:
    """Report on the findings: a table with one row each, below the name of its area."""
    blocking = [finding.name for finding in findings if finding.needed and finding.status == "missing"]
    rows: list[list[Cell | str]] = []
    for area, found in groupby(findings, lambda finding: finding.area):
        rows.append([Cell(area, is_strong=True), "", "", "", ""])
        rows += [[f"  {each.name}", Cell(each.status, MOODS[each.status]), each.found, each.purpose, each.remedy]
                 for each in found]
    columns = [Column(title) for title in ("capability", "", "found", "used for", "how to get it")]
    data = {"verdict": "FAIL" if blocking else "PASS", "findings": [finding._asdict() for finding in findings]}
    section = Section("", [Table(columns, rows)])
    if blocking:
        return Report("doctor", "this machine", "FAIL", "bad", f"The bench cannot run without: {', '.join(blocking)}.",
                      sections=[section], conclusion="the bench cannot run on this machine", data=data)
    counts = Counter(finding.status for finding in findings)
    return Report("doctor", "this machine", "PASS", "good", "The embedded bench runs on this machine.",
                  sections=[section], data=data, conclusion=(
                      f"the embedded bench runs on this machine; {counts['ok']} capabilities ok, {counts['limited']} "
                      f"limited, {counts['missing']} missing (optional)"))
