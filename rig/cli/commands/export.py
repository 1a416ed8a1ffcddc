"""`rig export`: signals as CSV, raw frames as CAN logs."""
from __future__ import annotations

import argparse
from pathlib import Path

from rig.cli import options


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rig export`."""
    parser.add_argument("trace", metavar="TRACE", help="trace.mcap, the folder of a run, or a CSV")
    parser.add_argument("--all", action="store_true", help="also export the signals of set-up and clean-up")
    options.add_force_option(parser)


def run_command(args: argparse.Namespace) -> int:
    """The suffix of --out chooses the format."""
    from fdi.output import require_new, require_writable
    from fdi.report.report import Report
    from plant.errors import InputError
    from rig.cli.answer import show_answer
    from rig.recorder.convert import export_trace

    if args.out is None:
        raise InputError("--out", "", "the file to write, such as run.csv or frames.blf")
    out = require_new(require_writable(args.out, "--out", source=args.trace), is_forced=args.force)
    count = export_trace(Path(args.trace), out, args.all)
    sentence = f"{args.out}: {count} {'rows' if '.csv' in Path(args.out).suffixes else 'frames'}"
    show_answer(Report("export", args.trace, sentence=sentence, data={"path": str(args.out), "count": count}), args)
    return 0
