"""`rig recover`: brings back a log whose writer died."""

import argparse
from dataclasses import asdict
from pathlib import Path

from fdi.output import require_new, require_writable
from fdi.report import Report
from rig.cli import give_answer
from rig.recorder.recover import recover_log


def run_command(args: argparse.Namespace) -> int:
    """The log goes to --out (default: FILE with .recovered before its suffix)."""
    source = Path(args.file)
    out = (source.with_name(f"{source.stem}.recovered{source.suffix}") if args.out is None else
           require_writable(args.out, "--out", source=source))
    salvage = recover_log(source, require_new(out, is_forced=args.force))
    return give_answer(Report("recover", str(source), sentence=str(salvage), data=asdict(salvage)), args)
