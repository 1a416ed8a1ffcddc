"""Checksums that protect a frame: CRCs of SAE and AUTOSAR, AUTOSAR's end-to-end profiles, and functions of users.

Each gets the frame as bytes, with the bits of the checksum itself 0. The CRCs and profiles take the bytes other than
the checksum's own one, in the order of the frame.
"""
from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from types import ModuleType

from plant.errors import InputError
from rig.benches.frame_map import Field, Guard, insert_bits

Checksum = Callable[[Field, bytes, int], int]
UserChecksum = Callable[[bytes, int], int]


@cache
def _list_remainders(polynomial: int) -> tuple[int, ...]:
    """The CRC-8 of each byte."""
    found = []
    for value in range(256):
        for _ in range(8):
            value = (value << 1 ^ polynomial) & 0xFF if value & 0x80 else value << 1
        found.append(value)
    return tuple(found)


def compute_crc8(data: bytes, polynomial: int, start: int = 0xFF, inversion: int = 0xFF) -> int:
    """The CRC-8 of bytes, most significant bit first.

    >>> hex(compute_crc8(b"123456789", 0x1D)), hex(compute_crc8(b"123456789", 0x2F))
    ('0x4b', '0xdf')
    """
    remainders = _list_remainders(polynomial)
    for byte in data:
        start = remainders[start ^ byte]
    return start ^ inversion


def _protect_profile_1(each: Field, data: bytes, counter: int) -> int:
    """AUTOSAR PRS E2E, profile 1A: both bytes of the data ID, then the data; CRC-8 as of SAE J1850, from 0 to 0."""
    return compute_crc8(each.data_id.to_bytes(2, "little") + data, 0x1D, 0, 0)


def _protect_profile_2(each: Field, data: bytes, counter: int) -> int:
    """AUTOSAR PRS E2E, profile 2: the data, then the data ID of this counter; CRC-8 with polynomial 0x2F."""
    return compute_crc8(data + bytes([each.data_ids[counter % len(each.data_ids)]]), 0x2F)


CHECKSUMS: dict[str, Checksum] = {
    "crc8_sae_j1850": lambda each, data, counter: compute_crc8(data, 0x1D),
    "crc8_h2f": lambda each, data, counter: compute_crc8(data, 0x2F),
    "e2e_profile_1": _protect_profile_1,
    "e2e_profile_2": _protect_profile_2,
}
_USERS: dict[str, UserChecksum] = {}  # by `Field.checksum`


def compute_checksum(each: Field, data: bytes, counter: int) -> int:
    """The checksum that belongs into a field of this frame; what `data` has there does not matter.

    Args:
        each: the field, of guard CHECKSUM.
        data: the whole frame.
        counter: the frame's alive counter, or how many of these frames were sent before: both choose the same data ID.

    Raises:
        InputError: a user's function failed or gave no whole number.
    """
    if each.checksum in CHECKSUMS:
        own = each.lowest // 8
        return CHECKSUMS[each.checksum](each, data[:own] + data[own + 1:], counter)
    try:
        found = _USERS[each.checksum](insert_bits(each, data, 0), counter)
        return int(found) & (1 << each.length) - 1
    except Exception as error:
        name, _, function = each.checksum.partition("#")[0].rpartition(":")
        raise InputError(name, function, f"a whole number from (data, counter), not "
                                         f"{type(error).__name__}: {error}") from error


def load_checksum(name: str, source: bytes, function: str) -> str:
    """Run a user's file and keep its function `(data: bytes, counter: int) -> int`; its name for `Field.checksum`.

    Raises:
        InputError: not Python, or no such function.
    """
    known = f"{name}:{function}#{hashlib.sha256(source).hexdigest()[:8]}"
    if known not in _USERS:
        module = ModuleType(f"checksum_of_{name}")
        try:
            exec(compile(source, name, "exec", dont_inherit=True), module.__dict__)
        except Exception as error:
            raise InputError(name, "", f"a file that Python can run ({type(error).__name__}: {error})") from error
        if not callable(getattr(module, function, None)):
            raise InputError(name, function, "a function (data: bytes, counter: int) -> int")
        _USERS[known] = getattr(module, function)
        compute_checksum(Field(name="", lowest=0, length=8, guard=Guard.CHECKSUM, checksum=known), bytes(8), 0)
    return known
