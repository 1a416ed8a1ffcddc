"""Reading an MCAP log of protobuf messages, by the schemas that stand in the file itself.

Messages are found through the index of each chunk and read by protobuf's parser; the library's message iterator makes
an object of every record first, which is slower.
"""

import contextlib
import os
import struct
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Set
from dataclasses import dataclass
from io import BytesIO
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import IO, Any, BinaryIO, cast

import numpy as np
import zstandard
from google.protobuf.descriptor import FieldDescriptor
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, Schema
from mcap.summary import Summary
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray

from plant import InputError, UnpackingError, limit_unpacked_size, require

_KINDS = {  # protobuf's kinds of numbers as numpy's; all others are objects
    FieldDescriptor.CPPTYPE_DOUBLE: "f8", FieldDescriptor.CPPTYPE_FLOAT: "f8", FieldDescriptor.CPPTYPE_BOOL: "?",
    FieldDescriptor.CPPTYPE_INT32: "i8", FieldDescriptor.CPPTYPE_INT64: "i8", FieldDescriptor.CPPTYPE_UINT32: "i8",
    FieldDescriptor.CPPTYPE_UINT64: "u8",
}
MOST_RECORDS = 1000  # attachments, and metadata records, of a log
_RECORD = struct.Struct("<BQ")  # opcode, length of what follows
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time


@dataclass(frozen=True)
class Log:
    """An MCAP file: its channels, attachments (name -> bytes) and metadata (record -> names and values).

    A log of this rig counts its times from the start of the run. In the file they are counted from 1970, and the
    metadata record `clock` holds the start (`epoch_ns`); older logs have none and begin at 0.
    """

    path: Path
    schemas: Mapping[int, Schema]
    channels: Mapping[int, Channel]
    attachments: Mapping[str, bytes]
    metadata: Mapping[str, Mapping[str, str]]
    _chunks: tuple[ChunkIndex, ...]
    epoch_ns: int = 0  # of the start of the run, since 1970

    def read_messages(self, *topics: str, most: int | None = None) -> Iterator[tuple[str, int, Any]]:
        """(topic, time in ns, protobuf message) of the topics, by time; equal times in the order of the file.

        `most`: no more than so many, the first ones in time.

        Raises:
            InputError: messages that are not protobuf or do not fit their schema, and chunks that are damaged.
        """
        with _report_damage(self.path, " and ".join(topics)):
            decode = self._find_decoders(topics)
            messages = sorted(self.list_raw_messages(decode.keys()), key=lambda message: message[1])
            for channel, time_ns, data in messages[:most]:
                topic, parse = decode[channel]
                yield topic, time_ns, parse(data)

    def read_columns(self, topic: str) -> dict[str, NDArray[Any]]:
        """The messages of a topic by time, one array (messages,) per field, and `time_ns`, the log time in ns.

        Raises:
            InputError: messages that are not protobuf or do not fit their schema, and chunks that are damaged.
        """
        with _report_damage(self.path, topic):
            decode = self._find_decoders([topic])
            messages = ((time_ns, decode[channel][1](data))
                        for channel, time_ns, data in self.list_raw_messages(decode.keys()))
            first = next(messages, None)
            if first is None:
                return {"time_ns": np.empty(0, np.int64)}
            kinds = {f.name: _KINDS.get(f.cpp_type, "O") for f in first[1].DESCRIPTOR.fields}
            read = attrgetter(*kinds)
            rows = ((time_ns, *read(message)) for time_ns, message in chain([first], messages))
            table = np.fromiter(rows, np.dtype([("time_ns", "i8"), *kinds.items()]))
            table = table[np.argsort(table["time_ns"], kind="stable")]
            return {name: table[name].copy() for name in table.dtype.names or ()}

    def _find_decoders(self, topics: Collection[str]) -> dict[int, tuple[str, Callable[[bytes], Any]]]:
        """Topic and parser of each channel of these topics, by its number."""
        factory, decoders = DecoderFactory(), {}
        for number, channel in self.channels.items():
            if channel.topic in topics:
                parse = factory.decoder_for(channel.message_encoding, self.schemas.get(channel.schema_id))
                if parse is None:
                    raise InputError(self.path, channel.topic, "protobuf messages")
                decoders[number] = channel.topic, parse
        return decoders

    def list_raw_messages(self, channels: Set[int] | None = None) -> Iterator[tuple[int, int, bytes]]:
        """(channel, log time in ns, data) of every message, or of those of some channels, in the order of the file.

        Raises:
            InputError: a chunk that is damaged.
        """
        for raw, offsets in self._unpack_chunks(channels):
            # unsigned, so that no offset of a damaged index counts from the end
            starts = None if offsets is None else offsets.astype(np.uint64).tolist()
            for channel, time_ns, _, data in scan_messages(raw, starts):
                if channels is None or channel in channels:
                    yield channel, time_ns - self.epoch_ns, data

    def _unpack_chunks(self, channels: Set[int] | None) -> Iterator[tuple[bytes, NDArray[np.int64] | None]]:
        """The chunks that hold messages of these channels, unpacked, and where these begin; None: no index says it."""
        with self.path.open("rb") as stream:
            for index in self._chunks:
                offsets = index.message_index_offsets
                numbers = sorted(offsets.keys() & (channels or ()))
                if offsets and channels is not None and not numbers:
                    continue
                starts = [_message_offsets(stream, index, number) for number in numbers]
                yield _read_chunk(self.path, stream, index), np.sort(np.concatenate(starts)) if starts else None

    def read_units(self, topic: str) -> dict[str, str]:
        """Field -> unit, from the channel's metadata."""
        return {key.removeprefix("unit."): value for channel in self.channels.values() if channel.topic == topic
                for key, value in channel.metadata.items() if key.startswith("unit.")}


