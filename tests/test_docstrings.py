"""Docstrings and comments name only what exists: a name in backticks is defined in the project or used in that file."""

import ast
import builtins
import doctest
import importlib
import io
import keyword
import re
import sys
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parent.parent
FILES = sorted(path for package in ("plant", "fdi", "rig", "dbc") for path in (ROOT / package).rglob("*.py"))
NAME = re.compile(r"`([A-Za-z_][\w.]*)(?:\([^`]*\))?`")
# names of other programs, which this code neither defines nor uses
LIBRARIES = {*sys.stdlib_module_names, "numpy", "scipy", "can", "canopen", "mcap", "numba"}
FOREIGN = {*LIBRARIES, "resid", "array_split", "udp_multicast", "_asdict", "ro", "wo"}  # the last two: EDS


@cache
def list_nodes(source: str) -> list[ast.AST]:
    """All nodes of the syntax tree of a file."""
    return list(ast.walk(ast.parse(source)))


def list_definitions(source: str) -> Iterator[str]:
    """Functions and classes, and the names that a module or a class assigns."""
    for node in list_nodes(source):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        if isinstance(node, ast.Module | ast.ClassDef):
            for statement in node.body:
                if isinstance(statement, ast.Assign | ast.AnnAssign):
                    yield from (part.id for part in ast.walk(statement)
                                if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store))


@cache
def list_known_names() -> set[str]:
    """What Python, other programs and the project define, and the names of the project's files and folders."""
    defined = {name for path in FILES for name in list_definitions(path.read_text())}
    parts = {part for path in FILES for part in path.relative_to(ROOT).with_suffix("").parts}
    return {*dir(builtins), *keyword.kwlist} | FOREIGN | defined | parts


def find_docstrings(source: str) -> Iterator[ast.Constant]:
    for node in list_nodes(source):
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Module) and ast.get_docstring(node) is not None:
            first = node.body[0]
            assert isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
            yield first.value


def list_words(source: str) -> Iterator[str]:
    """Names that the code of a file uses, and the words of its texts, which may be keys of files and messages."""
    docstrings = set(find_docstrings(source))
    for node in list_nodes(source):
        if isinstance(node, ast.Name):
            yield node.id
        elif isinstance(node, ast.Attribute):
            yield node.attr
        elif isinstance(node, ast.arg | ast.keyword) and node.arg:
            yield node.arg
        elif isinstance(node, ast.alias):
            yield from (node.asname or node.name).split(".")
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in docstrings:
            yield from re.split(r"\W+", node.value)


def find_unknown_names(source: str) -> list[str]:
    """Names in backticks in the docstrings and comments of a file that nothing defines or uses."""
    tokens = tokenize.generate_tokens(io.StringIO(source).readline) if re.search("#.*`", source) else ()
    texts = [str(node.value) for node in find_docstrings(source)]
    texts += [token.string for token in tokens if token.type == tokenize.COMMENT]
    known = list_known_names() | set(list_words(source))
    return [name for text in texts for name in NAME.findall(text) if not set(filter(None, name.split("."))) <= known]


def test_names_in_backticks_exist() -> None:
    found = {path.relative_to(ROOT).as_posix(): find_unknown_names(path.read_text()) for path in FILES}
    assert len(found) > 200 and {path: names for path, names in found.items() if names} == {}


def test_a_name_of_nothing_is_found() -> None:
    text = '"""As `starts_of` does; see `plant.run.simulate` and `own`."""\n# `no_such_name(x)`\nown = 1\n'
    assert find_unknown_names(text) == ["starts_of", "no_such_name"]


def test_examples_in_docstrings_are_true() -> None:
    files = [path.relative_to(ROOT).with_suffix("") for path in FILES if ">>> " in path.read_text()]
    wrong = {str(file): doctest.testmod(importlib.import_module(".".join(file.parts))).failed for file in files}
    assert len(files) > 20 and not any(wrong.values()), wrong
