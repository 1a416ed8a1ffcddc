"""`rig add`: effects added to a model file and fitted; the error after each step, also on the held-out run."""
from __future__ import annotations

import argparse

from rig.cli import discovery_options, options


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    add = parser.add_argument
    add("words", nargs="+", metavar="EFFECT|TRACE",
        help="effects to add, and the measured run to fit (default: the run that the model file was fitted to)")
    add("--trace", metavar="TRACE", help="same as the positional TRACE")
    discovery_options.add_run_options(parser)
    options.add_model_options(parser)


def run_command(args: argparse.Namespace) -> int:
    """The model goes to --out (default: that of --model, else model.toml). Exit status 0 if the effects help."""
    from dataclasses import replace

    from fdi.discovery.update_model import add_effects, find_runs, write_model_file
    from fdi.report.explain_report import build_model_report
    from rig.cli.answer import Places, choose_file, show_answer, write_answer
    from rig.cli.progress_bar import show_progress

    model, known = discovery_options.load_model(args)
    effects, trace = discovery_options.split_words(args.words, args.trace, model.plant)
    path = discovery_options.choose_model_file(args, trace)
    page = choose_file(str(path.with_suffix(".html")), (".html",), trace)
    with show_progress(is_silent=args.json or args.quiet) as progress:
        progress("reading", 0.0)
        runs = find_runs(model, known, trace, args.repeat, args.holdout, discovery_options.list_signals(args))
        known = replace(known, effect_files=discovery_options.list_effect_files(args, known))
        update = add_effects(effects, runs, model, known, discovery_options.format_command_line(), progress)
        progress("writing", 0.95)
        report = build_model_report(update, path, write_model_file(update, path), page)
        write_answer(report, Places(page, None))
    show_answer(report, args)
    return 0 if update.helps else 1
