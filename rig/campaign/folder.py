"""The folder of a campaign.

    campaign.json      the matrix, and a hash of the code; a folder belongs to one campaign
    finished.jsonl     one row per finished case (see `rig.campaign.batch`)
    results.parquet    all rows in the matrix's order; replaced as a whole
"""
from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from plant.errors import InputError
from rig.campaign.batch import Row, RowFile, import_extra, read_rows
from rig.campaign.matrix import Matrix, restore_matrix

MATRIX, ROWS, RESULTS = "campaign.json", "finished.jsonl", "results.parquet"
PART = ".part"


def open_campaign(path: str | Path, matrix: Matrix, sources: str) -> RowFile:
    """Open the rows of a campaign's folder for writing by one process at a time; an empty folder becomes its own.

    Raises:
        InputError: the folder belongs to another matrix or to something else, the code has changed since the campaign
            was started, another process is at work in it, or it cannot be written.
    """
    folder = Path(path)
    expected = json.loads(json.dumps({"matrix": matrix.spec, "code": sources}))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if is_campaign_folder(folder):
            present = _read_campaign(folder)
            changed = [key for key in {**present["matrix"], **expected["matrix"]}
                       if present["matrix"].get(key) != expected["matrix"].get(key)]
            if changed:
                raise InputError(path, "--out", "a folder of this matrix, or a new one; it differs in "
                                                f"{', '.join(changed)}")
            if present["code"] != sources:
                raise InputError(path, "--out", "a new folder: the code has changed since this campaign was started")
        elif any(not file.name.endswith(PART) for file in folder.iterdir()):
            raise InputError(path, "--out", "an empty folder, or one of this campaign")
        else:
            replace_file(folder / MATRIX, (json.dumps(expected, indent=1) + "\n").encode())
    except OSError as error:
        raise InputError(path, "", f"a folder that can be written ({error.strerror})") from error
    return RowFile(folder / ROWS)


def is_campaign_folder(folder: str | Path) -> bool:
    """Whether the folder is one of a campaign."""
    return (Path(folder) / MATRIX).is_file()


def read_matrix_of_folder(folder: str | Path) -> Matrix:
    """The matrix of a campaign's folder. Raises InputError."""
    return restore_matrix(_read_campaign(Path(folder))["matrix"])


def read_campaign_rows(source: str | Path) -> list[Row]:
    """The rows of a campaign's folder, finished or not, or of a results.parquet, in the matrix's order.

    Raises:
        InputError: there is no such campaign.
    """
    path = Path(source)
    if path.is_dir() and is_campaign_folder(path):
        return select_newest(read_rows(path / ROWS))
    if path.suffix != ".parquet" or not path.is_file():
        raise InputError(source, "", f"the folder of a campaign, or its {RESULTS}")
    parquet = import_extra("pyarrow.parquet")
    try:
        rows: list[Row] = parquet.read_table(path).to_pylist()
    except (OSError, ValueError) as error:
        raise InputError(source, "", f"a Parquet file ({error})") from None
    return [{key: value for key, value in row.items() if value is not None} for row in rows]


def write_results(folder: str | Path, rows: Iterable[Row]) -> None:
    """Replace results.parquet by one with the newest row of each case; the matrix goes into its schema."""
    pa, parquet = import_extra("pyarrow"), import_extra("pyarrow.parquet")
    path, newest = Path(folder) / RESULTS, select_newest(rows)
    names = list(dict.fromkeys(name for row in newest for name in row))
    table = pa.table({name: pa.array([row.get(name) for row in newest]) for name in names})
    table = table.replace_schema_metadata({"campaign": json.dumps(_read_campaign(Path(folder)))})
    part = path.with_name(path.name + PART)
    parquet.write_table(table, part)
    part.replace(path)


def replace_file(path: Path, data: bytes) -> None:
    """Write a file as a whole: a reader sees the old content or the new one. Raises InputError."""
    part = path.with_name(path.name + PART)
    try:
        with part.open("wb") as out:
            out.write(data)
            out.flush()
            os.fsync(out.fileno())
        part.replace(path)
    except PermissionError as error:
        raise InputError(path, "", f"a place that can be written ({error.strerror})") from None


def _read_campaign(folder: Path) -> dict[str, Any]:
    """The content of campaign.json. Raises InputError."""
    try:
        content = json.loads((folder / MATRIX).read_text(encoding="utf-8"))
        return {"matrix": content["matrix"], "code": content["code"]}
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(folder / MATRIX, "", f"the matrix of a campaign ({type(error).__name__})") from None


def select_newest(rows: Iterable[Row]) -> list[Row]:
    """The last row of each case, ordered by its number."""
    newest = {row["case"]: row for row in rows if "case" in row}
    return [newest[number] for number in sorted(newest)]
