"""Reads TOML text into frozen dataclasses. Errors name file and line, key, and what was expected there.

The dataclass is the schema: its fields are the keys, its annotations the types (`Annotated[float, "s"]` adds the unit),
its defaults say what may be left out. A base class whose subclasses are told apart by the key `kind` is read by the
table of kinds given for it. A field with metadata {"key": False} is the program's own, not a key.
"""
from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import MISSING, dataclass, field, fields
from difflib import get_close_matches
from math import isfinite
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

from plant.errors import InputError

T = TypeVar("T")
Kinds = Mapping[type, Mapping[str, type]]  # base class -> {kind: subclass}


@dataclass(frozen=True)
class Place:
    """Where a value stands: a file, the keys that lead to it, and the lines of all keys."""

    file: str
    lines: Mapping[Path, int] = field(default_factory=dict, repr=False)
    keys: Path = ()

    def at(self, *keys: str | int) -> Place:
        """The place below this one."""
        return Place(self.file, self.lines, self.keys + keys)

    def refuse(self, expected: str) -> InputError:
        """The error to raise for the value at this place, with the line of the nearest key that has one."""
        known = (self.lines[self.keys[:n]] for n in range(len(self.keys), 0, -1) if self.keys[:n] in self.lines)
        line = next(known, None)
        text = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in self.keys).lstrip(".")
        return InputError(self.file if line is None else f"{self.file}:{line}", text, expected)


def parse_table(text: str, file: str) -> tuple[dict[str, Any], Place]:
    """The tables of a TOML text and the place of its root; InputError with the line if it is not TOML."""
    try:
        return tomllib.loads(text), Place(file, find_lines(text))
    except tomllib.TOMLDecodeError as error:
        found = re.fullmatch(r"(.*) \(at (?:line (\d+), column \d+|end of document)\)", str(error), re.DOTALL)
        message, line = (found[1], found[2] or text.count("\n") + 1) if found else (str(error), 1)
        raise InputError(f"{file}:{line}", "", f"TOML; {message[:1].lower()}{message[1:]}") from error
    except RecursionError as error:
        raise InputError(file, "", "TOML with fewer levels of brackets") from error


def build_dataclass(cls: type[T], table: object, place: Place, kinds: Kinds | None = None) -> T:
    """A `cls` from the table at `place`; raises InputError for a key or value it cannot be made from."""
    kinds = kinds or {}
    if not isinstance(table, dict):
        raise place.refuse("a table")
    pairs = dict(table)
    if cls in kinds:
        kind = pairs.pop("kind", None)
        if not isinstance(kind, str) or kind not in kinds[cls]:
            raise (place.at("kind") if kind is not None else place).refuse(f"a kind: {list_choices(kind, kinds[cls])}")
        cls = kinds[cls][kind]
    hints = get_type_hints(cls, include_extras=True)
    known = {f.name: f for f in fields(cls) if f.metadata.get("key", True)}  # type: ignore[arg-type]
    for key in pairs:
        if key not in known:
            raise place.at(key).refuse(f"a key: {list_choices(key, known)}")
    for key, f in known.items():
        if key not in pairs and f.default is MISSING and f.default_factory is MISSING:
            raise place.refuse(f"also the key {key!r}, {describe_annotation(hints[key])}")
    values = {key: _convert(value, hints[key], place.at(key), kinds) for key, value in pairs.items()}
    try:
        return cls(**values)
    except InputError as error:  # the class knows what is wrong with which field, not where it stands
        raise (place.at(error.field) if error.field else place).refuse(error.expected) from error


def list_choices(word: object, known: Iterable[str]) -> str:
    """The words that would have done in place of `word`, and the one that was probably meant.

    >>> one_of("hodl", ["hold", "step"])
    "'hold' or 'step', not 'hodl' (did you mean 'hold'?)"
    """
    names = sorted(known)
    listed = " or ".join(filter(None, (", ".join(map(repr, names[:-1])), "".join(map(repr, names[-1:])))))
    if word is None:
        return listed
    close = get_close_matches(str(word), names, 1)
    return f"{listed}, not {word!r}" + (f" (did you mean {close[0]!r}?)" if close else "")


def _convert(value: object, hint: Any, place: Place, kinds: Kinds) -> Any:
    """`value` as the annotated type, or InputError at `place`."""
    bare = get_args(hint)[0] if get_origin(hint) is Annotated else hint
    origin, args = get_origin(bare), get_args(bare)
    if bare in _SCALARS:
        if not _is_scalar(value, bare):
            raise place.refuse(f"{describe_annotation(hint)}, not {value!r}")
        return bare(value)
    if origin is Literal:
        if value not in args:
            raise place.refuse(list_choices(value, args))
        return value
    if origin in (Union, UnionType):
        for member in (m for m in args if m is not NoneType):
            with suppress(InputError):
                return _convert(value, member, place, kinds)
        raise place.refuse(f"{describe_annotation(hint)}, not {value!r}")
    if origin is tuple:
        members = args[:1] * len(value) if isinstance(value, list) and args[-1] is Ellipsis else args
        if not isinstance(value, list) or len(value) != len(members):
            raise place.refuse(f"{describe_annotation(hint)}, not {value!r}")
        return tuple(_convert(item, member, place.at(i), kinds) for i, (item, member) in
                     enumerate(zip(value, members, strict=True)))
    if origin is Mapping:
        if not isinstance(value, dict):
            raise place.refuse(f"{describe_annotation(hint)}, not {value!r}")
        return dict(_flatten_names(value, args[1], place, kinds))
    return build_dataclass(bare, value, place, kinds)


