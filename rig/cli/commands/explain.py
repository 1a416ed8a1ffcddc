"""`rig explain`: which physical effect is missing from a model, with the evidence and the doubt."""
from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from rig.cli import discovery_options, options

if TYPE_CHECKING:
    from fdi.discovery.candidates import Answer


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    add = parser.add_argument
    add("trace", metavar="TRACE", help="trace.mcap, the folder of a run, or a CSV with t,com,xj,cor[,p12,xs,load]")
    discovery_options.add_run_options(parser)
    options.add_model_options(parser)
    add("--write-effect", metavar="FILE.py", help="write the shape of the residual as an effect, to edit and add")
    add("--report", action="store_true", help="write a page with pictures, explain.html beside the trace, or where "
                                              "--out FILE.html says")


def run_command(args: argparse.Namespace) -> int:
    """Exit status 0 if nothing is missing, 1 otherwise."""
    from fdi.discovery.explain_runs import explain_runs
    from fdi.discovery.runs import read_runs
    from fdi.report.explain_report import build_explanation_report
    from rig.cli.answer import choose_file, choose_places, show_answer, write_answer
    from rig.cli.progress_bar import show_progress

    places = choose_places(args, "explain.html", args.trace)
    choose_file(args.write_effect, (".py",), args.trace, "--write-effect")
    model, _ = discovery_options.load_model(args)
    with show_progress(is_silent=args.json or args.quiet) as progress:
        progress("reading", 0.0)
        runs = read_runs(model, args.trace, args.repeat, args.holdout, discovery_options.list_signals(args))
        answer, pattern = explain_runs(runs, args.seed, args.write_effect, progress)
        files = [*places.files, *([("effect", args.write_effect)] if args.write_effect else [])]
        report = build_explanation_report(answer, args.trace, args.model or "eha", runs.sources,
                                    discovery_options.format_command_line(), choose_next_command(args, answer), pattern,
                                    runs.notes, files)
        write_answer(report, places)
    show_answer(report, args)
    return 0 if answer.verdict == "NOTHING_MISSING" else 1


def choose_next_command(args: argparse.Namespace, answer: Answer) -> str:
    """What to type next; "" if there is nothing left to do."""
    arguments = discovery_options.format_arguments(args, args.trace)
    effects = answer.explanation.effects
    if answer.verdict in ("EXPLAINED", "PARTLY", "AMBIGUOUS") and effects:
        chosen = effects[:1] if answer.verdict == "AMBIGUOUS" else effects
        return f"rig add {' '.join(chosen)} {arguments}"
    if answer.verdict == "UNEXPLAINED" and args.write_effect:
        return f"rig explain {arguments} --effects {args.write_effect}"
    if answer.verdict == "UNEXPLAINED" and answer.pattern:
        return f"rig explain {arguments} --write-effect missing.py"
    return ""
