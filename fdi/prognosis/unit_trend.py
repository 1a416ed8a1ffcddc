"""The trends of the faults of one unit."""
from __future__ import annotations

import contextlib
import csv
import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdi.diagnosis.faults import FAULTS, Estimate, Fault, Level, measure_departures
from fdi.output import write_text
from fdi.prognosis.trend import Trend, fit_trend
from fdi.progress import Progress
from fdi.sources import hash_sources
from fdi.trace import Trace, report_unreadable
from plant import InputError, Model, find_cache_folder, require

LIMIT_NAMES = {"maintenance": "MidBand", "non_nominal": "MaxBand"}


@dataclass(frozen=True, eq=False)
class UnitTrend:
    """The trends of the faults through the traces of one unit."""

    gathered: Gathered
    trends: tuple[Trend, ...]

    @property
    def level(self) -> Level:
        """The worst level at the last trace."""
        return max(trend.level for trend in self.trends)

    @property
    def unit(self) -> str:
        """Unit of time on the axis: days, h or flights."""
        return AXES[self.gathered.axis]


def follow_unit(gathered: Gathered) -> UnitTrend:
    """Follow the faults through the traces; one that falls, or goes both ways, by its distance from a healthy unit."""
    trends = (fit_trend(fault.turn_up(), [point.t for point in gathered.points],
                        [measure_departures(fault, point.sizes[fault.name]) for point in gathered.points])
              for fault in gathered.faults)
    return UnitTrend(gathered, tuple(replace(trend, declared=fault if fault.falls else None)
                                     for trend, fault in zip(trends, gathered.faults, strict=True)))


def read_points(path: Path, faults: Sequence[Fault] | None = None) -> Gathered:
    """Read the points of an earlier answer of `rig trend` from its JSON file; `faults`: default those of the answer.

    Raises:
        InputError: another kind of file.
    """
    try:
        answer = json.loads(path.read_text(encoding="utf-8"))
        faults = tuple(faults or (Fault(**table) for table in answer.get("faults", ()))) or FAULTS
        points = tuple(Point(str(p["trace"]), float(p["t"]), {
            f.name: Estimate(*(float(p[f.key][name]) for name in Estimate._fields)) for f in faults},
            str(p.get("note", ""))) for p in answer["points"])
        axis = str(answer["axis"])
        if not all(math.isfinite(p.t) and all(e.low <= e.value <= e.high for e in p.sizes.values()) for p in points):
            raise ValueError("finite times, and sizes within their intervals")
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(path, "", f"an answer of rig trend ({type(error).__name__}: {error})") from error
    require(axis in AXES and points, path, "axis", f"one of {', '.join(AXES)} and at least one point")
    return Gathered(str(path), axis, tuple(sorted(points, key=lambda p: p.t)), (), faults)


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
    faults: tuple[Fault, ...] = FAULTS


def gather_sizes(folder: Path, model: Model, progress: Progress, axis: str | None = None, table: Path | None = None,
                 again: bool = False, faults: Sequence[Fault] = FAULTS) -> Gathered:
    """Diagnose all traces of a folder and below.

    Args:
        folder: of one unit.
        model: the unit as delivered.
        progress: called with each stage and the share done, 0 to 1.
        axis: of time; default the first on which all traces have a place.
        table: of dates; default dates.csv in the folder, if there is one.
        again: diagnose again what has been diagnosed before.
        faults: what to follow.

    Raises:
        InputError: no folder, no traces, no axis on which all of them have a place, hours or flights that fall while
            the date rises, or none that can be judged.
    """
    place = table or folder / TABLE
    dates = read_dates_table(place) if table or place.is_file() else {}
    notes: list[str] = []
    rows: dict[Path, Row] = {}
    names = {file: file.relative_to(folder).as_posix() for file in list_traces(folder)}
    for file, name in names.items():
        try:
            rows[file] = _date_trace(folder, name, read_start_time(file, model, again, faults), find_row(dates, name))
        except InputError as error:
            notes.append(f"{name} left out: {str(error).removeprefix(f'{file}: ')}")
    axis = _choose_axis(folder, rows, axis)  # before the work: a trace without a date is refused at once
    matches = [find_row(dates, name) for name in names.values()]
    notes += [f"{key} is listed in {place.name}, but there is no such trace" for key, row in dates.items()
              if not any(row is match for match in matches)]  # two traces may have equal rows
    points: dict[tuple[float | Estimate, ...], Point] = {}
    for i, (file, row) in enumerate(rows.items()):
        progress(f"trace {i + 1} of {len(rows)}", i / len(rows))
        try:
            answer = diagnose_once(file, model, again, faults)
        except InputError as error:
            notes.append(f"{names[file]} left out: {str(error).removeprefix(f'{file}: ')}")
            continue
        sizes = {f.name: Estimate(*answer["sizes"][f.name]) for f in faults}
        first = points.setdefault((row[axis], *sizes.values()), Point(names[file], row[axis], sizes, answer["note"]))
        if first.trace != names[file]:  # noise never repeats a size to the last digit
            notes.append(f"{names[file]} left out: it is a copy of {first.trace}, with the same sizes at the same time")
    progress("trend", 1.0)
    if not points:
        raise InputError(folder, "", f"traces that can be judged; {notes[0]}" + (" ..." if notes[1:] else ""))
    return Gathered(str(folder), axis, tuple(sorted(points.values(), key=lambda p: (p.t, p.trace))), tuple(notes),
                    tuple(faults))


