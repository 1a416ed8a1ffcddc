"""The bytes of an MCAP file and of its chunks, whatever lengths they declare: within limits of the file's own size."""
from __future__ import annotations

import os
import zlib
from typing import BinaryIO

import zstandard
from mcap.records import Chunk
from mcap.stream_reader import lz4  # type: ignore[attr-defined]  # a requirement of mcap, not one of ours

from plant.unpacking import UnpackingError

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
        left = self.size - self._stream.tell()
        if length > left:
            raise EOFError(f"{length} bytes declared, {max(left, 0)} left in the file")
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


def unpack_chunk(chunk: Chunk) -> bytes:
    """The records in a chunk, its checksum verified.

    Raises:
        UnpackingError: damaged data, or more of them than the chunk declares or `LARGEST_CHUNK` allows.
    """
    size = chunk.uncompressed_size
    if size > LARGEST_CHUNK:
        raise UnpackingError(f"it declares {size} bytes, more than {LARGEST_CHUNK >> 20} MiB")
    match chunk.compression:
        case "zstd":
            data = _unpack_zstd(chunk.data, size)
        case "lz4":
            data = _unpack_lz4(chunk.data, size)
        case "":
            data = chunk.data
        case other:
            raise UnpackingError(f"compression {other[:20]!r} is not known")
    if len(data) != size:
        raise UnpackingError(f"it declares {size} bytes and has {len(data)} or more")
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise UnpackingError("its checksum is wrong")
    return data


def _unpack_zstd(packed: bytes, size: int) -> bytes:
    """Unpack one frame. The size in its header comes before the limit for zstandard, so it is compared here."""
    try:
        declared = zstandard.get_frame_parameters(packed).content_size
        if declared not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise UnpackingError(f"it declares {size} bytes, its zstd frame {declared}")
        unpacker = zstandard.ZstdDecompressor(max_window_size=2 * LARGEST_CHUNK)
        return unpacker.decompress(packed, max_output_size=size) if size else b""
    except zstandard.ZstdError as error:
        raise UnpackingError(str(error)) from error


def _unpack_lz4(packed: bytes, size: int) -> bytes:
    """Unpack at most one byte more than `size`."""
    try:
        data: bytes = lz4.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
    except RuntimeError as error:
        raise UnpackingError(str(error)) from error
    return data
