"""What can go wrong with what a user gives us: one class, one line."""
from __future__ import annotations


class RigError(Exception):
    """Something the user can mend; the command shows it as one line and exits with `status`."""

    status = 2


class InputError(RigError):
    """A value that cannot be used: where it stands, which field, what was expected.

    >>> str(InputError("model.toml", "spool.mass", "a number above 0 kg, not -1"))
    'model.toml: spool.mass: expected a number above 0 kg, not -1'
    """

    def __init__(self, where: object, field: str, expected: str) -> None:
        self.where, self.field, self.expected = str(where), field, expected
        super().__init__(f"{where}: {field}: expected {expected}" if field else f"{where}: expected {expected}")

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        """As a worker process hands it on."""
        return type(self), (self.where, self.field, self.expected)


def escape_control_characters(text: str) -> str:
    r"""`text` with its control characters as in Python source: printed, they would command the terminal.

    >>> escape_control_characters("a" + chr(27) + "[2Jb")
    'a\\x1b[2Jb'
    """
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
