"""`rig diff`: two or more runs side by side."""
from __future__ import annotations

import argparse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rig diff`."""
    add = parser.add_argument
    add("trace", metavar="A", help="the reference: trace.mcap, the folder of a run, or a CSV")
    add("others", metavar="B", nargs="+", help="a run to compare with the reference (repeatable)")
    add("--report", action="store_true", help="write a page with pictures, diff.html beside the first B, or where "
                                              "--out FILE.html says")


def run_command(args: argparse.Namespace) -> int:
    """Exit status 0 if noise explains all differences and no check changed, 1 otherwise."""
    from fdi.comparison.run_differences import compare_runs
    from fdi.report.diff_report import build_diff_report
    from fdi.trace.trace import Trace
    from rig.cli.answer import choose_places, show_answer, write_answer
    from rig.cli.progress_bar import show_progress

    sources = [args.trace, *args.others]
    places = choose_places(args, "diff.html", args.others[0])
    with show_progress(is_silent=args.json or args.quiet) as progress:
        traces = []
        for i, source in enumerate(sources):
            progress(f"reading {source}", i / (len(sources) + 2))
            traces.append(Trace.read(source, all=True))
        progress("aligning and subtracting", len(sources) / (len(sources) + 2))
        found = compare_runs(sources, traces)
        report = build_diff_report(found, places.files)
        progress("writing", (len(sources) + 1) / (len(sources) + 2))
        write_answer(report, places)
    show_answer(report, args)
    return 0 if found.verdict == "SAME" else 1
