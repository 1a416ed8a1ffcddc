"""`rig report`: one offline HTML file about a trace."""

import argparse
from pathlib import Path

from fdi.report import Report, write_run_page
from rig.cli import give_answer, load_declared_model, show_progress


def run_command(args: argparse.Namespace) -> int:
    """The page goes to --out (default: report.html beside the trace)."""
    source = Path(args.trace)
    folder = source if source.is_dir() else source.parent
    out = folder / "report.html" if args.out is None else Path(args.out)
    with show_progress(args, "writing"):
        write_run_page(source, out, load_declared_model(args).kind.signals)
    return give_answer(Report("report", str(source), sentence=str(out), data={"report": str(out)}), args)
