"""Completion in the shell by argcomplete: commands, options, and the names that options take.

The shell calls `rig` with the line typed so far in its environment. Without the package (extra "shell") nothing
happens.
"""

import argparse
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

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
    own = {"set": complete_parameter, "model": complete_model, "sequence": complete_sequence}
    for action in commands.choices[name]._actions if name in commands.choices else ():
        if action.dest in own:
            action.completer = own[action.dest]
        elif name in ("add", "remove", "effects") and not action.option_strings:
            action.completer = complete_effect
    return parser


def complete_parameter(prefix: str, **_: Any) -> Iterable[str]:
    """Parameters for --set, with the equals sign."""
    from plant.plants import find_plant

    groups = find_plant("eha").list_groups()
    names = (f"{group}.{field}=" for group, fields in groups.items() for field in fields._fields)
    return [name for name in names if name.startswith(prefix)]


def complete_model(prefix: str, **_: Any) -> Iterable[str]:
    """Shipped models, model files and plant files."""
    from plant.model import SHIPPED_MODELS
    from plant.plants import list_plants

    shipped = (*list_plants(), *SHIPPED_MODELS)
    return [name for name in shipped if name.startswith(prefix)] + _list_files(prefix, (".toml", ".py"))


def complete_sequence(prefix: str, **_: Any) -> Iterable[str]:
    """Shipped sequences and sequence files."""
    from rig.sequences.sequence import list_shipped

    return [name for name in list_shipped() if name.startswith(prefix)] + _list_files(prefix, (".toml",))


def complete_effect(prefix: str, **_: Any) -> Iterable[str]:
    """Effects of the catalogue; the traces and model files that follow them."""
    from plant.plants import find_plant

    names = [e.name for e in find_plant("eha").list_effects() if e.name.startswith(prefix)]
    return names + _list_files(prefix, (".mcap", ".csv", ".csv.gz", ".toml"))


def _list_files(prefix: str, suffixes: tuple[str, ...]) -> list[str]:
    """Folders and files of these suffixes that begin with what was typed."""
    folder = Path(prefix).parent if not prefix.endswith("/") else Path(prefix)
    if not folder.is_dir():
        return []
    found = [f"{path}/" if path.is_dir() else str(path) for path in sorted(folder.iterdir())]
    return [path for path in found if path.startswith(prefix) and path.endswith(("/", *suffixes))]
