"""`rig remove`: an effect removed from a model file, and what that does to the error."""

import argparse
from pathlib import Path

from fdi.discovery.update_model import find_runs, remove_effect_and_refit, write_model_file
from fdi.report import build_model_report
from plant import require
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
    """Without a trace the other parameters keep their values."""
    require(args.model and Path(args.model).is_file(), "--model", str(args.model or ""),
            "the model file to remove the effect from: --model FILE")
    model, provenance = load_known_model(args)
    effects, trace = split_words(args.words, model.plant)
    require(len(effects) == 1, "effect", effects[-1], "one effect at a time")
    path = choose_model_file(args, trace)
    page = choose_file(str(path.with_suffix(".html")), (".html",), trace) if trace else None
    with show_progress(args, "reading") as progress:
        runs = find_runs(model, provenance, trace, args.repeat, args.holdout, list_signals(args)) if trace else None
        update = remove_effect_and_refit(effects[0], runs, model, provenance, format_command_line(), progress)
    return give_answer(build_model_report(update, path, write_model_file(update, path), page), args,
                       places=Places(page))
