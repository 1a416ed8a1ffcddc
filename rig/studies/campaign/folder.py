"""The folder of a campaign: what it is, a line for each finished case at once, and all of them as Parquet at the end.

    campaign.json      the matrix, and the code it was begun with; a folder belongs to one campaign
    finished.jsonl     one row a finished case, on disk before the next; a line that a kill cut does not count
    results.parquet    all rows in the matrix's order, written whole or not at all
"""
from __future__ import annotations

import contextlib
import fcntl
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from plant.errors import InputError
from rig.studies.campaign.case import FAILED, Row
from rig.studies.campaign.matrix import Matrix, of_spec

MATRIX, JOURNAL, RESULTS = "campaign.json", "finished.jsonl", "results.parquet"
PART = ".part"


def is_campaign(folder: str | Path) -> bool:
    """Whether a campaign lives there."""
    return (Path(folder) / MATRIX).is_file()


def matrix_of(folder: str | Path) -> Matrix:
    """The matrix of a campaign's folder. Raises InputError."""
    return of_spec(_known(Path(folder))["matrix"])


class Folder:
    """A campaign's folder, held for one process at a time.

    Raises:
        InputError: it belongs to another matrix or to something else, the code has changed since, another process is
            at work in it, or it cannot be written.
    """

    def __init__(self, path: str | Path, matrix: Matrix, code: str, again: bool = False) -> None:
        self.path = Path(path)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            self._claim(matrix, code)
            self._journal = (self.path / JOURNAL).open("a+", encoding="utf-8")
        except OSError as error:
            raise InputError(path, "", f"a folder that can be written ({error.strerror})") from error
        try:
            fcntl.flock(self._journal, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._journal.close()
            raise InputError(path, "", "a folder in which no other rig campaign is at work") from None
        known = _rows(self.path / JOURNAL)
        self.rows: dict[int, Row] = {row["case"]: row for row in known if not (again and row["status"] == FAILED)}
        _end_cut_line(self.path / JOURNAL, self._journal)

    def __enter__(self) -> Folder:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
                 ) -> None:
        self._journal.close()

    def _claim(self, matrix: Matrix, code: str) -> None:
        mine = json.loads(json.dumps({"matrix": matrix.spec, "code": code}))
        if is_campaign(self.path):
            theirs = _known(self.path)
            if theirs["matrix"] != mine["matrix"]:
                changed = _difference(theirs["matrix"], mine["matrix"])
                raise InputError(self.path, "--out", f"a folder of this matrix or a new one; there, {changed} differs")
            if theirs["code"] != code:
                raise InputError(self.path, "--out", "a new folder: the code has changed since this campaign was begun")
            return
        if any(not name.name.endswith(PART) for name in self.path.iterdir()):
            raise InputError(self.path, "--out", "an empty folder or one of this campaign")
        replaced(self.path / MATRIX, (json.dumps(mine, indent=1) + "\n").encode())

    def add(self, row: Row) -> None:
        """Keep a finished case, come what may."""
        self._journal.write(json.dumps(row) + "\n")
        self._journal.flush()
        os.fsync(self._journal.fileno())
        self.rows[row["case"]] = row

    def finish(self) -> Path:
        """Write all rows so far as Parquet; where."""
        write_parquet(self.path / RESULTS, [self.rows[number] for number in sorted(self.rows)], _known(self.path))
        return self.path / RESULTS


def read_rows(source: str | Path) -> list[Row]:
    """The rows of a campaign's folder, finished or not, or of its results.parquet alone, in the matrix's order.

    Raises:
        InputError: there is no such campaign.
    """
    path = Path(source)
    if path.is_dir() and is_campaign(path):
        newest = {row["case"]: row for row in _rows(path / JOURNAL)}
        return [newest[number] for number in sorted(newest)]
    if path.suffix != ".parquet" or not path.is_file():
        raise InputError(source, "", f"the folder of a campaign, or its {RESULTS}")
    parquet = arrow()[1]
    try:
        found: list[Row] = parquet.read_table(path).to_pylist()
    except (OSError, ValueError) as error:
        raise InputError(source, "", f"a Parquet file ({error})") from None
    return [{key: value for key, value in row.items() if value is not None} for row in found]


def write_parquet(path: Path, rows: Iterable[Row], about: Mapping[str, Any]) -> None:
    """The rows as a Parquet file, with `about` in its metadata; whole or not at all."""
    pa, parquet = arrow()
    listed = list(rows)
    names = list(dict.fromkeys(name for row in listed for name in row))
    table = pa.table({name: pa.array([row.get(name) for row in listed]) for name in names})
    table = table.replace_schema_metadata({"campaign": json.dumps(about)})
    part = path.with_name(path.name + PART)
    parquet.write_table(table, part)
    part.replace(path)


def arrow() -> tuple[Any, Any]:
    """pyarrow and pyarrow.parquet.

    Raises:
        InputError: they are not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise InputError("pyarrow", "", "the extra: pip install 'eha-rig[fleet]'") from None
    return pyarrow, pyarrow.parquet


def replaced(path: Path, data: bytes) -> None:
    """Write a file whole or not at all."""
    part = path.with_name(path.name + PART)
    try:
        with part.open("wb") as out:
            out.write(data)
            out.flush()
            os.fsync(out.fileno())
        part.replace(path)
    except PermissionError as error:
        raise InputError(path, "", f"a place that can be written ({error.strerror})") from None


def _known(folder: Path) -> dict[str, Any]:
    try:
        found: dict[str, Any] = json.loads((folder / MATRIX).read_text(encoding="utf-8"))
        return {"matrix": found["matrix"], "code": found["code"]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(folder / MATRIX, "", f"the matrix of a campaign ({type(error).__name__})") from None


def _rows(path: Path) -> list[Row]:
    found = []
    if path.exists():
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            with contextlib.suppress(json.JSONDecodeError):  # cut by a kill
                found.append(json.loads(line))
    return [row for row in found if isinstance(row, dict) and "case" in row]


def _end_cut_line(path: Path, journal: Any) -> None:
    with path.open("rb") as file:
        if file.seek(0, os.SEEK_END):
            file.seek(-1, os.SEEK_END)
            if file.read(1) != b"\n":
                journal.write("\n")
                journal.flush()


def _difference(one: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    changed = [key for key in {**one, **other} if one.get(key) != other.get(key)]
    return ", ".join(changed)
