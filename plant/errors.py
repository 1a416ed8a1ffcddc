"""Errors that the user can correct, each shown as one line; and words that messages share."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Self


class RigError(Exception):
    """An error that the user can correct; the command shows it as one line and exits with `status`."""

    status = 2


class InputError(RigError):
    """A value that cannot be used: the file or option it is in, its field, and what was expected.

    >>> str(InputError("model.toml", "spool.mass", "a number above 0 kg, not -1"))
    'model.toml: spool.mass: expected a number above 0 kg, not -1'
    """

    def __init__(self, where: object, field: str, expected: str) -> None:
        self.where, self.field, self.expected = str(where), field, expected
        super().__init__(f"{where}: {field}: expected {expected}" if field else f"{where}: expected {expected}")

    def __reduce__(self) -> tuple[type[Self], tuple[str, str, str]]:
        """As a worker process hands it on."""
        return type(self), (self.where, self.field, self.expected)


def require(holds: object, where: object, field: str, expected: str) -> None:
    """Refuse input unless what it must be `holds`; `expected` says what that is.

    Raises:
        InputError: it does not.
    """
    if not holds:
        raise InputError(where, field, expected)


@contextmanager
def report_system_error(where: object, field: str, expected: str) -> Iterator[None]:
    """Turn what the system refuses within into bad input, with the system's own words."""
    try:
        yield
    except OSError as error:
        raise InputError(where, field, f"{expected} ({error.strerror or error})") from error


def escape_control_characters(text: str) -> str:
    r"""`text` with its control characters as in Python source: printed, they would command the terminal.

    >>> escape_control_characters("a" + chr(27) + "[2Jb")
    'a\\x1b[2Jb'
    """
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def show_value(value: object) -> str:
    """A wrong value as in Python source, for a message: of a long one the beginning.

    >>> show_value(1), show_value("x" * 300)[-9:], show_value(1 << 99999)
    ('1', 'xxxxxx...', 'a huge value')
    """
    try:
        return f"{text[:200]}..." if len(text := repr(value)) > 200 else text
    except (ValueError, RecursionError):  # a whole number of thousands of digits, tables of as many levels
        return "a huge value"


def count_nouns(count: int, noun: str, plural: str = "") -> str:
    """A count and its noun; `plural` where an "s" does not make it.

    >>> count_nouns(1, "repeat"), count_nouns(3, "cycle"), count_nouns(2, "bench", "benches")
    ('1 repeat', '3 cycles', '2 benches')
    """
    return f"{count} {noun if count == 1 else plural or f'{noun}s'}"


def suggest_name(word: str, names: Iterable[str], similarity: float = 0.6) -> str:
    """The end of a message about an unknown name: the nearest of `names`, or "" if none is near.

    >>> suggest_name("spol_friction", ["jack_friction", "spool_friction"])
    '; did you mean spool_friction?'
    """
    from difflib import get_close_matches  # only a mistake needs it

    near = get_close_matches(word, names, 1, similarity)
    return f"; did you mean {near[0]}?" if near else ""
