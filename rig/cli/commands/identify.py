"""`rig identify`: the parameters of an actuator from its runs, with intervals, and what these runs do not show."""
from __future__ import annotations

import argparse
import shlex
from dataclasses import replace
from datetime import date
from typing import TYPE_CHECKING

from rig.cli import discovery_options, options

if TYPE_CHECKING:
    from fdi.identification.identify import Identification


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    add = parser.add_argument
    add("runs", nargs="+", metavar="RUN",
        help="runs to fit, of any commands: trace.mcap, the folder of a run, or a CSV with t,com,xj,cor[,p12,xs,load]")
    add("--holdout", action="append", default=[], metavar="RUN",
        help="a run that no fit sees: shows whether the model holds (repeatable)")
    add("--signals", metavar="xj,p12,xs", help="signals to use (default: all that every run to fit has)")
    options.add_model_options(parser)


def run_command(args: argparse.Namespace) -> int:
    """The model goes to --out (default: identified.toml). Exit status 0 if every free parameter is identified.

    A model that does not explain the runs (UNEXPLAINED) is written only with --out.
    """
    from fdi.identification.free_parameters import read_free_parameters, read_identification_runs
    from fdi.identification.identify import identify_model, write_identified_model
    from fdi.report.identify_report import build_identification_report
    from rig.cli.answer import Places, choose_file, show_answer, write_answer
    from rig.cli.progress_bar import show_progress

    model, _ = discovery_options.load_model(args)
    path = choose_file(args.out or "identified.toml", (".toml",), args.runs[0])
    assert path is not None
    page = choose_file(str(path.with_suffix(".html")), (".html",), args.runs[0])
    ranges = read_free_parameters(model, args.model)
    command = discovery_options.format_command_line()
    with show_progress(is_silent=args.json or args.quiet) as progress:
        progress("reading", 0.0)
        runs = read_identification_runs(model, ranges, args.runs, args.holdout, discovery_options.list_signals(args))
        found = identify_model(runs.model, ranges, runs.fitted, runs.held_out, runs.sources, args.seed, progress)
        progress("writing", 0.97)
        files = [("page", str(page))]
        if found.verdict == "UNEXPLAINED":
            note = describe_doubtful_file(None if args.out is None else str(path))
            found = replace(found, notes=(*found.notes, note))
        if found.verdict in ("IDENTIFIED", "PARTLY") or (found.verdict == "UNEXPLAINED" and args.out is not None):
            found = replace(found, model=replace(found.model, name=path.stem))
            backup = write_identified_model(found, path, command, date.today().isoformat())
            files.insert(0, ("model", str(path) + (f" (the one before: {backup})" if backup is not None else "")))
        report = build_identification_report(found, found.before.name, command,
                                             choose_next_command(args, found, str(path)), files)
        write_answer(report, Places(page, None))
    show_answer(report, args)
    return 0 if found.verdict == "IDENTIFIED" else 1


def describe_doubtful_file(path: str | None) -> str:
    """The note on the model file of parameters that do not explain the runs; `path`: None if it was not asked for."""
    if path is None:
        return "no model file: these parameters do not explain the runs; --out FILE.toml writes them all the same"
    return f"{path} was written because of --out; its parameters do not explain the runs"


def choose_next_command(args: argparse.Namespace, found: Identification, path: str) -> str:
    """What to type next: compare a held-out run; "" where there is no model to go on with."""
    if found.verdict in ("CANNOT_TELL", "UNEXPLAINED"):
        return ""
    return "rig compare " + shlex.join([(args.holdout or args.runs)[0], "--model", path])
