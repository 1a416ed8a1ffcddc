"""`rig trend`: how fault sizes grow from trace to trace, and the time left."""
from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from rig.cli import options

if TYPE_CHECKING:
    from fdi.prognosis.unit_trend import Answer

KINDS = (".html", ".png", ".svg", ".json")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    add = parser.add_argument
    add("folder", nargs="?", metavar="FOLDER", help="traces of one unit, dated by their logs, names or dates.csv; "
                                                    "or the JSON file of an earlier answer")
    options.add_model(parser)
    add("--axis", choices=("date", "hours", "flights"), help="what the sizes stand over (default: the first of these "
                                                             "that all traces have)")
    add("--dates", metavar="FILE.csv", help="table file,date[,hours][,flights] (default: dates.csv in the folder)")
    add("--again", action="store_true", help="diagnose each trace anew, also where its sizes are known")
    add("--score", action="store_true", help="instead: score the method on simulated units")
    add("--units", type=options.whole, default=20, metavar="N", help="with --score: units of each law (default 20)")


def run_command(args: argparse.Namespace) -> int:
    """Follow both faults; exit status 0 if both are within MidBand at the last trace, 1 otherwise."""
    from plant import InputError

    if args.score:
        if not args.units:
            raise InputError("--units", "0", "1 or more")
        return _score(args)
    if args.folder is None:
        raise InputError("FOLDER", "", "a folder of dated traces, or --score")
    from fdi.prognosis.unit_trend import to_json
    from rig.cli import show_trend

    place = _place(args)
    found = _found(args)
    if place is not None:
        _write(found, place)
    if args.json:
        print(json.dumps(to_json(found)))
    elif not args.quiet:
        show_trend.answer(found, place)
    return 0 if found.level == 0 else 1


def _found(args: argparse.Namespace) -> Answer:
    """From the folder's traces, or from the points of an earlier answer."""
    from fdi.prognosis.gather import Options, gather
    from fdi.prognosis.unit_trend import answer, read
    from rig.cli.progress_bar import show_progress

    model, source = options.model_of(args), Path(args.folder)
    with show_progress(is_silent=args.json or args.quiet) as progress:
        if source.suffix == ".json" and not source.is_dir():
            return answer(read(source))
        table = None if args.dates is None else Path(args.dates)
        return answer(gather(source, model, Options(args.axis, table, args.again), progress))


def _place(args: argparse.Namespace) -> Path | None:
    """Where the result is to go; asked before the work is done.

    Raises:
        InputError: a place that cannot be written, or a kind of file that this command does not make.
    """
    from fdi.output import writable
    from plant import InputError

    if not args.out:
        return None
    out = Path(args.out)
    kinds = (".json",) if args.score else KINDS
    if out.suffix not in kinds:
        raise InputError("--out", str(out), f"FILE with one of {', '.join(kinds)}")
    return writable(out, "--out", source=args.folder)


def _write(found: Answer, out: Path) -> None:
    """The page, picture or JSON file that was asked for."""
    from fdi.output import write_text
    from fdi.prognosis.unit_trend import to_json

    if out.suffix == ".json":
        write_text(out, json.dumps(to_json(found)) + "\n")
    elif out.suffix == ".html":
        from fdi.report.trend_page import render

        write_text(out, render(found))
    else:
        from fdi.report.trend_figure import save

        save(found, out)


def _score(args: argparse.Namespace) -> int:
    """The table of scores; always exit status 0."""
    from fdi.output import write_text
    from rig.cli import show_trend
    from rig.cli.progress_bar import show_progress
    from rig.studies.prognosis.summary import score_laws, to_json

    place = _place(args)
    with show_progress(is_silent=args.json or args.quiet) as progress:
        found = score_laws(args.units, args.seed, progress)
    if place is not None:
        write_text(place, json.dumps(to_json(found)) + "\n")
    if args.json:
        print(json.dumps(to_json(found)))
    elif not args.quiet:
        show_trend.scores(found)
    return 0
