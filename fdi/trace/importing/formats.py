"""Opening a recording by the suffix of its name: text tables, MF4, MAT, Parquet, and traces of this software."""
from __future__ import annotations

import importlib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi.trace.importing.measurement import ArrayMeasurement, Channel, Measurement
from fdi.trace.importing.text_table import open_text_table, split_unit
from fdi.trace.signals import SIGNALS
from fdi.trace.trace import Trace
from plant.errors import InputError

Floats = NDArray[np.float64]

TEXT_SUFFIXES = (".csv", ".txt", ".tsv", ".dat", ".gz")
SUFFIXES = (*TEXT_SUFFIXES, ".mf4", ".mdf", ".mat", ".parquet", ".mcap")


def open_measurement(path: Path, separator: str | None = None, decimal: str | None = None,
                     name_line: int | None = None) -> Measurement:
    """Open a recording; the last three are for text tables, found in the file if not given.

    Raises:
        InputError: a file that cannot be read, another format, or a package that is not installed.
    """
    if path.suffix != ".mcap" and not path.is_file():
        raise InputError(path, "", "a readable file" + ("" if path.exists() else "; it does not exist"))
    suffix = path.suffix.lower()
    if suffix in TEXT_SUFFIXES:
        return open_text_table(path, separator, decimal, name_line)
    if suffix in (".mf4", ".mdf"):
        return _open_mdf(path)
    if suffix == ".mat":
        return _open_mat(path)
    if suffix == ".parquet":
        return _open_parquet(path)
    if suffix == ".mcap":
        return _open_log(path)
    raise InputError(path, "", f"a file that ends in {', '.join(SUFFIXES)}")


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
    if column.dtype.kind not in "biuf" or column.ndim != 1:
        raise InputError(path, name, f"a channel of numbers, not {column.dtype} of shape {column.shape}")
    floats: Floats = column.astype(np.float64)
    if np.isinf(floats).any():
        raise InputError(path, name, f"finite numbers; value {int(np.isinf(floats).argmax()) + 1} is infinite")
    return floats


def _open_log(path: Path) -> Measurement:
    trace = Trace.read(path)
    names = ("t", *trace.signals)
    return ArrayMeasurement(path, f"trace of {trace.provenance.get('version.eha-rig', 'this software')}",
                            {name: SIGNALS[name].unit for name in names},
                            {name: Channel(trace.column(name)) for name in names})


@dataclass(frozen=True)
class MdfMeasurement:
    """An MDF file of version 3 or 4; each channel group has its own times."""

    path: Path
    format: str
    units: Mapping[str, str]
    places: Mapping[str, tuple[str, int, int]]  # name, group, index
    file: Any
    has_times: bool = True

    def read(self, names: Collection[str], dates: Collection[str] = ()) -> dict[str, Channel]:
        """The channels, in physical values."""
        out = {}
        for name in names:
            signal = self.file.get(*self.places[name], ignore_invalidation_bits=False)
            values = _as_floats(self.path, name, signal.samples)
            invalid = getattr(signal, "invalidation_bits", None)
            if invalid is not None and np.any(invalid):
                values[np.asarray(invalid, bool)] = np.nan
            out[name] = Channel(values, np.asarray(signal.timestamps, np.float64))
        return out


def _open_mdf(path: Path) -> Measurement:
    asammdf = _import_reader("asammdf", path)
    try:
        file = asammdf.MDF(path)
    except Exception as error:  # the package raises errors of many kinds for damaged files
        raise InputError(path, "", f"an MDF file ({str(error).splitlines()[0] if str(error) else error!r})") from error
    places: dict[str, tuple[str, int, int]] = {}
    units: dict[str, str] = {}
    for name, where in file.channels_db.items():
        for group, index in where:
            if file.masters_db.get(group) == index:
                continue
            label = name if len(where) == 1 else f"{name} (group {group})"
            places[label] = (name, group, index)
            channel = file.groups[group].channels[index]
            conversion = getattr(channel, "conversion", None)
            units[label] = getattr(channel, "unit", "") or getattr(conversion, "unit", "") or ""
    if not places:
        raise InputError(path, "", "an MDF file with at least one channel")
    order = sorted(places, key=lambda label: places[label][1:])
    return MdfMeasurement(path, f"MDF {file.version}", {label: units[label] for label in order}, places, file)


def _open_mat(path: Path) -> Measurement:
    from scipy.io import loadmat

    try:
        content = loadmat(path, squeeze_me=True, struct_as_record=False)
    except NotImplementedError:
        raise InputError(path, "", "a MAT file of version 5 to 7.2; in MATLAB: save FILE.mat -v7") from None
    except Exception as error:  # the reader raises errors of many kinds for damaged files
        raise InputError(path, "", f"a MAT file ({' '.join(str(error).split()) or type(error).__name__})") from error
    columns = dict(_flatten({name: value for name, value in content.items() if not name.startswith("__")}))
    if not columns:
        raise InputError(path, "", "a MAT file with at least one vector of numbers")
    channels = {name: Channel(_as_floats(path, name, values)) for name, values in columns.items()}
    return ArrayMeasurement(path, "MAT", {name: split_unit(name)[1] for name in columns}, channels)


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


@dataclass(frozen=True)
class ParquetMeasurement:
    """A Parquet file; of its columns only those asked for are read."""

    path: Path
    format: str
    units: Mapping[str, str]
    file: Any
    has_times: bool = False

    def read(self, names: Collection[str], dates: Collection[str] = ()) -> dict[str, Channel]:
        """The columns; nulls are missing values, timestamps are seconds since the first."""
        table = self.file.read(columns=list(names))
        out = {}
        for name in names:
            values = table.column(name).to_numpy(zero_copy_only=False)
            if values.dtype.kind == "M":
                values = (values - values[0]) / np.timedelta64(1, "ns") * 1e-9
            out[name] = Channel(_as_floats(self.path, name, values))
        return out


def _open_parquet(path: Path) -> Measurement:
    parquet = _import_reader("pyarrow.parquet", path)
    try:
        file = parquet.ParquetFile(path)
    except Exception as error:  # the package raises errors of many kinds for damaged files
        raise InputError(path, "", f"a Parquet file ({' '.join(str(error).split())})") from error
    units = {}
    for column in file.schema_arrow:
        said = (column.metadata or {}).get(b"unit", b"").decode(errors="replace")
        units[column.name] = "s" if str(column.type).startswith("timestamp") else said or split_unit(column.name)[1]
    return ParquetMeasurement(path, "Parquet", units, file)
