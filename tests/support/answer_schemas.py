"""The schemas of the JSON answers in docs/schema, and the check of an answer against its schema.

The published schemas allow further keys, because a new version may add some. The check does not: a key that the schema
lacks is an error here, so that the schemas stay complete.
"""

import json
from collections.abc import Sequence
from functools import cache
from typing import Any

from jsonschema import Draft202012Validator
from jsonschema.exceptions import best_match
from places import ROOT
from referencing import Registry, Resource

FOLDER = ROOT / "docs" / "schema"


def load_schemas() -> dict[str, dict[str, Any]]:
    """All schemas by the name of their file, such as "compare.json"."""
    return {path.name: json.loads(path.read_text()) for path in sorted(FOLDER.glob("*.json"))}


def name_schema(words: Sequence[str]) -> str:
    """The schema of the answer to a command line, given without "rig"."""
    command = words[0]
    if command == "bench":
        return "bench_realtime.json" if "realtime" in words else "bench.json"
    if command == "check" and "--bench" in words[1:2] and set(words[3:]) <= {"--json"}:
        return "check_bench.json"  # without a sequence
    if command == "check" and words[1:2] and str(words[1]).endswith(".py"):
        return "check_plant.json"
    for name, option in (("fdi", "--learn-bands"), ("evidence", "--verify"), ("trend", "--score")):
        if command == name and option in words:
            return f"{name}_{option.strip('-').replace('-', '_')}.json"
    return f"{command}.json"


def refuse_other_keys(schema: Any) -> Any:
    """The same schema, in which an object may have no other keys than those described."""
    if isinstance(schema, list):
        return [refuse_other_keys(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    out = {key: refuse_other_keys(value) for key, value in schema.items()}
    is_object = isinstance(schema.get("properties"), dict) and isinstance(schema.get("type"), str | list)
    return {"additionalProperties": False, **out} if is_object else out


@cache
def build_validator(name: str) -> Any:
    """The validator of one schema without other keys."""
    schemas = {file: refuse_other_keys(schema) for file, schema in load_schemas().items()}
    registry = Registry().with_resources((file, Resource.from_contents(schema)) for file, schema in schemas.items())
    return Draft202012Validator(schemas[name], registry=registry)


def check_answer(words: Sequence[str], answer: Any) -> None:
    """Fail unless the answer to a command line is as its schema says.

    Raises:
        AssertionError: the answer differs; it names the schema, the place and the difference.
    """
    name = name_schema(words)
    if name == "run.json" and "cases" in answer:  # several sequences
        name = "suite.json"
    error = best_match(build_validator(name).iter_errors(answer))
    if error is not None:
        place = "/".join(map(str, error.absolute_path)) or "the answer"
        raise AssertionError(f"docs/schema/{name}, {place}: {error.message[:400]}")
