"""When a trace was recorded: by a table dates.csv, the log itself, or an ISO date in the name of file or folder.

An axis other than the calendar (operating hours, flights) comes from the table alone. The age of a file does not count.
"""
from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from plant.errors import InputError

TABLE = "dates.csv"
AXES = {"date": "days", "hours": "h", "flights": "flights"}  # axis: its unit
_DATE = re.compile(r"(?<!\d)(\d{4})-?([01]\d)-?([0-3]\d)(?:[T_ ]([0-2]\d)[-:]?([0-5]\d)(?:[-:]?([0-5]\d))?)?(?!\d)")
_OFFSET = re.compile(r"([+-])(\d\d):?(\d\d)$")


class Row(NamedTuple):
    """The table's entries for a file; NaN where it has none."""

    date: float  # days since 1970-01-01, UTC
    hours: float
    flights: float


def parse_date(text: str) -> float:
    """An ISO date or time, UTC unless it names an offset, as days since 1970-01-01; NaN for any other text.

    >>> parse_date("1970-01-02"), parse_date("1970-01-01T12:00:00-12:00"), parse_date("soon")
    (1.0, 1.0, nan)
    """
    text = text.strip().removesuffix("Z")
    offset = _OFFSET.search(text) if "T" in text or " " in text else None
    late = 0.0
    if offset:
        sign, hours, minutes = offset.groups()
        late = float(f"{sign}1") * (int(hours) * 60 + int(minutes)) / 1440
        text = text[:offset.start()]
    try:
        found = np.datetime64(text.strip(), "s") if re.match(r"\d{4}-\d\d-\d\d", text) else np.datetime64("NaT")
    except ValueError:
        return math.nan
    return math.nan if np.isnat(found) else float(found.astype(float)) / 86400 - late


def format_day(day: float) -> str:
    """The date of a day since 1970-01-01.

    >>> format_day(20454.7)
    '2026-01-01'
    """
    return str(np.datetime64(math.floor(day), "D"))


def find_date_in_name(path: Path) -> float:
    """The date in a file's name, or in that of the nearest folder that has one, days since 1970-01-01; else NaN.

    >>> find_date_in_name(Path("unit7/2026-01-02/trace.mcap")) - parse_date("2026-01-01")
    1.0
    """
    for part in reversed(path.parts):
        for y, m, d, *clock in _DATE.findall(part):
            hour = "T" + ":".join(word or "00" for word in clock) if clock[0] else ""
            found = parse_date(f"{y}-{m}-{d}{hour}")
            if not math.isnan(found):
                return found
    return math.nan


def read_dates_table(path: Path) -> dict[str, Row]:
    """The table FILE,date[,hours][,flights] with a header: file, as written there, to its row.

    Raises:
        InputError: columns missing, an invalid date or number, or a file listed twice.
    """
    try:
        rows = list(csv.reader(path.read_text(encoding="utf-8-sig").splitlines()))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, "", f"a table file,date ({error})") from error
    head = [word.strip().lower() for word in rows[0]] if rows else []
    if "file" not in head or not set(AXES) & set(head):
        raise InputError(path, "header", "file and one or more of date, hours, flights")
    found: dict[str, Row] = {}
    for number, words in enumerate(rows[1:], 2):
        cells = dict(zip(head, (word.strip() for word in words), strict=False))
        name = cells.get("file", "").removeprefix("./")
        if not name:
            continue
        if name in found:
            raise InputError(f"{path}: line {number}", "file", f"each file once, not {name} again")
        found[name] = Row(*(_read_cell(f"{path}: line {number}", axis, cells.get(axis, "")) for axis in AXES))
    return found


def _read_cell(where: str, axis: str, text: str) -> float:
    if not text:
        return math.nan
    try:
        value = parse_date(text) if axis == "date" else float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        kind = "an ISO date such as 2026-01-31" if axis == "date" else "a number"
        raise InputError(where, axis, f"{kind}, not {text}")
    return value


def find_row(table: Mapping[str, Row], name: str) -> Row | None:
    """The table's row of a trace by its path in the folder, POSIX; its folder, file name or stem will do, too."""
    path = Path(name)
    for key in (name, str(path.parent), path.name, path.name.partition(".")[0]):
        if key in table:
            return table[key]
    return None
