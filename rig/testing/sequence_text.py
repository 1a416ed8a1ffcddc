"""Sequences built in Python, as the TOML text of the same sequence, so that a log of their run can be repeated."""
from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plant.errors import InputError
from plant.segments import RATE
from rig.sequences.sequence import Sequence as TestSequence
from rig.sequences.sequence import load_sequence, parse_sequence

Table = Mapping[str, Any]
Command = NDArray[np.float64] | Sequence[Table]
_COMMAND_FILE = "command.csv"


def build_sequence(sequence: str | None, command: Command | None, **more: Sequence[Table]) -> TestSequence:
    """A sequence from a file or name, or from a command.

    Args:
        sequence: a file, or the name of a shipped sequence.
        command: in its place, a demand in m for each cycle of 1 ms, or a list of segments as tables.
        more: entries as tables that are added to those of the sequence, by key: faults, checks, guards, load.

    Raises:
        InputError: a sequence or entry that cannot be used.
    """
    added = {key: list(entries) for key, entries in more.items() if len(entries)}
    if command is None:
        named = load_sequence(sequence or "preflight")
        if not added:
            return named
        table, files, name = tomllib.loads(named.source), dict(named.files), named.name
    else:
        if sequence is not None:
            raise InputError("sequence", sequence, "either a sequence or a command")
        table, files = _make_table(command)
        name = "command.toml"
    for key, entries in added.items():
        table[key] = [*table.get(key, []), *entries]

    def read_file(file: str) -> bytes:
        if file not in files:
            raise InputError(file, "", "a file of the sequence")
        return files[file]

    return parse_sequence(write_toml(table), name, read_file)


def _make_table(command: Command) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The table of a sequence that plays a command, and its files."""
    if isinstance(command, np.ndarray):
        rows = "\n".join(f"{k / RATE!r},{float(value)!r}" for k, value in enumerate(np.atleast_1d(command)))
        main: list[Any] = [{"name": "command", "kind": "csv", "file": _COMMAND_FILE}]
        return {"title": "Command from Python", "main": main}, {_COMMAND_FILE: f"t,com\n{rows}\n".encode()}
    return {"title": "Command from Python", "main": list(command)}, {}


def write_toml(table: Table) -> str:
    """A table as TOML text, one line for each of its keys.

    Raises:
        InputError: a value that TOML cannot hold.
    """
    return "".join(f"{_write_key(key)} = {_write_value(value)}\n" for key, value in table.items())


def _write_key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else json.dumps(key, ensure_ascii=False)


def _write_value(value: object) -> str:
    if isinstance(value, bool | np.bool_):
        return "true" if value else "false"
    if isinstance(value, int | np.integer):
        return str(int(value))
    if isinstance(value, float | np.floating):
        return repr(float(value))
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, Mapping):
        pairs = ", ".join(f"{_write_key(str(key))} = {_write_value(inner)}" for key, inner in value.items())
        return f"{{ {pairs} }}"
    if isinstance(value, Sequence | np.ndarray):
        return f"[{', '.join(_write_value(inner) for inner in value)}]"
    raise InputError("sequence", "", f"numbers, texts, lists and tables, not {type(value).__name__}")
