"""Robustness: fuzz frames, killed processes, full disks, long operation; hours with the numbers of the page."""

import argparse
from collections.abc import Sequence

from fdi.report import Report
from rig.cli import parse_whole_number
from studies.command import report_progress, run_study_command
from studies.robustness.run_study import build_robustness_report, run_study


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the study."""
    add = parser.add_argument
    add("--frames", type=parse_whole_number, default=100_000, metavar="N",
        help="fuzz frames for each node (default: 100000; 0: none)")
    add("--trials", type=parse_whole_number, default=5, metavar="N",
        help="effective disturbances of each kind, one in each run (default: 5; 0: none)")
    add("--minutes", type=float, default=5.0, metavar="N", help="minutes of long operation (default: 5; 0: none)")
    add("--controller", choices=("builtin", "c"), default="builtin", help="firmware of these runs (default: builtin)")


def study_robustness(args: argparse.Namespace) -> tuple[Report, bool]:
    """The report, and whether nothing hung, crashed, grew or was left."""
    figures = run_study(args.frames, args.trials, args.minutes, args.seed, args.controller, report_progress)
    return build_robustness_report(figures), not figures["problems"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study; see --help."""
    return run_study_command("studies.robustness", __doc__, arguments, add_options, study_robustness)


if __name__ == "__main__":
    raise SystemExit(main())
