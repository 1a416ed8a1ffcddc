"""The position demand as data: segments or a CSV file in, one value per 1 ms cycle and named sections out."""
from __future__ import annotations

import csv
import gzip
import zlib
from collections.abc import Iterator, Sequence
from math import isfinite
from pathlib import Path
from typing import NamedTuple

import numpy as np

from plant.errors import InputError
from plant.segments import FARTHEST, LONGEST, RATE, STRONGEST, Array, Segment, require

_SANE = {"com": FARTHEST, "load": STRONGEST}  # m, N; a value is either, and judged by whoever knows which


class Section(NamedTuple):
    """A segment's place in the command: cycles start <= k < stop."""

    name: str
    kind: str
    start: int
    stop: int


class Profile(NamedTuple):
    """A command, its sections in order, and the demand reached when it ends (where the next phase starts)."""

    command: Array  # shape (cycles,), m
    sections: tuple[Section, ...]
    end: float


class Command(NamedTuple):
    """What a command file holds, one value per cycle."""

    com: Array  # m
    load: Array | None  # N, None without such a column


def names(segments: Sequence[Segment]) -> list[str]:
    """What the sections of a command are called: their own name, or kind_number with the segment's number from 1."""
    return [segment.name or f"{segment.kind}_{number}" for number, segment in enumerate(segments, 1)]


def build(segments: Sequence[Segment], start: float = 0.0) -> Profile:
    """Lay segments end to end from the demand `start` (m). No segments: an empty command that ends where it starts.

    Raises InputError when two sections have the same name.
    """
    pieces: list[Array] = [np.empty(0)]
    sections: list[Section] = []
    last, begin = start, 0
    for segment, name in zip(segments, names(segments), strict=True):
        cycles = round(segment.duration * RATE)
        demand = segment.demand(np.arange(cycles + 1) / RATE, last)
        pieces.append(demand[:-1])
        last = float(demand[-1])
        require(all(name != s.name for s in sections), "name", f"a name used once, not a second {name!r}")
        sections.append(Section(name, segment.kind, begin, begin + cycles))
        begin += cycles
    return Profile(np.concatenate(pieces), tuple(sections), last)


def read_command(path: str | Path) -> Command:
    """A command file for `rig simulate`: CSV (or .csv.gz) with columns t, com and optionally load, SI units.

    Raises InputError naming the file, the line and what was expected there.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(path, "", f"a CSV file that can be read ({error.strerror})") from error
    columns = parse_columns(data, path)
    if "com" not in columns:
        raise InputError(path, "line 1", "a header with the columns t and com")
    return Command(columns["com"], columns.get("load"))


def parse_columns(data: bytes, where: object) -> dict[str, Array]:
    """The columns com, value and load of a CSV text, as far as it has them, at one value per cycle from its first row.

    Rows that are not 1 ms apart are joined by straight lines. Other columns are ignored, so a trace is a command too.
    Raises InputError for what is not a number, not finite, or not in order of time.
    """
    rows = _rows(data, where)
    _, header = next(rows, (0, [""]))
    titles = [title.strip().lower() for title in header]
    if "t" not in titles:
        raise InputError(where, "line 1", "a header with a column t and commas between columns")
    picked: dict[str, int] = {name: titles.index(name) for name in ("t", "com", "value", "load") if name in titles}
    table = {name: np.array(values) for name, values in _numbers(rows, picked, where).items()}
    t = table.pop("t")
    grid = t[0] + np.arange(round((t[-1] - t[0]) * RATE) + 1) / RATE
    if len(grid) == len(t) and np.abs(grid - t).max() < 0.01 / RATE:
        return table
    return {name: np.interp(grid, t, values) for name, values in table.items()}


def _rows(data: bytes, where: object) -> Iterator[tuple[int, list[str]]]:
    """(line number, cells) of each row that is not blank."""
    try:
        text = (gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data).decode("utf-8-sig")
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        raise InputError(where, "", "CSV text, plain or gzip-compressed") from error
    rows = csv.reader(text.splitlines())
    return ((rows.line_num, row) for row in rows if row)


def _numbers(rows: Iterator[tuple[int, list[str]]], picked: dict[str, int], where: object) -> dict[str, list[float]]:
    """The picked columns as numbers, checked row by row so that a refusal can name the line."""
    table: dict[str, list[float]] = {name: [] for name in picked}
    t = table["t"]
    for line, row in rows:
        for name, index in picked.items():
            cell = row[index] if index < len(row) else ""
            try:
                value = float(cell)
            except ValueError:
                value = float("nan")
            if not isfinite(value):
                raise InputError(where, f"line {line}, {name}", f"a finite number, not {cell!r}")
            table[name].append(value)
        if len(t) > 1 and t[-1] <= t[-2]:
            raise InputError(where, f"line {line}, t", f"a time after {t[-2]:g} s, not {t[-1]:g}")
        if t[-1] - t[0] > LONGEST:
            raise InputError(where, f"line {line}, t", f"seconds, and at most {LONGEST:g} of them, not {t[-1]:g}")
        for name, most in _SANE.items():
            if name in table and abs(table[name][-1]) > most:
                raise InputError(where, f"line {line}, {name}", f"at most {most:g} either way, not {table[name][-1]:g}")
    if not t:
        raise InputError(where, "line 2", "at least one row below the header")
    return table
