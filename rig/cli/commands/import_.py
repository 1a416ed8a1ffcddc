"""`rig import`: a CSV of signals or a CAN log of raw frames becomes a trace.mcap."""
from __future__ import annotations

import argparse
import json
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    parser.add_argument("file", metavar="FILE", help="what to import")
    parser.add_argument("--dbc", metavar="FILE", help="decodes the raw frames (default: the rig's own eha.dbc)")


def run_command(args: argparse.Namespace) -> int:
    """Write --out (default: FILE with .mcap in place of its suffix)."""
    import dbc
    from plant.errors import InputError
    from rig.recorder.convert import RAW, import_csv, import_frames

    source = Path(args.file)
    csv = source.name.endswith((".csv", ".csv.gz"))
    out = Path(args.out) if args.out is not None else source.with_name(source.name.split(".")[0] + ".mcap")
    if not csv and source.suffix not in RAW:
        raise InputError(source, "", f"a file that ends in .csv, .csv.gz, {', '.join(RAW)}")
    cycles = import_csv(source, out) if csv else import_frames(source, out, Path(args.dbc) if args.dbc else dbc.DBC)
    if args.json:
        print(json.dumps({"trace": str(out), "cycles": cycles}))
    elif not args.quiet:
        print(f"{out}: {cycles} cycles")
    return 0
