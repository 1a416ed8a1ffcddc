"""Options that mean the same in every command, and what they stand for."""
from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from plant.errors import InputError

if TYPE_CHECKING:
    from plant.model import Model


def add_model(parser: argparse.ArgumentParser) -> None:
    """--model, --set, --seed, --effects: which plant to run."""
    add = parser.add_argument
    add("--model", metavar="FILE|NAME", help="model file, or a nominal plant: eha (default), ehs (a pump-driven servo)")
    add("--set", action="append", default=[], metavar="GROUP.FIELD=VALUE",
        help="change a parameter of the model or of an effect, SI units (repeatable)")
    add("--effects", action="append", default=[], type=Path, metavar="FILE.py", help="your own effects (repeatable)")
    add_seed(parser)


def add_seed(parser: argparse.ArgumentParser) -> None:
    """--seed: of all random numbers of a run."""
    parser.add_argument("--seed", type=whole, default=0, metavar="N", help="seed of the noise (default 0)")


def whole(text: str) -> int:
    """A whole number from 0, for argparse."""
    value = int(text)
    if value < 0:
        raise ValueError
    return value


def counted(text: str) -> int:
    """A whole number from 1, for argparse."""
    value = whole(text)
    if value < 1:
        raise ValueError
    return value


whole.__name__ = "whole number from 0"
counted.__name__ = "whole number from 1"


def changes(pairs: list[str]) -> dict[str, str]:
    """The --set options as a dict.

    Raises:
        InputError: one that is not GROUP.FIELD=VALUE.
    """
    table: dict[str, str] = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not (equals and value and "." in name):
            raise InputError("--set", pair, "GROUP.FIELD=VALUE, such as spool.static_friction=35")
        table[name.strip()] = value.strip()
    return table


def model_of(args: argparse.Namespace) -> Model:
    """The model that --model, --set and --effects describe.

    Raises:
        InputError: a file, name or value that cannot be used.
    """
    from plant.model import load_model

    load_user_effects([*args.effects, *named_in(args.model, args.effects)])
    return load_model(args.model or "eha").replace(changes(args.set))


def named_in(model: str | None, given: list[Path]) -> list[Path]:
    """The files of a user's own effects that a model file names, where they are found: here or beside it.

    A file of the same name among the `given` ones takes the place of one.
    """
    if model is None or not Path(model).is_file():
        return []
    from plant.parameters import read_toml

    said = read_toml(Path(model)).get("provenance", {})
    named = said.get("effect_files", []) if isinstance(said, dict) else []
    files = [Path(name) for name in named if isinstance(name, str)]
    places = [next((p for p in (file, Path(model).parent / file) if p.is_file()), None) for file in files]
    return [p for p in places if p is not None and p.name not in [g.name for g in given]]


def load_user_effects(files: list[Path]) -> None:
    """Put the user's own effects into the catalogue.

    Raises:
        InputError: a file that cannot be used, or two of one name: a log keeps them by name.
    """
    if files:
        from plant.effects import load_effects

        for i, file in enumerate(files):
            if file.name in [other.name for other in files[:i]]:
                raise InputError("--effects", str(file), f"files of different names, not a second {file.name}")
            load_effects(file)
