"""The log of a run: the loop appends to a queue, a thread of its own packs and writes.

The thread wakes every 10 ms, so that it holds the interpreter lock for some 0.15 ms at a time and not for milliseconds;
compression and disk writes release the lock. A chunk is closed at 64 KiB, 0.25 s of run time or 0.2 s of wall time,
whichever comes first: that bounds what a killed process loses. Cycles that were played together come as columns, and
become the same bytes of the log as one by one.
"""
from __future__ import annotations

import os
import struct
import threading
import time
import zlib
from array import array
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from functools import cache, partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from numpy.typing import NDArray

from fdi.trace import DECLARATION, write_declaration
from plant import RigError, signals as plant_signals
from rig.network import Frame
from rig.recorder.schema import (
    CHANNELS,
    TOPICS,
    CanFrame,
    Event,
    Record,
    Signals,
    Timing,
    describe_channel,
    encode_schema,
    list_row_fields,
    make_packer,
    make_row_record,
)


class CycleBlock(NamedTuple):
    """Some cycles: the frames of all, and the rows of all but the last, which is still under way."""

    t_ns: NDArray[np.int64]  # (n,) time of each
    frames: Sequence[tuple[int, NDArray[np.int64] | None]]  # in order: COB-ID, (n,) payloads of 8 bytes; None: 0 bytes
    columns: Mapping[str, Any]  # each field of `record` and Timing: (n,), or one value for all
    record: Any = Signals  # type of a row

    def list_frames(self, cob_id: int) -> list[Frame]:
        """The frames with this COB-ID."""
        return [Frame(t_ns, cob_id, data.to_bytes(8, "little", signed=True))
                for identifier, payload in self.frames if identifier == cob_id and payload is not None
                for t_ns, data in zip(self.t_ns.tolist(), payload.tolist(), strict=True)]

    def make_row(self, i: int) -> tuple[Signals, Timing]:
        """A cycle as records."""
        row = {name: column[i].item() if isinstance(column, np.ndarray) else column
               for name, column in self.columns.items()}
        timing: Any = Timing
        signals, timing = (kind(*map(row.get, kind.__slots__)) for kind in (self.record, timing))
        return signals, timing


def pack_block(block: CycleBlock, epoch_ns: int) -> tuple[bytes, dict[int, NDArray[np.uint64]]]:
    """The messages of a block in the order in which they were sent, and for each channel its pairs of an index.

    A pair is the log time and the place of the message in the bytes.
    """
    kind, template = _make_template(tuple((cob_id, payload is not None) for cob_id, payload in block.frames),
                                    block.record)
    count, times = len(block.t_ns), (block.t_ns + epoch_ns).astype(np.uint64)
    table = np.frombuffer(template * count, kind).copy()
    for i, (_, payload) in enumerate(block.frames):
        if payload is not None:
            table[f"{i}"]["data"] = payload
    for name in (Signals.__name__, Timing.__name__):
        part = table[name]
        for column in block.columns.keys() & set(part.dtype.names or ()):
            part[column] = block.columns[column]
    for name in kind.names or ():
        table[name]["time"] = table[name]["published"] = times
    places = {name: int(offset) for name, (_, offset) in (kind.fields or {}).items()}  # type: ignore[misc]
    starts = np.arange(count, dtype=np.uint64) * np.uint64(kind.itemsize)
    kinds: dict[type, tuple[list[str], int]] = {
        CanFrame: ([f"{i}" for i in range(len(block.frames))], count),
        **{record: ([record.__name__], count - 1) for record in (block.record, Timing)}}
    index = {}
    for record, (names, rows) in kinds.items():
        pairs = np.empty((rows, len(names), 2), np.uint64)
        for j, name in enumerate(names):
            pairs[:, j, 0], pairs[:, j, 1] = times[:rows], starts[:rows] + np.uint64(places[name])
        index[CHANNELS[record]] = pairs.ravel()
    return table.tobytes()[:places[Signals.__name__] - kind.itemsize], index


@cache
def _make_template(frames: tuple[tuple[int, bool], ...], row: Any) -> tuple[np.dtype[Any], bytes]:
    """The messages of one cycle as a type and as bytes, numbers and payloads zero: its frames, then its row."""
    pack = make_packer(CanFrame)
    names, kinds, parts = [], [], []
    for i, (cob_id, has_payload) in enumerate(frames):
        tail = [("tag", "u1"), ("length", "u1"), *([("data", "<i8")] if has_payload else [])]
        names.append(f"{i}")
        kinds.append(np.dtype([*list_row_fields(CanFrame), *tail]))
        parts.append(pack(0, (0, cob_id, bytes(8 * has_payload))))
    for record in (row, Timing):
        names.append(record.__name__)
        kinds.append(np.dtype(list_row_fields(record)))
        parts.append(make_packer(record)(0, record(*[0] * len(record.__slots__))))  # type: ignore[arg-type]
    return np.dtype(list(zip(names, kinds, strict=True))), b"".join(parts)


