"""Other formats to and from a log: CSV of the signals; raw frames as candump .log, Vector .blf/.asc or PEAK .trc."""
from __future__ import annotations

import struct
import time
from array import array
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fdi.output import require_writable, write_whole
from fdi.trace import Trace, combine_columns, find_own_table, locate_log, make_table_trace, open_log, write_sensors
from fdi.trace.importing.conversion import ImportMap
from fdi.trace.importing.formats import Channel, Measurement, open_measurement
from plant import InputError, count_nouns, read_file, report_system_error, require, signals as plant_signals
from rig.benches import (
    FD,
    PROFILES,
    SWITCHED,
    Bench,
    FrameSpec,
    Role,
    State,
    decode_device_text,
    describe_identifier,
    read_database,
    unpack,
)
from rig.network import Frame, find_cob_id, make_message, name_state
from rig.recorder.schema import Event, NmtState, Record, Signals, collect_provenance, make_row_record
from rig.recorder.writer import Recorder

if TYPE_CHECKING:
    import can


RAW_SUFFIXES = (".log", ".blf", ".asc", ".trc")


def export_trace(source: Path, out: Path, everything: bool = False) -> int:
    """Write a trace as the suffix of `out` says: .csv, .csv.gz: the signals; .log, .blf, .asc, .trc: the raw frames.

    `everything`: signals of set-up and clean-up too; raw frames are always all of them. -> rows or frames written.
    Raises InputError for another suffix, and for a trace without raw frames.
    """
    if out.name.endswith((".csv", ".csv.gz")):
        trace = Trace.read(source, all=everything)
        trace.write_csv(require_writable(out, "--out", source=source))
        return len(trace)
    require(out.suffix in RAW_SUFFIXES, out, "--out", f"a name that ends in .csv, .csv.gz, {', '.join(RAW_SUFFIXES)}")
    import can

    path = locate_log(source)
    require(path.suffix == ".mcap", path, "", "a log with raw frames (.mcap)")
    raw = list(read_raw_frames(path))
    require(raw, path, "/can", "at least one raw frame")
    require(not (out.suffix == ".trc" and any(frame.cob_id & FD for frame in raw)), out, "--out",
            "a name that ends in .log, .blf or .asc: a .trc would lose the CAN FD frames")
    with (report_system_error(out, "--out", "a place that can be written"),
          write_whole(require_writable(out, "--out")) as part, can.Logger(part) as writer):
        for frame in raw:
            writer(make_message(frame.cob_id, frame.data, timestamp=frame.t_ns / 1e9,
                                channel="can0" if out.suffix == ".log" else 0))
    return len(raw)


def read_raw_frames(path: Path) -> Iterator[Frame]:
    """The raw frames of a log."""
    for _, t_ns, message in open_log(path).read_messages("/can"):
        yield Frame(t_ns, message.cob_id, message.data)


def import_csv(source: Path, out: Path, signals: plant_signals.Signals = plant_signals.EHA) -> int:
    """Make a log with signals only from a CSV trace with the columns of these `signals`; -> cycles."""
    return _write_own(Trace.read(source, signals=signals), source, out)


def import_own_table(source: Path, out: Path) -> int | None:
    """Make a log of a file in the columns of a plant's own rig, such as a MAT file; -> cycles, None: they are not.

    Raises:
        InputError: a file that cannot be read.
    """
    measurement = open_measurement(source)
    own_table = find_own_table(lambda _: measurement.units)
    if own_table is None:
        return None
    plant, table = own_table
    channels = measurement.read(sorted(table.sources), ())
    columns = combine_columns({name: channel.values for name, channel in channels.items()}, table)
    unused_names = sorted(set(measurement.units) - table.sources)
    notes = (f"columns that are not used: {', '.join(unused_names)}",) if unused_names else ()
    return _write_own(make_table_trace(source, columns, plant.signals, notes, plant.name), source, out)


