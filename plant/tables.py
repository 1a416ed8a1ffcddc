"""Reads TOML text into frozen dataclasses. Errors name file and line, key, and what was expected there.

The dataclass is the schema: its fields are the keys, its annotations the types (`Annotated[float, "s"]` adds the unit,
`Annotated[float, Quantity("s", low=0)]` unit and range), its defaults say what may be left out. A base class whose
kinds are told apart by the key `kind` is read by the table of kinds given for it. A field with metadata {"key": False}
is the program's own, not a key; one with the name `kind` gets the kind.
"""

import json
import re
import tomllib
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import MISSING, dataclass, field, fields, replace
from difflib import get_close_matches
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Self, TypeVar, Union, get_args, get_origin, get_type_hints

from plant.errors import InputError, report_system_error, show_value
from plant.quantity import Quantity

T = TypeVar("T")
Kinds = Mapping[type, Mapping[str, type]]  # base class -> {kind: class with its keys}


class Choice(NamedTuple):
    """Names that a text of a file may have, asked when it is read; the aliases are other words for some of them."""

    list_names: Callable[[], tuple[str, ...]]
    list_aliases: Callable[[], Mapping[str, str]] = dict

    @property
    def expected(self) -> str:
        """The names in words."""
        return list_choices(None, self.list_names())

    def convert(self, value: object) -> str | None:
        """The name that a value stands for; None if it stands for none."""
        name = self.list_aliases().get(value, value) if isinstance(value, str) else value
        return name if isinstance(name, str) and name in self.list_names() else None


@dataclass(frozen=True)
class Place:
    """Where a value stands: a file with its text, and the keys that lead to it ("main[3].time")."""

    file: str
    text: str = field(default="", repr=False)
    keys: str = ""

    def at(self, *keys: str | int) -> Self:
        """The place below this one."""
        path = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys)
        return replace(self, keys=(self.keys + path).lstrip("."))

    def refuse(self, expected: str) -> InputError:
        """The error to raise for the value at this place, with the line of the nearest key that has one."""
        line = find_line(self.text, self.keys)
        return InputError(f"{self.file}:{line}" if line else self.file, self.keys, expected)

    def require(self, holds: object, expected: str) -> None:
        """Refuse the value at this place unless what it must be `holds`. Raises InputError."""
        if not holds:
            raise self.refuse(expected)

    @contextmanager
    def locate(self, *, has_field: bool = False) -> Iterator[None]:
        """Turn an InputError raised within into one at this place, or, with `has_field`, at its field below."""
        try:
            yield
        except InputError as error:
            place = self.at(error.field) if has_field and error.field else self
            raise place.refuse(error.expected) from error


def quote_text(text: str) -> str:
    r"""A text as TOML writes it.

    >>> print(quote_text("a \"b\" " + chr(0x1d6fc) + chr(127)))
    "a \"b\" \U0001d6fc\u007f"
    """
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")  # a JSON text is TOML but for this


def read_file(path: Path) -> bytes:
    """The content of a file; raises InputError if it cannot be read."""
    with report_system_error(path, "", "a file that can be read"):
        return path.read_bytes()


def decode_text(data: bytes, name: object) -> str:
    """The text of a file; raises InputError if it is not UTF-8."""
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(name, "", "text in UTF-8") from error


def parse_table(text: str, file: str) -> tuple[dict[str, Any], Place]:
    """The tables of a TOML text and the place of its root; InputError with the line if it is not TOML."""
    try:
        tables = tomllib.loads(text)
        if _measure_depth(tables) > DEEPEST:
            raise RecursionError
        return tables, Place(file, text)
    except tomllib.TOMLDecodeError as error:
        match = re.fullmatch(r"(.*) \(at (?:line (\d+), column \d+|end of document)\)", str(error), re.DOTALL)
        message, line = (match[1], match[2] or text.count("\n") + 1) if match else (str(error), 1)
        raise InputError(f"{file}:{line}", "", f"TOML; {message[:1].lower()}{message[1:]}") from error
    except ValueError as error:  # of tomllib too: Python reads no decimal number that is longer
        raise InputError(file, "", "TOML with whole numbers of at most 4300 digits") from error
    except RecursionError as error:
        raise InputError(file, "", "TOML with fewer levels of brackets or parts of a key") from error


def build_dataclass(cls: type[T], table: object, place: Place, kinds: Kinds | None = None, **constants: Any) -> T:
    """A `cls` from the table at `place`; raises InputError for a key or value it cannot be made from.

    `constants`: fields that are no keys.
    """
    kinds = kinds or {}
    if not isinstance(table, dict):
        raise place.refuse("a table")
    pairs = dict(table)
    if cls in kinds:
        kind = pairs.pop("kind", None)
        if not isinstance(kind, str) or kind not in kinds[cls]:
            raise (place.at("kind") if kind is not None else place).refuse(f"a kind: {list_choices(kind, kinds[cls])}")
        cls = kinds[cls][kind]
        constants |= {f.name: kind for f in fields(cls) if f.name == "kind"}  # type: ignore[arg-type]
    hints = get_type_hints(cls, include_extras=True)
    keys = {f.name: f for f in fields(cls) if f.metadata.get("key", True)}  # type: ignore[arg-type]
    for key in pairs:
        if key not in keys:
            raise place.at(key).refuse(f"a key: {list_choices(key, keys)}")
    for key, f in keys.items():
        if key not in pairs and f.default is MISSING and f.default_factory is MISSING:
            raise place.refuse(f"also the key {key!r}, {describe_annotation(hints[key])}")
    values = {key: _convert(value, hints[key], place.at(key), kinds) for key, value in pairs.items()}
    with place.locate(has_field=True):  # the class knows what is wrong with which field, not where it stands
        return cls(**constants, **values)


