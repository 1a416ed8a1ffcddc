"""`rig compare`: a model held against a measured trace."""

import argparse

from fdi.comparison.compare import Comparison, compare
from fdi.report import build_comparison_report
from fdi.trace import Trace
from rig.cli import choose_places, format_arguments, give_answer, list_signals, load_chosen_model, show_progress


def run_command(args: argparse.Namespace) -> int:
    """Exit status 0 if the residual is noise, 1 otherwise."""
    places = choose_places(args, "compare.html", args.trace)
    model = load_chosen_model(args)
    with show_progress(args) as progress:
        trace, *repeats = (Trace.read(file, signals=model.kind.signals) for file in (args.trace, *args.repeat))
        comparison = compare(trace, model, repeats, list_signals(args), progress, args.trace)
        report = build_comparison_report(comparison, choose_next_command(args, comparison), places.files)
    return give_answer(report, args, int(comparison.verdict != "WITHIN_FLOOR"), places)


def choose_next_command(args: argparse.Namespace, comparison: Comparison) -> str:
    """What to type next; "" if there is nothing left to do."""
    verdict = comparison.verdict
    if verdict == "MODEL_INCOMPLETE" and comparison.model.kind.foreign is None:  # an FMU cannot be explained
        return f"rig explain {format_arguments(args)}"
    if verdict == "CANNOT_TELL" and not args.repeat:
        return f"rig compare {format_arguments(args)} --repeat SECOND_RUN"
    return ""
