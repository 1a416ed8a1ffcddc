"""`rig export`: signals as CSV, raw frames as CAN logs."""
from __future__ import annotations

import argparse
import json
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    parser.add_argument("trace", metavar="TRACE", help="trace.mcap, the folder of a run, or a CSV")
    parser.add_argument("--all", action="store_true", help="signals of set-up and clean-up too")


def run_command(args: argparse.Namespace) -> int:
    """Write --out; the format is that of its suffix."""
    from plant.errors import InputError
    from rig.recorder.convert import export

    if args.out is None:
        raise InputError("--out", "", "the file to write")
    count = export(Path(args.trace), Path(args.out), args.all)
    if args.json:
        print(json.dumps({"path": str(args.out), "count": count}))
    elif not args.quiet:
        print(f"{args.out}: {count} {'rows' if '.csv' in Path(args.out).suffixes else 'frames'}")
    return 0
