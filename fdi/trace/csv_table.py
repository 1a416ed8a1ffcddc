"""A trace as plain CSV: SI units, one row per cycle, empty fields for missing samples."""
from __future__ import annotations

import csv
import gzip
import io
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from plant.errors import InputError

Floats = NDArray[np.float64]


def read_csv(path: Path, required: Iterable[str], optional: Iterable[str],
             separator: str = ",") -> tuple[dict[str, Floats], tuple[str, ...]]:
    """-> the known columns, shape (rows,), NaN where a field is empty; and the names of columns that are not known.

    Raises InputError naming the line for anything but numbers, and for t that does not grow.
    """
    try:
        with open_text(path) as stream:
            return _parse(path, csv.reader(stream, delimiter=separator), tuple(required), tuple(optional))
    except UnicodeDecodeError as error:
        raise InputError(path, "", "a text file (UTF-8)") from error
    except (OSError, EOFError) as error:
        raise InputError(path, "", f"a readable file ({getattr(error, 'strerror', None) or error})") from error


def write_csv(path: Path, columns: Mapping[str, Floats]) -> None:
    """Write columns, shape (rows,) each; values survive a round trip exactly; `.gz` compresses, with no time inside."""
    names = list(columns)
    rows = (",".join("" if math.isnan(v) else repr(v) for v in row)
            for row in zip(*(columns[name].tolist() for name in names), strict=True))
    text = "\n".join([",".join(names), *rows]) + "\n"
    raw = text.encode()
    try:
        path.write_bytes(gzip.compress(raw, mtime=0) if path.suffix == ".gz" else raw)
    except OSError as error:
        raise InputError(path, "", f"a place that can be written ({error.strerror})") from error


def open_text(path: Path) -> io.TextIOBase:
    """A text file, unpacked if it is a `.gz`."""
    if path.suffix == ".gz":
        return io.TextIOWrapper(gzip.open(path), encoding="utf-8-sig", newline="")
    return path.open(encoding="utf-8-sig", newline="")


def _parse(path: Path, rows: Iterator[list[str]], required: tuple[str, ...],
           optional: tuple[str, ...]) -> tuple[dict[str, Floats], tuple[str, ...]]:
    header = [name.strip() for name in next(rows, [])]
    for name in required:
        if name not in header:
            raise InputError(f"{path}: line 1", name,
                             f"a column of this name in the header {','.join([*required, *optional])}")
    if len(set(header)) < len(header):
        raise InputError(f"{path}: line 1", "header", "each column once")
    known = [(i, name) for i, name in enumerate(header) if name in required or name in optional]
    values: list[list[float]] = [[] for _ in known]
    last = -math.inf
    for line, row in enumerate(rows, 2):
        if not row:
            continue
        if len(row) != len(header):
            raise InputError(f"{path}: line {line}", "", f"{len(header)} fields as in the header, not {len(row)}")
        for out, (i, name) in zip(values, known, strict=True):
            out.append(_number(path, line, name, row[i]))
            if name == "t":
                if not out[-1] > last:
                    raise InputError(f"{path}: line {line}", "t", f"a time after {last:g} s, not {row[i]!r}")
                last = out[-1]
    if not values[0]:
        raise InputError(path, "", "at least one row after the header")
    return ({name: np.array(column) for column, (_, name) in zip(values, known, strict=True)},
            tuple(name for name in header if name not in required and name not in optional))


def _number(path: Path, line: int, name: str, text: str) -> float:
    try:
        value = float(text) if text.strip() else math.nan
    except ValueError:
        value = math.inf
    if math.isinf(value):
        raise InputError(f"{path}: line {line}", name, f"a finite number or an empty field, not {text!r}")
    return value
