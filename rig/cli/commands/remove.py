"""`rig remove`: an effect taken out of a model file again, and what that does to the error."""
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
    add("words", nargs="+", metavar="EFFECT [TRACE]", help="the effect, and the measured run to fit what is left to")
    add("--trace", metavar="TRACE", help="the measured run, for those who like options")
    discovery_options.add_runs(parser)
    options.add_model(parser)


def run_command(args: argparse.Namespace) -> int:
    """Write --out (default: the file of --model, in place)."""
    from pathlib import Path

    from fdi.discovery import model_file as ledgers
    from plant import InputError
    from rig.cli import model_update, show_ledger
    from rig.cli.progress_bar import show_progress

    if not args.model or not Path(args.model).is_file():
        raise InputError("--model", str(args.model or ""), "the model FILE to take it out of")
    model, known = discovery_options.model_of(args)
    effects, trace = model_update.split(args.words, args.trace, model.plant)
    if len(effects) > 1:
        raise InputError("effect", effects[1], "one effect at a time")
    path = model_update.target(args, trace or args.model + " ")
    page = discovery_options.place(str(path.with_suffix(".html")), (".html",), trace or "") if trace else None
    with show_progress(is_silent=args.json or args.quiet) as progress:
        runs = None
        if trace is not None:
            progress("reading", 0.0)
            runs = model_update.runs_of(args, trace, ledgers.remove_all_effects(model, known), known)
            discovery_options.prepare(runs, progress, known.effects)
        done = model_update.removed(effects[0], runs, model, known, progress)
        done = done.using(discovery_options.effect_files(args, known))
        why = sentence(done, effects[0])
        kept = model_update.write(path, done, page, f"without {effects[0]}", why)
    if args.json:
        print(json.dumps(model_update.to_json(path, done, page)))
    elif not args.quiet:
        show_ledger.shown(done, path, page, kept, why)
    return 0


def sentence(done: Done, effect: str) -> str:
    """What came of it."""
    from fdi.report.numbers import SIGNAL_NAMES, SIGNAL_UNITS, format_amount

    if done.refit is None:
        return f"{effect} is out."
    before, after = done.provenance.ledger[-2:]
    floor = done.provenance.floor or done.refit.floor
    s = max(after.error, key=lambda name: after.error[name] / floor[name])
    return f"{effect} is out: error of {SIGNAL_NAMES[s]} {format_amount(before.error[s], SIGNAL_UNITS[s])} -> " \
           f"{format_amount(after.error[s], SIGNAL_UNITS[s])}, floor {format_amount(floor[s], SIGNAL_UNITS[s])}."
