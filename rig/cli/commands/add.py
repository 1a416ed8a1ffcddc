"""`rig add`: effects added to a model file and fitted; the error after each step, also on the held-out run."""

import argparse

from fdi.discovery.update_model import add_effects, find_runs, write_model_file
from fdi.report import build_model_report
from rig.cli import (
    Places,
    choose_file,
    choose_model_file,
    format_command_line,
    give_answer,
    list_signals,
    load_known_model,
    show_progress,
    split_words,
)


def run_command(args: argparse.Namespace) -> int:
    """Exit status 0 if the effects help."""
    model, provenance = load_known_model(args)
    effects, trace = split_words(args.words, model.plant)
    path = choose_model_file(args, trace)
    page = choose_file(str(path.with_suffix(".html")), (".html",), trace)
    with show_progress(args, "reading") as progress:
        runs = find_runs(model, provenance, trace, args.repeat, args.holdout, list_signals(args))
        update = add_effects(effects, runs, model, provenance, format_command_line(), progress)
    report = build_model_report(update, path, write_model_file(update, path), page)
    return give_answer(report, args, int(not update.helps), Places(page))