CHUNK_BYTES = 64 * 1024
CHUNK_NS = 250_000_000  # run time
CHUNK_WALL = 0.2  # s
DRAIN_EVERY = 0.01  # s
MOST_BLOCKS = 300  # waiting, of up to 500 cycles
QUEUE_LIMIT = 2_000_000  # items; a disk that hangs must not eat the memory
LIBRARY = "eha-rig"
_make_index = partial(array, "Q")
Observer = Callable[[Event], None]  # gets the events of a run in the writing thread, 10 ms behind the run


class RecorderError(RigError):
    """The log cannot be written any more (disk full, folder gone, disk too slow). Raised once, to the loop."""


def list_topics(signals: plant_signals.Signals = plant_signals.EHA) -> dict[str, type]:
    """The record of each topic, for a plant with these signals."""
    return {**TOPICS, "/signals": make_row_record(signals)}


def list_channels(signals: plant_signals.Signals = plant_signals.EHA) -> list[McapRecord]:
    """Schemas and channels of a log of a plant with these signals; both have the number of the channel."""
    topics = list_topics(signals)
    schemas = [Schema(id=CHANNELS[record], data=encode_schema(record), encoding="protobuf",
                      name=f"eha.{record.__name__}") for record in topics.values()]
    channels = [Channel(id=CHANNELS[record], topic=topic, message_encoding="protobuf",
                        metadata=describe_channel(record), schema_id=CHANNELS[record])
                for topic, record in topics.items()]
    return [*schemas, *channels]


