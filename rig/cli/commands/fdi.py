"""`rig fdi`: how far filter clogging and spool friction have gone, from one captured test."""
from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rig.cli import options

if TYPE_CHECKING:
    from fdi.diagnosis.bands import Bands
    from fdi.diagnosis.diagnosis import Diagnosis


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rig fdi`."""
    add = parser.add_argument
    add("trace", metavar="TRACE", nargs="?",
        help="trace.mcap, the folder of a run, or a CSV with t,com,xj,cor[,p12,xs,load]")
    options.add_model_options(parser)
    add("--bands", metavar="FILE", help="bands to judge by (default: the shipped ones, for the preflight command)")
    add("--with-effects", action="store_true",
        help="search the catalogue for what else is wrong, and size both faults beside it "
             "(half a minute of computing more, two minutes where the search is hard)")
    add("--learn-bands", nargs="*", metavar="TRACE",
        help="make bands from healthy traces of a fleet and write them to --out FILE.toml; without traces, from "
             "simulated units")
    add("--command", dest="command_file", metavar="FILE",
        help="command that --learn-bands simulates: CSV with t,com (default: the main phase of preflight)")


def run_command(args: argparse.Namespace) -> int:
    """Exit status 0 if both faults are acceptable, 1 otherwise. --learn-bands makes bands instead."""
    if args.learn_bands is not None:
        return learn_bands(args)
    from plant import InputError

    if args.command_file is not None:
        raise InputError("--command", str(args.command_file), "--learn-bands beside it; a trace has its own command")
    from fdi.diagnosis.diagnosis import diagnose
    from fdi.report.diagnosis_report import build_diagnosis_report
    from fdi.trace.trace import Trace
    from rig.cli.answer import choose_places, show_answer, write_answer
    from rig.cli.progress_bar import show_progress

    if args.trace is None:
        raise InputError("TRACE", "", "a trace: trace.mcap, the folder of a run, or a CSV")
    places = choose_places(args, "", args.trace)
    model = options.load_chosen_model(args)
    with show_progress(is_silent=args.json or args.quiet) as progress:
        diagnosis = diagnose(Trace.read(args.trace), model, load_bands(args), progress, str(args.trace),
                             with_effects=args.with_effects)
        report = replace(build_diagnosis_report(diagnosis), next_command=suggest_next_command(args, diagnosis),
                         files=places.files)
        progress("writing", 0.0)
        write_answer(report, places)
    show_answer(report, args)
    return 0 if diagnosis.is_acceptable else 1


def learn_bands(args: argparse.Namespace) -> int:
    """Make bands for a command and write them; exit status 0."""
    from fdi.diagnosis.learn_bands import make_bands_file
    from fdi.report.diagnosis_report import build_bands_report
    from plant import InputError
    from rig.cli.answer import show_answer
    from rig.cli.commands.simulate import load_command
    from rig.cli.progress_bar import show_progress

    if args.trace is not None:
        raise InputError("--learn-bands", str(args.trace), "traces after the option, not before it")
    if not args.out or Path(args.out).suffix != ".toml":
        raise InputError("--out", str(args.out or ""), "FILE.toml, where the bands go")
    model = options.load_chosen_model(args)
    com, _, name = load_command(args.command_file, model["controller.period"])
    with show_progress(is_silent=args.json or args.quiet) as progress:
        made = make_bands_file(args.learn_bands, args.out, model, com, name, args.seed, progress)
    show_answer(build_bands_report(made), args)
    return 0


def load_bands(args: argparse.Namespace) -> Bands | None:
    """The bands of --bands; None for the software's own."""
    if args.bands is None:
        return None
    from fdi.diagnosis import bands

    return bands.load_bands(Path(args.bands))


def suggest_next_command(args: argparse.Namespace, diagnosis: Diagnosis) -> str:
    """What to type next where neither fault explains the trace: the search for other effects, or after it
    `rig explain`; else "".
    """
    import shlex

    if diagnosis.verdict != "SOMETHING_ELSE":
        return ""
    words = [args.trace]
    for option, values in (("--model", [args.model] if args.model else []), ("--set", args.set),
                           ("--effects", args.effects)):
        words += [word for value in values for word in (option, str(value))]
    words += ["--trust"] if args.trust else []
    if diagnosis.beside is None:
        return "rig fdi --with-effects " + shlex.join(words)
    return "rig explain " + shlex.join(words)
