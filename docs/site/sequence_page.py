"""The reference page of the keys of a sequence, from the classes that read them."""
from __future__ import annotations

import inspect
import json
from collections.abc import Iterable
from dataclasses import MISSING, fields
from typing import Any, get_type_hints

from catalogue_pages import make_plain_table
from markdown_text import MADE, escape_markup, make_table, quote_code

from plant import Model, Segment, tables
from rig.cli.commands import list as list_command
from rig.network import Identity
from rig.sequences import SEGMENT_KINDS, Check, Guard, ProtocolLimits, Sequence, Step, TimingPolicy, faults
from rig.sequences.checks import KEYS, KINDS


def write_sequence_page() -> list[str]:
    """The page of everything that a sequence file may have."""
    lines = ["# Keys of sequences", "", MADE, "",
             "A sequence is a TOML file. [How to write a test](../docs/sequences.md) explains how the parts work "
             "together."]
    lines += ["", "## Shipped sequences", *make_plain_table(list_command.list_sequences(Model()))]
    lines += ["## Tables of the file", *describe_keys(Sequence)]
    for title, kinds, base in (("Segments", SEGMENT_KINDS, Segment), ("Faults", faults.KINDS, faults.Fault),
                               ("Checks", KEYS, Check)):
        lines += [f"## {title}", "", describe_class(base), "", f"Keys of all {title.lower()}:", *describe_keys(base)]
        common = {f.name for f in fields(base)}
        for name, kind in kinds.items():
            measured = KINDS[name] if base is Check else None
            text = describe_class(kind) if measured is None else escape_markup(measured.text)
            lines += [f"### {title[:-1]} {name}", "", text]
            lines += ["", f"Unit: {measured.unit or 'of the signal'}."] if measured and name != "python" else []
            lines += describe_keys(kind, without=common)
    for title, cls in (("Guards", Guard), ("Steps in Python", Step), ("Limits of the protocol checks", ProtocolLimits),
                       ("Timing", TimingPolicy), ("Firmware", Identity)):
        lines += [f"## {title}", "", describe_class(cls), *describe_keys(cls)]
    return lines


def describe_class(cls: type[Any]) -> str:
    """The docstring of a class as Markdown."""
    return escape_markup(inspect.getdoc(cls) or "")


def describe_keys(cls: type[Any], without: Iterable[str] = ()) -> list[str]:
    """The keys of a table of the file, with what may stand there and the default."""
    hints = get_type_hints(cls, include_extras=True)
    rows = []
    for f in fields(cls):
        if f.metadata.get("key", True) and f.name not in without:
            is_required = f.default is MISSING and f.default_factory is MISSING
            default = "required" if is_required else format_default(f.default)
            rows.append((quote_code(f.name), escape_markup(tables.describe_annotation(hints[f.name])), default))
    return make_table(("key", "value", "default"), rows)


def format_default(value: object) -> str:
    """A default as TOML has it; "" for none, and for a table, whose keys have their own defaults."""
    return quote_code(json.dumps(value)) if isinstance(value, bool | int | float | str) else ""