def list_traces(folder: Path) -> list[Path]:
    """All files of a folder and below that may be traces.

    Raises:
        InputError: no folder, or no such file.
    """
    require(folder.is_dir(), folder, "", "a folder of dated traces, or the JSON file of an earlier answer")
    paths = sorted(path for path in folder.rglob("*") if path.name.endswith(ENDINGS) and path.name != TABLE
                   and not any(part.startswith(".") for part in path.relative_to(folder).parts))
    require(paths, folder, "", "traces in it: .mcap, .csv or .csv.gz")
    return paths


def _date_trace(folder: Path, name: str, start_time: str, row: Row | None) -> Row:
    """The place of a trace on each axis: by the table, else by its own start time, else by its name."""
    row = row or dict.fromkeys(AXES, math.nan)
    if not math.isnan(row["date"]):
        return row
    day = parse_date(start_time)
    return {**row, "date": find_date_in_name(Path(folder.resolve().name) / name) if math.isnan(day) else day}


def _choose_axis(folder: Path, rows: Mapping[Path, Row], choice: str | None) -> str:
    """The axis asked for, or the first on which every trace has a place; hours or flights rise with the date."""
    without = {axis: [file for file, row in rows.items() if math.isnan(row[axis])] for axis in AXES}
    for axis in (choice,) if choice else AXES:
        if not without[axis]:
            dated = sorted((row["date"], row[axis], file) for file, row in rows.items() if not math.isnan(row["date"]))
            for (_, least, earlier), (_, count, file) in pairwise(dated):
                require(count >= least, file, axis,
                        f"at least the {least:g} of {earlier}, which has an earlier date, not {count:g}")
            return axis
    missing = choice or "date"
    expected = f"a line in {folder / TABLE} with a column {missing}" if missing != "date" else (
        "a start time in the log, an ISO date in the name of file or folder (2026-01-31), or a line in "
        f"{folder / TABLE} (file,date)")
    raise InputError(without[missing][0], missing, expected)


def read_start_time(file: Path, model: Model, again: bool = False, faults: Sequence[Fault] = FAULTS) -> str:
    """Start time in the log; "" if there is none.

    Raises:
        InputError: a file that is not a trace.
    """
    if (answer := _read_answer(_find_answer_file(file, model, faults), again)) is not None:
        return str(answer["started"])
    return Trace.read(file, signals=model.kind.signals).provenance.get("started", "")


def diagnose_once(file: Path, model: Model, again: bool = False, faults: Sequence[Fault] = FAULTS) -> dict[str, Any]:
    """Start time and sizes of a trace, by `diagnose` or from the answer stored by an earlier call.

    Raises:
        InputError: a trace that cannot be judged; this answer is not stored.
    """
    place = _find_answer_file(file, model, faults)
    answer = _read_answer(place, again)
    if answer is None:
        from fdi.diagnosis.diagnosis import diagnose

        trace = Trace.read(file, signals=model.kind.signals)
        d = diagnose(trace, model, source=str(file), faults=faults)
        answer = {"started": trace.provenance.get("started", ""),
                  "sizes": {name: list(size) for name, size in d.sizes.items()},
                  "note": "something else is wrong" if d.verdict == "SOMETHING_ELSE" else ""}
        with contextlib.suppress(OSError, InputError):  # an answer that cannot be kept is found again next time
            place.parent.mkdir(parents=True, exist_ok=True)
            write_text(place, json.dumps(answer), "the cache of answers")
    return answer


