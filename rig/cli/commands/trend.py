"""`rig trend`: how fault sizes grow from trace to trace, and the time left."""

import argparse
from dataclasses import replace
from pathlib import Path

from fdi.diagnosis.faults import choose_faults, load_faults
from fdi.prognosis.unit_trend import UnitTrend, follow_unit, gather_sizes, read_points
from fdi.report import build_trend_report, draw_trends, save_drawing
from plant import require
from rig.cli import Places, choose_file, give_answer, load_chosen_model, show_progress


def run_command(args: argparse.Namespace) -> int:
    """Exit status 0 if all faults are within MidBand at the last trace, 1 otherwise."""
    require(args.folder is not None, "FOLDER", "", "a folder of dated traces")
    out = choose_file(args.out or None, (".html", ".png", ".svg", ".json"), args.folder)
    unit = follow_traces(args)
    report = build_trend_report(unit)
    if out is not None:
        report = replace(report, files=[("written", str(out))])
        if out.suffix in (".png", ".svg"):
            save_drawing(draw_trends(unit), out, "--out")
    kind = "" if out is None else out.suffix
    places = Places(out if kind == ".html" else None, out if kind == ".json" else None)
    return give_answer(report, args, int(unit.level != 0), places)


def follow_traces(args: argparse.Namespace) -> UnitTrend:
    """The trends of the traces in a folder, or of the points in the JSON file of an earlier answer."""
    model, source = load_chosen_model(args), Path(args.folder)
    with show_progress(args) as progress:
        if source.suffix == ".json" and not source.is_dir():
            return follow_unit(read_points(source, load_faults(args.faults, model.kind) if args.faults else None))
        table = None if args.dates is None else Path(args.dates)
        return follow_unit(gather_sizes(source, model, progress, args.axis, table, args.again,
                                        choose_faults(args.faults, model.kind)))
