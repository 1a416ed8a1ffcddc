"""Completion in the shell by argcomplete: commands, options, and the names that options take.

The shell calls `rig` with the line typed so far in its environment. Only the command on that line is imported. Without
the package (extra "shell") nothing happens.
"""
from __future__ import annotations

import argparse
import os
from collections.abc import Iterable
from typing import Any

from rig.cli.command_list import HELP_OF_COMMAND, import_command


def complete_line() -> None:
    """Answer the shell and end the program; return where argcomplete is not installed."""
    try:
        import argcomplete
    except ImportError:
        return
    argcomplete.autocomplete(build_completion_parser(os.environ.get("COMP_LINE", "")), always_complete_options="long")


def build_completion_parser(line: str) -> argparse.ArgumentParser:
    """The parser of the commands with the options of the one on the line."""
    words = line.split()
    chosen = words[1] if len(words) > 1 else ""
    parser = argparse.ArgumentParser(prog="rig")
    parser.add_argument("--version", action="store_true")
    commands = parser.add_subparsers(dest="command")
    for name, text in HELP_OF_COMMAND.items():
        command = commands.add_parser(name, help=text)
        if name == chosen:
            import_command(name).add_arguments(command)
            command.add_argument("--json", action="store_true")
            command.add_argument("--out")
            command.add_argument("--quiet", action="store_true")
            _add_completers(command, name)
    return parser


def _add_completers(command: argparse.ArgumentParser, name: str) -> None:
    """Tell argcomplete, by an attribute of each action, which names an option or argument takes."""
    own = {"set": complete_parameter, "model": complete_model, "sequence": complete_sequence}
    for action in command._actions:
        if action.dest in own:
            action.completer = own[action.dest]  # type: ignore[attr-defined]
        elif name in ("add", "remove", "effects") and not action.option_strings:
            action.completer = complete_effect  # type: ignore[attr-defined]


def complete_parameter(prefix: str, **_: Any) -> Iterable[str]:
    """Parameters for --set, with the equals sign."""
    from plant.model import find_parameter_groups

    names = (f"{group}.{field}=" for group, fields in find_parameter_groups().items() for field in fields._fields)
    return [name for name in names if name.startswith(prefix)]


def complete_model(prefix: str, **_: Any) -> Iterable[str]:
    """Shipped models and model files."""
    from plant.model import SHIPPED_MODELS
    from plant.plants import list_plants

    shipped = (*list_plants(), *SHIPPED_MODELS)
    return [name for name in shipped if name.startswith(prefix)] + _list_files(prefix, (".toml",))


def complete_sequence(prefix: str, **_: Any) -> Iterable[str]:
    """Shipped sequences and sequence files."""
    from importlib.resources import files
    from pathlib import Path

    entries = (entry.name for entry in files("rig.sequences").iterdir())
    shipped = sorted(Path(name).stem for name in entries if name.endswith(".toml"))
    return [name for name in shipped if name.startswith(prefix)] + _list_files(prefix, (".toml",))


def complete_effect(prefix: str, **_: Any) -> Iterable[str]:
    """Effects of the catalogue; the traces and model files that follow them."""
    from plant.model import list_offered_effects

    names = [e.name for e in list_offered_effects() if e.name.startswith(prefix)]
    return names + _list_files(prefix, (".mcap", ".csv", ".csv.gz", ".toml"))


def _list_files(prefix: str, suffixes: tuple[str, ...]) -> list[str]:
    """Folders and files of these suffixes that begin with what was typed."""
    from pathlib import Path

    folder = Path(prefix).parent if not prefix.endswith("/") else Path(prefix)
    if not folder.is_dir():
        return []
    found = [f"{path}/" if path.is_dir() else str(path) for path in sorted(folder.iterdir())]
    return [path for path in found if path.startswith(prefix) and path.endswith(("/", *suffixes))]
