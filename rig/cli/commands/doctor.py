"""`rig doctor`: what this machine can do, and how to get the rest."""
from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rig.doctor import Finding

MARKS = {"ok": "[green]ok[/]", "limited": "[yellow]limited[/]", "missing": "[red]missing[/]"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    text = "length of each timer measurement, 0: none (default 1)"
    parser.add_argument("--seconds", type=float, default=1.0, metavar="S", help=text)


def run_command(args: argparse.Namespace) -> int:
    """Show every finding; 1 if something is missing without which not even the embedded bench runs."""
    from plant.errors import InputError

    if not 0 <= args.seconds <= 3600:
        raise InputError("--seconds", "", f"between 0 and 3600 s, not {args.seconds:g}")
    from fdi.output import write_text
    from rig import doctor

    findings = doctor.survey(args.seconds)
    blocked = [finding.name for finding in findings if finding.needed and finding.status == "missing"]
    answer = {"verdict": "FAIL" if blocked else "PASS", "findings": [finding._asdict() for finding in findings]}
    if args.out is not None:
        write_text(args.out, json.dumps(answer, indent=1) + "\n")
    if args.json:
        print(json.dumps(answer))
    elif not args.quiet:
        show(findings)
    if blocked and not args.json:
        print(f"rig doctor: the bench cannot run without: {', '.join(blocked)}")
    return 1 if blocked else 0


def show(findings: list[Finding]) -> None:
    """The table: one row for each finding, under its area's name."""
    from rich.markup import escape
    from rich.table import Table

    from rig.cli.terminal import console

    table = Table(box=None, pad_edge=False)
    for column in ("What this machine can do", "", "found", "for", "how to get it"):
        table.add_column(column, overflow="fold")
    area = ""
    for finding in findings:
        if finding.area != area:
            table.add_row(f"[bold]{finding.area}[/]")
            area = finding.area
        texts = [escape(text) for text in (finding.found, finding.purpose, finding.remedy)]
        table.add_row(f"  {escape(finding.name)}", MARKS[finding.status], *texts)
    console().print(table)
