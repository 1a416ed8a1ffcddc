"""What `rig explain`, `rig add` and `rig remove` share: their options, runs, places for results."""
from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rig.cli import options

if TYPE_CHECKING:
    from fdi.discovery.model_file import Provenance
    from fdi.discovery.runs import Runs
    from fdi.progress import Progress
    from plant import Model


def add_runs(parser: argparse.ArgumentParser) -> None:
    """--repeat, --holdout and --signals."""
    add = parser.add_argument
    add("--repeat", action="append", default=[], metavar="TRACE",
        help="the same command again: tells noise from physics (repeatable)")
    add("--holdout", metavar="TRACE", help="another command, which no fit sees: tells physics from luck")
    add("--signals", metavar="xj,p12,xs", help="what to explain (default: what the trace has)")


def signals_of(args: argparse.Namespace) -> list[str] | None:
    """The chosen signals, None for all there are."""
    return [name.strip() for name in args.signals.split(",")] if args.signals is not None else None


def model_of(args: argparse.Namespace) -> tuple[Model, Provenance]:
    """The model of --model, --set and --effects, and where it comes from.

    Raises:
        InputError: what cannot be used.
    """
    from fdi.discovery.model_file import Provenance, load_model_file

    options.load_user_effects([*args.effects, *options.named_in(args.model, args.effects)])
    if args.model and Path(args.model).is_file():
        model, known = load_model_file(Path(args.model))
        return model.replace(options.changes(args.set)), known
    return options.model_of(args), Provenance()


def effect_files(args: argparse.Namespace, known: Provenance) -> tuple[str, ...]:
    """The user's effect files, of this command and of those before it."""
    return tuple(dict.fromkeys([*known.effect_files, *map(str, args.effects)]))


def prepare(runs: Runs, progress: Progress, effects: Sequence[str] | None = None) -> None:
    """Find sizes to start from for effects that say none, and compile what they need; by default all there are.

    Raises:
        InputError: a user's law that cannot be compiled and run.
    """
    from fdi.discovery.refit import lean_model
    from fdi.estimation.unknowns import UNREPLAYED, complete_model
    from plant.effects import CATALOGUE
    from plant.lanes import warm
    from plant.model import offered
    from plant.run import laws
    from plant.starts import ensure_starts

    for name in [e.name for e in offered(runs.model.plant)] if effects is None else effects:
        if not CATALOGUE[name].starts and CATALOGUE[name].fitted:
            progress(f"looking for sizes of {name}", 0.0)
            ensure_starts(name, runs.est.com, runs.est.load)
    replayed = [name for name in effects or () if CATALOGUE[name].port not in UNREPLAYED]
    model = complete_model(runs.model) if effects is None else lean_model(runs.model, replayed)
    with laws(model):
        if effects is None:
            warm(model, lambda stage, share: progress(stage, 0.0))
        else:
            progress("compiling the plant with it, once", 0.0)
            _tried(model, replayed)


def _tried(model: Model, effects: Sequence[str]) -> None:
    """A replay of a few samples without and with each effect: compiles the kernels that these take, and no others."""
    import numpy as np

    from plant.effects import CATALOGUE
    from plant.lanes import Lanes

    sizes = {e.fitted[0]: e.starts[-1][e.fitted[0]] for e in map(CATALOGUE.__getitem__, effects) if e.starts}
    names = list(sizes) or [next(iter(model.values))]
    usual = np.array([model[name] for name in names])
    rows = usual + np.vstack([0.0 * usual, np.diag([sizes.get(n, x) - x for n, x in zip(names, usual, strict=True)])])
    Lanes(model, names, 1, 1).replay(rows, np.zeros(2), np.zeros(2))


def place(out: str | None, suffixes: tuple[str, ...], source: str, option: str = "--out") -> Path | None:
    """Where a result is to go; asked before long work.

    Raises:
        InputError: a place that cannot be written, or a kind of file that is not made here.
    """
    from fdi.output import writable
    from plant import InputError

    if out is None:
        return None
    path = Path(out)
    if path.suffix not in suffixes:
        raise InputError(option, out, " or ".join(f"FILE{suffix}" for suffix in suffixes))
    return writable(path, option, source=source)


def typed() -> str:
    """The command as it was typed, for provenance."""
    return shlex.join(["rig", *sys.argv[1:]]) if Path(sys.argv[0]).name in ("rig", "cli.py") else "rig"


def words(trace: str, args: argparse.Namespace, model: str | None = None) -> str:
    """The arguments that say which runs and which model, for a command to type next."""
    found = [trace]
    for option, values in (("--repeat", args.repeat), ("--holdout", [args.holdout]), ("--model", [model or args.model]),
                           ("--set", [] if model else args.set), ("--effects", args.effects),
                           ("--signals", [args.signals])):
        found += [word for value in values if value for word in (option, str(value))]
    return shlex.join(found)