def _write_own(trace: Trace, source: Path, out: Path) -> int:
    write_mcap(trace, out, collect_provenance(
        imported=source.name, period=trace.period, pace="imported",
        **{key: value for key, value in trace.provenance.items() if key == "plant"}))
    return len(trace)


def write_imported(trace: Trace, import_map: ImportMap, out: Path) -> None:
    """Write an imported trace as a log, with its map as an attachment and where it comes from as metadata."""
    attached = replace(trace, attachments={"map.toml": import_map.text.encode()})
    write_mcap(attached, out, collect_provenance(period=repr(trace.period), pace="imported", **trace.provenance))


def write_mcap(trace: Trace, out: Path, metadata: Mapping[str, str] | None = None) -> None:
    """Write a trace's signals as a log; `metadata` is its own provenance by default.

    Raises:
        RecorderError: a place that cannot be written.
    """
    provenance = {"period": repr(trace.period), **trace.provenance} if metadata is None else metadata
    attachments = {name: ("application/octet-stream", data) for name, data in trace.attachments.items()}
    _write_log(out, attachments, {**provenance, **write_sensors(trace.sensors)}, _list_rows(trace),
               trace.declared)


def _list_rows(trace: Trace, block: int = 10_000) -> Iterator[tuple[int, Signals]]:
    """The rows of a trace that have a value, made in blocks: those of a long recording would fill the memory."""
    signals = np.column_stack([trace.columns[name] for name in trace.declared.names])
    make: Callable[..., Signals] = make_row_record(trace.declared)
    rows = np.flatnonzero(~np.isnan(signals).all(axis=1))
    for first in range(0, len(rows), block):
        part = rows[first:first + block]
        for k, phase, values in zip(part.tolist(), trace.phase[part].tolist(), signals[part].tolist(), strict=True):
            yield round(k * trace.period * 1e9), make(k, phase, *values, 0, 0, 0)


def _write_log(out: Path, attachments: Mapping[str, tuple[str, bytes]], metadata: Mapping[str, str],
               items: Iterable[Frame | tuple[int, Record]],
               signals: plant_signals.Signals = plant_signals.EHA) -> None:
    """Write raw frames, and records with their times, as fast as the writer can: here nothing paces the loop."""
    with write_whole(out) as part:
        recorder = Recorder(part, attachments, metadata, declared=signals)
        for k, item in enumerate(items):
            if isinstance(item, Frame):
                recorder.frame(item)
            else:
                recorder.put(*item)
            while k % 10_000 == 0 and recorder.waiting > 100_000:
                time.sleep(0.01)
        recorder.close()


