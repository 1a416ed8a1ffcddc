"""Other formats to and from a log: CSV of the signals; raw frames as candump .log, Vector .blf/.asc or PEAK .trc."""
from __future__ import annotations

import math
import time
from array import array
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fdi.output import require_writable, write_whole
from fdi.trace.importing.formats import Channel
from fdi.trace.importing.import_map import ImportMap
from fdi.trace.mcap_log import open_log
from fdi.trace.sensor_dynamics import write_sensors
from fdi.trace.trace import Trace
from plant.errors import InputError
from rig.network import codec
from rig.network.frame import Frame
from rig.network.node_objects import NmtState as State
from rig.recorder.schema import Event, NmtState, Record, Signals, collect_provenance
from rig.recorder.writer import Recorder

if TYPE_CHECKING:
    import can


RAW_SUFFIXES = (".log", ".blf", ".asc", ".trc")
NAN = math.nan


def export_trace(source: Path, out: Path, everything: bool = False) -> int:
    """Write a trace as the suffix of `out` says: .csv, .csv.gz: the signals; .log, .blf, .asc, .trc: the raw frames.

    `everything`: signals of set-up and clean-up too; raw frames are always all of them. -> rows or frames written.
    Raises InputError for another suffix, and for a trace without raw frames.
    """
    if out.name.endswith((".csv", ".csv.gz")):
        trace = Trace.read(source, all=everything)
        trace.write_csv(require_writable(out, "--out", source=source))
        return len(trace)
    if out.suffix not in RAW_SUFFIXES:
        raise InputError(out, "--out", f"a name that ends in .csv, .csv.gz, {', '.join(RAW_SUFFIXES)}")
    import can

    path = source / "trace.mcap" if source.is_dir() else source
    if path.suffix != ".mcap":
        raise InputError(path, "", "a log with raw frames (.mcap)")
    raw = list(read_raw_frames(path))
    if not raw:
        raise InputError(path, "/can", "at least one raw frame")
    try:
        with write_whole(require_writable(out, "--out")) as part, can.Logger(part) as writer:
            for frame in raw:
                writer(can.Message(timestamp=frame.t_ns / 1e9, arbitration_id=frame.cob_id, data=frame.data,
                                   is_extended_id=False, channel="can0" if out.suffix == ".log" else 0))
    except OSError as error:
        raise InputError(out, "--out", f"a place that can be written ({error.strerror})") from error
    return len(raw)


def read_raw_frames(path: Path) -> Iterator[Frame]:
    """The raw frames of a log."""
    for _, t_ns, message in open_log(path).read_messages("/can"):
        yield Frame(t_ns, message.cob_id, message.data)


def import_csv(source: Path, out: Path) -> int:
    """Make a log with signals only from a CSV trace; -> cycles."""
    trace = Trace.read(source)
    write_mcap(trace, out, collect_provenance(imported=source.name, period=trace.period, pace="imported"))
    return len(trace)


def write_imported(trace: Trace, chosen: ImportMap, out: Path) -> None:
    """Write an imported trace as a log, with its map as an attachment and where it comes from as metadata."""
    attached = replace(trace, attachments={"map.toml": chosen.text.encode()})
    write_mcap(attached, out, collect_provenance(period=repr(trace.period), pace="imported", **trace.provenance))


def write_mcap(trace: Trace, out: Path, metadata: Mapping[str, str] | None = None) -> None:
    """Write a trace's signals as a log; `metadata` is its own provenance by default.

    Raises InputError for a place that cannot be written; unlike a run it makes no folder.
    """
    given = {"period": repr(trace.period), **trace.provenance} if metadata is None else metadata
    given = {**given, **write_sensors(trace.sensors)}
    attachments = {name: ("application/octet-stream", data) for name, data in trace.attachments.items()}
    with write_whole(_require_mcap(out)) as part:
        recorder = Recorder(part, attachments, given)
        columns: tuple[NDArray[Any], ...] = (trace.phase, trace.com, trace.xj, trace.cor, trace.p12, trace.xs,
                                             trace.load)
        for k, (phase, *values) in enumerate(_list_rows(columns)):
            if not all(math.isnan(value) for value in values):
                com, xj, cor, p12, xs, load = values
                recorder.put(round(k * trace.period * 1e9), Signals(k, phase, com, xj, cor, p12, xs, load, 0, 0, 0))
                _wait_for_writer(recorder, k)
        recorder.close()


def _list_rows(columns: Sequence[NDArray[Any]], block: int = 10_000) -> Iterator[tuple[Any, ...]]:
    """The rows of columns as Python numbers, made in blocks: those of a long recording would fill the memory."""
    for first in range(0, len(columns[0]), block):
        yield from zip(*(column[first:first + block].tolist() for column in columns), strict=True)


