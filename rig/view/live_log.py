"""The log of a run as another process reads it while it is written: the run itself is never delayed by its screen."""
from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator
from dataclasses import fields
from io import BytesIO
from pathlib import Path
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Chunk, Schema
from mcap_protobuf.decoder import DecoderFactory

from fdi.trace.mcap_log import scan_messages, unpack_chunk
from rig.recorder import CanFrame, Record
from rig.recorder.schema import TOPICS
from rig.recorder.writer import MAGIC, list_channels

_RECORD = struct.Struct("<BQ")  # opcode, length


def follow_log(path: Path) -> Iterator[list[tuple[int, Record]]]:
    """Give the records of the log that are new, with their log times in ns, again and again; no raw frames.

    The writer closes a chunk at least every 0.2 s; what it has not written yet comes later. The log is opened once, as
    soon as it is there: it may be moved or deleted. What is given ends if it cannot be read.
    """
    decoders: dict[int, Any] = {}
    for kind, schema in zip(TOPICS.values(), list_channels(), strict=False):  # schemas come first
        if kind is not CanFrame and isinstance(schema, Schema):
            decode = DecoderFactory().decoder_for("protobuf", schema)
            decoders[schema.id] = kind, [field.name for field in fields(kind)], decode
    done = len(MAGIC)  # bytes of the file
    with contextlib.suppress(OSError):
        while not path.exists():
            yield []
        with path.open("rb", buffering=0) as file:
            while True:
                file.seek(done)
                found, start = list[tuple[int, Record]](), 0
                for raw, end in _list_chunks(file.read()):
                    start = end
                    found += _decode_messages(raw, decoders)
                done += start
                yield found


def _decode_messages(raw: bytes, decoders: dict[int, Any]) -> Iterator[tuple[int, Record]]:
    for channel, t_ns, _, message in scan_messages(raw):
        if channel in decoders:
            kind, names, decode = decoders[channel]
            record = decode(message)
            yield t_ns, kind(**{name: getattr(record, name) for name in names})


def _list_chunks(data: bytes) -> Iterator[tuple[bytes, int]]:
    """The chunks that are complete, unpacked, and where each ends."""
    at = 0
    while at + _RECORD.size <= len(data):
        opcode, length = _RECORD.unpack_from(data, at)
        at += _RECORD.size + length
        if opcode == Opcode.CHUNK and at <= len(data):
            chunk = Chunk.read(ReadDataStream(BytesIO(data[at - length:at])))
            yield unpack_chunk(chunk), at
