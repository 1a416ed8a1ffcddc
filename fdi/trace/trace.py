"""A recording as numpy columns: the one thing that crosses from the rig to analysis, and its only container there."""
from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, get_type_hints

import numpy as np
from numpy.typing import NDArray

from fdi.trace.check_result import CheckResult
from fdi.trace.csv_table import read_csv, require_growth, write_csv
from fdi.trace.declaration import DECLARATION, read_declaration
from fdi.trace.mcap_log import Log, open_log
from fdi.trace.sections import Floats, Section, find_sections
from fdi.trace.sensor_dynamics import SensorDynamics, read_sensors
from plant import EHA, InputError, Signal, Signals, escape_control_characters, require

if TYPE_CHECKING:
    from plant import Part  # a bench that reads its own log does not load the compiler

Flags = NDArray[np.bool_]
Messages = list[tuple[int, Any]]  # (time ns, protobuf message)

PER_ROW = ("t", "phase", "usable", "filled", "incomplete")  # columns of a trace beside its signals
SETUP, MAIN, CLEANUP = 0, 1, 2
MOST_MESSAGES = 100_000  # events of a log that are read: a node can send a thousand emergencies a second


class Gap(NamedTuple):
    """Cycles that have no row at all."""

    t0: float  # s, last row before
    t1: float  # s, first row after
    cycles: int


class Event(NamedTuple):
    """Something that happened once."""

    t: float  # s
    level: str  # INFO, WARN, ERROR
    kind: str
    text: str


class Nmt(NamedTuple):
    """A node's NMT state from this time on."""

    t: float  # s
    node: int
    code: int  # CiA 301: 0 boot-up, 4 stopped, 5 operational, 127 pre-operational
    name: str


class Timing(NamedTuple):
    """When each cycle ran: columns of shape (cycles,), wall-clock seconds."""

    t: Floats  # s, on the trace's own axis
    lateness: Floats
    response: Floats  # NaN: no answer
    work: Floats
    overrun: NDArray[np.bool_]
    feedback_response: Floats  # NaN: none came; older logs do not have this column and those behind it
    valve_response: Floats
    execution: Floats


R = TypeVar("R", Event, Nmt, CheckResult)
_NONE = np.empty(0)
NO_TIMING = Timing(_NONE, _NONE, _NONE, _NONE, np.empty(0, bool), _NONE, _NONE, _NONE)