def import_frames(source: Path, out: Path, dbc: Path) -> int:
    """Make a log from raw frames, decoded by `dbc` and cut into cycles at each SYNC; -> cycles.

    Row k holds the demand sent before SYNC k, what the plant sensed at it and the drive frame that echoes its number.
    Raises InputError for a file or DBC that cannot be read, and when there is no SYNC in it.
    """
    raw = list(_read_frames(source))
    cycles = _CycleBuilder(_load_decoder(dbc))
    records = [(frame.t_ns, record) for frame in raw for record in cycles.feed(frame)]
    if not cycles.rows:
        raise InputError(source, "", f"at least one SYNC frame (0x{codec.SYNC:03X})")
    spans = [b[0] - a[0] for a, b in zip(cycles.rows, cycles.rows[1:], strict=False)]
    period = round(sorted(spans)[len(spans) // 2] / 1e9, 4) if spans else 1e-3
    items: list[tuple[int, Frame | Record]] = [(f.t_ns, f) for f in raw]
    items += [*cycles.rows, *records]
    with write_whole(_require_mcap(out)) as part:
        recorder = Recorder(part, {dbc.name: ("text/plain", dbc.read_bytes())},
                            collect_provenance(imported=source.name, period=period, pace="imported"))
        for k, (t_ns, item) in enumerate(sorted(items, key=lambda pair: pair[0])):
            if isinstance(item, Frame):
                recorder.frame(item)
            else:
                recorder.put(t_ns, item)
            _wait_for_writer(recorder, k)
        recorder.close()
    return len(cycles.rows)


class _CycleBuilder:
    """Frames in, one Signals a SYNC out; heartbeats and emergencies become records on the way."""

    def __init__(self, decode: dict[int, Any]) -> None:
        self.rows: list[tuple[int, Signals]] = []
        self._decode = decode
        self._demand, self._control = NAN, 0
        self._sent: int | None = None  # cycle of the command since the last SYNC
        self._recent: deque[tuple[int, Signals]] = deque(maxlen=8)  # an answer is late by a few cycles at most
        self._nmt: dict[int, int] = {}

    def feed(self, frame: Frame) -> Iterable[Record]:
        """Take a frame; -> what is to be recorded besides rows."""
        cob_id, node = frame.cob_id, frame.cob_id & 0x7F
        if cob_id == codec.SYNC:
            self._open(frame.t_ns)
        elif cob_id in self._decode:
            message = self._decode[cob_id]
            if len(frame.data) < message.length:
                return [Event("WARN", "frame", f"0x{cob_id:03X}: {len(frame.data)} bytes instead of {message.length}")]
            self._signals(cob_id, message.decode(frame.data, decode_choices=False))
        elif 0x700 < cob_id < 0x780 and len(frame.data) == 1 and self._nmt.get(node) != frame.data[0]:
            self._nmt[node] = frame.data[0]
            return [NmtState(node, frame.data[0], _name_state(frame.data[0]))]
        elif codec.SYNC < cob_id < 0x100 and len(frame.data) == 8:
            code = int.from_bytes(frame.data[:2], "little")
            return [Event("ERROR" if code else "INFO", "emcy", f"node {node}: 0x{code:04X}")]
        return []

    def _open(self, t_ns: int) -> None:
        cycle, expected = (self.rows[-1][1].cycle + 1, self._recent[-1][0] + 1) if self.rows else (0, 0)
        sent = expected if self._sent is None else self._sent
        skipped = (sent - expected) & 0xFFFF if self.rows else 0
        cycle += skipped if skipped < 1000 else 0  # the counter of a bench started anew is no gap
        row = Signals(cycle, 1, self._demand, NAN, NAN, NAN, NAN, NAN, self._control, 0, 0)
        self.rows.append((t_ns, row))
        self._recent.append((sent & 0xFFFF, row))
        self._sent = None

    def _signals(self, cob_id: int, values: dict[str, Any]) -> None:
        if cob_id == codec.COMMAND:
            self._demand, self._control = values["position_demand"], values["control_word"]
            self._sent = values["cycle"]
        elif cob_id == codec.FEEDBACK and self.rows:
            self.rows[-1][1].xj, self.rows[-1][1].p12 = values["ram_position"], values["load_pressure"]
        elif cob_id == codec.VALVE_STATE and self.rows:
            self.rows[-1][1].xs, self.rows[-1][1].flags = values["spool_position"], values["flags"]
        elif cob_id == codec.DRIVE:
            for sent, row in self._recent:
                if sent == values["cycle"]:
                    row.cor, row.status = values["current"], values["status_word"]


def _name_state(code: int) -> str:
    try:
        return State(code).name.lower().replace("_", "-")
    except ValueError:
        return f"state {code}"


def _read_frames(source: Path) -> Iterator[Frame]:
    first = None
    for message in list_can_messages(source):
        if message.is_extended_id or message.is_fd:
            continue
        first = message.timestamp if first is None else first
        t_ns = max(0, round((message.timestamp - first) * 1e9))
        yield Frame(t_ns, message.arbitration_id, bytes(message.data))


def list_can_messages(source: Path) -> Iterator[can.Message]:
    """The data frames of a CAN log (.log of candump, .blf, .asc, .trc), one by one.

    Raises:
        InputError: a file that cannot be read or is no such log.
    """
    import can
    from can.io.blf import BLFParseError

    try:
        with can.LogReader(source) as reader:
            for message in reader:
                if not (message.is_error_frame or message.is_remote_frame):
                    yield message
    except OSError as error:
        raise InputError(source, "", f"a readable file ({error.strerror})") from error
    except (ValueError, IndexError, can.CanError, BLFParseError) as error:
        raise InputError(source, "", f"CAN frames as {source.suffix} ({error})") from error


def _load_decoder(dbc: Path) -> dict[int, Any]:
    import cantools

    try:
        base = cantools.database.load_file(str(dbc), database_format="dbc")
    except OSError as error:
        raise InputError(dbc, "--dbc", f"a readable file ({error.strerror})") from error
    except cantools.Error as error:
        raise InputError(dbc, "--dbc", f"a DBC file ({str(error).splitlines()[0]})") from error
    found = {m.frame_id: m for m in base.messages}  # type: ignore[union-attr]
    wanted: dict[int, set[str]] = {}
    for signal in codec.SIGNALS:
        wanted.setdefault(signal.cob_id, set()).add(signal.name)
    for cob_id, names in wanted.items():
        if cob_id not in found or not names <= {s.name for s in found[cob_id].signals}:
            raise InputError(dbc, f"frame 0x{cob_id:03X}", f"the signals {', '.join(sorted(names))}")
    return {cob_id: found[cob_id] for cob_id in wanted}


def _require_mcap(out: Path) -> Path:
    if out.suffix != ".mcap":
        raise InputError(out, "--out", "a name that ends in .mcap")
    return require_writable(out, "--out")


def _wait_for_writer(recorder: Recorder, item: int) -> None:
    """Let the writer keep up: here nothing paces the loop."""
    if item % 10_000 == 0:
        while recorder.waiting > 100_000:
            time.sleep(0.01)


@dataclass(frozen=True)
class CanMeasurement:
    """A CAN log and the messages of its DBC; channels are named by message and signal, with a dot."""

    path: Path
    format: str
    units: Mapping[str, str]
    messages: Mapping[tuple[int, bool], Any]  # (identifier, is extended) to the message of the DBC
    has_times: bool = True

    def read(self, names: Collection[str], dates: Collection[str] = ()) -> dict[str, Channel]:
        """The signals and their times since the first frame of the log. Frames that are too short are left out.

        Raises:
            InputError: a log that cannot be read, or without a frame of one of the signals.
        """
        wanted: dict[str, list[str]] = {}
        for name in names:
            message, _, signal = name.rpartition(".")
            wanted.setdefault(message, []).append(signal)
        values = {name: array("d") for name in names}
        times = {name: array("d") for name in names}
        first: float | None = None
        for frame in list_can_messages(self.path):
            first = frame.timestamp if first is None else first
            known = self.messages.get((frame.arbitration_id, frame.is_extended_id))
            if known is None or known.name not in wanted or len(frame.data) < known.length:
                continue
            found = known.decode(bytes(frame.data), decode_choices=False)
            for signal in wanted[known.name]:
                if signal in found:  # of a multiplexed message, those of this frame
                    name = f"{known.name}.{signal}"
                    values[name].append(float(found[signal]))
                    times[name].append(frame.timestamp - first)
        for name, column in values.items():
            if not column:
                raise InputError(self.path, name, "at least one frame of this message")
        return {name: Channel(np.frombuffer(values[name]), np.frombuffer(times[name])) for name in names}


def open_can_log(path: Path, dbc: Path) -> CanMeasurement:
    """A CAN log with the signals of a DBC.

    Raises:
        InputError: a DBC that cannot be read or has no signals.
    """
    import cantools

    try:
        base: Any = cantools.database.load_file(str(dbc))
    except OSError as error:
        raise InputError(dbc, "--dbc", f"a readable file ({error.strerror})") from error
    except (cantools.Error, ValueError) as error:
        reason = str(error).splitlines()
        raise InputError(dbc, "--dbc", f"a DBC file ({reason[0] if reason else type(error).__name__})") from error
    messages = {(m.frame_id, m.is_extended_frame): m for m in getattr(base, "messages", ())}
    units = {f"{m.name}.{s.name}": s.unit or "" for m in messages.values() for s in m.signals}
    if not units:
        raise InputError(dbc, "--dbc", "a DBC file with at least one signal")
    return CanMeasurement(path, f"CAN log, {dbc.name}", units, messages)
