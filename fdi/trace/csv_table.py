"""Text tables: CSV files of traces (SI units, a row per cycle), in a plant's own columns, or of any other logger."""

import contextlib
import csv
import gzip
import io
import math
import re
import zlib
from array import array
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fdi.output import write_whole
from fdi.trace.sections import Floats
from plant import (
    InputError,
    LimitedGzip,
    Plant,
    Signals,
    Table,
    Term,
    UnpackingError,
    find_plant,
    list_plants,
    report_system_error,
    require,
    show_value,
)

COMMENTS = ("#", "%", "//", "!")
MISSING = {"", "nan", "na", "n/a", "null", "none", "-", "--", "#n/a", "nil"}


def read_csv(path: Path, signals: Signals) -> tuple[dict[str, Floats], tuple[str, ...], str, Signals]:
    """Read a CSV of t and these signals, or of those of another plant, or of a plant's own rig: the header tells.

    Returns:
        The known columns, (rows,), NaN where a field is empty; what a reader should know, such as columns left out; the
        plant whose rig wrote the file in its own columns, "" for a trace of this software; the signals of the columns.

    Raises:
        InputError: a column that is missing, or anything but numbers; it names the line.
    """
    with report_unreadable(path, "UTF-8"), open_text(path) as stream:
        header = stream.readline()
    if (match := find_own_table(partial(split_line, header))) is not None:
        plant, table = match
        sources, notes = _read_known(path, split_line(header, table.separator), table.separator, sorted(table.sources))
        return combine_columns(sources, table), notes, plant.name, plant.signals
    names = split_line(header, ",")
    choices = (signals, *(find_plant(name).signals for name in list_plants() if not {*signals.required} <= {*names}))
    signals = next((s for s in choices if {*s.required} <= {*names}), signals)
    required = ("t", *signals.required)
    possible = (*required, *(name for name in signals.names if name not in required))
    for name in required:
        hint = "" if len(names) > 1 else " (commas separate columns; rig import reads other separators)"
        require(name in names, f"{path}: line 1", name,
                f"a column of this name; the header is {show_value(','.join(names))}{hint}")
    return *_read_known(path, names, ",", [name for name in possible if name in names]), "", signals


def _read_known(path: Path, names: Sequence[str], separator: str, known_names: Collection[str]
                ) -> tuple[dict[str, Floats], tuple[str, ...]]:
    """The known columns of a text with these names in its first line, and which were left out."""
    require(len(set(names)) == len(names), f"{path}: line 1", "header", "each column once")
    columns = read_columns(path, Layout("utf-8-sig", separator, ".", tuple(names), 1, 2), known_names)
    unknown_names = [name for name in names if name not in columns]
    if len(unknown_names) < 2:
        return columns, tuple(f"column {name} is not known and was left out" for name in unknown_names)
    more = f" and {len(unknown_names) - 3} more" if len(unknown_names) > 3 else ""
    return columns, (f"{len(unknown_names)} columns are not known and were left out: "
                     f"{', '.join(unknown_names[:3])}{more}",)


def find_own_table(list_names: Callable[[str], Collection[str]]) -> tuple[Plant, Table] | None:
    """The plant whose rig writes a file with these columns, and how; None if no plant's does.

    `list_names` gives the names in the file, which may depend on the separator of a text.
    """
    tables = ((plant, table) for plant in map(find_plant, list_plants()) for table in plant.tables)
    return next(((plant, table) for plant, table in tables if table.sources <= set(list_names(table.separator))), None)


@contextlib.contextmanager
def report_unreadable(where: object, encodings: str) -> Iterator[None]:
    """Errors of reading a table as one line. `encodings`: those that the reader knows, in words.

    Raises InputError.
    """
    try:
        yield
    except UnicodeError as error:
        raise InputError(where, "", f"a text file ({encodings})") from error
    except csv.Error as error:
        raise InputError(where, "", f"a table of numbers ({error})") from error
    except (OSError, EOFError, zlib.error, UnpackingError) as error:
        raise InputError(where, "", f"a readable file ({getattr(error, 'strerror', None) or error})") from error


def write_csv(path: Path, columns: Mapping[str, Floats]) -> None:
    """Write columns, shape (rows,) each; values survive a round trip exactly; `.gz` compresses, with no time inside."""
    rows = (",".join("" if math.isnan(v) else repr(v) for v in row)
            for row in zip(*(column.tolist() for column in columns.values()), strict=True))
    raw = ("\n".join([",".join(columns), *rows]) + "\n").encode()
    with report_system_error(path, "", "a place that can be written"), write_whole(path) as part:
        part.write_bytes(gzip.compress(raw, mtime=0) if path.suffix == ".gz" else raw)