@dataclass(frozen=True, eq=False)
class Trace:
    """One row per cycle, also for cycles that are missing: their samples are NaN.

    Row k holds the sensed outputs at the start of cycle k, the command that the controller gets then, and the drive
    that it answers. Columns have shape (n,) and the units of `units`, SI as a rule; a signal that was not measured is
    NaN throughout. t = 0 is where the main phase starts. A column is an attribute by the name of its signal too
    (`trace.xj`), unless a trace has an attribute of that name itself.

    A trace that was prepared for replay (fdi.estimation.replay) has command, drive and load without gaps, names the
    `outputs` that replays are compared with, and flags the rows for which that cannot be done.
    """

    t: Floats
    declared: Signals  # of the plant that was recorded
    columns: Mapping[str, Floats]  # of all declared signals, by name, without the time
    period: float  # s
    phase: NDArray[np.int64]  # 0 set-up, 1 main, 2 clean-up
    usable: Flags  # rows that a replay can be compared with; all rows of a trace that was not prepared
    filled: Flags  # rows whose drive is interpolated
    incomplete: Flags  # rows in which command, controlled signal or drive was not recorded, though they were filled
    units: Mapping[str, str]  # by signal
    chambers: Floats | None = None  # (n, 2) Pa, pressures of both chambers, where they were measured one by one
    outputs: tuple[str, ...] = ()  # measured and chosen ones; none in a trace that was not prepared
    gaps: tuple[Gap, ...] = ()
    provenance: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # what reading had to leave out
    events: tuple[Event, ...] = ()
    checks: tuple[CheckResult, ...] = ()
    nmt: tuple[Nmt, ...] = ()
    timing: Timing = NO_TIMING
    attachments: Mapping[str, bytes] = field(default_factory=dict)  # enough to repeat the run
    sensors: Mapping[str, SensorDynamics] = field(default_factory=dict)  # by signal, of those that are not ideal
    parts: tuple[Part, ...] = ()  # pieces of a longer recording that the rows are; none: one piece
    slack: float = 0.0  # half a step of the controlled signal, where a prepared trace holds it in coarse steps
    lead: Mapping[str, Floats] = field(default_factory=dict)  # columns of the set-up before, where only main was read

    def __len__(self) -> int:
        return len(self.t)

    @property
    def sequence_checks(self) -> tuple[CheckResult, ...]:
        """The checks of the sequence, each over a window of the run."""
        return tuple(check for check in self.checks if not check.is_protocol)

    @property
    def protocol_checks(self) -> tuple[CheckResult, ...]:
        """The checks that every run makes of the controller's behaviour on the bus."""
        return tuple(check for check in self.checks if check.is_protocol)

    def __getattr__(self, name: str) -> Floats:
        """The column of a signal of that name."""
        if name.startswith("_") or name == "columns" or name not in self.columns:  # the second while it is unpickled
            raise AttributeError(f"a trace without signal {name!r}" if name != "columns" else name)
        return self.columns[name]

    @classmethod
    def read(cls, path: str | Path, *, all: bool = False, signals: Signals = EHA) -> Trace:
        """Read trace.mcap (its main phase, or every phase with `all`), a run's folder, .csv or .csv.gz.

        `signals` are those of the plant whose columns a CSV file has; a log that says which it holds does not need
        them. Raises InputError, naming file, line or field, for what cannot be a trace.
        """
        path = Path(path)
        require(path.exists(), path, "", "a readable file or the folder of a run; it does not exist")
        if path.is_dir():
            path /= "trace.mcap"
            require(path.is_file(), path.parent, "", "the folder of a run; it has no trace.mcap")
        if path.suffix == ".mcap":
            return _from_log(open_log(path), all, signals)
        if path.name.endswith((".csv", ".csv.gz")):
            columns, notes, plant, signals = read_csv(path, signals)
            return make_table_trace(path, columns, signals, notes, plant)
        raise InputError(path, "", "a trace: .mcap, .csv, .csv.gz or the folder of a run")

    @classmethod
    def from_columns(cls, columns: Mapping[str, Floats], period: float, provenance: Mapping[str, str],
                     signals: Signals = EHA) -> Trace:
        """A trace from columns of shape (n,): at least command, controlled signal and drive of the `signals`; and t."""
        rows = len(columns[signals.command.name])
        grid = {"t": np.round(np.arange(rows) * period, 9), **columns}
        return _make_trace(grid, signals, period, np.arange(rows), provenance=dict(provenance))

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the signals that have at least one sample."""
        return tuple(name for name in self.declared.names if not np.isnan(self.columns[name]).all())

    def column(self, name: str) -> Floats:
        """A column by the name of its signal, or t. Raises KeyError."""
        return self.t if name == "t" else self.columns[name]

    @property
    def command(self) -> Floats:
        """What the controller is asked for."""
        return self.columns[self.declared.command.name]

    @property
    def controlled(self) -> Floats:
        """What of the plant the controller controls, as sensed."""
        return self.columns[self.declared.controlled.name]

    @property
    def drive(self) -> Floats:
        """What the controller answers, and what drives the plant."""
        return self.columns[self.declared.drive.name]

    @property
    def load(self) -> Floats:
        """The external load; zero for a plant that declares none."""
        signal = self.declared.load
        return np.zeros(len(self)) if signal is None else self.columns[signal.name]

    def take_rows(self, rows: NDArray[np.int64] | slice, **fields: Any) -> Trace:
        """The same trace with these of its rows, and other `fields`."""
        row_fields: dict[str, Any] = {name: getattr(self, name)[rows] for name in PER_ROW}
        chambers = None if self.chambers is None else self.chambers[rows]
        columns = {name: column[rows] for name, column in self.columns.items()}
        return replace(self, **{**row_fields, "columns": columns, "chambers": chambers, "lead": {}, **fields})

    def with_columns(self, columns: Mapping[str, Floats], **fields: Any) -> Trace:
        """The same trace with other columns for these signals, and other `fields`. Raises KeyError."""
        if unknown_names := columns.keys() - self.columns.keys():
            raise KeyError(unknown_names.pop())
        return replace(self, columns={**self.columns, **columns}, **fields)

    def join_lead(self) -> Trace:
        """The trace from the start of its set-up on, whose rows are not usable: there the plant rests.

        The trace itself where there is none, or where it takes longer than main: a replay is then mostly of the set-up.
        """
        rows = len(self.lead.get(self.declared.command.name, ()))
        if not 0 < rows <= len(self):
            return self
        before, unusable = self.t[0] + self.period * np.arange(-rows, 0), np.zeros(rows, bool)
        columns = {name: np.concatenate([self.lead[name], column]) for name, column in self.columns.items()}
        drive = columns[self.declared.drive.name]
        drive[:rows] = hold_last(np.append(0.0, drive[:rows]))[1:]  # as a plant does that misses it
        return replace(self, t=np.concatenate([np.round(before, 9), self.t]), columns=columns, lead={},
                       phase=np.concatenate([np.full(rows, SETUP), self.phase]),
                       usable=np.concatenate([unusable, self.usable]), filled=np.concatenate([unusable, self.filled]),
                       incomplete=np.concatenate([unusable, self.incomplete]))

    def with_inputs(self, command: Floats | None = None, drive: Floats | None = None, load: Floats | None = None,
                    **fields: Any) -> Trace:
        """The same trace with other inputs, (n,) each, and other `fields`."""
        d = self.declared
        inputs = ((d.command, command), (d.drive, drive), (d.load, load))
        return self.with_columns({s.name: column for s, column in inputs if s is not None and column is not None},
                                 **fields)

    @cached_property
    def scale(self) -> float:
        """The size of the motion: lengths that are right for a ram, whose command is at most 1 m, are multiplied by it.

        It is the largest command that the plant declares, else a hundred times the range of this one; in an open loop
        those of the controlled signal.
        """
        signal = self.declared.controlled if self.declared.is_open_loop else self.declared.command
        return measure_scale(signal, self.columns[signal.name])

    def mask_unusable(self, name: str) -> Floats:
        """A column, NaN where it is missing or its row cannot be used."""
        return np.where(self.usable, self.column(name), np.nan)

    @cached_property
    def measurements(self) -> Floats:
        """The outputs as rows (s, n), NaN where they are missing or cannot be used."""
        return np.array([self.mask_unusable(name) for name in self.outputs])

    @cached_property
    def output_names(self) -> tuple[str, ...]:
        """Names of all outputs that the plant declares, in the order of the columns of a replay."""
        return tuple(s.name for s in self.declared.outputs)

    @property
    def output_columns(self) -> list[int]:
        """Where the outputs stand among the columns of a replay."""
        return [self.output_names.index(name) for name in self.outputs]

    def pass_sensors(self, outputs: Floats) -> Floats:
        """A model's outputs, (.., n, outputs), as the sensors of this trace show them."""
        if not self.sensors:
            return outputs
        readings = outputs.copy()
        for i, name in enumerate(self.output_names):
            if name in self.sensors:
                readings[..., i] = self.sensors[name].apply(outputs[..., i], self.period)
        return readings

    @property
    def filtered(self) -> tuple[str, ...]:
        """The outputs whose sensors filter or delay."""
        return tuple(name for name in self.output_names if name in self.sensors and self.sensors[name].filters)

    @cached_property
    def anchor(self) -> Floats:
        """What a replay is drawn to: the controlled signal as measured, and known in the first row, where it starts."""
        anchor = self.unlagged.copy()
        if np.isnan(anchor[0]):
            anchor[0] = anchor[~np.isnan(anchor)][0]
        return anchor

    @cached_property
    def unlagged(self) -> Floats:
        """The controlled signal without the lag of its sensor: a replay drawn to it as measured would lag behind."""
        name = self.declared.controlled.name
        return self.sensors[name].undo(self.controlled, self.period) if name in self.filtered else self.controlled

    def with_notes(self, *notes: str) -> Trace:
        """The same trace with more notes."""
        return replace(self, notes=(*self.notes, *notes))

    def __repr__(self) -> str:
        source = self.provenance.get("source", "")
        names = ", ".join(name for name in self.output_names if name in self.signals)
        of = f" of {source}" if source else ""
        return f"<Trace{of}: {len(self)} cycles of {1e3 * self.period:g} ms, {len(self) * self.period:g} s, {names}>"

    def sections(self) -> list[Section]:
        """Hold, step, ramp and dynamic sections of the command in this trace."""
        return list(self._sections)

    @cached_property
    def _sections(self) -> tuple[Section, ...]:
        # once: every panel of a figure shades them
        return tuple(find_sections(self.command, self.period, self.scale))

    def write_csv(self, path: str | Path) -> None:
        """Write t and the measured signals; missing cycles become gaps in t. Raises InputError."""
        measured_names = {*self.declared.required, *self.signals}
        names = ("t", *(name for name in self.declared.names if name in measured_names))
        has_value = ~np.all([np.isnan(self.column(name)) for name in names[1:]], axis=0)
        write_csv(Path(path), {name: self.column(name)[has_value] for name in names})


