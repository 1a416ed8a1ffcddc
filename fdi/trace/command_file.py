"""Command files: the demand of a test, and the load on the plant, as columns of a CSV text."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fdi.trace.csv_table import (
    Layout,
    is_comment,
    open_text,
    read_columns,
    report_unreadable,
    require_growth,
    split_line,
)
from plant import EHA, LONGEST, RATE, Array, InputError, Signal, Signals, read_file, require, resample_on_cycles


def read_command(path: str | Path, period: float = 1 / RATE, signals: Signals = EHA) -> tuple[Array, Array | None]:
    """Command and load, None without such a column, of a file: CSV (or .csv.gz) in SI units.

    Its columns are t and those of the plant's signals, of the EHA com and load. One value per cycle of `period` s, as
    `resample_on_cycles` makes it.

    Raises:
        InputError: the file, the line and what was expected there.
    """
    columns = parse_columns(read_file(Path(path)), path, period, signals)
    require("com" in columns, path, "line 1", f"a header with the columns t and {signals.command.name}")
    return columns["com"], columns.get("load")


def parse_columns(data: bytes, where: object, period: float = 1 / RATE, signals: Signals = EHA) -> dict[str, Array]:
    """The columns com, value and load of a CSV text, those that it has, one value per cycle from its first row.

    com and load stand for the command and the load of the plant's `signals`, by whose names the text has them.

    Rows need not be one cycle apart: see `resample_on_cycles`. Other columns are ignored, so a trace is a command too.

    Raises:
        InputError: a value that is no finite number, or times that do not increase.
    """
    with report_unreadable(where, "CSV in UTF-8, plain or gzip-compressed"), open_text(data) as stream:
        titles = [title.lower() for title in split_line(stream.readline(), ",")]
    require("t" in titles, where, "line 1", "a header with a column t and commas between columns")
    load = signals.load
    plain = Signal("", "", "", "")
    candidates = [("t", "t", plain), ("com", signals.command.name, signals.command), ("value", "value", plain),
                  *([("load", load.name, load)] if load else [])]
    matches = [(key, name.lower(), signal) for key, name, signal in candidates if name.lower() in titles]
    columns = read_columns(data, Layout("utf-8-sig", ",", ".", tuple(titles), 1, 2), [name for _, name, _ in matches],
                           where=where)
    t = columns["t"]
    require_growth(t, where, "t")
    _refuse_row(data, where, "t", t, t - t[0] > LONGEST, f"seconds, and at most {LONGEST:g} of them")
    for _, name, signal in matches:
        _refuse_row(data, where, name, columns[name], ~np.isfinite(columns[name]), "a finite number")
        _refuse_row(data, where, name, columns[name], np.abs(columns[name]) > signal.largest,
                    f"at most {signal.largest:g} {signal.unit} either way")
    return {key: resample_on_cycles(t, columns[name], period) for key, name, _ in matches if key != "t"}


def _refuse_row(data: bytes, where: object, name: str, column: Array, is_bad: NDArray[np.bool_], expected: str) -> None:
    if is_bad.any():
        row = int(is_bad.argmax())
        with open_text(data) as stream:  # rows are not lines: comments and empty lines stand between them
            lines = [number for number, text in enumerate(stream, 1) if number > 1 and not is_comment(text)]
        raise InputError(where, f"line {lines[row]}, {name}", f"{expected}, not {column[row]:g}")