def _flatten_names(table: dict[str, Any], hint: Any, place: Place, kinds: Kinds,
                   prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values: `spool.travel = 1` and `"spool.travel" = 1` are the same to a user."""
    for key, item in table.items():
        if isinstance(item, dict):
            yield from _flatten_names(item, hint, place.at(key), kinds, f"{prefix}{key}.")
        else:
            yield prefix + key, _convert(item, hint, place.at(key), kinds)


_SCALARS: dict[Any, str] = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}


def _is_scalar(value: object, kind: Any) -> bool:
    if kind is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and isfinite(value)
    return type(value) is kind


def describe_annotation(hint: Any) -> str:
    """An annotation in words: what a user should write."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return f"{describe_annotation(args[0])} in {args[1]}"
    if origin is Literal:
        return list_choices(None, args)
    if origin in (Union, UnionType):
        return " or ".join(describe_annotation(member) for member in args if member is not NoneType)
    if origin is tuple:
        members = [describe_annotation(member) for member in args if member is not Ellipsis]
        return f"a list, each {members[0]}" if args[-1] is Ellipsis else f"[{', '.join(members)}]"
    if origin is Mapping:
        return f"a table of names, each with {describe_annotation(args[1])}"
    return _SCALARS.get(hint, "a table")


_MOST_PARTS = 100  # of a key
Path = tuple[str | int, ...]  # ("main", 3, "time"): key, place in the array, key

_TOKEN = re.compile(
    r"""
    (?P<skip> [ \t\r]+ | \#[^\n]* )
  | (?P<newline> \n )
  | (?P<string> \"\"\"(?:\\.|[^\\])*?\"{3,5} | '''.*?'{3,5} | "(?:\\.|[^"\\])*" | '[^']*' )
  | (?P<mark> [\[\]{},=] )
  | (?P<bare> [^\s\[\]{},="'\#]+ )
    """,
    re.DOTALL | re.VERBOSE,
)


class _Token(NamedTuple):
    kind: str
    text: str
    line: int


def find_lines(text: str) -> dict[Path, int]:
    """Line number, from 1, of every key, array element and table header.

    Raises:
        RecursionError: a key of more than 100 parts; the paths of all its parts would take a lot of memory.
    """
    scanner = _Scanner(text)
    scanner.document()
    return scanner.found


class _Scanner:
    """Walks the tokens once; `found` grows on the way."""

    def __init__(self, text: str) -> None:
        self.found: dict[Path, int] = {}
        self._tables: dict[Path, int] = {}  # how many elements an array of tables has so far
        self._tokens: list[_Token] = []
        line = 1
        for match in _TOKEN.finditer(text):
            if match.lastgroup != "skip":
                self._tokens.append(_Token(str(match.lastgroup), match.group(), line))
            line += match.group().count("\n")
        self._tokens.append(_Token("end", "", line))
        self._next = 0

    def document(self) -> None:
        prefix: Path = ()
        while not self._at("end"):
            if self._accept("\n"):
                continue
            if self._at("["):
                prefix = self._header()
            else:
                self._pair(prefix)

    def _header(self) -> Path:
        """[a.b] or [[a.b]] -> the path below which the following pairs stand."""
        line = self._take().line
        is_array = self._accept("[")
        path: Path = ()
        for part in self._key():
            path += (part,)
            if path in self._tables:
                path += (self._tables[path] - 1,)
        self._accept("]")
        self._accept("]")
        if is_array:
            path = path[:-1] if isinstance(path[-1], int) else path
            self._tables[path] = self._tables.get(path, 0) + 1
            self.found.setdefault(path, line)
            path += (self._tables[path] - 1,)
        self.found[path] = line
        return path

    def _pair(self, prefix: Path) -> None:
        line = self._tokens[self._next].line
        path = prefix
        for part in self._key():
            path += (part,)
            self.found.setdefault(path, line)
        self._accept("=")
        self._value(path)

    def _key(self) -> list[str]:
        """A key's parts: a.b and a."b" are two."""
        parts: list[str] = []
        while not (self._at("=") or self._at("]") or self._at("end")):
            token = self._take()
            parts += [token.text[1:-1]] if token.kind == "string" else [p for p in token.text.split(".") if p]
            if len(parts) > _MOST_PARTS:
                raise RecursionError(f"a key of more than {_MOST_PARTS} parts")
        return parts

    def _value(self, path: Path) -> None:
        if self._accept("["):
            index = 0
            while not (self._accept("]") or self._at("end")):
                if self._accept("\n") or self._accept(","):
                    continue
                self.found[(*path, index)] = self._tokens[self._next].line
                self._value((*path, index))
                index += 1
        elif self._accept("{"):
            while not (self._accept("}") or self._at("end")):
                if not (self._accept(",") or self._accept("\n")):
                    self._pair(path)
        else:
            while self._tokens[self._next].kind in ("string", "bare"):  # a date and its time are two tokens
                self._take()

    def _at(self, text: str) -> bool:
        token = self._tokens[self._next]
        return token.kind == "end" if text == "end" else token.kind in ("mark", "newline") and token.text == text

    def _accept(self, text: str) -> bool:
        found = self._at(text)
        self._next += found
        return found

    def _take(self) -> _Token:
        self._next += 1
        return self._tokens[self._next - 1]
