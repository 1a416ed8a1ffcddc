"""Turns segments or a CSV file into a position demand: one value per cycle, and named sections."""

import csv
from collections.abc import Iterator, Mapping, Sequence
from math import ceil, isfinite
from pathlib import Path
from typing import NamedTuple

import numpy as np

from plant.errors import InputError
from plant.segments import LONGEST, RATE, Array, Segment, require
from plant.signals import EHA, Signals
from plant.tables import read_file
from plant.unpacking import UnpackingError, unpack_gzip

SLACK = 0.01  # of a cycle: a time within it of a row is that row's


class Section(NamedTuple):
    """The cycles of a segment in the command: start <= k < stop."""

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
    """The columns of a command file, one value per cycle."""

    com: Array  # m
    load: Array | None  # N, None without such a column


def list_section_names(segments: Sequence[Segment]) -> list[str]:
    """Names of the sections of a command: the segment's own, or kind_number with its number from 1."""
    return [segment.name or f"{segment.kind}_{number}" for number, segment in enumerate(segments, 1)]


def build_profile(segments: Sequence[Segment], start: float = 0.0, rate: float = RATE) -> Profile:
    """Lay segments end to end from the demand `start` (m), `rate` values a second.

    No segments: an empty command that ends where it starts.

    Raises:
        InputError: two sections have the same name, or a segment cannot be sampled at this rate.
    """
    pieces: list[Array] = [np.empty(0)]
    sections: list[Section] = []
    last, begin = start, 0
    for segment, name in zip(segments, list_section_names(segments), strict=True):
        segment.require_rate(rate)
        cycles = round(segment.duration * rate)
        demand = segment.demand(np.arange(cycles + 1) / rate, last)
        pieces.append(demand[:-1])
        last = float(demand[-1])
        require(all(name != s.name for s in sections), "name", f"a name used once, not a second {name!r}")
        sections.append(Section(name, segment.kind, begin, begin + cycles))
        begin += cycles
    return Profile(np.concatenate(pieces), tuple(sections), last)


def read_command(path: str | Path, period: float = 1 / RATE, signals: Signals = EHA) -> Command:
    """A command file for `rig simulate`: CSV (or .csv.gz) with columns t, command and optionally load, SI units.

    Their names are those of the plant's signals, of the EHA com and load.

    One value per cycle of `period` s, as `resample_on_cycles` makes it.

    Raises:
        InputError: the file, the line and what was expected there.
    """
    columns = parse_columns(read_file(Path(path)), path, period, signals)
    if "com" not in columns:
        raise InputError(path, "line 1", f"a header with the columns t and {signals.command.name}")
    return Command(columns["com"], columns.get("load"))


def parse_columns(data: bytes, where: object, period: float = 1 / RATE, signals: Signals = EHA) -> dict[str, Array]:
    """The columns com, value and load of a CSV text, those that it has, one value per cycle from its first row.

    com and load stand for the command and the load of the plant's `signals`, by whose names the text has them.

    Rows need not be one cycle apart: see `resample_on_cycles`. Other columns are ignored, so a trace is a command too.

    Raises:
        InputError: a value that is no finite number, or times that do not increase.
    """
    rows = _read_rows(data, where)
    _, header = next(rows, (0, [""]))
    titles = [title.strip().lower() for title in header]
    if "t" not in titles:
        raise InputError(where, "line 1", "a header with a column t and commas between columns")
    named = {"t": "t", "com": signals.command.name, "value": "value"}
    named |= {"load": signals.load.name} if signals.load else {}
    picked = {key: titles.index(name.lower()) for key, name in named.items() if name.lower() in titles}
    largest = {"com": signals.command.largest, "load": signals.load.largest if signals.load else 0.0}
    table = {key: np.array(values) for key, values in _parse_numbers(rows, picked, where, largest).items()}
    t = table.pop("t")
    return {name: resample_on_cycles(t, values, period) for name, values in table.items()}


def resample_on_cycles(t: Array, values: Array, period: float) -> Array:
    """The demand at the start of each cycle, from `values` at the times `t` (s, increasing).

    Rows at that period are taken as they are. Otherwise rows up to 1 ms apart, the usual cycle, are samples that hold
    until the next: a step stays a step. Rows further apart are breakpoints, joined by straight lines. The last row
    lasts as long as the one before it, if these are samples, or one cycle.
    """
    gaps = np.diff(t)
    held = gaps <= (1 + SLACK) / RATE
    tail = gaps[-1] if len(gaps) and held[-1] else period
    cycles = max(1, ceil((t[-1] - t[0] + tail) / period - SLACK))
    grid = t[0] + np.arange(cycles) * period
    row = np.searchsorted(t, grid + SLACK * min(period, 1 / RATE), side="right") - 1
    lines = np.interp(grid, t, values)
    samples: Array = np.where(np.append(held, True)[row] | (np.abs(grid - t[row]) < SLACK * period), values[row], lines)
    return samples


def _read_rows(data: bytes, where: object) -> Iterator[tuple[int, list[str]]]:
    """(line number, cells) of each row that is not blank."""
    try:
        text = (unpack_gzip(data) if data[:2] == b"\x1f\x8b" else data).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(where, "", "CSV text, plain or gzip-compressed") from error
    except UnpackingError as error:
        raise InputError(where, "", f"CSV text, plain or gzip-compressed ({error})") from error
    rows = csv.reader(text.splitlines())
    try:
        yield from ((rows.line_num, row) for row in rows if row)
    except csv.Error as error:
        raise InputError(where, f"line {rows.line_num}", f"CSV ({error})") from error


def _parse_numbers(rows: Iterator[tuple[int, list[str]]], picked: dict[str, int], where: object,
                   largest: Mapping[str, float]) -> dict[str, list[float]]:
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
        for name, most in largest.items():
            if name in table and abs(table[name][-1]) > most:
                raise InputError(where, f"line {line}, {name}", f"at most {most:g} either way, not {table[name][-1]:g}")
    if not t:
        raise InputError(where, "line 2", "at least one row below the header")
    return table
