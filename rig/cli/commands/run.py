"""`rig run`: play test sequences on the bench, log and judge them."""

import argparse

from rig.run.page_writer import PageWriter


def run_command(args: argparse.Namespace) -> int:
    """Results go to the folder --out (default: a new one in runs/). Exit status 0 if no check failed."""
    with PageWriter() as pages:  # first: its process loads what it needs while this one loads what the run needs
        from rig.cli.single_run import run_sequence

        return run_sequence(args, pages)
