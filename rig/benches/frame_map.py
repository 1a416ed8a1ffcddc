"""The frames of a bench as data: where each value lies, what a count is worth, who sends the frame, and when.

A bench file (bench_file.py) with its EDS, DCF or DBC becomes a `FrameMap`. Python packs and unpacks with `pack`
and `unpack`; compiled loops use the tables of packing.py, which hold the same.
"""
from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from fractions import Fraction
from functools import cached_property

EXTENDED = 1 << 31  # in an identifier: it has 29 bits, as in Linux's can_id
FD = 1 << 30  # in an identifier: a CAN FD frame
SWITCHED = 1 << 29  # beside FD, to send a frame: its data go at the higher bit rate
MOST_FRAMES = 48  # of a bench: the compiled loops keep a bit of a word for each


def describe_identifier(identifier: int) -> str:
    """An identifier as people write it: 0x182, or 0x18FF0102 with 29 bits.

    >>> describe_identifier(0x182), describe_identifier(0x123 | EXTENDED)
    ('0x182', '0x00000123')
    """
    return f"0x{identifier & 0x1FFF_FFFF:08X}" if identifier & EXTENDED else f"0x{identifier & 0x7FF:03X}"


class Role(IntEnum):
    """Who takes part in a run, whatever the node numbers are."""

    RIG = 1
    CONTROLLER = 2
    PLANT = 3


class Kind(IntEnum):
    """How the bits of a value are read."""

    UNSIGNED = 0
    SIGNED = 1
    FLOAT = 2  # IEEE 754, 32 or 64 bits


class Guard(IntEnum):
    """What a protected field holds: the sender computes it and the receiver checks it."""

    NONE = 0
    COUNTER = 1  # counts the frames, modulo its range
    CHECKSUM = 2  # see `Field.checksum`


@dataclass(frozen=True, kw_only=True)
class Field:
    """One value in a frame. In counts it is round((value - offset) / count), limited to the range of its bits."""

    name: str  # signal of the bench, or of the device ("Demand.Enable")
    lowest: int  # place of the least significant bit: 8 * byte + bit
    length: int  # bits, 1 to 64
    is_big_endian: bool = False  # Motorola: above bit 7 of a byte comes bit 0 of the byte before
    kind: Kind = Kind.UNSIGNED
    count: Fraction = Fraction(1)  # what a count is worth, SI
    offset: Fraction = Fraction(0)  # SI
    fixed: int | None = None  # always these counts: selector of a multiplexed frame, or filling
    guard: Guard = Guard.NONE
    wrap: int | None = None  # of a counter: how many values it has; None: all that its bits hold
    checksum: str = ""  # of a checksum: name in checksums.py, or FILE.py:FUNCTION
    data_id: int = 0  # of AUTOSAR's profile 1
    data_ids: tuple[int, ...] = ()  # of AUTOSAR's profile 2: by counter

    @cached_property
    def range(self) -> tuple[int, int]:
        """Smallest and largest counts of an integer."""
        if self.kind is Kind.SIGNED:
            return -(1 << self.length - 1), (1 << self.length - 1) - 1
        return 0, (1 << self.length) - 1

    @property
    def modulus(self) -> int:
        """How many values a counter has: after the last comes 0."""
        return self.wrap or 1 << self.length

    def encode(self, value: float) -> int:
        """The bits of a value; out of range it saturates, as the output of a transducer does.

        Raises:
            ValueError: NaN for an integer: no invented number is sent.
        """
        if self.kind is Kind.FLOAT:
            return encode_float(self.compute_counts(value), self.length)
        return int(self.compute_counts(value)) & (1 << self.length) - 1

    def compute_counts(self, value: float) -> float:
        """What the device's object holds for a value: limited and rounded to a whole number unless it is a float.

        Raises:
            ValueError: as of `encode`.
        """
        numerator, denominator, offset = self._worth
        counts = (value - offset) * denominator / numerator
        if self.kind is Kind.FLOAT:
            return counts
        low, high = self.range
        if counts >= high:
            return high
        if counts <= low:
            return low
        return round(counts)  # of NaN: ValueError

    def wrap_number(self, number: int) -> int:
        """The number of a cycle as the field holds it."""
        return number & (1 << self.length) - 1

    def compute_value(self, counts: float) -> float:
        """The value that these counts stand for, SI."""
        numerator, denominator, offset = self._worth
        return counts * numerator / denominator + offset

    @cached_property
    def _worth(self) -> tuple[int, int, float]:
        """What a count is worth as two whole numbers, and the offset.

        0.005 m at 1e-7 m is 50000 and back 0.005 exactly, for 10^7 is a floating point number and 10^-7 is none.
        """
        return self.count.numerator, self.count.denominator, float(self.offset)

    def decode(self, bits: int) -> float:
        """The value that these bits stand for, SI."""
        counts: float = bits
        if self.kind is Kind.FLOAT:
            counts = decode_float(bits, self.length)
        elif self.kind is Kind.SIGNED and bits >> self.length - 1:
            counts = bits - (1 << self.length)
        return self.compute_value(counts)


