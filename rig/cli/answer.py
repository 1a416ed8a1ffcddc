"""How every command shows its answer: as one JSON object, as tables and sentences, or not at all."""
from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fdi.report.report import Report


def show_answer(report: Report, args: argparse.Namespace) -> None:
    """Print a report on standard output as --json and --quiet ask; --json comes before --quiet."""
    if args.json:
        from fdi.report.json import to_json

        print(to_json(report.data))
    elif not args.quiet:
        from fdi.report.terminal import print_report
        from rig.cli.terminal import console

        print_report(report, console())
