"""`rig compare`: a model held against a measured trace."""
from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from rig.cli import options

if TYPE_CHECKING:
    from fdi.comparison.compare import Comparison


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    add = parser.add_argument
    add("trace", metavar="TRACE", help="trace.mcap, the folder of a run, or a CSV with t,com,xj,cor[,p12,xs,load]")
    options.add_model(parser)
    add("--repeat", action="append", default=[], metavar="TRACE",
        help="the same command again: measures the noise, whatever its colour (repeatable)")
    add("--signals", metavar="xj,p12,xs", help="what to compare (default: what the trace has)")
    add("--report", action="store_true", help="write a page with pictures, compare.html beside the trace, "
                                              "or where --out FILE.html says")


def run_command(args: argparse.Namespace) -> int:
    """Replay a trace with a model; exit status 0 if only noise is left, 1 otherwise."""
    from fdi.comparison.compare import compare
    from fdi.report.compare_text import to_json
    from fdi.trace.trace import Trace
    from rig.cli import show_compare
    from rig.cli.progress_bar import show_progress

    page, answer = places(args)
    model = options.model_of(args)
    chosen = [name.strip() for name in args.signals.split(",")] if args.signals is not None else None
    with show_progress(is_silent=args.json or args.quiet) as progress:
        trace = Trace.read(args.trace)
        repeats = [Trace.read(file) for file in args.repeat]
        found = compare(trace, model, repeats, chosen, progress, str(args.trace))
        write(found, page, answer)
    if args.json:
        print(json.dumps(to_json(found)))
    elif not args.quiet:
        show_compare.comparison(found, next_command(args, found), page)
    return 0 if found.verdict == "WITHIN_FLOOR" else 1


def places(args: argparse.Namespace) -> tuple[Path | None, Path | None]:
    """Where a page and a JSON file are to go; asked before the work is done.

    Raises:
        InputError: a place that cannot be written, or a kind of file that this command does not make.
    """
    from fdi.output import writable
    from plant import InputError

    source = Path(args.trace)
    out = Path(args.out) if args.out else None
    if out is not None and out.suffix not in (".html", ".json"):
        raise InputError("--out", str(out), "FILE.html for a page, or FILE.json")
    page = out if out is not None and out.suffix == ".html" else None
    if args.report and page is None:
        page = (source if source.is_dir() else source.parent) / "compare.html"
    answer = out if out is not None and out.suffix == ".json" else None
    for place, option in ((page, "--out" if page == out else "--report"), (answer, "--out")):
        if place is not None:
            writable(place, option, source=source)
    return page, answer


def write(found: Comparison, page: Path | None, answer: Path | None) -> None:
    """The page and the JSON file that were asked for."""
    from fdi.output import write_text
    from fdi.report.compare_text import to_json

    if answer is not None:
        write_text(answer, json.dumps(to_json(found)) + "\n")
    if page is not None:
        from fdi.report.compare_page import render

        write_text(page, render(found))


def next_command(args: argparse.Namespace, found: Comparison) -> str:
    """What to type next, "" if there is nothing left to do."""
    import shlex

    words = [args.trace]
    for option, values in (("--model", [args.model] if args.model else []), ("--set", args.set),
                           ("--effects", args.effects), ("--repeat", args.repeat),
                           ("--signals", [args.signals] if args.signals else [])):
        words += [word for value in values for word in (option, str(value))]
    if found.verdict == "MODEL_INCOMPLETE":
        return "rig explain " + shlex.join(words)
    if found.verdict == "CANNOT_TELL" and not args.repeat:
        return f"rig compare {shlex.join(words)} --repeat SECOND_RUN"
    return ""