def list_choices(word: object, choices: Iterable[str]) -> str:
    """The words that would have done in place of `word`, and the one that was probably meant.

    >>> list_choices("hodl", ["hold", "step"])
    "'hold' or 'step', not 'hodl' (did you mean 'hold'?)"
    """
    names = sorted(choices)
    listing = " or ".join(filter(None, (", ".join(map(repr, names[:-1])), "".join(map(repr, names[-1:])))))
    if word is None:
        return listing
    close = get_close_matches(word, [n for n in names if isinstance(n, str)], 1) if isinstance(word, str) else []
    return f"{listing}, not {show_value(word)}" + (f" (did you mean {close[0]!r}?)" if close else "")


def _convert(value: Any, hint: Any, place: Place, kinds: Kinds) -> Any:
    """`value` as the annotated type, or InputError at `place`."""
    bare, *notes = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    origin, args = get_origin(bare), get_args(bare)
    for choice in (note for note in notes if isinstance(note, Choice)):
        if (name := choice.convert(value)) is None:
            raise place.refuse(list_choices(value, choice.list_names()))
        return name
    if bare in _SCALARS:
        if _is_scalar(value, bare) and not any(isinstance(note, Quantity) and note.refuses(value) for note in notes):
            return bare(value)
    elif bare is Any:
        return value
    elif origin is Literal:
        if value in args:
            return value
        raise place.refuse(list_choices(value, args))
    elif origin in (Union, UnionType):
        members = [member for member in args if member is not NoneType]
        if len(members) == 1:
            return _convert(value, members[0], place, kinds)
        for member in members:
            with suppress(InputError):  # so nobody asks for the line
                return _convert(value, member, Place(place.file), kinds)
    elif origin is tuple:
        parts = args[:1] * len(value) if isinstance(value, list) and args[-1] is Ellipsis else args
        if isinstance(value, list) and len(value) == len(parts):
            return tuple(_convert(item, part, place.at(i), kinds) for i, (item, part) in
                         enumerate(zip(value, parts, strict=True)))
    elif origin is Mapping:
        if isinstance(value, dict):
            return dict(_flatten_names(value, args[1], place, kinds))
    else:
        return build_dataclass(bare, value, place, kinds)
    raise place.refuse(f"{describe_annotation(hint)}, not {show_value(value)}")


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
    """Whether a value is of the kind; whole numbers are of 64 bits, as TOML has them, and floating ones are finite."""
    if kind is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= 1e308
    return type(value) is kind and not (isinstance(value, int) and abs(value) >= 1 << 63)


def describe_annotation(hint: Any) -> str:
    """An annotation in words: what a user should write."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        words = describe_annotation(args[0])
        note = args[1]
        if isinstance(note, Choice):
            return note.expected
        return f"{words} {note.bounds}" if isinstance(note, Quantity) else f"{words} in {note}"
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


DEEPEST = 100  # tables and arrays within each other
ENDS = ("", "]", "]]", "}]", "]}]", '"""', "'''")  # of what may be open at the end of a line


def find_line(text: str, keys: str) -> int:
    """The line, from 1, in which a TOML text has the value of these keys, or the nearest one above it; 0: it has none.

    >>> find_line("a.b = [\\n1]\\n[[c]]", "a.b[0]"), find_line("a = 1\\n[[c]]", "c[0].d"), find_line("a = 1", "b")
    (2, 2, 0)
    """
    tables, lines = tomllib.loads(text), text.split("\n")
    while not _has_value(tables, keys):
        keys = keys[:max(keys.rfind("."), keys.rfind("["), 0)]

    def is_read(count: int) -> bool:
        """Whether the value is in so many lines; where an array or text goes on behind them, it is read as if ended."""
        for stop in range(count, 0, -1):
            for end in ENDS:
                with suppress(tomllib.TOMLDecodeError):
                    return _has_value(tomllib.loads("\n".join([*lines[:stop], end])), keys)
        return False

    return bisect_left(range(1, len(lines) + 1), True, key=is_read) + 1 if keys else 0


def _has_value(value: Any, keys: str) -> bool:
    """Whether a value of TOML holds one that these keys lead to. A key may have dots and brackets in it."""
    if not keys:
        return True
    names = {f"[{i}]": item for i, item in enumerate(value)} if isinstance(value, list) else value
    return isinstance(names, dict) and any(
        _has_value(item, keys[len(name):].removeprefix(".")) for name, item in names.items()
        if keys == name or keys.startswith((f"{name}.", f"{name}[")))


def _measure_depth(value: Any) -> int:
    inner = list(value.values()) if isinstance(value, dict) else value
    return 1 + max(map(_measure_depth, inner), default=0) if isinstance(inner, list) else 0
