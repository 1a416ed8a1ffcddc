"""`rig report`: one offline HTML file about a trace."""
from __future__ import annotations

import argparse
from pathlib import Path

from fdi.foreign_code import load_effects_of_model
from fdi.report.report import Report
from fdi.report.run_report import write_run_page
from plant.model import load_model
from rig.cli.answer import give_answer


def run_command(args: argparse.Namespace) -> int:
    """The page goes to --out (default: report.html beside the trace)."""
    source = Path(args.trace)
    folder = source if source.is_dir() else source.parent
    out = folder / "report.html" if args.out is None else Path(args.out)
    load_effects_of_model(args.model, is_trusted=args.trust)
    write_run_page(source, out, load_model(args.model or "eha").kind.signals)
    return give_answer(Report("report", str(source), sentence=str(out), data={"report": str(out)}), args)
