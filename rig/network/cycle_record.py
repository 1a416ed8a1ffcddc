"""The emulator's own record of its cycles (object 0x2212): when it heard SYNC, and when it was ready with what.

The rig reads it after a run and so knows of the emulator's stalls. The times are those of the emulator's machine
(CLOCK_MONOTONIC); on one machine they are also those of the rig's timing.
"""
from __future__ import annotations

import struct
import zlib
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant.errors import InputError

RING = 1 << 17  # cycles that are kept: the last two minutes
_HEAD = struct.Struct("<4sIq")  # version, number of cycles, time of the first SYNC in ns
_VERSION = b"ECR1"
_US = 1000  # ns
_LARGEST = 16 * RING * 6  # bytes after decompression

Times = NDArray[np.int64]


class CycleRecord(NamedTuple):
    """One entry a cycle, in order, each (n,). Times in ns of CLOCK_MONOTONIC, kept to a microsecond.

    `flags` are those of the valve state frame (`codec.Flags`). In a cycle without the frames `sent` is when they would
    have been sent.
    """

    cycle: Times  # as in the valve state frame, but not cut to 16 bits
    sync: Times  # the kernel received SYNC
    start: Times  # the emulator began the cycle: the difference to `sync` is its wake-up latency
    sent: Times  # feedback and valve state were handed to the kernel
    done: Times  # the plant had moved: the emulator was ready for the next SYNC
    flags: Times


def encode_cycle_record(record: CycleRecord) -> bytes:
    """The bytes of object 0x2212: a head, then the differences from cycle to cycle as bytes of like weight, compressed.

    Empty without a cycle.
    """
    if not len(record.cycle):
        return b""
    columns = np.array([record.cycle, (record.sync - record.sync[0]) // _US, *(
        (times - record.sync) // _US for times in (record.start, record.sent, record.done)), record.flags])
    columns = np.clip(columns, -2**31, 2**31 - 1)
    changes = np.diff(columns[:2], axis=1, prepend=columns[:2, :1])
    changes[0, 0] = columns[0, 0]
    # The period of SYNC and the times after it vary by a few us: most upper bytes are zero, and compress to nothing.
    body = np.concatenate([changes, columns[2:]]).astype("<i4").view(np.uint8).reshape(6, -1, 4)
    planes = np.ascontiguousarray(body.transpose(0, 2, 1)).tobytes()
    return _HEAD.pack(_VERSION, len(record.cycle), int(record.sync[0])) + zlib.compress(planes, 6)


def decode_cycle_record(data: bytes) -> CycleRecord:
    """What `encode_cycle_record` packed; of an emulator without a record (b"") one without cycles.

    Raises:
        InputError: other bytes.
    """
    if not data:
        return CycleRecord(*(np.zeros(0, np.int64) for _ in CycleRecord._fields))
    try:
        version, count, first = _HEAD.unpack_from(data)
        if version != _VERSION:
            raise ValueError(f"version {version!r}")
        planes = zlib.decompressobj().decompress(data[_HEAD.size:], _LARGEST)
        body = np.frombuffer(planes, np.uint8).reshape(6, 4, count)
    except (struct.error, zlib.error, ValueError) as error:
        raise InputError("object 0x2212", "", f"a cycle record of version {_VERSION.decode()} ({error})") from error
    values = np.ascontiguousarray(body.transpose(0, 2, 1)).view("<i4").reshape(6, count).astype(np.int64)
    cycle, since = np.cumsum(values[:2], axis=1)
    sync = first + since * _US
    start, sent, done = (sync + times * _US for times in values[2:5])
    return CycleRecord(cycle, sync, start, sent, done, values[5])