def _read_answer(place: Path, again: bool) -> dict[str, Any] | None:
    """The answer stored there; None if there is none, or it is not wanted again."""
    if again or not place.is_file():
        return None
    return dict(json.loads(place.read_text(encoding="utf-8")))


def _find_answer_file(file: Path, model: Model, faults: Sequence[Fault]) -> Path:
    """File for the answer of a trace: its name is a hash of the trace, the model, the faults and the code."""
    with report_unreadable(file, "UTF-8"):
        content = file.read_bytes()
    effect_files = {f for e in model.effects if (f := model.find_effect(e).file)}
    hashes = [hashlib.sha256(Path(f).read_bytes()).hexdigest() for f in sorted(effect_files)]
    text = json.dumps([sorted(model.values.items()), model.effects, hashes, model.plant, hash_sources("plant", "fdi"),
                       [asdict(fault) for fault in faults]])
    return find_cache_folder() / "trend" / f"{hashlib.sha256(content + text.encode()).hexdigest()[:32]}.json"


TABLE = "dates.csv"
AXES = {"date": "days", "hours": "h", "flights": "flights"}  # axis: its unit
Row = dict[str, float]  # places of a trace, by axis; a date in days since 1970-01-01, UTC; NaN where it has none
_DATE = re.compile(r"(?<!\d)(\d{4})-?([01]\d)-?([0-3]\d)(?:[T_ ]([0-2]\d)[-:]?([0-5]\d)(?:[-:]?([0-5]\d))?)?(?!\d)")


def parse_date(text: str) -> float:
    """An ISO date or time, UTC unless it names an offset, as days since 1970-01-01; NaN for any other text.

    >>> parse_date("1970-01-02"), parse_date("1970-01-01T12:00:00-12:00"), parse_date("soon")
    (1.0, 1.0, nan)
    """
    try:
        date = datetime.fromisoformat(text.strip())
    except ValueError:
        return math.nan
    return date.replace(microsecond=0, tzinfo=date.tzinfo or UTC).timestamp() / 86400


def format_day(day: float, with_time: bool = False) -> str:
    """The date of a day since 1970-01-01, with or without hours and minutes.

    >>> format_day(20454.7), format_day(20454.7, with_time=True)
    ('2026-01-01', '2026-01-01 16:48')
    """
    return str(np.datetime64(round(day * 1440.0), "m")).replace("T", " ")[:16 if with_time else 10]


def find_date_in_name(path: Path) -> float:
    """The date in a file's name, or in that of the nearest folder that has one, days since 1970-01-01; else NaN.

    >>> find_date_in_name(Path("unit7/2026-01-02/trace.mcap")) - parse_date("2026-01-01")
    1.0
    """
    days = (parse_date(f"{y}-{m}-{d}" + ("T" + ":".join(word or "00" for word in clock) if clock[0] else ""))
            for part in reversed(path.parts) for y, m, d, *clock in _DATE.findall(part))
    return next((day for day in days if not math.isnan(day)), math.nan)


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
    require("file" in head and set(AXES) & set(head), path, "header", "file and one or more of date, hours, flights")
    table: dict[str, Row] = {}
    for number, words in enumerate(rows[1:], 2):
        cells = dict(zip(head, (word.strip() for word in words), strict=False))
        name = cells.get("file", "").removeprefix("./")
        if not name:
            continue
        require(name not in table, f"{path}: line {number}", "file", f"each file once, not {name} again")
        table[name] = {axis: _read_cell(f"{path}: line {number}", axis, cells.get(axis, "")) for axis in AXES}
    return table


def _read_cell(where: str, axis: str, text: str) -> float:
    if not text:
        return math.nan
    try:
        value = parse_date(text) if axis == "date" else float(text)
    except ValueError:
        value = math.nan
    kind, least = ("an ISO date such as 2026-01-31", -math.inf) if axis == "date" else ("a number from 0", 0.0)
    require(math.isfinite(value) and value >= least, where, axis, f"{kind}, not {text}")
    return value


def find_row(table: Mapping[str, Row], name: str) -> Row | None:
    """The table's row of a trace by its path in the folder, POSIX; its folder, file name or stem will do, too."""
    path = Path(name)
    keys = (name, str(path.parent), path.name, path.name.partition(".")[0])
    return next((table[key] for key in keys if key in table), None)
