"""Where a result is to go: asked before long work is done, and before anything that lies there is lost; or written."""
from __future__ import annotations

from pathlib import Path

from plant.errors import InputError


def require_writable(out: str | Path, field: str, *, source: str | Path | None = None) -> Path:
    """`out`, if a file can be written there; what lies there stays as it is until the result comes.

    Folders are not made. Raises InputError for a place that cannot be written, and for the `source` itself.
    """
    path = Path(out)
    there = path.exists()
    if there and source is not None and Path(source).exists() and path.samefile(source):
        raise InputError(path, field, "another file than the one that is read")
    try:
        with path.open("ab"):
            pass
    except OSError as error:
        raise InputError(path, field, f"a place that can be written ({error.strerror})") from error
    if not there:
        path.unlink()
    return path


def write_text(path: str | Path, text: str, option: str = "--out") -> None:
    """Write a text file in UTF-8 where `option` says.

    Raises:
        InputError: a path that cannot be written.
    """
    try:
        Path(path).write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(option, str(path), f"a file that can be written ({error.strerror})") from error
