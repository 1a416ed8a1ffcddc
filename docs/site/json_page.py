"""The reference page of the JSON keys, from the schemas in docs/schema."""
from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from markdown_text import MADE, escape_markup, make_table, name_anchor, quote_code

SCHEMAS = Path(__file__).resolve().parent.parent / "schema"


def write_json_page() -> list[str]:
    """The page of all keys of the JSON answers, from the schemas."""
    lines = ["# Keys of the JSON answers", "", MADE, "",
             "One section for each schema in `docs/schema/`. `[]` is an item of a list, `*` a name that the data "
             "give. [The JSON answers of the commands](../docs/json.md) explains the keys command by command.", ""]
    for path in sorted(SCHEMAS.glob("*.json")):
        schema = json.loads(path.read_text())
        lines += [f"({name_anchor('json', path.stem)})=", f"## {path.stem}.json", "",
                  f"{escape_markup(schema['title'])}. [The schema](../docs/schema/{path.name}).", ""]
        parts = [("", schema)] if "properties" in schema or "anyOf" in schema else []
        parts += [(name, part) for name, part in schema.get("$defs", {}).items()]
        for name, part in parts:
            rows = [(quote_code(key), type_, escape_markup(text)) for key, type_, text in list_keys(part, name)]
            lines += make_table(("key", "type", "meaning"), rows)
    return lines


def list_keys(schema: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, str, str]]:
    """(key with its path, type, meaning) of everything below a schema."""
    if path:
        yield path, describe_type(schema), schema.get("description", "")
    for variant in schema.get("anyOf", []):
        yield from ((key, *rest) for key, *rest in list_keys(variant, path) if key != path)
    for name, inner in schema.get("properties", {}).items():
        yield from list_keys(inner, f"{path}.{name}" if path else name)
    for key, mark in (("items", "[]"), ("additionalProperties", ".*")):
        inner = schema.get(key)
        if isinstance(inner, dict) and {"properties", "items", "additionalProperties", "anyOf"} & inner.keys():
            yield from (row for row in list_keys(inner, path + mark) if row[0] != path + mark)


def describe_type(schema: Mapping[str, Any]) -> str:
    """The type of a value in words."""
    if "$ref" in schema:
        file, _, place = schema["$ref"].partition("#")
        return f"[{place.rpartition('/')[2] or file}](#{name_anchor('json', Path(file or 'common').stem)})"
    if "enum" in schema:
        return ", ".join("null" if value is None else quote_code(value) for value in schema["enum"])
    if "const" in schema:
        return quote_code(schema["const"])
    if "anyOf" in schema:
        return " or ".join(dict.fromkeys(describe_type(variant) for variant in schema["anyOf"]))
    kinds = schema.get("type", "any")
    words = [kinds] if isinstance(kinds, str) else kinds
    inner = schema.get("items")
    return " or ".join(f"list of {describe_type(inner)}" if word == "array" and inner else word for word in words)