@contextlib.contextmanager
def _report_damage(path: Path, topic: str) -> Iterator[None]:
    """Report whatever a damaged schema, index or message leads to as bad input."""
    try:
        yield
    except InputError:
        raise
    except OSError as error:
        raise InputError(path, "", f"a readable file ({error.strerror})") from error
    except Exception as error:  # the parsers of schemas and messages raise many kinds
        raise InputError(path, topic, f"sound messages ({type(error).__name__}: {error})") from error


def locate_log(path: Path) -> Path:
    """The log in the folder of a run; another path as it is."""
    return path / "trace.mcap" if path.is_dir() else path


def open_log(path: Path) -> Log:
    """Read everything but the messages. Raises InputError for what is not a complete MCAP file."""
    try:
        with path.open("rb") as stream:
            file = BoundedFile(stream)
            reader = SeekingReader(cast(IO[bytes], file), record_size_limit=file.size)
            summary = reader.get_summary()
            if summary is None:
                raise InputError(path, "", "a complete MCAP log; this one was cut short: rig recover")
            _check_sizes(path, summary, file.size)
            for index in summary.attachment_indexes:
                require(file.has_checksum(index.offset, index.length), path, f"attachment {index.name}",
                        "sound data (its checksum is wrong)")
            attachments = {item.name: item.data for item in reader.iter_attachments()}
            metadata = {item.name: item.metadata for item in reader.iter_metadata()}
    except OSError as error:
        raise InputError(path, "", f"a readable file ({error.strerror})") from error
    except (McapError, struct.error, ValueError, EOFError, StopIteration) as error:
        raise InputError(path, "", "a complete MCAP log; if its writer died, rig recover brings it back") from error
    return Log(path, summary.schemas, summary.channels, attachments, metadata, tuple(summary.chunk_indexes),
               _read_epoch(path, metadata))


def _read_epoch(path: Path, metadata: Mapping[str, Mapping[str, str]]) -> int:
    """The start of the run, ns since 1970; 0 in a log without the record `clock`. Raises InputError."""
    text = metadata.get("clock", {}).get("epoch_ns", "0")
    require(text.isascii() and text.isdecimal() and len(text) < 20 and int(text) < 2**63, path,
            "metadata clock.epoch_ns", f"nanoseconds since 1970, not {text[:40]!r}")
    return int(text)


def _check_sizes(path: Path, summary: Summary, size: int) -> None:
    """Refuse a log whose parts, as its summary declares them, are larger than a file of `size` bytes can hold.

    Raises:
        InputError: it names the declared size.
    """
    require((attachment_bytes := sum(index.data_size for index in summary.attachment_indexes)) <= size, path,
            "attachments", f"at most the {size} bytes of the file, not {attachment_bytes}")
    unpacked_size, most = sum(index.uncompressed_size for index in summary.chunk_indexes), limit_unpacked_size(size)
    require(unpacked_size <= most, path, "chunks",
            f"at most {most >> 20} MiB for {size} bytes packed, not {unpacked_size >> 20} MiB")
    require(len({index.chunk_start_offset for index in summary.chunk_indexes}) == len(summary.chunk_indexes), path,
            "chunks", "each chunk once in the index")
    for what, count in (("attachments", len(summary.attachment_indexes)), ("metadata", len(summary.metadata_indexes))):
        require(count <= MOST_RECORDS, path, what, f"at most {MOST_RECORDS} records, not {count}")


def _read_chunk(path: Path, stream: BinaryIO, index: ChunkIndex) -> bytes:
    """The records of a chunk, unpacked."""
    try:
        file = BoundedFile(stream)
        file.seek(index.chunk_start_offset + _RECORD.size)
        chunk = Chunk.read(ReadDataStream(cast(IO[bytes], file)))
        if chunk.uncompressed_size != index.uncompressed_size:
            raise UnpackingError(f"the index declares {index.uncompressed_size} bytes, not {chunk.uncompressed_size}")
        return unpack_chunk(chunk)
    except (McapError, ValueError, struct.error, EOFError) as error:
        raise InputError(path, f"chunk at byte {index.chunk_start_offset}", f"sound data ({error})") from error


