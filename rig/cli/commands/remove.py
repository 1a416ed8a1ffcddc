"""`rig remove`: an effect removed from a model file, and what that does to the error."""
from __future__ import annotations

import argparse
from pathlib import Path

from rig.cli import discovery_options, options


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    add = parser.add_argument
    add("words", nargs="+", metavar="EFFECT|TRACE", help="the effect, and the measured run to fit the rest to")
    add("--trace", metavar="TRACE", help="same as the positional TRACE")
    discovery_options.add_run_options(parser)
    options.add_model_options(parser)


def run_command(args: argparse.Namespace) -> int:
    """The model goes to --out (default: the file of --model, in place)."""
    from dataclasses import replace

    from fdi.discovery.update_model import find_runs, remove_effect_and_refit, write_model_file
    from fdi.report.explain_report import build_model_report
    from plant import InputError
    from rig.cli.answer import Places, choose_file, show_answer, write_answer
    from rig.cli.progress_bar import show_progress

    if not args.model or not Path(args.model).is_file():
        raise InputError("--model", str(args.model or ""), "the model file to remove the effect from: --model FILE")
    model, known = discovery_options.load_model(args)
    effects, trace = discovery_options.split_words(args.words, args.trace, model.plant)
    if len(effects) > 1:
        raise InputError("effect", effects[1], "one effect at a time")
    path = discovery_options.choose_model_file(args, trace)
    page = choose_file(str(path.with_suffix(".html")), (".html",), trace) if trace else None
    with show_progress(is_silent=args.json or args.quiet) as progress:
        runs = None
        if trace is not None:
            progress("reading", 0.0)
            runs = find_runs(model, known, trace, args.repeat, args.holdout, discovery_options.list_signals(args))
        known = replace(known, effect_files=discovery_options.list_effect_files(args, known))
        words = discovery_options.format_command_line()
        update = remove_effect_and_refit(effects[0], runs, model, known, words, progress)
        report = build_model_report(update, path, write_model_file(update, path), page)
        write_answer(report, Places(page, None))
    show_answer(report, args)
    return 0
