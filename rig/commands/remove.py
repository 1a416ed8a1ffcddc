"""`rig remove`: an effect taken out of a model file again, and what that does to the error."""
from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

from rig import discovery, options

if TYPE_CHECKING:
    from rig.ledger import Done

HELP = "take an effect out of a model file; with a TRACE, refit and show the error going up"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    add = parser.add_argument
    add("words", nargs="+", metavar="EFFECT [TRACE]", help="the effect, and the measured run to fit what is left to")
    add("--trace", metavar="TRACE", help="the measured run, for those who like options")
    discovery.add_runs(parser)
    options.add_model(parser)


def run(args: argparse.Namespace) -> int:
    """Write --out (default: the file of --model, in place)."""
    from pathlib import Path

    from fdi.discovery import ledger as ledgers
    from plant import InputError
    from rig import ledger, show_ledger

    if not args.model or not Path(args.model).is_file():
        raise InputError("--model", str(args.model or ""), "the model FILE to take it out of")
    model, known = discovery.model_of(args)
    effects, trace = ledger.split(args.words, args.trace, model.plant)
    if len(effects) > 1:
        raise InputError("effect", effects[1], "one effect at a time")
    path = ledger.target(args, trace or args.model + " ")
    page = discovery.place(str(path.with_suffix(".html")), (".html",), trace or "") if trace else None
    with discovery.patience(args.json or args.quiet) as progress:
        runs = None
        if trace is not None:
            progress("reading", 0.0)
            runs = ledger.runs_of(args, trace, ledgers.original(model, known), known)
            discovery.prepare(runs, progress, known.effects)
        done = ledger.removed(effects[0], runs, model, known, progress)
        done = done.using(discovery.effect_files(args, known))
        why = sentence(done, effects[0])
        kept = ledger.write(path, done, page, f"without {effects[0]}", why)
    if args.json:
        print(json.dumps(ledger.to_json(path, done, page)))
    elif not args.quiet:
        show_ledger.shown(done, path, page, kept, why)
    return 0


def sentence(done: Done, effect: str) -> str:
    """What came of it."""
    from fdi.discovery.words import SHOWN, UNITS, amount

    if done.refit is None:
        return f"{effect} is out."
    before, after = done.provenance.ledger[-2:]
    floor = done.provenance.floor or done.refit.floor
    s = max(after.error, key=lambda name: after.error[name] / floor[name])
    return f"{effect} is out: error of {SHOWN[s]} {amount(before.error[s], UNITS[s])} -> " \
           f"{amount(after.error[s], UNITS[s])}, floor {amount(floor[s], UNITS[s])}."
