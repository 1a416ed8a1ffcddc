"""`rig check`: a dry run of a sequence: its command against the limits of the actuator, and the predicted run."""
from __future__ import annotations

import argparse
from pathlib import Path

from rig.cli.answer import choose_places, give_answer
from rig.cli.inputs import parse_changes
from rig.cli.progress_bar import show_progress
from rig.run.job import JobChoice, build_job
from rig.suite.dry_run import make_dry_run
from rig.suite.dry_run_report import build_dry_run_report


def run_command(args: argparse.Namespace) -> int:
    """Exit status 1 if a limit is violated."""
    places = choose_places(args, "", args.sequence if Path(args.sequence).is_file() else "")
    choice = JobChoice(args.sequence, args.model, parse_changes(args.set), args.seed, tuple(args.effects))
    with show_progress(is_silent=args.json or args.quiet) as progress:
        progress("simulating", 0.0)
        dry = make_dry_run(build_job(choice, is_trusted=args.trust))
    return give_answer(build_dry_run_report(dry, places.files), args, int(bool(dry.problems)), places)
