"""`rig recover`: brings back a log whose writer died."""
from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    parser.add_argument("file", metavar="FILE", help="the broken trace.mcap")


def run_command(args: argparse.Namespace) -> int:
    """Write --out (default: FILE with .recovered before its suffix) and say what was lost."""
    from rig.recorder.recover import recover

    source = Path(args.file)
    out = Path(args.out) if args.out is not None else source.with_name(f"{source.stem}.recovered{source.suffix}")
    salvage = recover(source, out)
    if args.json:
        print(json.dumps({**asdict(salvage), "path": str(salvage.path)}))
    elif not args.quiet:
        print(salvage)
    return 0