def make_table_trace(path: Path, columns: dict[str, Floats], signals: Signals, notes: tuple[str, ...] = (),
                     plant: str = "") -> Trace:
    """The trace of the columns of a file, t among them, (rows,); `plant`: whose rig wrote it in its own columns.

    Raises:
        InputError: fewer than two rows, or more than one a cycle.
    """
    t = columns.pop("t")
    require(len(t) >= 2, path, "t", "at least two rows")
    require_growth(t, path, "t")
    typical = float(np.percentile(np.diff(t), 50, method="lower"))
    rows = np.concatenate([[0], np.cumsum(np.rint(np.diff(t) / typical).astype(int))])
    if (np.diff(rows) < 1).any():
        line = int(np.argmin(np.diff(rows))) + 3
        raise InputError(f"{path}: line {line}", "t", f"one row per cycle of {typical:g} s")
    period = round(float(t[-1] - t[0]) / float(rows[-1]), 9)
    grid = _spread_rows(path, rows, {**columns, "t": t})
    grid["t"] = np.where(np.isnan(grid["t"]), np.round(t[0] + period * np.arange(len(grid["t"])), 9), grid["t"])
    return _make_trace(grid, signals, period, rows, notes=notes,
                       provenance={"source": path.name} | ({"plant": plant} if plant else {}))


