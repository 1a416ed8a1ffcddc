"""`rig trend`: how fault sizes grow from trace to trace, and the time left."""
from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rig.cli import options

if TYPE_CHECKING:
    from fdi.prognosis.unit_trend import UnitTrend
    from fdi.report.report import Report


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rig trend`."""
    add = parser.add_argument
    add("folder", nargs="?", metavar="FOLDER", help="traces of one unit, dated by their logs, names or dates.csv; "
                                                    "or the JSON file of an earlier answer")
    options.add_model_options(parser)
    add("--axis", choices=("date", "hours", "flights"),
        help="time axis of the trend (default: the first of these that all traces have)")
    add("--dates", metavar="FILE.csv", help="table file,date[,hours][,flights] (default: dates.csv in the folder)")
    add("--again", action="store_true", help="diagnose every trace again, even if its sizes are stored")


def run_command(args: argparse.Namespace) -> int:
    """Exit status 0 if both faults are within MidBand at the last trace, 1 otherwise."""
    from plant import InputError

    if args.folder is None:
        raise InputError("FOLDER", "", "a folder of dated traces")
    from fdi.report.trend_report import build_trend_report
    from rig.cli.answer import choose_file, show_answer

    out = choose_file(args.out or None, (".html", ".png", ".svg", ".json"), args.folder)
    unit = follow_traces(args)
    report = build_trend_report(unit)
    if out is not None:
        write_file(unit, report, out)
        report = replace(report, files=[("written", str(out))])
    show_answer(report, args)
    return 0 if unit.level == 0 else 1


def follow_traces(args: argparse.Namespace) -> UnitTrend:
    """The trends of the traces in a folder, or of the points in the JSON file of an earlier answer."""
    from fdi.prognosis.unit_trend import follow_unit, gather_sizes, read_points
    from rig.cli.progress_bar import show_progress

    model, source = options.load_chosen_model(args), Path(args.folder)
    with show_progress(is_silent=args.json or args.quiet) as progress:
        if source.suffix == ".json" and not source.is_dir():
            return follow_unit(read_points(source))
        table = None if args.dates is None else Path(args.dates)
        return follow_unit(gather_sizes(source, model, progress, args.axis, table, args.again))


def write_file(unit: UnitTrend, report: Report, out: Path) -> None:
    """Write the page, figure or JSON file that was asked for, by its suffix."""
    from rig.cli.answer import Places, write_answer

    if out.suffix in (".png", ".svg"):
        from fdi.report.trend_figure import save_trends

        save_trends(unit, out)
    else:
        write_answer(report, Places(out, None) if out.suffix == ".html" else Places(None, out))
