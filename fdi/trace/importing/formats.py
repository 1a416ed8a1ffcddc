"""Opening a recording by the suffix of its name: text tables, MF4, MAT, Parquet, and traces of this software."""
from __future__ import annotations

import codecs
import importlib
import math
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import islice, product
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.trace import (
    MISSING,
    Floats,
    Layout,
    Trace,
    is_comment,
    is_padded,
    make_number_parser,
    open_text,
    read_columns,
    report_unreadable,
    split_line,
)
from plant import InputError, find_unit, require

OTHER_UNITS = ("V", "mV", "counts", "%")  # what a logger may write that needs scale and offset
TEXT_SUFFIXES = (".csv", ".txt", ".tsv", ".dat", ".gz")


def open_measurement(path: Path, separator: str | None = None, decimal: str | None = None,
                     name_line: int | None = None) -> Measurement:
    """Open a recording; the last three are for text tables, found in the file if not given.

    Raises:
        InputError: a file that cannot be read, another format, or a package that is not installed.
    """
    suffix = path.suffix.lower()
    require(suffix in SUFFIXES, path, "", f"a file that ends in {', '.join(SUFFIXES)}")
    require(suffix == ".mcap" or path.is_file(), path, "",
            "a readable file" + ("" if path.exists() else "; it does not exist"))
    return (open_text_table(path, separator, decimal, name_line) if suffix in TEXT_SUFFIXES else
            READERS[suffix](path))


def _import_reader(name: str, path: Path) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise InputError(path, "", f"the package {name.partition('.')[0]}, which reads {path.suffix}: "
                                   "pip install 'eha-rig[measure]'") from None


def _as_floats(path: Path, name: str, values: Any) -> Floats:
    """Numbers and truth values as floats, (n,).

    Raises:
        InputError: anything else.
    """
    column = np.asarray(values)
    require(column.dtype.kind in "biuf" and column.ndim == 1, path, name,
            f"a channel of numbers, not {column.dtype} of shape {column.shape}")
    floats: Floats = column.astype(np.float64)
    if np.isinf(floats).any():
        raise InputError(path, name, f"finite numbers; value {int(np.isinf(floats).argmax()) + 1} is infinite")
    return floats


def _open_log(path: Path) -> Measurement:
    trace = Trace.read(path)
    units = {name: trace.units[name] for name in ("t", *trace.signals)}
    return Measurement(path, f"trace of {trace.provenance.get('version.eha-rig', 'this software')}", units,
                       read_singly(lambda name: Channel(trace.column(name))))


def _open_with(path: Path, kind: str, reader: Callable[[Path], Any]) -> Any:
    """What a package's reader makes of a file.

    Raises:
        InputError: a damaged file, for which the packages raise errors of many kinds.
    """
    try:
        return reader(path)
    except Exception as error:
        raise InputError(path, "", f"{kind} ({' '.join(str(error).split()) or type(error).__name__})") from error


def _open_mdf(path: Path) -> Measurement:
    """An MDF file of version 3 or 4; each channel group has its own times."""
    file = _open_with(path, "an MDF file", _import_reader("asammdf", path).MDF)
    places: dict[str, tuple[str, int, int]] = {  # name, group, index
        name if len(where) == 1 else f"{name} (group {group})": (name, group, index)
        for name, where in file.channels_db.items() for group, index in where if file.masters_db.get(group) != index}
    require(places, path, "", "an MDF file with at least one channel")

    def read(label: str) -> Channel:
        signal = file.get(*places[label], ignore_invalidation_bits=False)
        values = _as_floats(path, label, signal.samples)
        if signal.invalidation_bits is not None:
            values[np.asarray(signal.invalidation_bits, bool)] = np.nan
        return Channel(values, np.asarray(signal.timestamps, np.float64))

    units = {}
    for label, (_, group, index) in sorted(places.items(), key=lambda place: place[1][1:]):
        channel = file.groups[group].channels[index]
        units[label] = getattr(channel, "unit", "") or getattr(channel.conversion, "unit", "") or ""
    return Measurement(path, f"MDF {file.version}", units, read_singly(read), has_times=True)


def _open_mat(path: Path) -> Measurement:
    from scipy.io import loadmat

    content = _open_with(path, "a MAT file of version 5 to 7.2, as save -v7 writes it",
                         partial(loadmat, squeeze_me=True, struct_as_record=False))
    columns = dict(_flatten({name: value for name, value in content.items() if not name.startswith("__")}))
    require(columns, path, "", "a MAT file with at least one vector of numbers")
    return Measurement(path, "MAT", {name: split_unit(name)[1] for name in columns},
                       read_singly(lambda name: Channel(_as_floats(path, name, columns[name]))))


