"""Reading an MCAP log of protobuf messages, by the schemas that stand in the file itself.

Rows of numbers are read as whole columns through the index of each chunk. Other messages are found by a plain scan and
read by protobuf's parser; the library's message iterator makes an object of every record first, which is slower.
"""
from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, Schema
from mcap.stream_reader import get_chunk_data_stream
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray

from plant.errors import InputError

_NUMBERS = {  # protobuf types of fixed width: wire type and numpy type
    FieldDescriptorProto.TYPE_DOUBLE: (1, "<f8"),
    FieldDescriptorProto.TYPE_FIXED32: (5, "<u4"),
    FieldDescriptorProto.TYPE_BOOL: (0, "?"),
}
_RECORD = struct.Struct("<BQ")  # opcode, length of what follows
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time


@dataclass(frozen=True)
class Log:
    """An MCAP file: its channels, attachments (name -> bytes) and metadata (record -> names and values)."""

    path: Path
    schemas: Mapping[int, Schema]
    channels: Mapping[int, Channel]
    attachments: Mapping[str, bytes]
    metadata: Mapping[str, Mapping[str, str]]
    _chunks: tuple[ChunkIndex, ...]

    def messages(self, *topics: str) -> Iterator[tuple[str, int, Any]]:
        """(topic, time in ns, protobuf message) of the topics, by time; equal times in the order of the file."""
        factory = DecoderFactory()
        decode = {number: (c.topic, factory.decoder_for(c.message_encoding, self.schemas.get(c.schema_id)))
                  for number, c in self.channels.items() if c.topic in topics}
        out = []
        with self.path.open("rb") as stream:
            for index in self._chunks:
                if not index.message_index_offsets or decode.keys() & index.message_index_offsets.keys():
                    for channel, time_ns, _, data in scan_messages(_read_chunk(self.path, stream, index)):
                        if channel in decode:
                            out.append((time_ns, channel, data))
        out.sort(key=lambda item: item[0])
        for time_ns, channel, data in out:
            topic, parse = decode[channel]
            if parse is None:
                raise InputError(self.path, topic, "protobuf messages")
            yield topic, time_ns, parse(data)

    def read_columns(self, topic: str) -> dict[str, NDArray[Any]]:
        """The messages of a topic by time, one array (messages,) per field, and `time_ns`, the log time in ns.

        Raises:
            InputError: messages that are not protobuf, and chunks that are damaged.
        """
        columns = self._read_rows(topic)
        if columns is not None:
            return columns
        messages = [(time_ns, message) for _, time_ns, message in self.messages(topic)]
        if not messages:
            return {"time_ns": np.empty(0, np.int64)}
        names = [field.name for field in messages[0][1].DESCRIPTOR.fields]
        return {"time_ns": np.array([time_ns for time_ns, _ in messages])} | {
            name: np.array([getattr(message, name) for _, message in messages]) for name in names}

    def _read_rows(self, topic: str) -> dict[str, NDArray[Any]] | None:
        """The same for messages that all hold the same numbers in the same places; None if they do not."""
        numbers = [number for number, channel in self.channels.items() if channel.topic == topic]
        layout = _row_layout(self.schemas.get(self.channels[numbers[0]].schema_id)) if len(numbers) == 1 else None
        if layout is None:
            return None
        dtype, tags = layout
        parts = []
        with self.path.open("rb") as stream:
            for index in self._chunks:
                if numbers[0] not in index.message_index_offsets:
                    if index.message_index_offsets:
                        continue
                    return None  # a chunk without an index
                offsets = _message_offsets(stream, index, numbers[0])
                rows = _decode_rows(_read_chunk(self.path, stream, index), offsets, dtype)
                if rows is None:
                    return None
                parts.append(rows)
        if not parts:
            return None
        table = np.concatenate(parts)
        if not all((table[name] == value).all() for name, value in tags.items()):
            return None
        table = table[np.argsort(table["time_ns"], kind="stable")]
        return {name: table[name].copy() for name in dtype.names or () if not name.startswith(".")}

    def units(self, topic: str) -> dict[str, str]:
        """Field -> unit, from the channel's metadata."""
        return {key.removeprefix("unit."): value for channel in self.channels.values() if channel.topic == topic
                for key, value in channel.metadata.items() if key.startswith("unit.")}


