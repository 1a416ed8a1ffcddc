"""A file of rows: one JSON object per line, one line per finished job.

Each row is on disk before the next one is written, so a kill costs at most the line that was being written. Such a
truncated line is skipped on reading, and ended before the next row is appended.
"""
from __future__ import annotations

import contextlib
import fcntl
import json
import os
from pathlib import Path
from types import TracebackType
from typing import Any

from plant.errors import InputError

Row = dict[str, Any]


class RowFile:
    """A row file opened for appending, locked against other processes.

    `rows` are the rows of the file, in the order in which they were written, including those appended since.

    Raises:
        InputError: the file cannot be written, or another process has it open.
    """

    def __init__(self, path: Path) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("a+", encoding="utf-8")
        except OSError as error:
            raise InputError(path.parent, "", f"a folder that can be written ({error.strerror})") from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._file.close()
            raise InputError(path.parent, "", "a folder in which no other rig process is at work") from None
        self.rows = read_rows(path)
        if not _ends_with_newline(path):
            self._file.write("\n")
            self._file.flush()

    def __enter__(self) -> RowFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
                 ) -> None:
        self._file.close()

    def append(self, row: Row) -> None:
        """Write a row and wait until it is on disk."""
        self._file.write(json.dumps(row) + "\n")
        self._file.flush()
        os.fsync(self._file.fileno())
        self.rows.append(row)


def read_rows(path: Path) -> list[Row]:
    """The rows of a file, without truncated lines; none if there is no such file."""
    if not path.exists():
        return []
    rows = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        with contextlib.suppress(json.JSONDecodeError, RecursionError):
            rows.append(json.loads(line))
    return [row for row in rows if isinstance(row, dict)]


def _ends_with_newline(path: Path) -> bool:
    """Whether the last line is complete; an empty file has no last line."""
    with path.open("rb") as file:
        if not file.seek(0, os.SEEK_END):
            return True
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"
