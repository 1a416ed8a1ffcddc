"""`rig recover`: brings back a log whose writer died."""

import argparse
from dataclasses import asdict
from pathlib import Path

from fdi.report import Report
from rig.cli import give_answer
from rig.recorder.recover import recover_log


def run_command(args: argparse.Namespace) -> int:
    """The log goes to --out (default: FILE with .recovered before its suffix)."""
    source = Path(args.file)
    out = Path(args.out) if args.out is not None else source.with_name(f"{source.stem}.recovered{source.suffix}")
    salvage = recover_log(source, out)
    return give_answer(Report("recover", str(source), sentence=str(salvage), data=asdict(salvage)), args)