def _spread_rows(path: Path, rows: NDArray[np.int64], columns: Mapping[str, Floats]) -> dict[str, Floats]:
    """Columns, shape (m,), spread over all cycles 0..rows[-1]: NaN where there is none."""
    n = int(rows[-1]) + 1
    # The columns are as long as the numbers say, not as the file.
    require(n <= 10 * len(rows) + 1_000_000, path, "t", f"gaps that leave more than {len(rows)} of {n} cycles")
    out = {name: np.full(n, math.nan) for name in columns}
    for name, values in columns.items():
        out[name][rows] = values
    return out


def _make_trace(grid: Mapping[str, Floats], signals: Signals, period: float, rows: NDArray[np.int64], **more: Any
                ) -> Trace:
    """The trace of columns in which cycles without one of the `rows` are NaN."""
    t = grid["t"]
    columns = {name: grid.get(name, np.full(len(t), math.nan)) for name in signals.names}
    if "pa" in grid and "pb" in grid:
        more["chambers"] = np.column_stack([grid["pa"], grid["pb"]])
    fields = {"phase": np.full(len(t), MAIN), "units": {s.name: s.unit for s in signals}, **more,
              "usable": np.ones(len(t), bool), "filled": np.zeros(len(t), bool), "incomplete": np.zeros(len(t), bool)}
    gaps = tuple(Gap(float(t[a]), float(t[b]), int(b - a - 1)) for a, b in pairwise(rows) if b - a > 1)
    return Trace(t=t, declared=signals, columns=columns, period=period, gaps=gaps, **fields)


