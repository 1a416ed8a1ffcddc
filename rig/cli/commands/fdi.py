"""`rig fdi`: how far filter clogging and spool friction have gone, from one captured test."""
from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.cli import options

if TYPE_CHECKING:
    from fdi.diagnosis.diagnosis import Diagnosis
    from fdi.diagnosis.envelope import Bands
    from fdi.progress import Progress
    from rig.studies.fault_size_methods import Row


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    add = parser.add_argument
    add("trace", metavar="TRACE", nargs="?",
        help="trace.mcap, the folder of a run, or a CSV with t,com,xj,cor[,p12,xs,load]")
    options.add_model(parser)
    add("--bands", metavar="FILE", help="bands to judge by (default: the software's own, of the preflight command)")
    add("--optimisers", action="store_true",
        help="also by differential evolution, simulated annealing and a genetic algorithm: error, simulations, time")
    add("--comparators", action="store_true",
        help="also by a neural network and a logistic regression, trained on simulated faults ('eha-rig[learn]')")
    add("--learn-bands", nargs="*", metavar="TRACE", help="make bands from a fleet's healthy traces and write them to "
                                                          "--out FILE.toml; without traces, from simulated units")
    add("--command", dest="command_file", metavar="FILE",
        help="what --learn-bands simulates: CSV with t,com (default: the main phase of preflight)")


def run_command(args: argparse.Namespace) -> int:
    """Diagnose a trace; exit status 0 if both faults are acceptable, 1 otherwise. Or learn bands."""
    if args.learn_bands is not None:
        return learned(args)
    from plant import InputError

    if args.command_file is not None:
        raise InputError("--command", str(args.command_file), "--learn-bands beside it; a trace has its own command")
    from fdi.diagnosis.diagnosis import diagnose
    from fdi.output import write_text
    from fdi.trace.trace import Trace
    from rig.cli import show_fdi
    from rig.cli.progress_bar import show_progress

    if args.trace is None:
        raise InputError("TRACE", "", "a trace to judge, or --learn-bands")
    answer = places(args)
    model = options.model_of(args)
    with show_progress(is_silent=args.json or args.quiet) as progress:
        found = diagnose(Trace.read(args.trace), model, bands_of(args), progress, str(args.trace))
        rows = methods_of(args, found, progress)
        if answer is not None and answer.suffix == ".html":
            from fdi.report.diagnosis_page import render

            progress("writing the page", 0.0)
            write_text(answer, render(found))
        elif answer is not None:
            write_text(answer, json.dumps(as_json(found, rows)) + "\n")
    if args.json:
        print(json.dumps(as_json(found, rows)))
    elif not args.quiet:
        show_fdi.diagnosis(found, next_command(args, found), [answer] if answer else [], rows)
    return 0 if found.passed else 1


def methods_of(args: argparse.Namespace, found: Diagnosis, progress: Progress) -> list[Row]:
    """What other methods find, as far as they are asked for."""
    if not (args.optimisers or args.comparators):
        return []
    from rig.studies import fault_size_methods

    rows = list(fault_size_methods.optimisers(found, args.seed, progress)) if args.optimisers else []
    return rows + (list(fault_size_methods.comparators(found, args.seed, progress)) if args.comparators else [])


def as_json(found: Diagnosis, rows: Sequence[Row]) -> dict[str, Any]:
    """The JSON object; with the methods' table if there is one."""
    from fdi.report.diagnosis_text import to_json

    return to_json(found) | ({"methods": [row._asdict() for row in rows]} if rows else {})


def learned(args: argparse.Namespace) -> int:
    """Make bands of a command and write them; exit status 0."""
    from fdi.diagnosis.learn_bands import run as learn
    from plant import InputError
    from rig.cli import show_fdi
    from rig.cli.commands.simulate import command_of
    from rig.cli.progress_bar import show_progress

    if args.trace is not None:
        raise InputError("--learn-bands", str(args.trace), "traces behind it, not before it")
    if not args.out or Path(args.out).suffix != ".toml":
        raise InputError("--out", str(args.out or ""), "FILE.toml, where the bands go")
    model = options.model_of(args)
    com, _, name = command_of(args.command_file, model["controller.period"])
    with show_progress(is_silent=args.json or args.quiet) as progress:
        made = learn(args.learn_bands, args.out, model, com, name, args.seed, progress)
    if args.json:
        print(json.dumps(made))
    elif not args.quiet:
        show_fdi.bands(made)
    return 0


def bands_of(args: argparse.Namespace) -> Bands | None:
    """The bands of --bands; None for the software's own."""
    if args.bands is None:
        return None
    from fdi.diagnosis.bands_file import load

    return load(Path(args.bands))


def places(args: argparse.Namespace) -> Path | None:
    """Where a JSON file is to go; asked before the work is done.

    Raises:
        InputError: a place that cannot be written, or a kind of file that this command does not make.
    """
    from fdi.output import writable
    from plant import InputError

    if args.trace is None:
        raise InputError("TRACE", "", "a trace: trace.mcap, the folder of a run, or a CSV")
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
