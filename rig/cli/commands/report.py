"""`rig report`: one offline HTML file about a trace."""
from __future__ import annotations

import argparse
import json
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    parser.add_argument("trace", metavar="TRACE", help="trace.mcap, the folder of a run, or a CSV")


def run_command(args: argparse.Namespace) -> int:
    """Write --out (default: report.html beside the trace)."""
    from fdi.report.run_page import write_report

    source = Path(args.trace)
    out = Path(args.out) if args.out is not None else (source if source.is_dir() else source.parent) / "report.html"
    write_report(source, out)
    if args.json:
        print(json.dumps({"report": str(out)}))
    elif not args.quiet:
        print(out)
    return 0
