"""`rig compare`: a model held against a measured trace."""
from __future__ import annotations

import argparse

from rig.cli import discovery_options, options


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    add = parser.add_argument
    add("trace", metavar="TRACE", help="trace.mcap, the folder of a run, or a CSV with t,com,xj,cor[,p12,xs,load]")
    options.add_model_options(parser)
    add("--repeat", action="append", default=[], metavar="TRACE",
        help="another run of the same command: measures the noise floor (repeatable)")
    add("--signals", metavar="xj,p12,xs", help="what to compare (default: what the trace has)")
    add("--report", action="store_true", help="write a page with pictures, compare.html beside the trace, "
                                              "or where --out FILE.html says")


def run_command(args: argparse.Namespace) -> int:
    """Exit status 0 if the residual is noise, 1 otherwise."""
    from fdi.comparison.compare import compare
    from fdi.report.compare_report import build_comparison_report
    from fdi.trace.trace import Trace
    from rig.cli.answer import choose_places, show_answer, write_answer
    from rig.cli.progress_bar import show_progress

    places = choose_places(args, "compare.html", args.trace)
    model = options.load_chosen_model(args)
    with show_progress(is_silent=args.json or args.quiet) as progress:
        trace = Trace.read(args.trace)
        repeats = [Trace.read(file) for file in args.repeat]
        comparison = compare(trace, model, repeats, discovery_options.list_signals(args), progress, str(args.trace))
        report = build_comparison_report(comparison, choose_next_command(args, comparison.verdict), places.files)
        write_answer(report, places)
    show_answer(report, args)
    return 0 if comparison.verdict == "WITHIN_FLOOR" else 1


def choose_next_command(args: argparse.Namespace, verdict: str) -> str:
    """What to type next; "" if there is nothing left to do."""
    arguments = discovery_options.format_arguments(args, args.trace)
    if verdict == "MODEL_INCOMPLETE":
        return f"rig explain {arguments}"
    if verdict == "CANNOT_TELL" and not args.repeat:
        return f"rig compare {arguments} --repeat SECOND_RUN"
    return ""
