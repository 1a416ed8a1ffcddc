"""`rig bench explain`: the blind trial from the command line."""
from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

from fdi.output import writable, write_text
from plant.errors import InputError
from rig.cli.terminal import console
from rig.studies.trial import show_trial
from rig.studies.trial.blackbox import NAME
from rig.studies.trial.run_trial import Progress, run
from rig.studies.trial.score import summary


def trial(args: argparse.Namespace) -> int:
    """Run it; exit status 0 if every rate that is asked for is reached, 1 otherwise.

    Raises:
        InputError: no cases, no C compiler, or a place that cannot be written.
    """
    if args.cases < 1 or args.jobs < 1:
        raise InputError("--cases" if args.cases < 1 else "--jobs", str(min(args.cases, args.jobs)), "1 or more")
    if args.out is not None:
        writable(args.out, "--out")
    out = console()

    def tell(progress: Progress) -> None:
        if not (args.json or args.quiet):
            out.print(show_trial.line(progress), markup=False)

    with tempfile.TemporaryDirectory() as nowhere:
        folder = Path(args.folder or nowhere)
        figures = summary(run(NAME, range(args.seed, args.seed + args.cases), folder, args.jobs, tell))
    if args.out is not None:
        write_text(args.out, json.dumps(figures, indent=1) + "\n")
    if args.json:
        print(json.dumps(figures))
    elif not args.quiet:
        show_trial.summary(figures, out)
    return 0 if all(rate["met"] or not rate["of"] for rate in figures["rates"]) else 1
