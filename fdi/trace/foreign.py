"""Recordings of a plant's own rig, as they come: its columns are put together to those of a trace."""
from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fdi.trace.csv_table import open_text, read_csv
from plant.plants import Plant, Table, Term, find, names

Floats = NDArray[np.float64]


def recorded_by(path: Path) -> Plant | None:
    """The plant whose rig wrote a CSV, told by the names in its first line; None for a trace of ours or any other."""
    try:
        with open_text(path) as stream:
            first = stream.readline()
    except (OSError, EOFError, UnicodeDecodeError):
        return None  # the reader says it better
    for plant in map(find, names()):
        if plant.table and plant.table.sources <= set(_header(first, plant.table)):
            return plant
    return None


def _header(line: str, table: Table) -> list[str]:
    return [name.strip() for name in next(csv.reader([line], delimiter=table.separator), [])]


def read_foreign(path: Path, table: Table) -> tuple[dict[str, Floats], tuple[str, ...]]:
    """-> columns of a trace, shape (rows,), NaN where a part of one is missing; and the names that were left out.

    Raises InputError as for any CSV.
    """
    sources, others = read_csv(path, sorted(table.sources), (), table.separator)
    columns = {name: sum((_part(sources, term) for term in terms), start=np.zeros(1))[table.skip:]
               for name, terms in table.columns.items()}
    if table.load:
        columns["load"] = table.load(columns)
    return columns, others


def _part(sources: Mapping[str, Floats], term: Term) -> Floats:
    values = term.factor * sources[term.source]
    return np.concatenate([values[term.later:], np.full(term.later, np.nan)])
