"""Salvage of a log whose writer died: every intact chunk is kept, and the indexes are rebuilt."""
from __future__ import annotations

import struct
from array import array
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import IO, cast

from mcap.exceptions import McapError
from mcap.records import Attachment, Chunk, McapRecord, Metadata
from mcap.stream_reader import StreamReader

from fdi.output import require_writable, write_whole
from fdi.trace import BoundedFile, read_declarations, scan_messages, unpack_chunk
from plant import InputError, UnpackingError, count_nouns, limit_unpacked_size, report_system_error
from rig.recorder.writer import McapFile

_DAMAGE = (McapError, struct.error, ValueError, EOFError)


@dataclass(frozen=True)
class Salvage:
    """The result of a salvage."""

    path: Path  # the log written anew
    complete: bool  # the log was whole: nothing to salvage
    messages: int
    cycles: int
    duration: float  # s, from the first to the last message kept
    attachments: tuple[str, ...]
    lost_bytes: int  # in the file, but in no sound chunk
    reason: str  # why reading stopped; empty for a whole log

    def __str__(self) -> str:
        content = (f"{count_nouns(self.messages, 'message')}, {count_nouns(self.cycles, 'cycle')}, "
                   f"{self.duration:.3f} s, {count_nouns(len(self.attachments), 'file')}")
        if self.complete:
            return f"{self.path}: the log was complete: {content}"
        return (f"{self.path}: kept {content}; lost {self.lost_bytes} bytes of the file ({self.reason}) "
                f"and data not yet written, at most about 0.25 s")


def recover_log(path: Path, out: Path) -> Salvage:
    """Write the intact part of `path` to `out`, a complete indexed MCAP file with the attachments and metadata.

    Raises InputError when `path` cannot be read or holds nothing sound, and when `out` cannot be written.
    """
    with report_system_error(path, "", "a file that can be read"):
        source = path.open("rb")
    with source:
        damage = _Damage()
        records = _list_intact_records(BoundedFile(source), damage)
        first = next(records, None)
        if first is None:
            reason = damage.reason or "it is empty"
            raise InputError(path, "", f"an MCAP log with at least one intact record ({reason})")
        with (report_system_error(out, "--out", "a place that can be written"),
              write_whole(require_writable(out, "--out", source=path)) as part):
            return replace(_write_salvage(chain([first], records), damage, part), path=out)


@dataclass
class _Damage:
    """What a log has lost: why reading stopped, and bytes."""

    reason: str = ""
    lost: int = 0


def _list_intact_records(file: BoundedFile, damage: _Damage) -> Iterator[McapRecord | bytes]:
    """The sound records of a log up to where it ends; damaged chunks and attachments in the middle are left out.

    A chunk is given as the records in it, unpacked.
    """
    at, remaining_bytes = 0, limit_unpacked_size(file.size)
    try:
        for record in StreamReader(cast(IO[bytes], file), emit_chunks=True, record_size_limit=file.size).records:
            start, at = at, file.tell()
            if not isinstance(record, Chunk):
                if not isinstance(record, Attachment) or file.has_checksum(start, at - start):
                    yield record
                else:
                    damage.reason, damage.lost = f"damaged file {record.name}", damage.lost + at - start
                continue
            remaining_bytes -= record.uncompressed_size
            if remaining_bytes < 0:
                raise UnpackingError("the chunks declare too many bytes for a file of this size")
            try:
                raw = unpack_chunk(record)
                _index_messages(raw)
                read_declarations(raw)
            except _DAMAGE as error:
                damage.reason, damage.lost = f"damaged chunk: {error}", damage.lost + at - start
            else:
                yield raw
    except _DAMAGE as error:
        damage.reason = damage.reason or str(error) or "the file ends in mid run"
        damage.lost += file.size - at


def _write_salvage(records: Iterable[McapRecord | bytes], damage: _Damage, out: Path) -> Salvage:
    file, names = McapFile(out, "eha-rig recover", []), []
    for record in records:
        if isinstance(record, Attachment):
            names.append(record.name)
            file.write_attachment(record.name, record.media_type, record.data, record.log_time)
        elif isinstance(record, Metadata):
            file.write_metadata(record.name, record.metadata)
        elif isinstance(record, bytes):
            if not file.channels:
                file.declare(read_declarations(record))
            if index := _index_messages(record):
                file.write_chunk(record, index)
        else:
            file.declare([record])
    if damage.reason:
        file.write_metadata("recovered", {"reason": damage.reason, "lost_bytes": str(damage.lost)})
    counts = file.build_statistics()
    cycles = sum(n for c, n in counts.channel_message_counts.items()
                 if c in file.channels and file.channels[c].topic == "/signals")
    file.finish()
    return Salvage(out, not damage.reason, counts.message_count, cycles,
                   (counts.message_end_time - counts.message_start_time) * 1e-9, tuple(names), damage.lost,
                   damage.reason)


def _index_messages(raw: bytes) -> dict[int, array[int]]:
    """Channel -> flat pairs (log time ns, offset) of the messages in a chunk."""
    index: dict[int, array[int]] = {}
    for channel, time_ns, at, _ in scan_messages(raw):
        index.setdefault(channel, array("Q")).extend((time_ns, at))
    return index