def _message_offsets(stream: BinaryIO, index: ChunkIndex, channel: int) -> NDArray[np.int64]:
    """Where the messages of a channel begin in an unpacked chunk, from the message index behind it."""
    file = BoundedFile(stream)
    file.seek(index.message_index_offsets[channel])
    _, length = _RECORD.unpack(file.read(_RECORD.size))
    return np.frombuffer(file.read(length)[6:], "<u8").reshape(-1, 2)[:, 1].astype(np.int64)


def scan_messages(raw: bytes, starts: Iterable[int] | None = None) -> Iterator[tuple[int, int, int, bytes]]:
    """(channel, log time in ns, offset of the record, data) of each message in an unpacked chunk, in its order.

    `starts`: offsets of the messages that are wanted; None: all. Raises struct.error for a chunk that ends within a
    record.
    """
    for at in _list_records(raw) if starts is None else starts:
        opcode, length = _RECORD.unpack_from(raw, at)
        if opcode == Opcode.MESSAGE:
            channel, _, time_ns, _ = _MESSAGE.unpack_from(raw, at + 9)
            yield channel, time_ns, at, raw[at + 31:at + 9 + length]


def _list_records(raw: bytes) -> Iterator[int]:
    at = 0
    while at < len(raw):
        yield at
        at += 9 + int(_RECORD.unpack_from(raw, at)[1])


def read_declarations(raw: bytes) -> list[Schema | Channel]:
    """The schemas and channels in an unpacked chunk.

    Raises struct.error or EndOfFile for a chunk that ends within a record.
    """
    declarations: list[Schema | Channel] = []
    for at in _list_records(raw):
        opcode, length = _RECORD.unpack_from(raw, at)
        body = ReadDataStream(BytesIO(raw[at + 9:at + 9 + length]))
        if opcode == Opcode.SCHEMA:
            declarations.append(Schema.read(body))
        elif opcode == Opcode.CHANNEL:
            declarations.append(Channel.read(body))
    return declarations


LARGEST_CHUNK = 64 << 20  # bytes unpacked; this software writes chunks of 64 KiB, other writers of 1 to 4 MiB


class BoundedFile:
    """A binary file that refuses to read beyond its end.

    The mcap library reads as many bytes as a record declares, and Python reserves memory for all of them beforehand.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.size = os.fstat(stream.fileno()).st_size  # bytes

    def read(self, length: int = -1) -> bytes:
        """Read that many bytes. Raises EOFError where the file has fewer."""
        rest = self.size - self._stream.tell()
        if length > rest:
            raise EOFError(f"{length} bytes declared, {max(rest, 0)} left in the file")
        return self._stream.read(length)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to a place. Raises EOFError for one outside the file."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._stream.tell(), os.SEEK_END: self.size}[whence]
        if not 0 <= start + offset <= self.size:
            raise EOFError(f"a record at byte {start + offset} of a file of {self.size} bytes")
        return self._stream.seek(start + offset)

    def tell(self) -> int:
        """Where the next byte is read."""
        return self._stream.tell()

    def has_checksum(self, start: int, length: int) -> bool:
        """Whether the attachment at these bytes has the checksum at its end; 0 is none. Raises EOFError."""
        self.seek(start + _RECORD.size)
        content = self.read(length - _RECORD.size)
        return int.from_bytes(content[-4:], "little") in (0, zlib.crc32(content[:-4]))


def unpack_chunk(chunk: Chunk) -> bytes:
    """The records in a chunk, its checksum verified.

    Raises:
        UnpackingError: damaged data, or more of them than the chunk declares or `LARGEST_CHUNK` allows.
    """
    size = chunk.uncompressed_size
    if size > LARGEST_CHUNK:
        raise UnpackingError(f"it declares {size} bytes, more than {LARGEST_CHUNK >> 20} MiB")
    if chunk.compression not in _UNPACKERS:
        raise UnpackingError(f"compression {chunk.compression[:20]!r} is not known, only zstd and none")
    data = _UNPACKERS[chunk.compression](chunk.data, size)
    if len(data) != size:
        raise UnpackingError(f"it declares {size} bytes and has {len(data)} or more")
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise UnpackingError("its checksum is wrong")
    return data


def _unpack_zstd(packed: bytes, size: int) -> bytes:
    """Unpack one frame. The size in its header comes before the limit for zstandard, so it is compared here."""
    try:
        content_size = zstandard.get_frame_parameters(packed).content_size
        if content_size not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise UnpackingError(f"it declares {size} bytes, its zstd frame {content_size}")
        return zstandard.ZstdDecompressor(max_window_size=2 * LARGEST_CHUNK).decompress(
            packed, max_output_size=size) if size else b""
    except zstandard.ZstdError as error:
        raise UnpackingError(str(error)) from error


_UNPACKERS: dict[str, Callable[[bytes, int], bytes]] = {"": lambda packed, size: packed, "zstd": _unpack_zstd}