def open_log(path: Path) -> Log:
    """Read everything but the messages. Raises InputError for what is not a complete MCAP file."""
    try:
        with path.open("rb") as stream:
            reader = SeekingReader(stream)
            summary = reader.get_summary()
            if summary is None:
                raise InputError(path, "", "a complete MCAP log; this one was cut short: rig recover")
            attachments = {item.name: item.data for item in reader.iter_attachments()}
            metadata = {item.name: item.metadata for item in reader.iter_metadata()}
    except OSError as error:
        raise InputError(path, "", f"a readable file ({error.strerror})") from error
    except (McapError, struct.error, ValueError, EOFError) as error:
        raise InputError(path, "", "a complete MCAP log; if its writer died, rig recover brings it back") from error
    return Log(path, summary.schemas, summary.channels, attachments, metadata, tuple(summary.chunk_indexes))


def _read_chunk(path: Path, stream: Any, index: ChunkIndex) -> bytes:
    stream.seek(index.chunk_start_offset + 9)
    try:
        data, size = get_chunk_data_stream(Chunk.read(ReadDataStream(stream)), validate_crc=True)
        return data.read(size)
    except (McapError, zstandard.ZstdError, ValueError, struct.error) as error:
        raise InputError(path, f"chunk at byte {index.chunk_start_offset}", f"sound data ({error})") from error


def _row_layout(schema: Schema | None) -> tuple[np.dtype[Any], dict[str, int]] | None:
    """A whole message record whose fields are all numbers of fixed width, as a numpy type, and what its tags must be.

    Names that begin with a dot are not fields of the message. None for a schema with other fields.
    """
    if schema is None or schema.encoding != "protobuf":
        return None
    files = FileDescriptorSet.FromString(schema.data).file
    messages = [message for file in files for message in file.message_type]
    if len(messages) != 1:
        return None
    fields = messages[0].field
    if any(field.type not in _NUMBERS or field.label == field.LABEL_REPEATED for field in fields):
        return None
    head = [(".opcode", "u1"), (".length", "<u8"), (".channel", "<u2"), (".sequence", "<u4"), ("time_ns", "<i8"),
            (".published", "<u8")]
    columns, tags = [], {".opcode": int(Opcode.MESSAGE)}
    for field in sorted(fields, key=lambda field: field.number):
        wire, kind = _NUMBERS[field.type]
        tag = f".tag {field.name}"
        tags[tag] = field.number << 3 | wire
        columns += [(tag, "u1"), (field.name, kind)]
    if max(tags.values()) > 0x7F:  # a tag of two bytes
        return None
    dtype = np.dtype([*head, *columns])
    tags[".length"] = dtype.itemsize - _RECORD.size
    return dtype, tags


def _message_offsets(stream: Any, index: ChunkIndex, channel: int) -> NDArray[np.int64]:
    """Where the messages of a channel begin in an unpacked chunk, from the message index behind it."""
    stream.seek(index.message_index_offsets[channel])
    _, length = _RECORD.unpack(stream.read(_RECORD.size))
    pairs = np.frombuffer(stream.read(length)[6:], "<u8").reshape(-1, 2)
    return pairs[:, 1].astype(np.int64)


def _decode_rows(raw: bytes, offsets: NDArray[np.int64], dtype: np.dtype[Any]) -> NDArray[Any] | None:
    """The records at `offsets` of a chunk; None if one would end beyond it."""
    if len(offsets) and offsets.max() + dtype.itemsize > len(raw):
        return None
    places = offsets[:, None] + np.arange(dtype.itemsize)
    rows: NDArray[Any] = np.frombuffer(raw, np.uint8)[places].view(dtype)[:, 0]
    return rows


def scan_messages(raw: bytes) -> Iterator[tuple[int, int, int, bytes]]:
    """(channel, log time in ns, offset of the record, data) of each message in an unpacked chunk, in its order.

    Raises struct.error for a chunk that ends within a record.
    """
    at, end = 0, len(raw)
    while at < end:
        opcode, length = _RECORD.unpack_from(raw, at)
        if opcode == Opcode.MESSAGE:
            channel, _, time_ns, _ = _MESSAGE.unpack_from(raw, at + 9)
            yield channel, time_ns, at, raw[at + 31:at + 9 + length]
        at += 9 + length