def encode_float(value: float, length: int) -> int:
    """The bits of an IEEE 754 number of 32 or 64 bits; what 32 bits cannot hold becomes infinite."""
    if length == 64:
        return int.from_bytes(struct.pack("<d", value), "little")
    try:
        return int.from_bytes(struct.pack("<f", value), "little")
    except OverflowError:
        return 0x7F800000 if value > 0 else 0xFF800000


def decode_float(bits: int, length: int) -> float:
    """The number that 32 or 64 bits stand for."""
    code = "<d" if length == 64 else "<f"
    value: float = struct.unpack(code, bits.to_bytes(length // 8, "little"))[0]
    return value


@dataclass(frozen=True, kw_only=True)
class FrameSpec:
    """One frame of a bench."""

    name: str  # as people call it: "RPDO1", "Demand"
    identifier: int  # with EXTENDED and FD
    length: int  # bytes
    sender: Role
    fields: tuple[Field, ...]
    every: int = 1  # cycles from one to the next
    is_before_sync: bool = False  # sent before SYNC, with which its values take effect
    is_switched: bool = False  # CAN FD: the data go at the higher bit rate
    is_answer: bool = True  # of a sender other than the rig: it comes in each `every`-th cycle, so lockstep awaits it
    roles: tuple[str, ...] = ()  # as sequences name it: "command", "feedback", "valve_state", "drive"

    __hash__ = object.__hash__  # the loops ask for one and the same frame in each cycle; to hash its values takes 20 us

    @property
    def sent_as(self) -> int:
        """The identifier to send the frame with."""
        return self.identifier | SWITCHED * self.is_switched

    @cached_property
    def selectors(self) -> tuple[Field, ...]:
        """The fields that tell frames with the same identifier apart; several where multiplexers are nested."""
        return tuple(each for each in self.fields if each.fixed is not None and each.name)

    def has(self, *names: str) -> bool:
        """Whether the frame carries one of these values."""
        return any(each.name in names for each in self.fields)


_CODES = {(8, 0): "B", (8, 1): "b", (16, 0): "H", (16, 1): "h", (32, 0): "I", (32, 1): "i", (64, 0): "Q", (64, 1): "q",
          (32, 2): "f", (64, 2): "d"}

Writer = Callable[[Mapping[str, float], int, int], bytes]


def make_writer(spec: FrameSpec) -> Writer:
    """A function of values, cycle and count of frames sent that packs a frame; a fast one as in `make_reader`."""
    code = _find_code(spec)
    if code is None:
        return lambda values, cycle, count: pack(spec, {**values, "cycle": cycle}, count)
    write, fields = struct.Struct(code.upper().replace("F", "I").replace("D", "Q")).pack, spec.fields

    def pack_bytes(values: Mapping[str, float], cycle: int, count: int) -> bytes:
        return write(*[_choose_bits(each, values, cycle) for each in fields])

    return pack_bytes


def _choose_bits(each: Field, values: Mapping[str, float], cycle: int) -> int:
    if each.fixed is not None:
        return each.fixed
    if each.name == "cycle":
        return each.wrap_number(cycle)
    return each.encode(values.get(each.name, 0.0))


def _find_code(spec: FrameSpec) -> str | None:
    """Format of `struct` for a frame whose values are whole bytes, little endian and in order; None for another."""
    code, place = "<", 0
    for each in spec.fields:
        letter = _CODES.get((each.length, int(each.kind)))
        if letter is None or each.is_big_endian or each.lowest != place or each.guard is not Guard.NONE:
            return None
        code, place = code + letter, place + each.length
    return code if place == 8 * spec.length else None


def check_guards(spec: FrameSpec, data: bytes, last: int) -> tuple[str, int]:
    """What is wrong with checksum and alive counter of a frame, and its counter.

    "" for nothing, "checksum", "repeated" for the counter of the frame before, "jump" for one that is not the next.
    `last`: the counter of the frame before, -1 for the first.
    """
    from rig.benches.checksums import compute_checksum

    counter = next((each for each in spec.fields if each.guard is Guard.COUNTER), None)
    number = -1 if counter is None else extract_bits(counter, data)
    for each in spec.fields:
        if each.guard is Guard.CHECKSUM:
            expected = compute_checksum(each, insert_bits(each, data, 0), max(number, 0))
            if extract_bits(each, data) != expected:
                return "checksum", last
    if counter is None or last < 0 or number == (last + 1) % counter.modulus:
        return "", number
    return "repeated" if number == last else "jump", number


def make_reader(spec: FrameSpec) -> Callable[[bytes], dict[str, float]]:
    """A function like `unpack` for one frame; a fast one where its values are whole bytes, little endian, in order."""
    code = _find_code(spec)
    if code is None:
        return lambda data: unpack(spec, data)
    rows = [(each.name, each.count.numerator, each.count.denominator, float(each.offset)) for each in spec.fields]
    read = struct.Struct(code).unpack

    def unpack_bytes(data: bytes) -> dict[str, float]:
        return {name: counts * high / low + offset
                for counts, (name, high, low, offset) in zip(read(data), rows, strict=True)}

    return unpack_bytes


def locate_bits(each: Field, length: int) -> tuple[str, int]:
    """Byte order of the integer to which a frame of `length` bytes is taken, and by how much a field is shifted in it.
    """
    if not each.is_big_endian:
        return "little", each.lowest
    return "big", 8 * (length - 1 - each.lowest // 8) + each.lowest % 8


@dataclass(frozen=True, kw_only=True)
class FrameMap:
    """All cyclic frames of a bench."""

    frames: tuple[FrameSpec, ...]
    sync: int | None = None  # identifier of SYNC; None: there is none
    by_identifier: dict[int, list[FrameSpec]] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for each in self.frames:
            self.by_identifier.setdefault(each.identifier, []).append(each)

    @property
    def identifiers(self) -> list[int]:
        """Those of the frames, and of SYNC."""
        return sorted({*self.by_identifier, *([] if self.sync is None else [self.sync])})

    @property
    def is_fd(self) -> bool:
        """Whether there are CAN FD frames."""
        return any(each.identifier & FD for each in self.frames)

    def find_role(self, role: str) -> FrameSpec:
        """The frame that a sequence calls so: "command", "feedback", "valve_state" or "drive".

        Raises:
            StopIteration: there is none.
        """
        return next(each for each in self.frames if role in each.roles)

    @cached_property
    def drive(self) -> FrameSpec:
        """The frame in which the controller sends its output."""
        return self.find_role("drive")

    def list_from(self, *senders: Role) -> tuple[FrameSpec, ...]:
        """The frames of these senders."""
        return tuple(each for each in self.frames if each.sender in senders)

    def list_of(self, role: Role) -> tuple[FrameSpec, ...]:
        """The frames that a participant sends, in their order, and then those that it receives."""
        others = tuple(each for each in self.frames if each.sender is not role)
        return self.list_from(role) + others

    def find(self, identifier: int, data: bytes) -> FrameSpec | None:
        """The frame with this identifier and, if it is multiplexed, with the selectors of `data`; None: not mapped."""
        for each in self.by_identifier.get(identifier, ()):
            if not each.selectors or (len(data) == each.length and all(
                    extract_bits(chosen, data) == chosen.fixed for chosen in each.selectors)):
                return each
        return None


def list_bits(each: Field) -> list[int]:
    """The places of a field's bits, 8 * byte + bit, from the least significant one on.

    >>> list_bits(Field(name="", lowest=8, length=10, is_big_endian=True))
    [8, 9, 10, 11, 12, 13, 14, 15, 0, 1]
    """
    if not each.is_big_endian:
        return list(range(each.lowest, each.lowest + each.length))
    byte, bit = divmod(each.lowest, 8)
    return [8 * (byte - (bit + i) // 8) + (bit + i) % 8 for i in range(each.length)]


def extract_bits(each: Field, data: bytes) -> int:
    """The bits of a field."""
    order, shift = locate_bits(each, len(data))
    whole = int.from_bytes(data, order)  # type: ignore[arg-type]  # "little" or "big"
    return whole >> shift & (1 << each.length) - 1


def insert_bits(each: Field, data: bytes, bits: int) -> bytes:
    """`data` with the bits of a field set."""
    order, shift = locate_bits(each, len(data))
    whole = int.from_bytes(data, order)  # type: ignore[arg-type]
    mask = (1 << each.length) - 1
    return (whole & ~(mask << shift) | (bits & mask) << shift).to_bytes(len(data), order)  # type: ignore[arg-type]


def pack(spec: FrameSpec, values: Mapping[str, float], counter: int = 0) -> bytes:
    """The payload of a frame. A value that `values` lacks is 0; `counter`: how many of these frames were sent before.

    Raises:
        ValueError: NaN for an integer.
    """
    from rig.benches.checksums import compute_checksum

    data = bytes(spec.length)
    for each in spec.fields:
        if each.guard is Guard.NONE:
            data = insert_bits(each, data, _choose_bits(each, values, int(values.get("cycle", 0.0))))
        elif each.guard is Guard.COUNTER:
            counter %= each.modulus
            data = insert_bits(each, data, counter)
    for each in spec.fields:
        if each.guard is Guard.CHECKSUM:  # over all else
            data = insert_bits(each, data, compute_checksum(each, data, counter))
    return data


def unpack(spec: FrameSpec, data: bytes) -> dict[str, float]:
    """The values of a frame by name, SI.

    Raises:
        ValueError: a payload of another length.
    """
    if len(data) != spec.length:
        raise ValueError(f"{spec.name}: {spec.length} bytes, not {len(data)}")
    return {each.name: each.decode(extract_bits(each, data)) for each in spec.fields if each.name}
