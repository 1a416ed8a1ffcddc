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
    options.add_model(parser)
    add("--axis", choices=("date", "hours", "flights"),
        help="time axis of the trend (default: the first of these that all traces have)")
    add("--dates", metavar="FILE.csv", help="table file,date[,hours][,flights] (default: dates.csv in the folder)")
    add("--again", action="store_true", help="diagnose every trace again, even if its sizes are stored")
    add("--score", action="store_true", help="instead: score the prognosis method on simulated units")
    add("--units", type=options.whole, default=20, metavar="N",
        help="with --score: simulated units of each growth law (default 20)")


def run_command(args: argparse.Namespace) -> int:
    """Follow both faults; exit status 0 if both are within MidBand at the last trace, 1 otherwise."""
    from plant import InputError

    if args.score:
        if not args.units:
            raise InputError("--units", "0", "1 or more")
        return score_method(args)
    if args.folder is None:
        raise InputError("FOLDER", "", "a folder of dated traces, or --score")
    from fdi.report.trend_report import build_trend_report
    from rig.cli.answer import show_answer

    out = choose_output(args, (".html", ".png", ".svg", ".json"))
    unit = follow_traces(args)
    report = build_trend_report(unit)
    if out is not None:
        write_answer(unit, report, out)
        report = replace(report, files=[("written", str(out))])
    show_answer(report, args)
    return 0 if unit.level == 0 else 1


def follow_traces(args: argparse.Namespace) -> UnitTrend:
    """The trends of the traces in a folder, or of the points in the JSON file of an earlier answer."""
    from fdi.prognosis.gather import Options, gather_sizes
    from fdi.prognosis.unit_trend import follow_unit, read_points
    from rig.cli.progress_bar import show_progress

    model, source = options.model_of(args), Path(args.folder)
    with show_progress(is_silent=args.json or args.quiet) as progress:
        if source.suffix == ".json" and not source.is_dir():
            return follow_unit(read_points(source))
        table = None if args.dates is None else Path(args.dates)
        return follow_unit(gather_sizes(source, model, Options(args.axis, table, args.again), progress))


def choose_output(args: argparse.Namespace, suffixes: tuple[str, ...]) -> Path | None:
    """Path of the file that --out asks for; checked before the work is done.

    Raises:
        InputError: a path that cannot be written, or a kind of file that this command does not write.
    """
    from fdi.output import writable
    from plant import InputError

    if not args.out:
        return None
    out = Path(args.out)
    if out.suffix not in suffixes:
        raise InputError("--out", str(out), f"FILE with one of {', '.join(suffixes)}")
    return writable(out, "--out", source=args.folder)


def write_answer(unit: UnitTrend, report: Report, out: Path) -> None:
    """Write the page, figure or JSON file that was asked for, by its suffix."""
    if out.suffix == ".json":
        from fdi.output import write_text
        from fdi.report.json import to_json

        write_text(out, to_json(report.data) + "\n")
    elif out.suffix == ".html":
        from fdi.report.html import write_html

        write_html(report, out)
    else:
        from fdi.report.trend_figure import save_trends

        save_trends(unit, out)


def score_method(args: argparse.Namespace) -> int:
    """Score the prognosis on simulated units; always exit status 0."""
    from fdi.output import write_text
    from fdi.report.json import to_json
    from rig.cli.answer import show_answer
    from rig.cli.progress_bar import show_progress
    from rig.studies.prognosis.score_report import build_score_report
    from rig.studies.prognosis.summary import score_laws

    out = choose_output(args, (".json",))
    with show_progress(is_silent=args.json or args.quiet) as progress:
        report = build_score_report(score_laws(args.units, args.seed, progress))
    if out is not None:
        write_text(out, to_json(report.data) + "\n")
    show_answer(report, args)
    return 0
