"""CSV files of traces: SI units, one row per cycle, empty fields for missing samples; or a plant's own columns."""

import contextlib
import csv
import gzip
import io
import math
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from itertools import chain
from pathlib import Path

import numpy as np

from fdi.output import write_whole
from fdi.trace.sections import Floats
from plant.errors import InputError, report_system_error, require
from plant.plants import Plant, Table, Term, find_plant, list_plants
from plant.signals import Signals
from plant.unpacking import LimitedGzip, UnpackingError


def read_csv(path: Path, signals: Signals) -> tuple[dict[str, Floats], tuple[str, ...], str, Signals]:
    """Read a CSV of t and these signals, or of those of another plant, or of a plant's own rig: the header tells.

    Returns:
        The known columns, (rows,), NaN where a field is empty; what a reader should know, such as columns left out; the
        plant whose rig wrote the file in its own columns, "" for a trace of this software; the signals of the columns.

    Raises:
        InputError: anything but numbers, and t that does not grow; it names the line.
    """
    with report_unreadable(path, "UTF-8"), open_text(path) as stream:
        header = stream.readline()
        def list_names(separator: str) -> set[str]:
            return {name.strip() for name in next(csv.reader([header], delimiter=separator), [])}

        if (found := find_own_table(list_names)) is not None:
            plant, table = found
            rows = csv.reader(chain([header], stream), delimiter=table.separator)
            sources, notes = _parse_rows(path, rows, tuple(sorted(table.sources)), ())
            return combine_columns(sources, table), notes, plant.name, plant.signals
        rows = csv.reader(chain([header], stream))
        names = {name.strip() for name in next(csv.reader([header]), [])}
        known = (signals, *(find_plant(name).signals for name in list_plants() if not {*signals.required} <= names))
        signals = next((s for s in known if {*s.required} <= names), signals)
        required = ("t", *signals.required)
        optional = tuple(name for name in signals.names if name not in required)
        return *_parse_rows(path, rows, required, optional), "", signals


def find_own_table(list_names: Callable[[str], Collection[str]]) -> tuple[Plant, Table] | None:
    """The plant whose rig writes a file with these columns, and how; None if no plant's does.

    `list_names` gives the names in the file, which may depend on the separator of a text.
    """
    tables = ((plant, table) for plant in map(find_plant, list_plants()) for table in plant.tables)
    return next(((plant, table) for plant, table in tables if table.sources <= set(list_names(table.separator))), None)


@contextlib.contextmanager
def report_unreadable(path: Path, encodings: str) -> Iterator[None]:
    """Errors of reading a table as one line. `encodings`: those that the reader knows, in words.

    Raises InputError.
    """
    try:
        yield
    except UnicodeError as error:
        raise InputError(path, "", f"a text file ({encodings})") from error
    except csv.Error as error:
        raise InputError(path, "", f"a table of numbers ({error})") from error
    except (OSError, EOFError, zlib.error, UnpackingError) as error:
        raise InputError(path, "", f"a readable file ({getattr(error, 'strerror', None) or error})") from error


def write_csv(path: Path, columns: Mapping[str, Floats]) -> None:
    """Write columns, shape (rows,) each; values survive a round trip exactly; `.gz` compresses, with no time inside."""
    names = list(columns)
    rows = (",".join("" if math.isnan(v) else repr(v) for v in row)
            for row in zip(*(columns[name].tolist() for name in names), strict=True))
    raw = ("\n".join([",".join(names), *rows]) + "\n").encode()
    with report_system_error(path, "", "a place that can be written"), write_whole(path) as part:
        part.write_bytes(gzip.compress(raw, mtime=0) if path.suffix == ".gz" else raw)


def open_text(path: Path, encoding: str = "utf-8-sig") -> io.TextIOBase:
    """A text file, unpacked if it is a `.gz`. Reading a `.gz` beyond its limit raises UnpackingError."""
    if path.suffix == ".gz":
        unpacked = io.BufferedReader(LimitedGzip(path, path.stat().st_size))
        return io.TextIOWrapper(unpacked, encoding=encoding, newline="")
    return path.open(encoding=encoding, newline="")


def _parse_rows(path: Path, rows: Iterator[list[str]], required: tuple[str, ...],
                optional: tuple[str, ...]) -> tuple[dict[str, Floats], tuple[str, ...]]:
    """The columns and the notes of a CSV text."""
    header = [name.strip() for name in next(rows, [])]
    for name in required:
        require(name in header, f"{path}: line 1", name,
                f"a column of this name in the header {','.join([*required, *optional])}")
    require(len(set(header)) >= len(header), f"{path}: line 1", "header", "each column once")
    known = [(i, name) for i, name in enumerate(header) if name in required or name in optional]
    values: dict[str, list[float]] = {name: [] for _, name in known}
    words = dict.fromkeys(values, 0)  # fields that say "nan"
    last = -math.inf
    for line, row in enumerate(rows, 2):
        if not row:
            continue
        if len(row) != len(header):
            raise InputError(f"{path}: line {line}", "", f"{len(header)} fields as in the header, not {len(row)}")
        for i, name in known:
            try:
                value = float(row[i]) if row[i].strip() else math.nan
            except ValueError:
                value = math.inf
            if math.isinf(value):
                raise InputError(f"{path}: line {line}", name, f"a finite number or an empty field, not {row[i]!r}")
            values[name].append(value)
            words[name] += math.isnan(value) and bool(row[i].strip())
        if "t" in values:
            t = values["t"][-1]
            if not t > last:
                raise InputError(f"{path}: line {line}", "t", f"a time after {last:g} s, "
                                                              f"not {row[header.index('t')]!r}")
            last = t
    require(values[known[0][1]], path, "", "at least one row after the header")
    unknown = [name for name in header if name not in values]
    notes = [f"column {name} is not known and was left out" for name in unknown]
    if len(unknown) > 1:
        more = f" and {len(unknown) - 3} more" if len(unknown) > 3 else ""
        notes = [f"{len(unknown)} columns are not known and were left out: {', '.join(unknown[:3])}{more}"]
    notes += [f"column {name}: {count} fields say nan and count as missing" for name, count in words.items() if count]
    return {name: np.array(column) for name, column in values.items()}, tuple(notes)


def combine_columns(sources: Mapping[str, Floats], table: Table) -> dict[str, Floats]:
    """The columns of a trace from those of a plant's own rig; NaN where a part of one is missing."""
    def shift_term(term: Term) -> Floats:
        return np.concatenate([(term.factor * sources[term.source])[term.later:], np.full(term.later, np.nan)])

    summed = {name: sum(map(shift_term, terms), start=np.zeros(1)) for name, terms in table.columns.items()}
    whole = summed | (table.derive(sources) if table.derive else {})
    columns = {name: values[table.skip:] for name, values in whole.items()}
    return columns | ({"load": table.load(columns)} if table.load else {})