def _from_log(log: Log, all_phases: bool, declared: Signals) -> Trace:
    declaration = read_declaration(log.path, log.metadata.get(DECLARATION, {}))
    if declaration is not None and not set(declared.names) < set(declaration.names):  # a model need not know them all
        declared = declaration
    signals, timing = log.read_columns("/signals"), log.read_columns("/timing")
    rest = {name: [(time_ns, message) for _, time_ns, message in log.read_messages(name, most=MOST_MESSAGES)]
            for name in ("/events", "/nmt", "/checks")}
    names = declared.names
    _require_numbers(log, "/signals", signals, ("cycle", "phase", *names))
    _require_numbers(log, "/timing", timing, ("cycle", *Timing._fields[1:5]))
    notes = [f"only the first {MOST_MESSAGES} messages of {name} were read"
             for name, messages in rest.items() if len(messages) == MOST_MESSAGES]
    run = dict(log.metadata.get("run", {}))
    require(len(signals["time_ns"]), log.path, "/signals", "at least one cycle")
    table = np.column_stack([signals[name].astype(float) for name in ("time_ns", "cycle", "phase", *names)])
    table = table[np.argsort(table[:, 1], kind="stable")]
    cycle, phase = table[:, 1].astype(int), table[:, 2].astype(int)
    if (np.diff(cycle) == 0).any():
        raise InputError(log.path, "/signals.cycle", f"each cycle once, not {cycle[:-1][np.diff(cycle) == 0][0]} again")
    period = _find_period(log, run, table[:, 0] * 1e-9, cycle)
    main = np.flatnonzero(phase == MAIN)
    require(all_phases or len(main), log.path, "/signals.phase", "a main phase; this run ended in its set-up")
    first = main[0] if len(main) else 0
    span = slice(None) if all_phases else slice(main[0], main[-1] + 1)
    seconds = _make_clock(table[:, 0], (cycle - cycle[first]) * period, table[first, 0])
    rows, lead = cycle[span] - cycle[span][0], dict[str, Floats]()
    grid = _spread_rows(log.path, rows, {name: table[span, 3 + i] for i, name in enumerate(names)}
                        | {"phase": phase[span].astype(float)})
    if first and not all_phases:
        before = _spread_rows(log.path, cycle[:first + 1] - cycle[0],
                              {name: table[:first + 1, 3 + i] for i, name in enumerate(names)})
        lead = {name: column[:-1] for name, column in before.items()}
    row_phases = hold_last(grid.pop("phase"))
    grid["t"] = np.round((np.arange(len(row_phases)) + (cycle[span][0] - cycle[first])) * period, 9)
    more = {f"{name}.{key}": value for name, record in log.metadata.items() if name not in ("run", DECLARATION)
            for key, value in record.items()}  # as `verdict.status`
    texts = {escape_control_characters(key): escape_control_characters(text) for key, text in {**run, **more}.items()}
    return _make_trace(grid, declared, period, rows, phase=row_phases.astype(int),
                       provenance={"source": log.path.name, **texts},
                       units={s.name: s.unit for s in declared} | log.read_units("/signals"),
                       attachments=log.attachments,
                       notes=tuple(notes), sensors=read_sensors(log.path, run), lead=lead,
                       timing=_select_timing(timing, cycle[span], int(cycle[first]), period),
                       events=tuple(_list_records(log, "/events", Event, rest, seconds)),
                       nmt=tuple(_list_records(log, "/nmt", Nmt, rest, seconds)),
                       checks=tuple(_list_records(log, "/checks", CheckResult, rest, seconds)))


