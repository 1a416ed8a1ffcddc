"""Completion in the shell by argcomplete: commands, options, and the names that options take.

The shell calls `rig` with the line typed so far in its environment. Without the package (extra "shell") nothing
happens.
"""

import argparse
import os
from collections.abc import Callable, Iterable
from typing import Any

import plant
from rig.cli.main import build_parser


def complete_line() -> None:
    """Answer the shell and end the program; return where argcomplete is not installed."""
    try:
        import argcomplete
    except ImportError:
        return
    argcomplete.autocomplete(build_completion_parser(os.environ.get("COMP_LINE", "")), always_complete_options="long")


def build_completion_parser(line: str) -> argparse.ArgumentParser:
    """The parser of `rig` with the options of the command on the line, and how argcomplete completes their values."""
    name = [*line.split(), "", ""][1]
    parser = build_parser(name)
    commands = next(action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    own = {"set": offer(list_parameters), "model": offer(list_models, "toml", "py"),
           "sequence": offer(list_sequences, "toml")}
    for action in commands.choices[name]._actions if name in commands.choices else ():
        if action.dest in own:
            action.completer = own[action.dest]
        elif name in ("add", "remove", "effects") and not action.option_strings:
            action.completer = offer(list_effects, "mcap", "csv", "csv.gz", "toml")
    return parser


def offer(list_names: Callable[[], Iterable[str]], *suffixes: str) -> Callable[..., list[str]]:
    """What argcomplete asks for names, and for files of these suffixes; it chooses those that begin as typed."""
    def complete(prefix: str, **_: Any) -> list[str]:
        from argcomplete.completers import FilesCompleter

        return [*list_names(), *(FilesCompleter(suffixes)(prefix) if suffixes else ())]

    return complete


def list_parameters() -> list[str]:
    """Parameters for --set, with the equals sign."""
    groups = plant.find_plant("eha").list_groups()
    return [f"{group}.{field}=" for group, fields in groups.items() for field in fields._fields]


def list_models() -> list[str]:
    """Shipped models and plants."""
    return [*plant.list_plants(), *plant.SHIPPED_MODELS]


def list_sequences() -> list[str]:
    """Shipped sequences."""
    from rig.sequences import list_shipped

    return [*list_shipped()]


def list_effects() -> list[str]:
    """Effects of the catalogue."""
    return [effect.name for effect in plant.find_plant("eha").list_effects()]
