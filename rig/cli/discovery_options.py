"""Options that `rig compare`, `rig explain`, `rig add` and `rig remove` share: measured runs and the model."""
from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rig.cli import options
from rig.cli.answer import choose_file

if TYPE_CHECKING:
    from fdi.discovery.update_model import Provenance
    from plant import Model


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """--repeat, --holdout and --signals."""
    add = parser.add_argument
    add("--repeat", action="append", default=[], metavar="TRACE",
        help="another run of the same command: measures the noise floor (repeatable)")
    add("--holdout", metavar="TRACE", help="a run of another command that no fit sees: reveals overfitting")
    add("--signals", metavar="xj,p12,xs", help="signals to use (default: all that the trace has)")


def list_signals(args: argparse.Namespace) -> list[str] | None:
    """The signals of --signals; None for all that the trace has."""
    return [name.strip() for name in args.signals.split(",")] if args.signals is not None else None


def load_model(args: argparse.Namespace) -> tuple[Model, Provenance]:
    """The model of --model, --set and --effects, with its provenance.

    Raises:
        InputError: a file or a value that cannot be used, or a model file with code that --trust does not allow.
    """
    from fdi.discovery.update_model import Provenance, load_model_file

    options.load_chosen_effects(args, args.model)
    if args.model and Path(args.model).is_file():
        model, known = load_model_file(Path(args.model))
        return model.replace(options.parse_changes(args.set)), known
    return options.load_chosen_model(args), Provenance()


def list_effect_files(args: argparse.Namespace, known: Provenance) -> tuple[str, ...]:
    """The user's effect files, those of this command and of earlier ones."""
    return tuple(dict.fromkeys([*known.effect_files, *map(str, args.effects)]))


def split_words(words: Sequence[str], trace: str | None, plant: str) -> tuple[list[str], str | None]:
    """The effects of a plant, and the trace, among the words of a command.

    Raises:
        InputError: a word that is neither an effect nor a trace; it offers the nearest effect.
    """
    from plant.errors import InputError, suggest_name
    from plant.model import list_offered_effects

    effects, known = [], [e.name for e in list_offered_effects(plant)]
    for word in words:
        is_file = word.endswith((".csv", ".csv.gz", ".mcap")) or Path(word).exists()
        if word in known:
            effects.append(word)
        elif trace is None and is_file:
            trace = word
        else:
            hint = suggest_name(word, known, 0.5) or " (rig effects lists them)"
            raise InputError("effect", word, f"an effect of the catalogue{hint}")
    if not effects:
        raise InputError("effect", "", "at least one effect (rig effects lists them)")
    return effects, trace


def choose_model_file(args: argparse.Namespace, trace: str | None) -> Path:
    """The model file to write: --out, else the file of --model, else model.toml.

    Raises:
        InputError: a place that cannot be written, or another kind of file.
    """
    own = args.model if args.model and Path(args.model).is_file() else "model.toml"
    path = choose_file(args.out or own, (".toml",), trace)
    assert path is not None
    return path


def format_command_line() -> str:
    """The command as the user typed it, for the history of a model file; "rig" in another program."""
    is_command = Path(sys.argv[0]).name in ("rig", "main.py")  # main.py: python -m rig.cli.main
    return shlex.join(["rig", *sys.argv[1:]]) if is_command else "rig"


def format_arguments(args: argparse.Namespace, trace: str) -> str:
    """The runs and the model of a command, as arguments of the command to type next."""
    words = [trace]
    for option, values in (("--repeat", args.repeat), ("--holdout", [getattr(args, "holdout", None)]),
                           ("--model", [args.model]), ("--set", args.set), ("--effects", args.effects),
                           ("--signals", [args.signals])):
        words += [word for value in values if value for word in (option, str(value))]
    words += ["--trust"] if args.trust else []
    return shlex.join(words)
