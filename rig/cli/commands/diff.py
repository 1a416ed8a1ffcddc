"""`rig diff`: two or more runs side by side."""

import argparse
from collections.abc import Sequence

from fdi.comparison.run_differences import RunDifferences, compare_runs
from fdi.progress import Progress
from fdi.report import build_diff_report
from fdi.trace import Trace
from plant import Signals
from rig.cli import choose_places, give_answer, load_declared_model, show_progress


def run_command(args: argparse.Namespace) -> int:
    """Exit status 0 if noise explains all differences and no check changed, 1 otherwise."""
    places = choose_places(args, "diff.html", args.others[0])
    with show_progress(args) as progress:
        differences = read_and_compare_runs([args.trace, *args.others], load_declared_model(args).kind.signals,
                                            progress)
        report = build_diff_report(differences, places.files)
    return give_answer(report, args, int(differences.verdict != "SAME"), places)


def read_and_compare_runs(sources: Sequence[str], signals: Signals, progress: Progress) -> RunDifferences:
    """Read traces, of which a CSV has `signals`, and subtract the first from the others.

    Raises:
        InputError: a trace that cannot be read.
    """
    traces = []
    for i, source in enumerate(sources):
        progress(f"reading {source}", i / (len(sources) + 1))
        traces.append(Trace.read(source, all=True, signals=signals))
    progress("aligning and subtracting", len(sources) / (len(sources) + 1))
    return compare_runs(sources, traces)
