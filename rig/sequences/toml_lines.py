"""On which line each value of a TOML text stands: `tomllib` does not say, and a refusal should.

Only for text that tomllib has accepted: the scanner follows the brackets and does not check the grammar.
"""
from __future__ import annotations

import re
from typing import NamedTuple

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