def _flatten(content: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, NDArray[Any]]]:
    """Vectors of numbers by name: fields of structures as "s.x", columns of matrices as "m(:,1)"."""
    for name, value in content.items():
        label = prefix + name
        if hasattr(value, "_fieldnames"):
            yield from _flatten({field: getattr(value, field) for field in value._fieldnames}, f"{label}.")
        elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
            if value.ndim == 1 and len(value) > 1:
                yield label, value
            elif value.ndim == 2:
                yield from ((f"{label}(:,{i + 1})", value[:, i]) for i in range(value.shape[1]))


def _open_parquet(path: Path) -> Measurement:
    """A Parquet file; nulls are missing values, timestamps are seconds since the first."""
    file = _open_with(path, "a Parquet file", _import_reader("pyarrow.parquet", path).ParquetFile)

    def read(name: str) -> Channel:
        values = file.read(columns=[name]).column(name).to_numpy(zero_copy_only=False)
        if values.dtype.kind == "M":
            values = (values - values[0]) / np.timedelta64(1, "ns") * 1e-9
        return Channel(_as_floats(path, name, values))

    units = {}
    for column in file.schema_arrow:
        unit = (column.metadata or {}).get(b"unit", b"").decode(errors="replace")
        units[column.name] = "s" if str(column.type).startswith("timestamp") else unit or split_unit(column.name)[1]
    return Measurement(path, "Parquet", units, read_singly(read))


READERS: Mapping[str, Callable[[Path], Measurement]] = {".mf4": _open_mdf, ".mdf": _open_mdf, ".mat": _open_mat,
                                                        ".parquet": _open_parquet, ".mcap": _open_log}
SUFFIXES = (*TEXT_SUFFIXES, *READERS)

SEPARATORS = (";", "\t", "|", ",", " ")
SAMPLE_LINES = 200  # of a file, from which its layout is found


def _describe_layout(layout: Layout) -> str:
    """Separator, decimal sign and line of the names, for people."""
    separator = {"\t": "tabulator", " ": "white space"}.get(layout.separator, f"'{layout.separator}'")
    decimal = ", decimal comma" if layout.decimal == "," else ""
    return f"CSV, separator {separator}{decimal}, " + (f"names in line {layout.name_line}" if layout.name_line else
                                                       "no names")


def open_text_table(path: Path, separator: str | None = None, decimal: str | None = None,
                    name_line: int | None = None) -> Measurement:
    """A text table; what is not given is found in its first lines.

    Raises:
        InputError: a file that cannot be read or holds no table of numbers.
    """
    with report_unreadable(path, "UTF-8, UTF-16 or Latin-1"):
        encoding = _find_encoding(path)
        with open_text(path, encoding) as stream:
            lines = [line.rstrip("\r\n") for line in islice(stream, SAMPLE_LINES)]
        separator, decimal = _find_separators(path, lines, separator, decimal)
        parse = make_number_parser(decimal)
        rows = [[] if is_comment(line) and number != name_line else split_line(line, separator)
                for number, line in enumerate(lines, 1)]
        width = _find_width(rows, parse)
        rows = [row[:width] if is_padded(row, width) else row for row in rows]
        first = next((i for i, row in enumerate(rows) if i + 1 != name_line and _is_data(row, width, parse)), None)
        if first is None:
            raise InputError(path, "", "a table with rows of numbers in its first 200 lines")
        names, units, line = _find_names(path, rows, lines, first, width, name_line)
    unique = tuple(name + (f" #{names[:i].count(name) + 1}" if name in names[:i] else "")
                   for i, name in enumerate(names))
    layout = Layout(encoding, separator, decimal, unique, line, first + 1)
    return Measurement(path, _describe_layout(layout), dict(zip(unique, units, strict=True)),
                       partial(_read_text, path, layout), layout=layout)


def _read_text(path: Path, layout: Layout, names: Collection[str], dates: Collection[str]) -> dict[str, Channel]:
    return {name: Channel(values) for name, values in read_columns(path, layout, names, dates).items()}


def split_unit(name: str) -> tuple[str, str]:
    """A name and the unit in brackets, or behind a slash or underscore, at its end; "" if there is none.

    >>> split_unit("Kolbenweg [mm]"), split_unit("druck_bar"), split_unit("state")
    (('Kolbenweg', 'mm'), ('druck', 'bar'), ('state', ''))
    """
    match = re.fullmatch(r"(.*?)\s*[\[(<{]\s*([^\])>}]*)\s*[\])>}]\s*", name)
    if match:
        return match[1].strip(), match[2].strip()
    match = re.fullmatch(r"(.+?)\s*[/_ ]\s*([A-Za-zµμ%]+)", name)
    if match and _is_unit(match[2]) and match[2] not in ("a", "n", "v", "in", "S", "h"):
        return match[1].strip(), match[2]
    return name.strip(), ""


def _is_unit(text: str) -> bool:
    return find_unit(text) is not None or text in OTHER_UNITS


