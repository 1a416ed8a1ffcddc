"""Files that a command writes for its user."""
from __future__ import annotations

from pathlib import Path

from plant.errors import InputError


def write_text(path: str | Path, text: str, option: str = "--out") -> None:
    """Write a text file in UTF-8 where `option` says.

    Raises:
        InputError: a path that cannot be written.
    """
    try:
        Path(path).write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(option, str(path), f"a file that can be written ({error.strerror})") from error
