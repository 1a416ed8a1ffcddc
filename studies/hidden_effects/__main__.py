"""Hidden effects: a blind trial of `rig explain` on traces of a simulator in C; hours for 200 cases."""
from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

from fdi.report.report import Report
from plant.errors import InputError
from studies.command import make_row_progress, run_study_command
from studies.hidden_effects.run_trial import RIG_EXPLAIN, run_trial
from studies.hidden_effects.trial_score import build_trial_report, describe_progress, summarise_trial


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the trial."""
    add = parser.add_argument
    add("--cases", type=int, default=200, metavar="N", help="number of cases (default: 200)")
    add("--plant", default="eha", metavar="NAME|FILE", help="shipped plant, or a plant file (default: eha)")
    add("--signals", metavar="NAMES", help="measure these in every case, of the EHA xj or xj,p12 or xj,p12,xs "
                                           "(default: random)")
    add("--jobs", type=int, default=2, metavar="N", help="cases at a time; use 1 for reliable timings (default: 2)")
    add("--folder", metavar="DIR", help="keep cases and answers there; an interrupted trial resumes there")


def run_trial_command(args: argparse.Namespace) -> tuple[Report, bool]:
    """The report of a trial, and whether every requested rate that was counted is reached.

    Raises:
        InputError: no cases, unknown signals, no C compiler, or a place that cannot be written.
    """
    for option, count in (("--cases", args.cases), ("--jobs", args.jobs)):
        if count < 1:
            raise InputError(option, str(count), "1 or more")
    with tempfile.TemporaryDirectory() as temporary:
        seeds, folder = range(args.seed, args.seed + args.cases), Path(args.folder or temporary)
        rows = run_trial(RIG_EXPLAIN, seeds, folder, args.jobs, make_row_progress(describe_progress), args.signals,
                         args.plant)
    figures = summarise_trial(rows)
    return build_trial_report(figures), all(rate["met"] or not rate["of"] for rate in figures["rates"])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the trial; see --help."""
    return run_study_command("studies.hidden_effects", __doc__, arguments, add_options, run_trial_command)


if __name__ == "__main__":
    raise SystemExit(main())