def _list_records(log: Log, topic: str, kind: type[R], rest: Mapping[str, Messages],
                  seconds: Callable[[float], float]) -> Iterator[R]:
    """The messages of a topic as records, at `seconds` of their log time where the record has a time.

    Texts lose their control characters, which would command the terminal they are printed on.

    Raises:
        InputError: messages that lack a field, or have a text for a number or the reverse.
    """
    fields = get_type_hints(kind)
    for time_ns, message in rest[topic]:
        values: dict[str, Any] = {}
        for name, field_type in fields.items():
            absent = getattr(kind, name, None)  # logs of earlier versions lack a field that has a default
            value = seconds(time_ns) if name == "t" else getattr(message, name, absent)
            if not isinstance(value, str | int | float) or isinstance(value, str) != (field_type is str):
                raise InputError(log.path, f"{topic}.{name}", f"a field of this name with a {field_type.__name__}")
            values[name] = escape_control_characters(value) if isinstance(value, str) else value
        yield kind(**values)


def _require_numbers(log: Log, topic: str, columns: Mapping[str, NDArray[Any]], names: Iterable[str]) -> None:
    """Refuse messages that lack one of these fields, or have something else than a number in it.

    Raises:
        InputError: it names the field.
    """
    for name in names if len(columns["time_ns"]) else ():
        require(name in columns and columns[name].ndim == 1 and columns[name].dtype.kind in "bfiu", log.path,
                f"{topic}.{name}", "a field of this name with a number")


def _find_period(log: Log, run: Mapping[str, str], t: Floats, cycle: NDArray[np.int64]) -> float:
    """The run's own figure, else the median over the cycles, to the microsecond."""
    figure = run.get("period", round(float(np.median(np.diff(t) / np.diff(cycle))), 6) if len(t) > 1 else 1e-3)
    try:
        period = float(figure)
    except ValueError:
        period = math.nan
    # the bounds hold for no NaN
    require(1e-6 <= period <= 3600.0, log.path, "metadata run.period",
            f"seconds, from 1e-6 to 3600, not {str(figure)!r}")
    return period


def _make_clock(time_ns: Floats, t: Floats, zero_ns: float) -> Callable[[float], float]:
    """Log time, ns, to s on the rows' own axis, where a cycle is one period long however long it took.

    Rows were logged at `time_ns` and stand at `t`, shape (rows,) both; a real-time run that was late by whole periods
    has jumps in the first and none in the second. Before the first row and after the last a second is a second.
    """
    log_times = np.maximum.accumulate(time_ns - zero_ns) / 1e9

    def convert_to_seconds(at_ns: float) -> float:
        at = (at_ns - zero_ns) / 1e9
        beyond = min(at - log_times[0], 0.0) + max(at - log_times[-1], 0.0)
        return round(float(np.interp(at, log_times, t) + beyond), 9)

    return convert_to_seconds


def _select_timing(columns: Mapping[str, NDArray[Any]], cycles: NDArray[np.int64], zero: int, period: float) -> Timing:
    """Of the cycles that have a row; t = 0 at cycle `zero`."""
    has_row = np.isin(columns.get("cycle", []), cycles)
    if not has_row.any():
        return NO_TIMING
    t = (columns["cycle"][has_row].astype(int) - zero) * period
    absent = np.full(len(has_row), math.nan)
    return Timing(np.round(t, 9), *(columns.get(name, absent)[has_row] for name in Timing._fields[1:]))


# Single columns, shape (n,): missing samples are NaN.


def measure_scale(signal: Signal, column: Floats) -> float:
    """The size of the motion of a signal with this column, (n,): see `Trace.scale`."""
    if math.isfinite(signal.largest):
        return signal.largest
    return 1.0 if np.isnan(column).all() else 100.0 * float(np.nanmax(column) - np.nanmin(column)) or 1.0