def open_text(source: Path | bytes, encoding: str = "utf-8-sig") -> io.TextIOWrapper:
    """The text of a file, unpacked if it is gzip-compressed. Reading that beyond its limit raises UnpackingError."""
    packed = io.BytesIO(source) if isinstance(source, bytes) else source.open("rb")
    is_packed, size = packed.read(2) == b"\x1f\x8b", packed.seek(0, io.SEEK_END)
    packed.seek(0)
    unpacked = io.BufferedReader(LimitedGzip(packed, size)) if is_packed else packed
    return io.TextIOWrapper(unpacked, encoding=encoding, newline="")


class Layout(NamedTuple):
    """How a text table is written."""

    encoding: str
    separator: str  # " ": any white space
    decimal: str
    names: tuple[str, ...]
    name_line: int  # 0: the file has no names
    first_line: int  # of the numbers


def read_columns(source: Path | bytes, layout: Layout, names: Collection[str], dates: Collection[str] = (),
                 where: object = None) -> dict[str, Floats]:
    """Columns of a text table, (rows,) each, NaN where a field is empty or says so; seconds of those that are `dates`.

    The table is read line by line: memory holds the chosen columns alone. `where` names it in refusals, default by its
    path.

    Raises:
        InputError: a field that is no number or date, or a row of another length; it names the line.
    """
    where = where or source
    columns = {name: array("d") for name in names}
    parse_number, width = make_number_parser(layout.decimal), len(layout.names)
    parsers = [(layout.names.index(name), name, _parse_date if name in dates else parse_number) for name in columns]
    encoding = layout.encoding.removesuffix("-sig").upper()
    with report_unreadable(where, encoding), open_text(source, layout.encoding) as stream:
        for line, text in enumerate(stream, 1):
            if line < layout.first_line or is_comment(text):
                continue
            fields = split_line(text.rstrip("\r\n"), layout.separator)
            if len(fields) != width and not is_padded(fields, width):
                raise InputError(f"{where}: line {line}", "", f"{width} fields, not {len(fields)}")
            for i, name, parse in parsers:
                try:
                    columns[name].append(parse(fields[i]))
                except ValueError:
                    kind = "a date and time (ISO 8601)" if name in dates else "a finite number or an empty field"
                    hint = " (remove a line of units, or use rig import --guess)" if line == layout.first_line else ""
                    raise InputError(f"{where}: line {line}", name, f"{kind}, not {fields[i]!r}{hint}") from None
    require(len(next(iter(columns.values()), array("d"))), where, "", "at least one row of numbers")
    return {name: np.frombuffer(column) for name, column in columns.items()}


def is_comment(line: str) -> bool:
    """Whether a line of a text table has neither names nor numbers."""
    return not line.strip() or line.lstrip().startswith(COMMENTS)


def split_line(line: str, separator: str) -> list[str]:
    """The fields of a line, without blanks around them."""
    if separator == " ":
        return line.split()
    if '"' not in line:
        return [field.strip() for field in line.split(separator)]
    return [field.strip() for field in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])]


def is_padded(fields: Sequence[str], width: int) -> bool:
    """Whether a row has only empty fields more, as behind a last separator."""
    return len(fields) > width and not any(fields[width:])


def make_number_parser(decimal: str) -> Callable[[str], float]:
    """Text to number, NaN for a missing one; raises ValueError for any other text and for infinity."""
    def parse(text: str) -> float:
        if decimal == "," and "." in text:
            raise ValueError
        try:
            value = float(text.replace(decimal, "."))
        except ValueError:
            if text.lower() in MISSING:
                return math.nan
            raise
        if math.isinf(value) or "_" in text:
            raise ValueError
        return value

    return parse


def _parse_date(text: str) -> float:
    """Seconds of an ISO date and time; a zone is left out."""
    text = re.sub(r"(Z|[+-]\d\d:?\d\d)$", "", text.strip()).replace(",", ".")
    value = np.datetime64(text.replace(" ", "T"), "ns")
    if np.isnat(value):
        raise ValueError
    # relative to 2020, so that a double resolves 0.1 us
    return float((value - np.datetime64("2020-01-01", "ns")).astype(np.int64)) / 1e9


def require_growth(t: Floats, where: object, field: str, hint: str = "") -> None:
    """Refuse times that do not grow, with a `hint` at what they may be.

    Raises:
        InputError: it names the row and both times.
    """
    grows = np.diff(t) > 0.0
    if not grows.all():
        row = int(np.argmin(grows)) + 1
        raise InputError(where, field,
                         f"times that grow; row {row + 1} has {t[row]:.9g} s after {t[row - 1]:.9g} s{hint}")


def combine_columns(sources: Mapping[str, Floats], table: Table) -> dict[str, Floats]:
    """The columns of a trace from those of a plant's own rig; NaN where a part of one is missing."""
    def shift_term(term: Term) -> Floats:
        return np.concatenate([(term.factor * sources[term.source])[term.later:], np.full(term.later, np.nan)])

    sums = {name: sum(map(shift_term, terms), start=np.zeros(1)) for name, terms in table.columns.items()}
    whole = sums | (table.derive(sources) if table.derive else {})
    columns = {name: values[table.skip:] for name, values in whole.items()}
    return columns | ({"load": table.load(columns)} if table.load else {})
