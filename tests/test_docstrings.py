"""Docstrings and comments name only what exists: a name in backticks is a word of the project's code."""

import ast
import builtins
import doctest
import importlib
import io
import keyword
import re
import sys
import tokenize
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parent.parent
FILES = sorted(path for package in ("plant", "fdi", "rig", "dbc") for path in (ROOT / package).rglob("*.py"))
NAME = re.compile(r"`([A-Za-z_][\w.]*)(?:\([^`]*\))?`")
# names of other programs, which this code neither defines nor uses
LIBRARIES = {*sys.stdlib_module_names, "numpy", "scipy", "can", "canopen", "mcap", "numba"}
FOREIGN = {*LIBRARIES, "resid", "array_split", "udp_multicast", "_asdict", "ro", "wo"}  # the last two: EDS


@cache
def split_source(source: str) -> tuple[str, set[str]]:
    """Docstrings and comments of a file, and the words of its code and of its other texts, such as keys of files."""
    nodes = list(ast.walk(ast.parse(source)))
    documented = [node for node in nodes if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Module)]
    docstrings = [text for node in documented if (text := ast.get_docstring(node, clean=False))]
    comments, words = list[str](), set[str]()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            comments.append(token.string)
        elif token.type != tokenize.STRING or not any(text in token.string for text in docstrings):
            words |= set(re.split(r"\W+", token.string))
    return "\n".join((*docstrings, *comments)), words


@cache
def list_known_names() -> set[str]:
    """What Python, other programs and the project's code name, and the names of the project's files and folders."""
    code = {name for path in FILES for name in split_source(path.read_text())[1]}
    parts = {part for path in FILES for part in path.relative_to(ROOT).with_suffix("").parts}
    return {*dir(builtins), *keyword.kwlist} | FOREIGN | code | parts


def find_unknown_names(source: str) -> list[str]:
    """Names in backticks in the docstrings and comments of a file that nothing defines or uses."""
    text, words = split_source(source)
    known = list_known_names() | words
    return [name for name in NAME.findall(text) if not set(filter(None, name.split("."))) <= known]


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
