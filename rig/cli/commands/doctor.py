"""`rig doctor`: what this machine can do, and how to get the rest."""
from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fdi.report.report import Mood, Report
    from rig.doctor import Finding, Status


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rig doctor`."""
    parser.add_argument("--seconds", type=float, default=1.0, metavar="S",
                        help="duration of each timer measurement; 0: no measurement (default 1)")


def run_command(args: argparse.Namespace) -> int:
    """Exit status 1 if the embedded bench cannot run here."""
    from plant.errors import InputError

    if not 0 <= args.seconds <= 3600:
        raise InputError("--seconds", "", f"between 0 and 3600 s, not {args.seconds:g}")
    from fdi.output import write_text
    from rig import doctor
    from rig.cli.answer import show_answer

    report = build_doctor_report(doctor.examine_machine(args.seconds))
    if args.out is not None:
        write_text(args.out, json.dumps(report.data, indent=1) + "\n")
    show_answer(report, args)
    return 0 if report.verdict == "PASS" else 1


def build_doctor_report(findings: Sequence[Finding]) -> Report:
    """Report on the findings: a table with one row each, below the name of its area."""
    from fdi.report.report import Cell, Column, Report, Section, Table

    moods: dict[Status, Mood] = {"ok": "good", "limited": "doubtful", "missing": "bad"}
    blocking = [finding.name for finding in findings if finding.needed and finding.status == "missing"]
    rows: list[list[Cell | str]] = []
    area = ""
    for finding in findings:
        if finding.area != area:
            area = finding.area
            rows.append([Cell(area, is_strong=True), "", "", "", ""])
        rows.append([f"  {finding.name}", Cell(finding.status, moods[finding.status]), finding.found, finding.purpose,
                     finding.remedy])
    columns = [Column(title) for title in ("capability", "", "found", "used for", "how to get it")]
    verdict = "FAIL" if blocking else "PASS"
    return Report(
        command="doctor", title="this machine", verdict=verdict, mood="bad" if blocking else "good",
        sentence=f"The bench cannot run without: {', '.join(blocking)}." if blocking
        else "The embedded bench runs on this machine.",
        sections=[Section("", [Table(columns, rows)])],
        conclusion="the bench cannot run on this machine" if blocking else
        f"the embedded bench runs on this machine; {_count_restrictions(findings)}",
        data={"verdict": verdict, "findings": [finding._asdict() for finding in findings]})


def _count_restrictions(findings: Sequence[Finding]) -> str:
    """How many capabilities this machine has, and how many are limited or missing."""
    counts = {word: sum(finding.status == word for finding in findings) for word in ("ok", "limited", "missing")}
    return f"{counts['ok']} capabilities ok, {counts['limited']} limited, {counts['missing']} missing (optional)"
