"""Checksums that protect a frame: CRCs of SAE and AUTOSAR, AUTOSAR's end-to-end profiles, and functions of users.

Each gets the frame as bytes, with the bits of the checksum itself 0. The CRCs and profiles take the bytes other than
the checksum's own one, in the order of the frame.
"""

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

from plant import InputError, require, run_file
from rig.benches.bench import Field, Protection, insert_bits


@cache
def _list_remainders(polynomial: int) -> tuple[int, ...]:
    """The CRC-8 of each byte."""
    return tuple(add_byte(0, byte, polynomial) for byte in range(256))


def add_byte(crc: int, byte: int, polynomial: int) -> int:
    """The CRC-8 with one more byte, most significant bit first. Compiled loops call it."""
    crc ^= byte
    for _ in range(8):
        crc = (crc << 1 ^ polynomial) & 0xFF if crc & 0x80 else crc << 1
    return crc


def compute_crc8(data: bytes, polynomial: int, start: int = 0xFF, inversion: int = 0xFF) -> int:
    """The CRC-8 of bytes, most significant bit first.

    >>> hex(compute_crc8(b"123456789", 0x1D)), hex(compute_crc8(b"123456789", 0x2F))
    ('0x4b', '0xdf')
    """
    remainders = _list_remainders(polynomial)
    for byte in data:
        start = remainders[start ^ byte]
    return start ^ inversion


class Crc(NamedTuple):
    """A CRC-8 over the bytes of a frame other than its own. Compiled loops calculate it from the same numbers."""

    polynomial: int
    start: int = 0xFF
    inversion: int = 0xFF
    has_data_id: bool = False  # both bytes of the data ID stand before the data

    def list_bytes(self, each: Field, data: bytes, counter: int) -> bytes:
        """What it is computed over: data ID, data, and the data ID that belongs to this counter."""
        checksum_byte = each.lowest // 8
        before = each.data_id.to_bytes(2, "little") if self.has_data_id else b""
        behind = bytes([each.data_ids[counter % len(each.data_ids)]]) if each.data_ids else b""
        return before + data[:checksum_byte] + data[checksum_byte + 1:] + behind


CHECKSUMS = {
    "crc8_sae_j1850": Crc(0x1D),
    "crc8_h2f": Crc(0x2F),
    "e2e_profile_1": Crc(0x1D, 0, 0, has_data_id=True),  # AUTOSAR PRS E2E, profile 1A
    "e2e_profile_2": Crc(0x2F),  # AUTOSAR PRS E2E, profile 2, with a data ID for each counter
}
USERS_CHECKSUMS: dict[str, Callable[[bytes, int], int]] = {}  # by `Field.checksum`


def compute_checksum(each: Field, data: bytes, counter: int) -> int:
    """The checksum that belongs into a field of this frame; what `data` has there does not matter.

    Args:
        each: the field, which is protected by a CHECKSUM.
        data: the whole frame.
        counter: the frame's alive counter, or how many of these frames were sent before: both choose the same data ID.

    Raises:
        InputError: a user's function failed or gave no whole number.
    """
    if each.checksum in CHECKSUMS:
        crc = CHECKSUMS[each.checksum]
        return compute_crc8(crc.list_bytes(each, data, counter), crc.polynomial, crc.start, crc.inversion)
    try:
        return int(USERS_CHECKSUMS[each.checksum](insert_bits(each, data, 0), counter)) & (1 << each.length) - 1
    except Exception as error:
        name, _, function = each.checksum.partition("#")[0].rpartition(":")
        raise InputError(name, function, f"a whole number from (data, counter), not "
                                         f"{type(error).__name__}: {error}") from error


def load_checksum(name: str, source: bytes, function: str) -> str:
    """Run a user's file and keep its function `(data: bytes, counter: int) -> int`; its name for `Field.checksum`.

    Raises:
        InputError: not Python, or no such function.
    """
    checksum = f"{name}:{function}#{hashlib.sha256(source).hexdigest()[:8]}"
    if checksum not in USERS_CHECKSUMS:
        module = run_file(Path(name), source)
        for place, value in vars(module).items():  # tables: compiled code takes constants alone
            if isinstance(value, list | bytearray):
                vars(module)[place] = bytes(value) if isinstance(value, bytearray) else tuple(value)
        require(callable(getattr(module, function, None)), name, function,
                "a function (data: bytes, counter: int) -> int")
        USERS_CHECKSUMS[checksum] = getattr(module, function)
        compute_checksum(Field(name="", lowest=0, length=8, protection=Protection.CHECKSUM, checksum=checksum),
                         bytes(8), 0)
    return checksum
