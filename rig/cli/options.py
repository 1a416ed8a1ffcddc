"""The options that have the same meaning in every command, and the values they stand for."""
from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from plant.errors import InputError

if TYPE_CHECKING:
    from plant.model import Model


def add_model_options(parser: argparse.ArgumentParser) -> None:
    """Add --model, --set, --effects and --seed, which choose the plant."""
    add = parser.add_argument
    add("--model", metavar="FILE|NAME", help="model file, or a shipped plant: eha (default), ehs (pump-driven servo)")
    add("--set", action="append", default=[], metavar="GROUP.FIELD=VALUE",
        help="change a parameter of the model or of an effect, SI units (repeatable)")
    add("--effects", action="append", default=[], type=Path, metavar="FILE.py", help="your own effects (repeatable)")
    add_seed_option(parser)


def add_seed_option(parser: argparse.ArgumentParser) -> None:
    """Add --seed."""
    parser.add_argument("--seed", type=parse_whole_number, default=0, metavar="N", help="seed of the noise (default 0)")


def parse_whole_number(text: str) -> int:
    """Parse a whole number from 0, as an argparse type."""
    value = int(text)
    if value < 0:
        raise ValueError
    return value


def parse_count(text: str) -> int:
    """Parse a whole number from 1, as an argparse type."""
    value = parse_whole_number(text)
    if value < 1:
        raise ValueError
    return value


parse_whole_number.__name__ = "whole number from 0"
parse_count.__name__ = "whole number from 1"


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
        InputError: a file, name or value that is invalid.
    """
    from plant.model import load_model

    load_user_effects([*args.effects, *find_effect_files(args.model, args.effects)])
    return load_model(args.model or "eha").replace(parse_changes(args.set))


def find_effect_files(model: str | None, given: list[Path]) -> list[Path]:
    """The effect files that a model file names, as far as they are found in this folder or beside the model file.

    A file in `given` replaces one of the same name.
    """
    if model is None or not Path(model).is_file():
        return []
    from plant.parameters import read_toml

    provenance = read_toml(Path(model)).get("provenance", {})
    names = provenance.get("effect_files", []) if isinstance(provenance, dict) else []
    files = [Path(name) for name in names if isinstance(name, str)]
    places = [next((p for p in (file, Path(model).parent / file) if p.is_file()), None) for file in files]
    return [p for p in places if p is not None and p.name not in [g.name for g in given]]


def load_user_effects(files: list[Path]) -> None:
    """Add the user's own effects to the catalogue.

    Raises:
        InputError: an invalid file, or two files of one name: a log stores them by name.
    """
    if files:
        from plant.effects import load_effects

        for i, file in enumerate(files):
            if file.name in [other.name for other in files[:i]]:
                raise InputError("--effects", str(file), f"files of different names, not a second {file.name}")
            load_effects(file)
