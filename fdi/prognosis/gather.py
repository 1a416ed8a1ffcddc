"""The sizes of both faults in each dated trace of a folder; answers are stored, so no trace is diagnosed twice."""
from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from fdi.diagnosis.faults import FAULTS, Estimate
from fdi.prognosis.dates import AXES, TABLE, Row, find_date_in_name, find_row, parse_date, read_dates_table
from fdi.progress import Progress
from fdi.sources import hash_sources
from fdi.trace.trace import Trace
from plant.compile import find_cache_folder
from plant.effects import CATALOGUE
from plant.errors import InputError
from plant.model import Model

ENDINGS = (".mcap", ".csv", ".csv.gz")


class Point(NamedTuple):
    """One trace: where it stands on the axis, and its sizes."""

    trace: str  # path within the folder
    t: float
    sizes: Mapping[str, Estimate]  # by fault
    note: str = ""


class Gathered(NamedTuple):
    """The traces of one unit in the order of time."""

    source: str
    axis: str  # "date" | "hours" | "flights"
    points: tuple[Point, ...]
    notes: tuple[str, ...]


class Options(NamedTuple):
    """How to gather."""

    axis: str | None = None  # default: the first on which all traces have a place
    table: Path | None = None  # default: dates.csv in the folder, if there is one
    again: bool = False  # diagnose again what has been diagnosed before


def gather_sizes(folder: Path, model: Model, options: Options, progress: Progress) -> Gathered:
    """Diagnose all traces of a folder and below.

    Raises:
        InputError: no folder, no traces, no axis on which all of them have a place, or none that can be judged.
    """
    place = options.table or folder / TABLE
    table = read_dates_table(place) if options.table or place.is_file() else {}
    notes: list[str] = []
    rows: dict[Path, Row] = {}
    for file in list_traces(folder):
        name = file.relative_to(folder).as_posix()
        try:
            rows[file] = _date_trace(folder, name, read_start_time(file, model, options.again), find_row(table, name))
        except InputError as error:
            notes.append(f"{name} left out: {str(error).removeprefix(f'{file}: ')}")
    axis = _choose_axis(folder, rows, options.axis)  # before the work: a trace without a date is refused at once
    notes += [f"{key} is listed in {place.name}, but there is no such trace" for key, row in table.items()
              if row not in [find_row(table, file.relative_to(folder).as_posix()) for file in rows]]
    points = []
    for i, (file, row) in enumerate(rows.items()):
        progress(f"trace {i + 1} of {len(rows)}", i / len(rows))
        name = file.relative_to(folder).as_posix()
        try:
            answer = diagnose_once(file, model, options.again)
        except InputError as error:
            notes.append(f"{name} left out: {str(error).removeprefix(f'{file}: ')}")
            continue
        sizes = {f.name: Estimate(*answer["sizes"][f.name]) for f in FAULTS}
        points.append(Point(name, row[list(AXES).index(axis)], sizes, answer["note"]))
    progress("trend", 1.0)
    if not points:
        raise InputError(folder, "", f"traces that can be judged; {notes[0]}" + (" ..." if notes[1:] else ""))
    return Gathered(str(folder), axis, tuple(sorted(points, key=lambda p: (p.t, p.trace))), tuple(notes))


def list_traces(folder: Path) -> list[Path]:
    """All files of a folder and below that may be traces.

    Raises:
        InputError: no folder, or no such file.
    """
    if not folder.is_dir():
        raise InputError(folder, "", "a folder of dated traces, or the JSON file of an earlier answer")
    found = sorted(path for path in folder.rglob("*") if path.name.endswith(ENDINGS) and path.name != TABLE
                   and not any(part.startswith(".") for part in path.relative_to(folder).parts))
    if not found:
        raise InputError(folder, "", "traces in it: .mcap, .csv or .csv.gz")
    return found


def _date_trace(folder: Path, name: str, own: str, row: Row | None) -> Row:
    """The place of a trace on each axis: by the table, else by its own start time, else by its name."""
    row = row or Row(math.nan, math.nan, math.nan)
    if not math.isnan(row.date):
        return row
    day = parse_date(own)
    return row._replace(date=day if not math.isnan(day) else find_date_in_name(Path(folder.resolve().name) / name))


def _choose_axis(folder: Path, rows: Mapping[Path, Row], wanted: str | None) -> str:
    """The axis asked for, or the first on which every trace has a place."""
    without = {axis: [file for file, row in rows.items() if math.isnan(row[i])] for i, axis in enumerate(AXES)}
    for axis in (wanted,) if wanted else AXES:
        if not without[axis]:
            return axis
    missing = without[wanted or "date"][0]
    if (wanted or "date") == "date":
        raise InputError(missing, "date", "a start time in the log, an ISO date in the name of file or folder "
                                          f"(2026-01-31), or a line in {folder / TABLE} (file,date)")
    raise InputError(missing, str(wanted), f"a line in {folder / TABLE} with a column {wanted}")


def read_start_time(file: Path, model: Model, again: bool = False) -> str:
    """Start time in the log; "" if there is none.

    Raises:
        InputError: a file that is not a trace.
    """
    place = _find_answer_file(file, model)
    if place.is_file() and not again:
        return str(json.loads(place.read_text(encoding="utf-8"))["started"])
    return Trace.read(file).provenance.get("started", "")


def diagnose_once(file: Path, model: Model, again: bool = False) -> dict[str, Any]:
    """Start time and sizes of a trace, by `diagnose` or from the answer stored by an earlier call.

    Raises:
        InputError: a trace that cannot be judged; this answer is not stored.
    """
    place = _find_answer_file(file, model)
    if place.is_file() and not again:
        found: dict[str, Any] = json.loads(place.read_text(encoding="utf-8"))
        return found
    from fdi.diagnosis.diagnosis import diagnose

    trace = Trace.read(file)
    d = diagnose(trace, model, source=str(file))
    note = "something else is wrong" if d.verdict == "SOMETHING_ELSE" else ""
    found = {"started": trace.provenance.get("started", ""), "sizes": {f.name: list(d.sizes[f.name]) for f in FAULTS},
             "note": note}
    place.parent.mkdir(parents=True, exist_ok=True)
    half = place.with_suffix(f".{hashlib.sha256(str(file.resolve()).encode()).hexdigest()[:8]}")
    half.write_text(json.dumps(found), encoding="utf-8")
    half.replace(place)  # whole or not at all
    return found


def _find_answer_file(file: Path, model: Model) -> Path:
    """File for the answer of a trace: its name is a hash of the trace, the model and the code."""
    try:
        content = file.read_bytes()
    except OSError as error:
        raise InputError(file, "", f"a readable file ({error.strerror})") from error
    theirs = {f for e in model.effects if (f := CATALOGUE[e].file)}
    own = [hashlib.sha256(Path(f).read_bytes()).hexdigest() for f in sorted(theirs)]
    text = json.dumps([sorted(model.values.items()), model.effects, own, model.plant, hash_sources("plant", "fdi")])
    return find_cache_folder() / "trend" / f"{hashlib.sha256(content + text.encode()).hexdigest()[:32]}.json"
