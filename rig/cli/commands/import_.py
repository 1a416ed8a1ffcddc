"""`rig import`: a CSV of signals or a CAN log of raw frames becomes a trace.mcap."""
from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rig import`."""
    parser.add_argument("file", metavar="FILE", help="a CSV of signals, or a CAN log: .log (candump), .blf, .asc, .trc")
    parser.add_argument("--dbc", metavar="FILE", help="DBC that decodes the raw frames (default: the shipped eha.dbc)")


def run_command(args: argparse.Namespace) -> int:
    """Write --out (default: FILE with .mcap in place of its suffix)."""
    import dbc
    from fdi.report.report import Report
    from plant.errors import InputError
    from rig.cli.answer import show_answer
    from rig.recorder.convert import RAW_SUFFIXES, import_csv, import_frames

    source = Path(args.file)
    csv = source.name.endswith((".csv", ".csv.gz"))
    out = Path(args.out) if args.out is not None else source.with_name(source.name.split(".")[0] + ".mcap")
    if not csv and source.suffix not in RAW_SUFFIXES:
        raise InputError(source, "", f"a file that ends in .csv, .csv.gz, {', '.join(RAW_SUFFIXES)}")
    if csv and args.dbc:
        raise InputError("--dbc", args.dbc, "a CAN log to decode; a CSV of signals has no frames")
    if csv:
        cycles = import_csv(source, out)
    else:
        cycles = import_frames(source, out, Path(args.dbc) if args.dbc else dbc.DBC)
    data = {"trace": str(out), "cycles": cycles}
    show_answer(Report("import", str(source), sentence=f"{out}: {cycles} cycles", data=data), args)
    return 0
