"""The options that have the same meaning in every command, and the values they stand for."""
from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from plant.errors import InputError

if TYPE_CHECKING:
    from plant.model import Model


def add_model_options(parser: argparse._ActionsContainer) -> None:
    """Add --model, --set, --effects and --seed, which choose the plant, to a parser or to a group of its options."""
    add = parser.add_argument
    add("--model", metavar="FILE|NAME",
        help="model file, or a shipped model: eha (default), ehs (pump-driven servo), servo (the same, a real one)")
    add("--set", action="append", default=[], metavar="GROUP.FIELD=VALUE",
        help="change a parameter of the model or of an effect, SI units (repeatable)")
    add("--effects", action="append", default=[], type=Path, metavar="FILE.py", help="your own effects (repeatable)")
    add_trust_option(parser)
    add_seed_option(parser)


def add_trust_option(parser: argparse._ActionsContainer) -> None:
    """Add --trust."""
    parser.add_argument("--trust", action="store_true",
                        help="run the code that a log or a model file brings along; it is listed first, with its hash")


def add_seed_option(parser: argparse._ActionsContainer) -> None:
    """Add --seed."""
    parser.add_argument("--seed", type=parse_whole_number, default=0, metavar="N", help="seed of the noise (default 0)")


def add_force_option(parser: argparse.ArgumentParser) -> None:
    """Add --force."""
    parser.add_argument("--force", action="store_true", help="replace the file of --out if there is one")


def parse_whole_number(text: str) -> int:
    """Parse a whole number from 0, as an argparse type."""
    return _parse_integer(text, 0)


def parse_count(text: str) -> int:
    """Parse a whole number from 1, as an argparse type."""
    return _parse_integer(text, 1)


def _parse_integer(text: str, least: int) -> int:
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if value < least:
        raise argparse.ArgumentTypeError(f"expected a whole number from {least}, not {text!r}")
    return value


def parse_changes(pairs: list[str]) -> dict[str, str]:
    """Parse the --set options: "GROUP.FIELD" to value.

    Raises:
        InputError: an option that is not GROUP.FIELD=VALUE.
    """
    table: dict[str, str] = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not (equals and value and "." in name):
            raise InputError("--set", pair, "GROUP.FIELD=VALUE, such as spool.static_friction=35")
        table[name.strip()] = value.strip()
    return table


def load_chosen_model(args: argparse.Namespace) -> Model:
    """Load the model that --model, --set and --effects describe.

    Raises:
        InputError: a file, name or value that is invalid, or a model file with code that --trust does not allow.
    """
    from plant.model import load_model

    load_chosen_effects(args, args.model)
    return load_model(args.model or "eha").replace(parse_changes(args.set))


def load_chosen_effects(args: argparse.Namespace, model: str | None) -> tuple[Path, ...]:
    """Add the user's own effects to the catalogue: the files of --effects and, with --trust, those of a model file.

    Returns:
        All these files.

    Raises:
        InputError: an invalid file, code that --trust does not allow, or two files of one name.
    """
    load_user_effects(args.effects)
    return (*args.effects, *load_effects_of_model(args, model))


def load_effects_of_model(args: argparse.Namespace, model: str | None) -> tuple[Path, ...]:
    """Add the effects of the files that a model file names to the catalogue, if --trust allows it.

    Returns:
        These files, without those that --effects replaces.

    Raises:
        InputError: an invalid file, code that --trust does not allow, or a file of the same name as another.
    """
    if model is None or not Path(model).is_file():
        return ()
    from fdi import foreign_code

    files = foreign_code.load_effects_of_model(model, args.effects, is_trusted=args.trust)
    foreign_code.require_different_names((*args.effects, *files))
    return files


def load_user_effects(files: Sequence[Path]) -> None:
    """Add the effects of files that the user names to the catalogue.

    Raises:
        InputError: an invalid file, or two files of one name.
    """
    if files:
        from fdi.foreign_code import require_different_names
        from plant.effects import load_effects

        require_different_names(files)
        for file in files:
            load_effects(file)
