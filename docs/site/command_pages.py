"""The reference pages of the commands, from the parser of the command line."""
from __future__ import annotations

import argparse
import re
from pathlib import Path

from markdown_text import MADE, escape_markup, make_contents, make_table, name_anchor, quote_code

from rig.cli.command_list import COMMANDS
from rig.cli.main import build_command_parser

SCHEMAS = Path(__file__).resolve().parent.parent / "schema"


def write_command_list() -> list[str]:
    """The page that lists the commands."""
    rows = [(f"[rig {name}](commands/{name}.md)", escape_markup(command.help)) for name, command in COMMANDS.items()]
    return ["# Options of the commands", "", MADE, *make_table(("command", "purpose"), rows),
            "Every command takes `--json`, `--out`, `--quiet` and `--help`. Examples are in "
            "[the commands, with examples](../docs/commands.md).", "",
            *make_contents(f"commands/{name}" for name in COMMANDS)]


def write_command_page(name: str) -> list[str]:
    """The page of one command: usage, arguments and options, as its parser has them."""
    parser = build_command_parser(name)
    formatter = argparse.HelpFormatter(parser.prog, width=84)  # so wide are the pages
    formatter.add_usage(parser.usage, parser._actions, parser._mutually_exclusive_groups)
    usage = re.sub("^(usage: | {7})", "", formatter.format_help(), flags=re.MULTILINE)
    lines = [f"# rig {name}", "", escape_markup(parser.description or ""), "", "```text", usage.rstrip(), "```", ""]
    for group in parser._action_groups:  # argparse has no public way to them
        actions = [action for action in group._group_actions if action.help is not argparse.SUPPRESS]
        if not actions and not group.description:
            continue
        title = (group.title or "options").removeprefix(f"rig {name} ")
        lines += [f"## {title[0].upper()}{title[1:]}", "", escape_markup(group.description or "")]
        lines += make_table(("name", "meaning"), [(name_action(action), describe_action(action, parser))
                                                  for action in actions])
    stems = [path.stem for path in sorted(SCHEMAS.glob("*.json")) if re.fullmatch(rf"{name}(_\w+)?", path.stem)]
    links = ["[Examples](../../docs/commands.md)"]
    links += [f"[keys of {stem}.json](../json.md#{name_anchor('json', stem)})" for stem in stems]
    return [*lines, "", "See also: " + ", ".join(links) + "."]


def name_action(action: argparse.Action) -> str:
    """An argument or option as it is typed."""
    value = argparse.HelpFormatter("")._format_args(action, action.metavar or (
        "{" + ",".join(map(str, action.choices)) + "}" if action.choices else action.dest.upper()))
    if not action.option_strings:
        return quote_code(value)
    return ", ".join(quote_code(f"{option} {value}".strip()) for option in action.option_strings)


def describe_action(action: argparse.Action, parser: argparse.ArgumentParser) -> str:
    """The help of an argument, with its default where the help does not say it."""
    text = argparse.HelpFormatter(parser.prog)._expand_help(action) if action.help else ""
    is_plain = isinstance(action.default, int | float | str) and not isinstance(action.default, bool)
    if is_plain and action.default not in ("", argparse.SUPPRESS) and "default" not in text and action.option_strings:
        text += f" (default {action.default})"
    return escape_markup(text)
