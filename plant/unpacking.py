"""Limits on unpacking. A file says itself how much it unpacks to, and a file of 240 kB can say 6 GB."""

import zlib

_GZIP = 31  # window bits of zlib that mean gzip


class UnpackingError(ValueError):
    """Packed data that unpack to more than `limit_unpacked_size` allows, or that are not what they say."""


def limit_unpacked_size(packed: int) -> int:
    """Bytes that `packed` bytes may unpack to.

    Recordings shrink to a half or a tenth; only data made to exhaust the memory shrink to less than a hundredth.
    """
    return (64 << 20) + 100 * packed


def unpack_gzip(packed: bytes) -> bytes:
    """Unpack gzip data of one or several members.

    Raises:
        UnpackingError: no gzip data, cut short, or more of them than `limit_unpacked_size` allows.
    """
    most, parts, size = limit_unpacked_size(len(packed)), [], 0
    while packed:
        member = zlib.decompressobj(_GZIP)
        try:
            parts.append(member.decompress(packed, most - size + 1))
        except zlib.error as error:
            raise UnpackingError(str(error)) from error
        size += len(parts[-1])
        if size > most:
            raise UnpackingError(f"it unpacks to more than {most >> 20} MiB")
        if not member.eof:
            raise UnpackingError("it is cut short")
        packed = member.unused_data.lstrip(b"\0")  # zeros may follow the last member
    return b"".join(parts)
