"""`rig check`: a dry run of a sequence: its command against the limits of the actuator, and the predicted run."""
from __future__ import annotations

import argparse

from rig.cli import options


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rig check`."""
    parser.add_argument("sequence", metavar="SEQUENCE",
                        help="test sequence: a .toml file, or the name of a shipped one")
    options.add_model_options(parser)


def run_command(args: argparse.Namespace) -> int:
    """Nothing is opened and nothing moves. Exit status 1 if a limit is violated; --out FILE.html has a picture."""
    from pathlib import Path

    from rig.cli.answer import choose_places, show_answer, write_answer
    from rig.cli.progress_bar import show_progress
    from rig.run.job import JobChoice, build_job
    from rig.suite.dry_run import make_dry_run
    from rig.suite.dry_run_report import build_dry_run_report

    source = args.sequence if Path(args.sequence).is_file() else ""
    places = choose_places(args, "", source)
    choice = JobChoice(args.sequence, args.model, options.parse_changes(args.set), args.seed, tuple(args.effects))
    with show_progress(is_silent=args.json or args.quiet) as progress:
        progress("simulating", 0.0)
        dry = make_dry_run(build_job(choice, is_trusted=args.trust))
        report = build_dry_run_report(dry, places.files)
        progress("page", 0.0)
        write_answer(report, places)
    show_answer(report, args)
    return 1 if dry.problems else 0
