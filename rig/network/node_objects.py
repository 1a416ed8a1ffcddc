"""Participants of a run, and application objects of our own nodes, which the rig writes and the nodes obey."""

import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from plant import InputError, Quantity
from rig.benches import Role

RIG, CONTROLLER, PLANT = Role.RIG, Role.CONTROLLER, Role.PLANT  # of the shipped bench they are the node-IDs as well
NAMES: dict[int, str] = {role: role.name.lower() for role in Role}
GAINS = 0x2110  # of the reference firmware
SCENARIO, COUNTERS, CYCLE_RECORD = 0x2210, 0x2211, 0x2212  # of the plant


class Gains(NamedTuple):
    """Object 0x2110 sub 1..5: the fields of `plant.parameters.Controller`."""

    proportional_gain: float
    integral_gain: float
    derivative_gain: float
    current_limit: float
    period: float


def read_gains(values: Mapping[str, float]) -> Gains | None:
    """The gains among the parameters of a model, or of a controller; None if one is missing."""
    names = [f"controller.{field}" for field in Gains._fields]
    return Gains(*(values[name] for name in names)) if all(name in values for name in names) else None


class NmtState(IntEnum):
    """States as the heartbeat carries them."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


def name_state(state: int) -> str:
    """What a heartbeat says, as the standard writes it.

    >>> name_state(127), name_state(0), name_state(9)
    ('PRE-OPERATIONAL', 'BOOT-UP', 'STATE 9')
    """
    names = {each.value: each.name.replace("_", "-") for each in NmtState} | {0: "BOOT-UP"}
    return names.get(state, f"STATE {state}")


class NmtCommand(IntEnum):
    """Command specifiers of the frame 0x000."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


Unsigned32 = Annotated[int, Quantity("1", low=0, high=0xFFFFFFFF)]


@dataclass(frozen=True, kw_only=True)
class Identity:
    """What a node says about itself, or has to say. None: it has no such object, or that is not compared."""

    device_type: Unsigned32 | None = None  # 0x1000
    name: str | None = None  # 0x1008, manufacturer device name
    hardware: str | None = None  # 0x1009, manufacturer hardware version
    software: str | None = None  # 0x100A, manufacturer software version
    vendor: Unsigned32 | None = None  # 0x1018 sub 1, vendor-ID
    product: Unsigned32 | None = None  # 0x1018 sub 2, product code
    revision: Unsigned32 | None = None  # 0x1018 sub 3, revision number
    serial: Unsigned32 | None = None  # 0x1018 sub 4, serial number

    @property
    def known(self) -> dict[str, int | str]:
        """What is known."""
        return {key: value for key, value in vars(self).items() if value is not None}

    def __str__(self) -> str:
        """What is known, in one line."""
        words = (f"{key.replace('_', ' ')} {_show_object(value)}" for key, value in self.known.items())
        return ", ".join(words) or "no identity objects"

    def find_difference(self, other: Self) -> tuple[str, str]:
        """The first key that another identity must have alike and has not, and how, in words; two empty texts for none.
        """
        for key, required in self.known.items():
            if (answer := getattr(other, key)) != required:
                return key, f"{_show_object(required)}, but the controller has {_show_object(answer)}"
        return "", ""


def _show_object(value: int | str | None) -> str:
    if value is None:
        return "no such object"
    return f"0x{value:08X}" if isinstance(value, int) else repr(value)


_OBJECTS = {"device_type": (0x1000, 0), "name": (0x1008, 0), "hardware": (0x1009, 0), "software": (0x100A, 0),
            "vendor": (0x1018, 1), "product": (0x1018, 2), "revision": (0x1018, 3), "serial": (0x1018, 4)}
_TEXTS = ("name", "hardware", "software")


def read_identity(upload: Callable[[int, int], bytes | None]) -> Identity:
    """The identity of a node; `upload(index, sub)` gives an object's bytes, None where the node has no such object."""
    known: Any = {key: _decode_text(data) if key in _TEXTS else int.from_bytes(data[:4], "little")
                  for key, place in _OBJECTS.items() if (data := upload(*place)) is not None}
    return Identity(**known)


def _decode_text(data: bytes, longest: int = 64) -> str:
    """A VISIBLE_STRING, at most `longest` characters; one that is no printable ASCII becomes a question mark."""
    text = data.rstrip(b"\0 ")[:longest].decode("ascii", "replace")
    return "".join(letter if letter.isascii() and letter.isprintable() else "?" for letter in text)


RING = 1 << 17  # cycles that are kept: the last two minutes
_HEAD = struct.Struct("<4sIq")  # version, number of cycles, time of the first SYNC in ns
_VERSION = b"ECR1"
_US = 1000  # ns
_LARGEST = 16 * RING * 6  # bytes after decompression

Times = NDArray[np.int64]


class CycleRecord(NamedTuple):
    """One entry a cycle, in order, each (n,). Times in ns of CLOCK_MONOTONIC, kept to a microsecond.

    `flags` are those of the valve state frame (`bench.Flags`). In a cycle without the frames `sent` is when they would
    have been sent.
    """

    cycle: Times  # as in the valve state frame, but not cut to 16 bits
    sync: Times  # the kernel received SYNC
    start: Times  # the emulator began the cycle: the difference to `sync` is its wake-up latency
    sent: Times  # feedback and valve state were handed to the kernel
    done: Times  # the plant had moved: the emulator was ready for the next SYNC
    flags: Times


def encode_cycle_record(record: CycleRecord) -> bytes:
    """The bytes of object 0x2212, little endian; empty without a cycle.

    4 bytes ECR1; UNSIGNED32 number n of cycles; INTEGER64 `sync` of the first in ns; then a zlib stream of six
    columns of n INTEGER32, each as four planes of n bytes, the lowest bytes first: the cycle number as the difference
    to the one before (the first: itself); `sync` in us after that of the cycle before (the first: 0); `start`, `sent`
    and `done` in us after `sync`; `flags`.
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
    """What `encode_cycle_record` packed.

    Raises:
        InputError: other bytes.
    """
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