class Recorder:
    """Writes one run to `path`, attachments and metadata first so that they outlive a crash.

    attachments: name -> (media type, bytes); metadata: name -> text. Times are ns since the run's start. In the file
    they are counted from `epoch_ns`, ns since 1970, which the metadata record `clock` holds: other programs then show
    dates, and two runs with the same seed still differ in this one number only.
    Raises RecorderError when the file cannot be made; later, once, from `cycle` or `put` when it cannot be written, or
    from `close` if neither was called since. After that everything is accepted and dropped, so that the loop
    can still bring the run to rest.
    """

    frame: Callable[[Frame], None]  # record a raw frame; the queue's own append, so it costs 30 ns

    def __init__(self, path: Path, attachments: Mapping[str, tuple[str, bytes]], metadata: Mapping[str, str],
                 epoch_ns: int = 0, observer: Observer | None = None,
                 declared: plant_signals.Signals = plant_signals.EHA) -> None:
        self.path = path
        self._epoch_ns, self._observer = epoch_ns, observer
        self._failure: RecorderError | None = None  # that the loop has not heard of
        self._queue: deque[Any] = deque()
        self.frame = self._queue.append
        self._stop = threading.Event()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = McapFile(path, LIBRARY, list_channels(declared))
            for name, (media_type, data) in attachments.items():
                self._file.write_attachment(name, media_type, data, time.time_ns())
            self._file.write_metadata("run", metadata)
            if declared != plant_signals.EHA:  # which a log without declaration has
                self._file.write_metadata(DECLARATION, write_declaration(declared))
            if epoch_ns:
                start = datetime.fromtimestamp(epoch_ns // 10**9, UTC).isoformat()
                self._file.write_metadata("clock", {"epoch_ns": str(epoch_ns), "start": start})
        except OSError as error:
            raise _describe_failure(path, error) from error
        self._packers = {record: make_packer(record) for record in list_topics(declared).values()}
        self._parts: list[bytes] = []
        self._size = 0
        self._first_ns = 0
        self._index: dict[int, array[int]] = defaultdict(_make_index)
        self._closed_at = time.monotonic()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def cycle(self, t_ns: int, signals: Signals, timing: Timing) -> None:
        """Record one cycle; raises RecorderError once when the log is lost."""
        self._queue.append((t_ns, signals))
        self.put(t_ns, timing)

    def cycles(self, block: CycleBlock) -> None:
        """Record cycles that were played together; raises RecorderError once when the log is lost.

        They come faster than any clock: a disk that is slower holds the run up, and memory does not fill.
        """
        while len(self._queue) > MOST_BLOCKS and self._thread.is_alive():
            time.sleep(DRAIN_EVERY)
        self.put(int(block.t_ns[0]), block)

    def put(self, t_ns: int, record: Record | CycleBlock) -> None:
        """Record anything but a raw frame; raises RecorderError once when the log is lost."""
        self._queue.append((t_ns, record))
        if self._failure is not None:
            self._tell()

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add names and values known only later, such as the verdict."""
        self._queue.append((0, (name, dict(values))))

    @property
    def waiting(self) -> int:
        """Records not yet packed."""
        return len(self._queue)

    def close(self) -> None:
        """Write all that is queued, the indexes and statistics. Safe to call again."""
        self._stop.set()
        self._thread.join()
        self._tell()

    def _tell(self) -> None:
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def _run(self) -> None:
        try:
            while not self._stop.wait(DRAIN_EVERY):
                self._drain()
                if time.monotonic() - self._closed_at >= CHUNK_WALL:
                    self._close_chunk()
            self._drain()
            self._close_chunk()
            self._file.finish()
        except OSError as error:
            self._fail(_describe_failure(self.path, error))
        except Exception as error:  # a record that cannot be packed is a bug, but it must not end in silence
            self._fail(RecorderError(f"{self.path}: the log stops here: {type(error).__name__}: {error}"))

    def _fail(self, failure: RecorderError) -> None:
        self._failure = failure
        self._file.close()
        while not self._stop.wait(DRAIN_EVERY):
            self._queue.clear()

    def _drain(self) -> None:
        queue, packers, epoch_ns = self._queue, self._packers, self._epoch_ns
        waiting = len(queue)
        if waiting > QUEUE_LIMIT:
            raise OSError(0, f"the disk is too slow: {waiting} records waiting")
        pack_frame, frames = packers[CanFrame], CHANNELS[CanFrame]
        for _ in range(waiting):
            item = queue.popleft()
            if len(item) == 3:
                t_ns = item[0] + epoch_ns
                self._add(t_ns, frames, pack_frame(t_ns, item))
                continue
            t_ns, record = item
            pack = packers.get(type(record))
            if isinstance(record, CycleBlock):
                self._add_block(record)
            elif pack is None:
                self._file.write_metadata(*record)
            else:
                self._add(t_ns + epoch_ns, CHANNELS[type(record)], pack(t_ns + epoch_ns, record))
                if self._observer is not None and isinstance(record, Event):
                    self._observer(record)

    def _add(self, t_ns: int, channel: int, raw: bytes) -> None:
        self._make_room(t_ns, t_ns)
        self._index[channel].extend((t_ns, self._size))
        self._parts.append(raw)
        self._size += len(raw)

    def _add_block(self, block: CycleBlock) -> None:
        self._make_room(int(block.t_ns[0]) + self._epoch_ns, int(block.t_ns[-1]) + self._epoch_ns)
        raw, index = pack_block(block, self._epoch_ns)
        for channel, pairs in index.items():
            if len(pairs):
                pairs[1::2] += np.uint64(self._size)
                self._index[channel].frombytes(pairs.tobytes())
        self._parts.append(raw)
        self._size += len(raw)

    def _make_room(self, first_ns: int, last_ns: int) -> None:
        """Close the chunk if it is full, or too old for records of these times."""
        if self._parts and (self._size >= CHUNK_BYTES or last_ns - self._first_ns >= CHUNK_NS):
            self._close_chunk()
        if not self._parts:
            self._first_ns = first_ns

    def _close_chunk(self) -> None:
        self._closed_at = time.monotonic()
        if self._file.is_deleted():
            raise OSError(0, "the file was deleted while it was being written")
        if self._parts:
            self._file.write_chunk(b"".join(self._parts), self._index)
            self._parts, self._size, self._index = [], 0, defaultdict(_make_index)


def _describe_failure(path: Path, error: OSError) -> RecorderError:
    return RecorderError(f"{path}: the log cannot be written: {error.strerror or error}")


MAGIC = b"\x89MCAP0\r\n"


def encode_records(records: Iterable[McapRecord]) -> bytes:
    """The records as they stand in a file."""
    out = RecordBuilder()
    for record in records:
        record.write(out)
    return bytes(out.end())  # type: ignore[no-untyped-call]


class McapFile:
    """Appends attachments, metadata and chunks; `finish` writes indexes and statistics. OSError is the disk's own."""

    def __init__(self, path: Path, library: str, declarations: Iterable[McapRecord]) -> None:
        self._file: BinaryIO = path.open("wb", buffering=0)
        self._offset = 0
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.declare(declarations)
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._declared = False  # schemas and channels stand at the head of the first chunk
        self._write(MAGIC + encode_records([Header(profile="", library=library)]))

    def declare(self, records: Iterable[McapRecord]) -> None:
        """Take schemas and channels, which the first chunk and the summary repeat; other records are left out."""
        for record in records:
            if isinstance(record, Schema):
                self.schemas[record.id] = record
            elif isinstance(record, Channel):
                self.channels[record.id] = record

    def _write(self, data: bytes) -> None:
        view = memoryview(data)
        while view:
            view = view[self._file.write(view):]
        self._offset += len(data)

    def is_deleted(self) -> bool:
        """Whether the file was deleted while it is open: Linux would continue to write without an error."""
        return os.fstat(self._file.fileno()).st_nlink == 0

    def write_attachment(self, name: str, media_type: str, data: bytes, time_ns: int = 0) -> None:
        """Write a file into the log."""
        raw = encode_records([Attachment(time_ns, time_ns, name, media_type, data)])
        self._attachments.append(AttachmentIndex(self._offset, len(raw), time_ns, time_ns, len(data), name, media_type))
        self._write(raw)

    def write_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record: names and values."""
        raw = encode_records([Metadata(name=name, metadata=dict(values))])
        self._metadata.append(MetadataIndex(self._offset, len(raw), name))
        self._write(raw)

    def write_chunk(self, raw: bytes, index: Mapping[int, array[int]]) -> None:
        """Messages as records, and for each channel its pairs (log time ns, offset in `raw`) in one flat array."""
        if not self._declared:
            head = encode_records([*self.schemas.values(), *self.channels.values()])
            raw, shift, self._declared = head + raw, len(head), True
            index = {c: array("Q", (v + shift * (i & 1) for i, v in enumerate(pairs))) for c, pairs in index.items()}
        content = zstandard.compress(raw)
        times = [t for pairs in index.values() for t in (min(pairs[::2]), max(pairs[::2]))]
        chunk = Chunk("zstd", content, max(times), min(times), zlib.crc32(raw), len(raw))
        out = [encode_records([chunk])]
        length = len(out[0])
        where, offsets = self._offset + length, {}
        for channel, pairs in index.items():
            self._counts[channel] = self._counts.get(channel, 0) + len(pairs) // 2
            offsets[channel] = where
            body = pairs.tobytes()  # little endian on every machine this runs on
            out.append(struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + len(body), channel, len(body)) + body)
            where += len(out[-1])
        self._chunks.append(ChunkIndex(length, self._offset, "zstd", len(content), chunk.message_end_time,
                                       where - self._offset - length, offsets, chunk.message_start_time, len(raw)))
        self._write(b"".join(out))

    def build_statistics(self) -> Statistics:
        """Statistics of the file so far."""
        return Statistics(attachment_count=len(self._attachments), channel_count=len(self.channels),
                          channel_message_counts=dict(self._counts), chunk_count=len(self._chunks),
                          message_count=sum(self._counts.values()), metadata_count=len(self._metadata),
                          message_start_time=min((c.message_start_time for c in self._chunks), default=0),
                          message_end_time=max((c.message_end_time for c in self._chunks), default=0),
                          schema_count=len(self.schemas))

    def finish(self) -> None:
        """Write the summary and close."""
        self._write(encode_records([DataEnd(data_section_crc=0)]))
        start, summary, offsets = self._offset, b"", []
        groups: list[tuple[int, list[McapRecord]]] = [
            (Opcode.SCHEMA, [*self.schemas.values()]), (Opcode.CHANNEL, [*self.channels.values()]),
            (Opcode.STATISTICS, [self.build_statistics()]), (Opcode.CHUNK_INDEX, [*self._chunks]),
            (Opcode.ATTACHMENT_INDEX, [*self._attachments]), (Opcode.METADATA_INDEX, [*self._metadata])]
        for opcode, records in groups:
            if records:
                group = encode_records(records)
                offsets.append(SummaryOffset(opcode, start + len(summary), len(group)))
                summary += group
        at = start + len(summary)
        summary += encode_records(offsets)
        crc = zlib.crc32(summary + struct.pack("<BQQQ", Opcode.FOOTER, 20, start, at))
        self._write(summary + encode_records([Footer(start, at, crc)]) + MAGIC)
        self.close()

    def close(self) -> None:
        """Close the file as it stands."""
        self._file.close()
