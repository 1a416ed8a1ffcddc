"""`rig fdi`: how far filter clogging and spool friction have gone, from one captured test."""
from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from rig import options

if TYPE_CHECKING:
    from fdi.health.diagnosis import Diagnosis
    from fdi.health.envelope import Bands

HELP = "judge filter clogging and spool friction from a trace: levels, sizes with intervals, what else is wrong"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    add = parser.add_argument
    add("trace", metavar="TRACE", help="trace.mcap, the folder of a run, or a CSV with t,com,xj,cor[,p12,xs,load]")
    options.add_model(parser)
    add("--bands", metavar="FILE", help="bands to judge by (default: the software's own, for the preflight command)")


def run(args: argparse.Namespace) -> int:
    """Diagnose a trace; exit status 0 if both faults are acceptable, 1 otherwise."""
    from fdi.health.diagnosis import diagnose
    from fdi.health.words import to_json
    from fdi.output import write_text
    from fdi.trace import Trace
    from rig import show_fdi
    from rig.waiting import waiting

    answer = places(args)
    model = options.model_of(args)
    with waiting(args.json or args.quiet) as progress:
        found = diagnose(Trace.read(args.trace), model, bands_of(args), progress, str(args.trace))
        if answer is not None:
            write_text(answer, json.dumps(to_json(found)) + "\n")
    if args.json:
        print(json.dumps(to_json(found)))
    elif not args.quiet:
        show_fdi.diagnosis(found, next_command(args, found), [answer] if answer else [])
    return 0 if found.passed else 1


def bands_of(args: argparse.Namespace) -> Bands | None:
    """The bands of --bands; None for the software's own."""
    if args.bands is None:
        return None
    from fdi.health.store import load

    return load(Path(args.bands))


def places(args: argparse.Namespace) -> Path | None:
    """Where a JSON file is to go; asked before the work is done.

    Raises:
        InputError: a place that cannot be written, or a kind of file that this command does not make.
    """
    from fdi.output import writable
    from plant import InputError

    if not args.out:
        return None
    out = Path(args.out)
    if out.suffix not in (".html", ".json"):
        raise InputError("--out", str(out), "FILE.html for a page, or FILE.json")
    return writable(out, "--out", source=Path(args.trace))


def next_command(args: argparse.Namespace, found: Diagnosis) -> str:
    """What to type next, "" if there is nothing left to do."""
    import shlex

    if found.verdict != "SOMETHING_ELSE":
        return ""
    words = [args.trace]
    for option, values in (("--model", [args.model] if args.model else []), ("--set", args.set),
                           ("--effects", args.effects)):
        words += [word for value in values for word in (option, str(value))]
    return "rig explain " + shlex.join(words)
