"""`rig export`: signals as CSV, raw frames as CAN logs."""
from __future__ import annotations

import argparse
from pathlib import Path

from fdi.output import require_new, require_writable
from fdi.report.report import Report
from plant.errors import InputError
from rig.cli.answer import give_answer
from rig.recorder.convert import export_trace


def run_command(args: argparse.Namespace) -> int:
    """The suffix of --out chooses the format."""
    if args.out is None:
        raise InputError("--out", "", "the file to write, such as run.csv or frames.blf")
    out = require_new(require_writable(args.out, "--out", source=args.trace), is_forced=args.force)
    count = export_trace(Path(args.trace), out, args.all)
    sentence = f"{out}: {count} {'rows' if '.csv' in out.suffixes else 'frames'}"
    return give_answer(Report("export", args.trace, sentence=sentence, data={"path": str(out), "count": count}), args)
