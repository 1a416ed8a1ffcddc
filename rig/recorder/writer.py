"""The log of a run: the loop appends to a queue, a thread of its own packs and writes.

The thread wakes every 10 ms, so that it holds the interpreter lock for some 0.15 ms at a time and not for milliseconds;
compression and disk writes release the lock. A chunk is closed at 64 KiB, 0.25 s of run time or 0.2 s of wall time,
whichever comes first: that bounds what a killed process loses.
"""
from __future__ import annotations

import threading
import time
from array import array
from collections import deque
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mcap.records import Channel, Schema

from plant.errors import RigError
from rig.network.frame import Frame
from rig.recorder.container import McapFile
from rig.recorder.schema import (
    CHANNELS,
    TOPICS,
    CanFrame,
    Record,
    Signals,
    Timing,
    describe_channel,
    encode_schema,
    make_packer,
)

CHUNK_BYTES = 64 * 1024
CHUNK_NS = 250_000_000  # run time
CHUNK_WALL = 0.2  # s
DRAIN_EVERY = 0.01  # s
QUEUE_LIMIT = 2_000_000  # items; a disk that hangs must not eat the memory
LIBRARY = "eha-rig"


class RecorderError(RigError):
    """The log cannot be written any more (disk full, folder gone, disk too slow). Raised once, to the loop."""


def list_channels() -> tuple[list[Schema], list[Channel]]:
    """Schemas and channels of a log of this rig."""
    schemas, out = [], []
    for topic, record in TOPICS.items():
        number = CHANNELS[record]
        schemas.append(Schema(id=number, data=encode_schema(record), encoding="protobuf",
                              name=f"eha.{record.__name__}"))
        out.append(Channel(id=number, topic=topic, message_encoding="protobuf", metadata=describe_channel(record),
                           schema_id=number))
    return schemas, out


class Recorder:
    """Writes one run to `path`, attachments and metadata first so that they outlive a crash.

    attachments: name -> (media type, bytes); metadata: name -> text. Times are ns since the run's start. In the file
    they are counted from `epoch_ns`, ns since 1970, which the metadata record `clock` holds: other programs then show
    dates, and two runs with the same seed still differ in this one number only. `observe` is called by the writing
    thread with each time and record but raw frames.
    Raises RecorderError when the file cannot be made; later, once, from `cycle` or `put` when it cannot be written, or
    from `close` if neither was called since. After that everything is accepted and dropped, so that the loop
    can still bring the run to rest.
    """

    frame: Callable[[Frame], None]  # record a raw frame; the queue's own append, so it costs 30 ns

    def __init__(self, path: Path, attachments: Mapping[str, tuple[str, bytes]], metadata: Mapping[str, str],
                 epoch_ns: int = 0, observe: Callable[[int, Record], None] | None = None) -> None:
        self.path = path
        self._epoch_ns, self._observe = epoch_ns, observe
        self._failure: RecorderError | None = None
        self._told = False
        self._queue: deque[Any] = deque()
        self.frame = self._queue.append
        self._stop = threading.Event()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = McapFile(path, LIBRARY, *list_channels())
            for name, (media_type, data) in attachments.items():
                self._file.write_attachment(name, media_type, data, time.time_ns())
            self._file.write_metadata("run", metadata)
            if epoch_ns:
                start = datetime.fromtimestamp(epoch_ns // 10**9, UTC).isoformat()
                self._file.write_metadata("clock", {"epoch_ns": str(epoch_ns), "start": start})
        except OSError as error:
            raise _describe_failure(path, error) from error
        self._packers = {record: make_packer(record) for record in TOPICS.values()}
        self._parts: list[bytes] = []
        self._size = 0
        self._first_ns = 0
        self._index: dict[int, array[int]] = {}
        self._closed_at = time.monotonic()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def cycle(self, t_ns: int, signals: Signals, timing: Timing) -> None:
        """Record one cycle; raises RecorderError once when the log is lost."""
        append = self._queue.append
        append((t_ns, signals))
        append((t_ns, timing))
        if self._failure is not None:
            self._tell()

    def put(self, t_ns: int, record: Record) -> None:
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
        if self._failure is not None and not self._told:
            self._tell()

    def _tell(self) -> None:
        if not self._told and self._failure is not None:
            self._told = True
            raise self._failure

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
        queue, packers, epoch_ns, observe = self._queue, self._packers, self._epoch_ns, self._observe
        waiting = len(queue)
        if waiting > QUEUE_LIMIT:
            raise OSError(0, f"the disk is too slow: {waiting} records waiting")
        pack_frame, frames = packers[CanFrame], CHANNELS[CanFrame]
        for _ in range(waiting):
            item = queue.popleft()
            if len(item) == 3:
                self._add(item[0] + epoch_ns, frames, pack_frame(item[0] + epoch_ns, item))
                continue
            t_ns, record = item
            pack = packers.get(type(record))
            if pack is None:
                self._file.write_metadata(*record)
            else:
                self._add(t_ns + epoch_ns, CHANNELS[type(record)], pack(t_ns + epoch_ns, record))
                if observe is not None:
                    observe(t_ns, record)

    def _add(self, t_ns: int, channel: int, raw: bytes) -> None:
        if not self._parts:
            self._first_ns = t_ns
        elif self._size >= CHUNK_BYTES or t_ns - self._first_ns >= CHUNK_NS:
            self._close_chunk()
            self._first_ns = t_ns
        try:
            self._index[channel].extend((t_ns, self._size))
        except KeyError:
            self._index[channel] = array("Q", (t_ns, self._size))
        self._parts.append(raw)
        self._size += len(raw)

    def _close_chunk(self) -> None:
        self._closed_at = time.monotonic()
        if self._file.is_deleted():
            raise OSError(0, "the file was deleted while it was being written")
        if self._parts:
            self._file.write_chunk(b"".join(self._parts), self._index)
            self._parts, self._size, self._index = [], 0, {}


def _describe_failure(path: Path, error: OSError) -> RecorderError:
    return RecorderError(f"{path}: the log cannot be written: {error.strerror or error}")
