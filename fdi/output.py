"""Where a result is to go: asked before long work is done, and before anything that lies there is lost; or written."""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from plant import InputError, report_system_error, require


def require_writable(out: str | Path, option: str, *, source: str | Path | None = None) -> Path:
    """`out`, if a file can be written there; what lies there stays as it is until the result comes.

    Folders are not made. Raises InputError for a place that cannot be written, and for the `source` itself.
    """
    path = Path(out)
    with report_system_error(option, str(path), "a place that can be written"):
        is_present = path.exists()
        if is_present and source is not None and Path(source).exists() and path.samefile(source):
            raise InputError(option, str(path), "another file than the one that is read")
        path.open("ab").close()
    if not is_present:
        path.unlink()
    return path


def write_text(path: str | Path, text: str, option: str = "--out") -> None:
    """Write a text file in UTF-8 where `option` says.

    Raises:
        InputError: a path that cannot be written.
    """
    _write_bytes(path, text.encode(), option)


def _write_bytes(path: str | Path, content: bytes, option: str) -> None:
    with report_system_error(option, str(path), "a file that can be written"), write_whole(path) as part:
        part.write_bytes(content)


def replace_text(path: str | Path, text: str) -> Path | None:
    """Write a text file; return where the one that was there before is now (suffix .bak), None if there was none.

    Raises:
        InputError: a path that cannot be written.
    """
    path, backup = Path(path), None
    if path.exists() and path.read_bytes():
        backup = path.with_name(path.name + ".bak")
        _write_bytes(backup, path.read_bytes(), "--out")  # whatever its encoding is
    write_text(path, text)
    return backup


@contextlib.contextmanager
def write_whole(path: str | Path) -> Iterator[Path]:
    """Give the path of a file or folder to make, which takes the place of `path` at the end, if nothing went wrong.

    On a full disk, or after Ctrl-C, `path` is what it was before, and no part of it is left. A folder may only replace
    an empty one. A device or pipe, and what lies in a folder that takes no new files, are written in place.
    """
    place = Path(os.path.realpath(path))
    can_be_replaced = place.is_file() or (place.is_dir() and not place.is_mount()) or not place.exists()
    if not can_be_replaced or not os.access(place.parent, os.W_OK):
        yield place
        return
    part = place.with_name(f".part-{os.getpid()}-{place.name[-50:]}")  # the suffix stays: it chooses the format
    try:
        yield part
        if place.exists():
            part.chmod(place.stat().st_mode & 0o7777)
        part.replace(place)
    except BaseException as error:
        if isinstance(error, OSError) and error.filename in (None, str(part)):
            error.filename = str(path)  # a full disk names none, and no one knows the part
        if part.is_dir():
            shutil.rmtree(part)
        part.unlink(missing_ok=True)
        raise


def require_new(out: str | Path, option: str = "--out", *, is_forced: bool) -> Path:
    """`out` of an option, if no file is there or --force allows to replace it.

    Raises:
        InputError: there is a file.
    """
    path = Path(out)
    require(is_forced or not path.is_file(), option, str(path),
            "a file that does not exist yet; --force replaces this one")
    return path
