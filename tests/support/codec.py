"""Bytes <-> physical values for the four PDOs of the bench: pure functions, no socket, no clock.

One table, `SIGNALS`, says where each value lies; it is what `dbc/eha.dbc` and the object dictionaries say too. Values
out of range saturate, like the output of a transducer (INT32 at 1e-7 m covers +-214 m; only a diverged plant reaches
that);
NaN has no raw value and raises ValueError: no invented number is sent.
"""

import struct
from typing import NamedTuple

SYNC = 0x080
COMMAND, FEEDBACK, VALVE_STATE, DRIVE = 0x202, 0x183, 0x283, 0x182  # COB-IDs

POSITION, PRESSURE, SPOOL, CURRENT = 1e-7, 10.0, 1e-9, 1e-8  # resolution: m, Pa, m, A per count

_HIGH, _LOW = 2**31 - 1, -(2**31)
_LEVEL_WORDS = struct.Struct("<iHH")  # command, valve state, drive: INT32, UNSIGNED16, UNSIGNED16
_LEVELS = struct.Struct("<ii")  # feedback: INT32, INT32


class Signal(NamedTuple):
    """Where one value lies in its frame (little endian) and what a count is worth."""

    cob_id: int
    name: str
    start: int  # bit
    length: int  # bits
    signed: bool
    scale: float  # unit per count
    unit: str


SIGNALS = (
    Signal(COMMAND, "position_demand", 0, 32, True, POSITION, "m"),
    Signal(COMMAND, "control_word", 32, 16, False, 1, ""),
    Signal(COMMAND, "cycle", 48, 16, False, 1, ""),
    Signal(FEEDBACK, "ram_position", 0, 32, True, POSITION, "m"),
    Signal(FEEDBACK, "load_pressure", 32, 32, True, PRESSURE, "Pa"),
    Signal(VALVE_STATE, "spool_position", 0, 32, True, SPOOL, "m"),
    Signal(VALVE_STATE, "flags", 32, 16, False, 1, ""),
    Signal(VALVE_STATE, "cycle", 48, 16, False, 1, ""),
    Signal(DRIVE, "current", 0, 32, True, CURRENT, "A"),
    Signal(DRIVE, "status_word", 32, 16, False, 1, ""),
    Signal(DRIVE, "cycle", 48, 16, False, 1, ""),
)


class Command(NamedTuple):
    """Position demand and control word from the rig, frame 0x202."""

    position: float  # m
    control: int
    cycle: int


class Feedback(NamedTuple):
    """Readings of the plant's position and pressure transducers, frame 0x183."""

    position: float  # XJ, m
    pressure: float  # P12, Pa


class ValveState(NamedTuple):
    """Spool position and input flags of the plant, frame 0x283."""

    spool: float  # XS, m
    flags: int
    cycle: int


class Drive(NamedTuple):
    """Current demand and status word of the controller, frame 0x182."""

    current: float  # Cor, A
    status: int
    cycle: int


def _saturate(counts: float) -> int:
    """The nearest INT32; half counts go to the even one.

    Raises ValueError for NaN.
    """
    return round(min(max(counts, _LOW), _HIGH))


# Counts per unit are whole numbers in binary while 1e-7 is not: multiply to encode and divide to decode, so that a raw
# value decodes to the double nearest to its decimal (50000 -> 0.005) and survives the way there and back.
def pack_command(position_demand: float, control: int, cycle: int) -> bytes:
    """Frame 0x202. `cycle` is taken modulo 2**16."""
    return _LEVEL_WORDS.pack(_saturate(position_demand * 1e7), control, cycle & 0xFFFF)


def pack_feedback(ram_position: float, load_pressure: float) -> bytes:
    """Frame 0x183."""
    return _LEVELS.pack(_saturate(ram_position * 1e7), _saturate(load_pressure / 10.0))


def pack_valve_state(spool_position: float, flags: int, cycle: int) -> bytes:
    """Frame 0x283. `cycle` is taken modulo 2**16."""
    return _LEVEL_WORDS.pack(_saturate(spool_position * 1e9), flags, cycle & 0xFFFF)


def pack_drive(coil_current: float, status: int, cycle: int) -> bytes:
    """Frame 0x182. `cycle` is taken modulo 2**16."""
    return _LEVEL_WORDS.pack(_saturate(coil_current * 1e8), status, cycle & 0xFFFF)


def unpack_command(data: bytes) -> Command:
    """Frame 0x202; raises struct.error unless `data` has 8 bytes, as all four do."""
    raw, control, cycle = _LEVEL_WORDS.unpack(data)
    return Command(raw / 1e7, control, cycle)


def unpack_feedback(data: bytes) -> Feedback:
    """Frame 0x183."""
    raw, load = _LEVELS.unpack(data)
    return Feedback(raw / 1e7, load * 10.0)


def unpack_valve_state(data: bytes) -> ValveState:
    """Frame 0x283."""
    raw, flags, cycle = _LEVEL_WORDS.unpack(data)
    return ValveState(raw / 1e9, flags, cycle)


def unpack_drive(data: bytes) -> Drive:
    """Frame 0x182."""
    raw, status, cycle = _LEVEL_WORDS.unpack(data)
    return Drive(raw / 1e8, status, cycle)
