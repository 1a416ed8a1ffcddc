"""Writes an MCAP file: the container only, without knowledge of the messages.

The mcap library's own Writer spends 4-5 us of Python on each message; here a chunk arrives as finished bytes with its
index, and the library's record classes write the rest (specification: mcap.dev/spec). A closed chunk reaches the kernel
at once, so what a dead writer leaves is whole up to its last chunk.
"""
from __future__ import annotations

import os
import struct
import zlib
from array import array
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import BinaryIO

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

MAGIC = b"\x89MCAP0\r\n"


def encode_records(records: Iterable[McapRecord]) -> bytes:
    """The records as they stand in a file."""
    out = RecordBuilder()
    for record in records:
        record.write(out)
    return bytes(out.end())  # type: ignore[no-untyped-call]


class McapFile:
    """Appends attachments, metadata and chunks; `finish` writes indexes and statistics. OSError is the disk's own."""

    def __init__(self, path: Path, library: str, schemas: Iterable[Schema], channels: Iterable[Channel]) -> None:
        self.path = path
        self._file: BinaryIO = path.open("wb", buffering=0)
        self._offset = 0
        self.schemas = {s.id: s for s in schemas}
        self.channels = {c.id: c for c in channels}
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._declared = False  # schemas and channels stand at the head of the first chunk
        self._write(MAGIC + encode_records([Header(profile="", library=library)]))

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
        packed = zstandard.compress(raw)
        times = [t for pairs in index.values() for t in (min(pairs[::2]), max(pairs[::2]))]
        chunk = Chunk("zstd", packed, max(times), min(times), zlib.crc32(raw), len(raw))
        out = [encode_records([chunk])]
        length = len(out[0])
        where, offsets = self._offset + length, {}
        for channel, pairs in index.items():
            self._counts[channel] = self._counts.get(channel, 0) + len(pairs) // 2
            offsets[channel] = where
            body = pairs.tobytes()  # little endian on every machine this runs on
            out.append(struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + len(body), channel, len(body)) + body)
            where += len(out[-1])
        self._chunks.append(ChunkIndex(length, self._offset, "zstd", len(packed), chunk.message_end_time,
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
