"""Limits on unpacking. A file says itself how much it unpacks to, and a file of 240 kB can say 6 GB."""

import gzip
import io
from typing import Any, BinaryIO


class UnpackingError(ValueError):
    """Packed data that unpack to more than `limit_unpacked_size` allows, or that are not what they say."""


def limit_unpacked_size(packed: int) -> int:
    """Bytes that `packed` bytes may unpack to.

    Recordings shrink to a half or a tenth; only data made to exhaust the memory shrink to less than a hundredth.
    """
    return (64 << 20) + 100 * packed


class LimitedGzip(io.RawIOBase):
    """The content of `size` bytes of gzip data, up to what `limit_unpacked_size` allows; beyond it, UnpackingError."""

    def __init__(self, packed: BinaryIO, size: int) -> None:
        self._packed, self._file = packed, gzip.open(packed)  # noqa: SIM115 (closed by `close`)
        self._left = self._most = limit_unpacked_size(size)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        data = self._file.read(len(buffer))
        self._left -= len(data)
        if self._left < 0:
            raise UnpackingError(f"it unpacks to more than {self._most >> 20} MiB")
        buffer[:len(data)] = data
        return len(data)

    def close(self) -> None:
        self._file.close()
        self._packed.close()
        super().close()
