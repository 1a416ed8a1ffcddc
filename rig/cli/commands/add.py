"""`rig add`: effects put into a model file and fitted; the error after each step, on data the fit never saw too."""
from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

from rig.cli import discovery_options, options

if TYPE_CHECKING:
    from rig.cli.model_update import Done


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    add = parser.add_argument
    add("words", nargs="+", metavar="EFFECT .. TRACE",
        help="effects to add, and the measured run to fit (default: the run that the model file was fitted to)")
    add("--trace", metavar="TRACE", help="the measured run, for those who like options")
    discovery_options.add_runs(parser)
    options.add_model(parser)


def run_command(args: argparse.Namespace) -> int:
    """Write --out (default: the file of --model, else model.toml); exit status 0 if the effect helps, 1 if not."""
    from fdi.discovery import model_file as ledgers
    from fdi.discovery.refit import check_addable
    from rig.cli import model_update, show_ledger
    from rig.cli.progress_bar import show_progress

    model, known = discovery_options.model_of(args)
    effects, trace = model_update.split(args.words, args.trace, model.plant)
    path = model_update.target(args, trace or args.words[0])
    page = discovery_options.place(str(path.with_suffix(".html")), (".html",), trace or args.words[0])
    with show_progress(is_silent=args.json or args.quiet) as progress:
        progress("reading", 0.0)
        runs = model_update.runs_of(args, trace, ledgers.remove_all_effects(model, known), known)
        check_addable(runs.model, [*known.effects, *effects])
        discovery_options.prepare(runs, progress, [*known.effects, *effects])
        done = model_update.added(effects, runs, model, known, progress)
        done = done.using(discovery_options.effect_files(args, known))
        progress("writing", 0.95)
        why = sentence(done, effects)
        kept = model_update.write(path, done, page, " + ".join(effects), why)
    if args.json:
        print(json.dumps(model_update.to_json(path, done, page)))
    elif not args.quiet:
        show_ledger.shown(done, path, page, kept, why)
    return 0 if done.refit is None or done.refit.helps else 1


def sentence(done: Done, effects: list[str]) -> str:
    """What came of it."""
    from fdi.report.numbers import SIGNAL_NAMES, SIGNAL_UNITS, format_amount, format_signal, join_words

    assert done.refit is not None
    before, after = done.refit.steps[-1 - len(effects)], done.refit.last
    floor = done.provenance.floor or done.refit.floor
    s = max(before.error, key=lambda name: before.error[name] / floor[name])
    said = f"{join_words(effects)} added: error of {SIGNAL_NAMES[s]} {format_signal(before.error[s], s)} " \
           f"-> {format_amount(after.error[s], SIGNAL_UNITS[s])}, floor {format_amount(floor[s], SIGNAL_UNITS[s])}"
    if s in after.holdout:
        said += f"; on the held-out run {format_amount(before.holdout[s], SIGNAL_UNITS[s])} -> " \
                f"{format_amount(after.holdout[s], SIGNAL_UNITS[s])}"
    return f"{said}." if done.refit.helps else f"{said}. {effects[-1]} takes away nothing but noise."
