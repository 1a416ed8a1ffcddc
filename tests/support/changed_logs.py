"""Logs as an attacker or an accident would change them: valid containers with other contents."""

import struct
import zlib
from array import array
from collections.abc import Mapping
from pathlib import Path

import zstandard
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Chunk, ChunkIndex
from mcap.stream_reader import StreamReader

from fdi.trace import open_log, scan_messages, unpack_chunk
from rig.recorder.writer import McapFile, encode_records


def change_log(source: Path, out: Path, attachments: Mapping[str, bytes] | None = None,
               settings: Mapping[str, str] | None = None) -> Path:
    """A copy of a log with more or other attachments, and other values in its record `run`."""
    log = open_log(source)
    file = McapFile(out, "test", [*log.schemas.values(), *log.channels.values()])
    for name, data in {**log.attachments, **(attachments or {})}.items():
        file.write_attachment(name, "text/plain", data)
    for name, values in log.metadata.items():
        file.write_metadata(name, {**values, **(settings or {})} if name == "run" else values)
    with source.open("rb") as stream:
        for record in StreamReader(stream, emit_chunks=True).records:
            if isinstance(record, Chunk):
                raw = unpack_chunk(record)
                index: dict[int, array[int]] = {}
                for channel, time_ns, at, _ in scan_messages(raw):
                    index.setdefault(channel, array("Q")).extend((time_ns, at))
                file.write_chunk(raw, index)
    file.finish()
    return out


def write_bomb(out: Path, kind: str) -> Path:
    """A log of less than 250 kB that would take gigabytes, each in another way."""
    file = McapFile(out, "test", [])
    size = 6 << 30  # what is declared
    if kind == "attachment":
        raw = encode_records([Attachment(0, 0, "model.toml", "text/plain", b"x" * 100)])
        at = raw.index(struct.pack("<Q", 100))
        file._write(raw[:at] + struct.pack("<Q", size) + raw[at + 8:])
        file._attachments.append(AttachmentIndex(file._offset - len(raw), len(raw), 0, 0, 100, "model.toml", ""))
    elif kind == "record":
        file._write(struct.pack("<BQ", Opcode.ATTACHMENT, size) + b"x" * 100)
        file._attachments.append(AttachmentIndex(file._offset - 109, 109, 0, 0, 100, "model.toml", ""))
    elif kind in ("one chunk", "lying chunk"):  # zeros compress to a 20,000th
        packer = zstandard.ZstdCompressor(level=1).compressobj(size=4 << 30)
        zeros = bytes(1 << 24)
        packed = b"".join(packer.compress(zeros) for _ in range(256)) + packer.flush()
        _append_chunk(file, packed, 4 << 30 if kind == "one chunk" else 1000)
    elif kind == "many chunks":
        packed = zstandard.compress(bytes(60 << 20))
        for _ in range(24):
            _append_chunk(file, packed, 60 << 20)
    elif kind == "one chunk indexed often":
        packed = zstandard.compress(bytes(8 << 20))
        _append_chunk(file, packed, 8 << 20)
        file._chunks *= 2000
    file.finish()
    assert out.stat().st_size < 250_000, out.stat().st_size
    return out


def _append_chunk(file: McapFile, packed: bytes, declared_size: int) -> None:
    at = file._offset
    file._write(encode_records([Chunk("zstd", packed, 0, 0, zlib.crc32(b""), declared_size)]))
    file._chunks.append(ChunkIndex(file._offset - at, at, "zstd", len(packed), 0, 0, {}, 0, declared_size))