def _find_encoding(path: Path) -> str:
    """By the byte order mark, else UTF-8 if the first 64 KiB are, else Latin-1."""
    with open_text(path, "latin-1") as stream:
        start = stream.read(65536).encode("latin-1")
    if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    require(b"\0" not in start, path, "", "a text file; it holds zero bytes")
    try:
        codecs.getincrementaldecoder("utf-8-sig")().decode(start)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


def _is_number(text: str, parse: Callable[[str], float]) -> bool:
    try:
        return not math.isnan(parse(text))
    except ValueError:
        return False


def _find_separators(path: Path, lines: list[str], separator: str | None, decimal: str | None) -> tuple[str, str]:
    """The pair under which most fields are numbers."""
    best, separators = 0.0, ("", "")
    body = [line for line in lines if not is_comment(line)]
    for sep, dec in product([separator] if separator else SEPARATORS, [decimal] if decimal else (".", ",")):
        rows, parse = [split_line(line, sep) for line in body], make_number_parser(dec)
        width = max(Counter(map(len, rows)).items(), key=lambda pair: pair[1], default=(0, 0))[0]
        if dec == sep or width < 2:
            continue
        cells = [cell for row in rows if len(row) == width and any(_is_number(cell, parse) for cell in row)
                 for cell in row]
        score = len(cells) * (sum(_is_number(cell, parse) for cell in cells) / max(len(cells), 1)) ** 3
        if score > best:
            best, separators = score, (sep, dec)
    require(best, path, "", "a table with at least two columns of numbers")
    return separators


def _find_width(rows: list[list[str]], parse: Callable[[str], float]) -> int:
    """Columns of the rows of numbers, without those behind a last separator."""
    widths = Counter(len(row) for row in rows if any(_is_number(cell, parse) for cell in row))
    width = widths.most_common(1)[0][0] if widths else 0
    alike = [row for row in rows if len(row) == width]
    return max((i + 1 for row in alike for i, cell in enumerate(row) if cell), default=0)


def _is_data(row: list[str], width: int, parse: Callable[[str], float]) -> bool:
    numbers = sum(_is_number(cell, parse) for cell in row)
    words = sum(not _is_number(cell, parse) and cell.lower() not in MISSING for cell in row)
    return len(row) == width and numbers > words


def _find_names(path: Path, rows: list[list[str]], lines: list[str], first: int, width: int,
                name_line: int | None) -> tuple[list[str], list[str], int]:
    """Names, units, and the line of the names: the text lines just above the numbers."""
    above = [i for i in range(first) if len(rows[i]) == width]
    if name_line is not None:
        require(name_line - 1 in above, f"{path}: line {name_line}", "names",
                f"{width} names above the first row of numbers, line {first + 1}")
        above = [i for i in above if i >= name_line - 1]
    elif above:
        above = above[-2:] if _is_unit_line(rows[above[-1]]) else above[-1:]
    names = rows[above[0]] if above else _find_names_in_comment(lines, first, width)
    names = [name or f"column {i + 1}" for i, name in enumerate(names)]
    units = [split_unit(name)[1] for name in names]
    if len(above) > 1 and _is_unit_line(rows[above[1]]):
        units = [cell.strip("[]() ") or unit for cell, unit in zip(rows[above[1]], units, strict=True)]
    return names, units, above[0] + 1 if above else 0


def _find_names_in_comment(lines: list[str], first: int, width: int) -> list[str]:
    """Names in the last comment line above the numbers, as `# t, x, p`; empty ones if there are none."""
    for line in reversed(lines[:first]):
        for separator in SEPARATORS:
            names = split_line(line.strip().lstrip("#%!/ "), separator)
            if len(names) == width and all(names):
                return names
    return [""] * width


def _is_unit_line(row: list[str]) -> bool:
    cells = [cell.strip("[]() ") for cell in row]
    unit_count = sum(_is_unit(cell) for cell in cells if cell and cell != "-")
    return unit_count > 0 and unit_count >= 0.5 * sum(bool(cell) and cell != "-" for cell in cells)


class Channel(NamedTuple):
    """A channel's samples, NaN where one is missing; times (s) where the file gives each channel its own."""

    values: Floats
    t: Floats | None = None


@dataclass(frozen=True)
class Measurement:
    """An open recording of another logger. `read` gives the channels of some names.

    The second argument of `read` names calendar times, which become seconds from the first one on. It raises InputError
    for a value that is no number, naming its place.
    """

    path: Path
    format: str  # for people: "CSV, separator ';', decimal comma, names in line 3"
    units: Mapping[str, str]  # channel to unit as the file has it, "" for none; all channels, in the file's order
    read: Callable[[Collection[str], Collection[str]], dict[str, Channel]]
    has_times: bool = False  # whether each channel has times of its own
    layout: Layout | None = None  # of a text table


def read_singly(read: Callable[[str], Channel]) -> Callable[[Collection[str], Collection[str]], dict[str, Channel]]:
    """A `Measurement.read` made of one that reads a single channel."""
    return lambda names, dates: {name: read(name) for name in names}