def import_frames(source: Path, out: Path, bench: Bench) -> int:
    """Make a log from the raw frames of a bench, cut into cycles at each SYNC or demand; -> cycles of its main phase.

    Row k holds the demand of cycle k, what the plant sensed in it and the drive frame that answers it. Main is the
    longest piece between two starts of the plant's node, which a run resets after its probes, from where the controller
    is first told to be active to where it last is.
    Raises InputError for a file that cannot be read, and when there is no cycle in it.
    """
    cycles = _CycleBuilder(bench)
    items: list[Frame | tuple[int, Record]] = []
    for t, message in list_can_messages(source):
        frame = Frame(max(0, round(t * 1e9)), find_cob_id(message), bytes(message.data))
        items += [frame, *((frame.t_ns, record) for record in cycles.feed(frame))]
    starts = [t_ns for t_ns, _ in cycles.rows]
    sync = bench.frames.sync
    begin = f"{cycles.begin.name} frame" if sync is None else f"SYNC frame (0x{sync:03X})"
    require(starts, source, "", f"at least one {begin}")
    spans = np.sort(np.diff(starts))
    middle = float(spans[len(spans) // 2]) if len(spans) else bench.cycle_ns
    first, stop = max(pairwise([0, *cycles.plant_starts, len(starts)]), key=lambda piece: piece[1] - piece[0])
    active_word = PROFILES[bench.profile].ladder[State.ACTIVE]
    active_rows = [k for k in range(first, stop) if cycles.rows[k][1].control == active_word]
    if active_rows:
        first, stop = active_rows[0], active_rows[-1] + 1
    for k, (_, row) in enumerate(cycles.rows):
        row.phase = int(k >= first) + int(k >= stop)
    period = bench.cycle_ns / 1e9
    if not 0.9 < middle / bench.cycle_ns < 1.1:  # another speed; times of receipt are some microseconds off
        period = round(middle / 1e9, 4)
        if abs(period - middle / 1e9) > 5e-6:
            period = round(middle / 1e9, 6)
    items = sorted([*items, *cycles.rows], key=lambda item: item[0])
    _write_log(out, {name: ("text/plain", data) for name, data in bench.files.items()},
               collect_provenance(imported=source.name, period=period, pace="imported"), items, bench.signals)
    return stop - first


_WORDS = {"control_word": "control", "status_word": "status", "flags": "flags"}


class _CycleBuilder:
    """Frames in, one Signals a cycle out; heartbeats and emergencies become records on the way."""

    def __init__(self, bench: Bench) -> None:
        self.rows: list[tuple[int, Signals]] = []
        self.plant_starts: list[int] = []  # rows before each boot-up of the plant's node
        self._plant_node = bench.find_number(Role.PLANT)
        self._frames, self._is_canopen = bench.frames, bool(bench.nodes)
        # without SYNC a cycle begins with the first frame of the rig, of those that it sends most often
        self.begin = min(bench.frames.list_from(Role.RIG), key=lambda each: each.every)
        self._record: Any = make_row_record(bench.signals)
        self._columns = {**{s.word: s.name for s in bench.signals[1:]}, **_WORDS}
        self._lasting = (bench.signals.command.word, "control_word")  # in force until the next one comes
        self._waiting: dict[str, float] = {}  # values for the next cycle
        self._sent: int | None = None  # cycle of the command since the last SYNC
        self._recent: deque[tuple[int, Signals]] = deque(maxlen=8)  # an answer is late by a few cycles at most
        self._nmt: dict[int, int] = {}
        self._emcy = {0x080 + node: node for node in range(1, 128)} | {
            each.emcy_id: each.node for each in bench.nodes.values() if each.emcy_id is not None}

    def feed(self, frame: Frame) -> Iterable[Record]:
        """Take a frame; -> what is to be recorded besides rows."""
        cob_id, node = frame.cob_id & ~SWITCHED, frame.cob_id & 0x7F
        spec = self._frames.find(cob_id, frame.data)
        if cob_id == self._frames.sync:
            self._open(frame.t_ns)
        elif spec is not None:
            if len(frame.data) < spec.length:
                return [Event("WARN", "frame",
                              f"{describe_identifier(cob_id)}: {count_nouns(len(frame.data), 'byte')} instead of "
                              f"{spec.length}")]
            self._take(frame.t_ns, spec, unpack(spec, frame.data[:spec.length]))
        elif (self._is_canopen and 0x700 < cob_id < 0x780 and len(frame.data) == 1
              and self._nmt.get(node) != frame.data[0]):
            state = self._nmt[node] = frame.data[0]
            if node == self._plant_node and not state:  # its boot-up
                self.plant_starts.append(len(self.rows))
            return [NmtState(node, state, name_state(state).lower())]
        elif self._is_canopen and cob_id in self._emcy and len(frame.data) == 8:
            code = int.from_bytes(frame.data[:2], "little")
            return [Event("ERROR" if code else "INFO", "emcy", f"node {self._emcy[cob_id]}: 0x{code:04X}")]
        return []

    def _open(self, t_ns: int) -> None:
        cycle, next_number = (self.rows[-1][1].cycle + 1, self._recent[-1][0] + 1) if self.rows else (0, 0)
        number = next_number if self._sent is None else self._sent
        gap = (number - next_number) & 0xFFFF if self.rows else 0
        cycle += gap if gap < 1000 else 0  # the counter of a bench started anew is no gap
        row = self._record(cycle, 1, *(np.nan for _ in range(len(self._columns) - len(_WORDS))), 0, 0, 0)
        self._fill(row, self._waiting)
        self.rows.append((t_ns, row))
        self._recent.append((number & 0xFFFF, row))
        self._waiting = {name: value for name, value in self._waiting.items() if name in self._lasting}
        self._sent = None

    def _take(self, t_ns: int, spec: FrameSpec, values: Mapping[str, float]) -> None:
        if spec.sender is Role.CONTROLLER:
            for number, row in list(self._recent)[-1 if "cycle" not in values else 0:]:
                if number == values.get("cycle", number):
                    self._fill(row, values)
        elif spec.is_before_sync or (self._frames.sync is None and spec is self.begin):
            self._waiting |= values
            self._sent = int(values["cycle"]) if "cycle" in values else self._sent
            if not spec.is_before_sync:
                self._open(t_ns)
        else:
            self._waiting |= {name: value for name, value in values.items() if name in self._lasting}
            if self.rows:
                self._fill(self.rows[-1][1], values)

    def _fill(self, row: Signals, values: Mapping[str, float]) -> None:
        """Put the values of a frame into a row."""
        for name, value in values.items():
            if (column := self._columns.get(name)) is not None:
                setattr(row, column, round(value) if name in _WORDS else value)


def list_can_messages(source: Path) -> Iterator[tuple[float, can.Message]]:
    """The data frames of a CAN log (.log of candump, .blf, .asc, .trc) and their times since the first of them, s.

    Raises:
        InputError: a file that cannot be read or is no such log.
    """
    import can
    from can.io.blf import BLFParseError

    first = None
    try:
        with can.LogReader(source) as reader:
            for message in reader:
                is_remote = message.is_remote_frame and not message.is_fd  # of .asc: an empty frame
                if not (message.is_error_frame or is_remote):
                    first = message.timestamp if first is None else first
                    yield message.timestamp - first, message
    except OSError as error:
        raise InputError(source, "", f"a readable file ({error.strerror})") from error
    except (ValueError, IndexError, struct.error, can.CanError, BLFParseError) as error:
        raise InputError(source, "", f"CAN frames as {source.suffix} ({error})") from error


def _read_signals(path: Path, messages: Mapping[tuple[int, bool], Any], names: Collection[str],
                  dates: Collection[str]) -> dict[str, Channel]:
    """Signals "message.signal" and their times since the first frame of a log. Frames that are too short are left out.

    `messages`: (identifier, is extended) to the message of the DBC.

    Raises:
        InputError: a log that cannot be read, or without a frame of one of the signals.
    """
    message_names = {name.rpartition(".")[0] for name in names}
    columns = {name: (array("d"), array("d")) for name in names}  # values, times
    for t, frame in list_can_messages(path):
        message = messages.get((frame.arbitration_id, frame.is_extended_id))
        if message is None or message.name not in message_names or len(frame.data) < message.length:
            continue
        for signal, value in message.decode(bytes(frame.data), decode_choices=False).items():
            name = f"{message.name}.{signal}"
            if name in columns:
                columns[name][0].append(float(value))
                columns[name][1].append(t)
    for name, (values, _) in columns.items():
        require(values, path, name, "at least one frame of this message")
    return {name: Channel(*map(np.frombuffer, column)) for name, column in columns.items()}


def open_can_log(path: Path, dbc: Path) -> Measurement:
    """A CAN log with the signals of a DBC.

    Raises:
        InputError: a DBC that cannot be read or has no signals.
    """
    messages: dict[tuple[int, bool], Any] = {
        (m.frame_id, m.is_extended_frame): m
        for m in read_database(str(dbc), decode_device_text(read_file(dbc))).messages}
    units = {f"{m.name}.{s.name}": s.unit or "" for m in messages.values() for s in m.signals}
    require(units, dbc, "--dbc", "a DBC file with at least one signal")
    return Measurement(path, f"CAN log, {dbc.name}", units, partial(_read_signals, path, messages), has_times=True)
