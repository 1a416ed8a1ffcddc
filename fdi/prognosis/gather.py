"""The sizes of both faults in each dated trace of a folder, kept so that no trace is diagnosed twice."""
from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from fdi.diagnosis.faults import FAULTS, Estimate
from fdi.prognosis.dates import AXES, TABLE, Row, days, in_name, read_table, row_of
from fdi.progress import Progress
from fdi.sources import digest
from fdi.trace.trace import Trace
from plant.compile import cache_folder
from plant.effects import CATALOGUE
from plant.errors import InputError
from plant.model import Model

Keep = Path | None

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

    axis: str | None = None  # default: the first that all traces have
    table: Path | None = None  # default: dates.csv in the folder, if there is one
    again: bool = False  # diagnose even what is known


def gather(folder: Path, model: Model, options: Options, progress: Progress) -> Gathered:
    """Diagnose all traces of a folder and below.

    Raises:
        InputError: no folder, no traces, no axis on which all of them stand, or none that can be judged.
    """
    place = options.table or folder / TABLE
    table = read_table(place) if options.table or place.is_file() else {}
    notes: list[str] = []
    rows: dict[Path, Row] = {}
    for file in traces(folder):
        name = file.relative_to(folder).as_posix()
        try:
            rows[file] = _row(folder, name, started(file, model, options.again), row_of(table, name))
        except InputError as error:
            notes.append(f"{name} left out: {str(error).removeprefix(f'{file}: ')}")
    axis = _axis(folder, rows, options.axis)  # before the work: a trace without a date is refused at once
    notes += [f"{key} stands in {place.name}, but there is no such trace" for key, row in table.items()
              if row not in [row_of(table, file.relative_to(folder).as_posix()) for file in rows]]
    points = []
    for i, (file, row) in enumerate(rows.items()):
        progress(f"trace {i + 1} of {len(rows)}", i / len(rows))
        name = file.relative_to(folder).as_posix()
        try:
            told = diagnosed(file, model, options.again)
        except InputError as error:
            notes.append(f"{name} left out: {str(error).removeprefix(f'{file}: ')}")
            continue
        sizes = {f.name: Estimate(*told["sizes"][f.name]) for f in FAULTS}
        points.append(Point(name, row[list(AXES).index(axis)], sizes, told["note"]))
    progress("trend", 1.0)
    if not points:
        raise InputError(folder, "", f"traces that can be judged; {notes[0]}" + (" ..." if notes[1:] else ""))
    return Gathered(str(folder), axis, tuple(sorted(points, key=lambda p: (p.t, p.trace))), tuple(notes))


def traces(folder: Path) -> list[Path]:
    """All files that may be traces. Raises InputError where there are none."""
    if not folder.is_dir():
        raise InputError(folder, "", "a folder of dated traces, or the JSON file of an earlier answer")
    found = sorted(path for path in folder.rglob("*") if path.name.endswith(ENDINGS) and path.name != TABLE
                   and not any(part.startswith(".") for part in path.relative_to(folder).parts))
    if not found:
        raise InputError(folder, "", "traces in it: .mcap, .csv or .csv.gz")
    return found


def _row(folder: Path, name: str, own: str, row: Row | None) -> Row:
    """Where a trace stands: by the table, else by its own start time, else by its name."""
    row = row or Row(math.nan, math.nan, math.nan)
    if not math.isnan(row.date):
        return row
    day = days(own)
    return row._replace(date=day if not math.isnan(day) else in_name(Path(folder.resolve().name) / name))


def _axis(folder: Path, rows: Mapping[Path, Row], wanted: str | None) -> str:
    """The axis asked for, or the first on which every trace stands."""
    without = {axis: [file for file, row in rows.items() if math.isnan(row[i])] for i, axis in enumerate(AXES)}
    for axis in (wanted,) if wanted else AXES:
        if not without[axis]:
            return axis
    missing = without[wanted or "date"][0]
    if (wanted or "date") == "date":
        raise InputError(missing, "date", "a start time in the log, an ISO date in the name of file or folder "
                                          f"(2026-01-31), or a line in {folder / TABLE} (file,date)")
    raise InputError(missing, str(wanted), f"a line in {folder / TABLE} with a column {wanted}")


def started(file: Path, model: Model, again: bool = False) -> str:
    """When the log says that it began, "" if it does not say.

    Raises:
        InputError: a file that is no trace.
    """
    place = _kept(file, model)
    if place.is_file() and not again:
        return str(json.loads(place.read_text(encoding="utf-8"))["started"])
    return Trace.read(file).provenance.get("started", "")


def diagnosed(file: Path, model: Model, again: bool = False) -> dict[str, Any]:
    """Start time and sizes of a trace, by `diagnose` or from what was kept of an earlier call.

    Raises:
        InputError: a trace that cannot be judged; that is not kept.
    """
    place = _kept(file, model)
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


def _kept(file: Path, model: Model) -> Path:
    """Where the answer of a trace is kept: under a hash of the trace, the model and the code that judges."""
    try:
        content = file.read_bytes()
    except OSError as error:
        raise InputError(file, "", f"a readable file ({error.strerror})") from error
    theirs = {f for e in model.effects if (f := CATALOGUE[e].file)}
    own = [hashlib.sha256(Path(f).read_bytes()).hexdigest() for f in sorted(theirs)]
    text = json.dumps([sorted(model.values.items()), model.effects, own, model.plant, digest("plant", "fdi")])
    return cache_folder() / "trend" / f"{hashlib.sha256(content + text.encode()).hexdigest()[:32]}.json"