def hold_last(x: Floats) -> Floats:
    """`x` with each missing sample replaced by the last one before it; 0 before the first sample.

    >>> hold_last(np.array([np.nan, 1.0, np.nan, 2.0])).tolist()
    [0.0, 1.0, 1.0, 2.0]
    """
    return np.nan_to_num(x[np.maximum.accumulate(np.where(np.isnan(x), 0, np.arange(len(x))))])


def hold_next(x: Floats) -> Floats:
    """`x` with each missing sample replaced by the first one after it; 0 after the last sample."""
    return hold_last(x[::-1])[::-1]


def fill_gaps(x: Floats) -> Floats:
    """`x` with straight lines over its missing samples, the end values beyond the first and the last; else zeros."""
    rows, has_value = np.arange(len(x)), ~np.isnan(x)
    return np.interp(rows, rows[has_value], x[has_value]) if has_value.any() else np.zeros(len(x))


def shift_rows(x: Floats, rows: int) -> Floats:
    """`x` delayed by so many rows (negative: advanced); the end values are repeated.

    >>> shift_rows(np.arange(4), 1).tolist(), shift_rows(np.arange(4), -1).tolist()
    ([0, 0, 1, 2], [1, 2, 3, 3])
    """
    return x[np.clip(np.arange(len(x)) - rows, 0, len(x) - 1)]


def find_stretches(flags: Flags) -> NDArray[np.int64]:
    """First row and stop of each stretch of rows, (m, 2), in which `flags` (n,) are up.

    >>> find_stretches(np.array([True, False, True, True])).tolist()
    [[0, 1], [2, 4]]
    """
    return np.flatnonzero(np.diff(flags, prepend=False, append=False)).reshape(-1, 2)


def bridge_gaps(x: Floats, longest: int) -> tuple[Floats, Flags]:
    """Fill gaps of up to `longest` samples with cubics through the two samples on either side.

    Longer gaps, and one at the start, hold the last sample and are flagged in the second result. Straight lines replace
    the cubics at the ends and where the samples beside a gap are far apart.
    """
    is_missing = np.isnan(x)
    rows = np.arange(len(x))
    sample_rows = rows[~is_missing]
    values = np.interp(rows, sample_rows, x[sample_rows])
    is_unknown = np.zeros(len(x), bool)
    for first, stop in find_stretches(is_missing):
        is_unknown[first:stop] = stop - first > longest or first == 0
    gaps = rows[is_missing & ~is_unknown]
    after = np.searchsorted(sample_rows, gaps)
    is_inner = (after >= 2) & (after < len(sample_rows) - 1)
    gaps, neighbours = gaps[is_inner], sample_rows[after[is_inner][:, None] + np.arange(-2, 2)]
    is_narrow = neighbours[:, 3] - neighbours[:, 0] <= longest + 5
    values[gaps[is_narrow]] = _interpolate_cubic(neighbours[is_narrow], x[neighbours[is_narrow]], gaps[is_narrow])
    return np.where(is_unknown, hold_last(x), values), is_unknown


def rms(x: Floats) -> float:
    """Root mean square of the samples that are there; NaN if there are none."""
    samples = x[~np.isnan(x)]
    return float(np.sqrt(np.mean(samples**2))) if len(samples) else float("nan")


def _interpolate_cubic(at: NDArray[np.int64], values: Floats, rows: NDArray[np.int64]) -> Floats:
    """Lagrange's cubics through `values` (m, 4) at rows `at` (m, 4), evaluated at `rows` (m,)."""
    out = np.zeros(len(rows))
    for i in range(4):
        others = [j for j in range(4) if j != i]
        parts = (rows[:, None] - at[:, others]) / (at[:, [i]] - at[:, others])
        out += values[:, i] * parts.prod(axis=1)
    return out
