"""A bench as a value: the device under test, its frames as data, and what the rig sends in which phase of a run.

A frame says where each value lies, what a count is worth, who sends it, and when. A bench file (bench_file.py) with its
EDS, DCF or DBC becomes a `Bench`. Python packs and unpacks with `pack` and `unpack`; compiled loops use the tables of
packing.py, which hold the same.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum, IntFlag
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple, Self

from plant import EHA, Signals, require
from rig.benches.calibration import Decision, SensorCalibration

EXTENDED = 1 << 31  # in an identifier: it has 29 bits, as in Linux's can_id
FD = 1 << 30  # in an identifier: a CAN FD frame
SWITCHED = 1 << 29  # beside FD, to send a frame: its data go at the higher bit rate; a bus delivers frames without it
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


class Protection(IntEnum):
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
    protection: Protection = Protection.NONE
    wrap: int | None = None  # of a counter: how many values it has; None: all that its bits hold
    checksum: str = ""  # of a checksum: name in checksums.py, or FILE.py:FUNCTION
    data_id: int = 0  # of AUTOSAR's profile 1
    data_ids: tuple[int, ...] = ()  # of AUTOSAR's profile 2: by counter

    @cached_property
    def range(self) -> tuple[int, int]:
        """Smallest and largest counts of an integer."""
        half = 1 << self.length - 1
        return (-half, half - 1) if self.kind is Kind.SIGNED else (0, 2 * half - 1)

    @property
    def ends(self) -> tuple[float, float]:
        """Smallest and largest value of an integer, SI."""
        low, high = sorted(map(self.compute_value, self.range))
        return low, high

    @property
    def modulus(self) -> int:
        """How many values a counter has: after the last comes 0."""
        return self.wrap or 1 << self.length

    def encode(self, value: float) -> int:
        """The bits of a value; out of range it saturates, as the output of a transducer does.

        Raises:
            ValueError: NaN for an integer: no invented number is sent.
        """
        counts = self.compute_counts(value)
        return encode_float(counts, self.length) if self.kind is Kind.FLOAT else int(counts) & (1 << self.length) - 1

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
        return round(min(max(counts, low), high))  # of NaN: ValueError

    def wrap_number(self, number: int) -> int:
        """The number of a cycle as the field holds it."""
        return number & (1 << self.length) - 1

    def compute_value(self, counts: float) -> float:
        """The value that these counts stand for, SI."""
        numerator, denominator, offset = self._worth
        # a whole number of more than 53 bits is rounded first, as in the compiled cycles
        return float(counts) * numerator / denominator + offset

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
    return float(struct.unpack("<d" if length == 64 else "<f", bits.to_bytes(length // 8, "little"))[0])


@dataclass(frozen=True, kw_only=True)
class FrameSpec:
    """One frame of a bench."""

    name: str  # as people call it: "RPDO1", "Demand"
    identifier: int  # with EXTENDED and FD
    length: int  # bytes
    sender: Role
    fields: tuple[Field, ...] = ()
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
    def selector(self) -> Field | None:
        """The field that tells the pages of a multiplexed frame apart."""
        return next((each for each in self.fields if each.fixed is not None and each.name), None)

    def has(self, *names: str) -> bool:
        """Whether the frame carries one of these values."""
        return any(each.name in names for each in self.fields)


def locate_bits(each: Field, length: int) -> tuple[str, int]:
    """Byte order of the integer to which a frame of `length` bytes is taken, and by how much a field is shifted in it.
    """
    return ("big", 8 * (length - 1 - each.lowest // 8) + each.lowest % 8) if each.is_big_endian else (
        "little", each.lowest)


@dataclass(frozen=True, kw_only=True)
class FrameMap:
    """All cyclic frames of a bench."""

    frames: tuple[FrameSpec, ...]
    sync: int | None = None  # identifier of SYNC; None: there is none

    @cached_property
    def by_identifier(self) -> dict[int, list[FrameSpec]]:
        """The frames of each identifier."""
        return {name: [each for each in self.frames if each.identifier == name]
                for name in dict.fromkeys(each.identifier for each in self.frames)}

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
        return self.list_from(role) + tuple(each for each in self.frames if each.sender is not role)

    def find(self, identifier: int, data: bytes) -> FrameSpec | None:
        """The frame with this identifier and, if it is multiplexed, with the page of `data`; None: not mapped."""
        for each in self.by_identifier.get(identifier, ()):
            selector = each.selector
            if selector is None or (len(data) == each.length and extract_bits(selector, data) == selector.fixed):
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
    return int.from_bytes(data, order) >> shift & (1 << each.length) - 1  # type: ignore[arg-type]  # little or big


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
        if each.fixed is not None:
            data = insert_bits(each, data, each.fixed)
        elif each.protection is Protection.COUNTER:
            counter %= each.modulus
            data = insert_bits(each, data, counter)
        elif each.name == "cycle":
            data = insert_bits(each, data, int(values.get("cycle", 0)))
        elif each.protection is Protection.NONE:
            data = insert_bits(each, data, each.encode(values.get(each.name, 0.0)))
    for each in spec.fields:
        if each.protection is Protection.CHECKSUM:  # over all else
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


Profile = Literal["cia402", "cia408", "none"]
SERVICES = {0x580: "SDO", 0x600: "SDO", 0x700: "heartbeat"}  # of a node, beside EMCY: CiA 301, table of 7.3.5

RIG_INPUTS = ("control_word", "mode", "cycle", "flags")  # of a controller: what the rig gives beside the plant
RIG_OUTPUTS = ("status_word", "mode_display", "cycle")


def list_inputs(signals: Signals) -> dict[str, str]:
    """What a controller may receive on a bench with a plant that has these signals: word and unit.

    "" is a number without a unit.
    """
    inputs = (signals.command, *signals.outputs, *([signals.load] if signals.load else []))
    return {s.word: _show_unit(s.unit) for s in inputs} | dict.fromkeys(RIG_INPUTS, "")


def list_outputs(signals: Signals) -> dict[str, str]:
    """What a controller may send: word and unit."""
    return {signals.drive.word: _show_unit(signals.drive.unit)} | dict.fromkeys(RIG_OUTPUTS, "")


def list_measured(signals: Signals) -> tuple[str, ...]:
    """The words of what transducers of the plant read, the load among them."""
    return tuple(s.word for s in signals if s.role in ("output", "load"))


def find_word(signals: Signals, name: str) -> str:
    """The word of a signal that is called by it, by its name, or as on every bench: position_demand, load."""
    load = {} if signals.load is None else {"load": signals.load.word}
    words = {s.word: s.word for s in signals[1:]}
    return {"position_demand": signals.command.word, **load, **{s.name: s.word for s in signals[1:]}, **words}.get(
        name, name)


def _show_unit(unit: str) -> str:
    return "" if unit == "1" else unit


class Flags(IntFlag):
    """State of the input of the plant in a cycle: how the controller answered the cycle before."""

    DRIVE_MISSING = 0x1  # no drive frame came
    DRIVE_LATE = 0x2  # the frame that came answers an earlier cycle
    CURRENT_ZEROED = 0x4  # too many in a row: the plant gets no current


class SignalObject(NamedTuple):
    """The object of a device that holds a signal, and how."""

    key: tuple[int, int]  # index, sub-index
    field: Field


@dataclass(frozen=True, kw_only=True)
class CanopenNode:
    """A CANopen node of a bench."""

    node: int  # node-ID
    eds: Path  # or DCF
    profile: Profile = "none"  # meaning of control word and status word
    mode: int | None = None  # CiA 402: written to 0x6060
    settings: tuple[tuple[int, int, str], ...] = ()  # objects (index, sub) that hold a parameter of the model
    values: tuple[tuple[int, int, bytes], ...] = ()  # of a DCF: written at bring-up
    emcy: tuple[int, ...] = ()  # error codes that its manual lists
    emcy_id: int | None = None  # identifier of its EMCY, with EXTENDED; None: it sends none
    inputs: Mapping[str, SignalObject] = field(default_factory=dict)  # signals that it receives
    outputs: Mapping[str, SignalObject] = field(default_factory=dict)  # signals that it sends


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Everything that depends on the device under test."""

    name: str
    frames: FrameMap
    nodes: Mapping[Role, CanopenNode]  # empty on plain CAN; without PLANT the rig itself moves the plant
    plant: str = "eha"  # model that runs unless another is chosen
    kind: str = "eha"  # what models call its plant
    signals: Signals = EHA  # of the plant that runs; their words are names of fields in the frames
    noise: float = 2e-6  # SI, nominal, of the sensor of the controlled signal; 0: not known
    cycle_ns: int = 1_000_000
    bitrate: int = 1_000_000  # bit/s
    data_bitrate: int | None = None  # bit/s, of the data of CAN FD frames with BRS; None: not known
    timeout_ns: int | None = None  # without a drive frame for so long the controller is gone; None: three cycles
    phases: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # field: phase -> counts
    ready: Mapping[str, float] = field(default_factory=dict)  # field of a frame of the controller: counts in main
    files: Mapping[str, bytes] = field(default_factory=dict)  # bench file, EDS, DBC: name -> content, for the log
    decision: Decision = "simple"  # rule by which a value with an uncertainty passes a limit
    calibration: Mapping[str, SensorCalibration] = field(default_factory=dict)  # by signal of the plant

    @property
    def fineness(self) -> float:
        """What differences of the controlled signal are measured by: noise of its sensor, or a part of a demand count.

        A demand in floating point has no such count.
        """
        return max(self.noise or 2e-6, 0.2 * self.find_count(self.signals.command.word))

    def find_count(self, word: str) -> float:
        """What one count of a signal is worth in its frames, SI; 0 in floating point, and where no frame has it."""
        return max((float(abs(each.count)) for spec in self.frames.frames for each in spec.fields
                    if each.name == word and each.kind is not Kind.FLOAT), default=0.0)

    def find_least(self, word: str) -> float:
        """The size of the value nearest to 0 that a signal can have, SI: of one with an offset up to half a count."""
        return max((min(abs(each.decode(each.encode(0.0))), 0.5 * float(abs(each.count))) for spec in self.frames.frames
                    for each in spec.fields if each.name == word), default=0.0)

    def list_ranges(self, *roles: str) -> list[tuple[str, str, float, float]]:
        """Frame, signal, smallest and largest value, SI, where the frames to the controller have integers for signals
        of these roles.
        """
        names = {s.word: s.name for s in self.signals if s.role in roles}
        return [(spec.name, names[each.name], *each.ends) for spec in self.frames.list_from(Role.RIG, Role.PLANT)
                for each in spec.fields if each.name in names and each.kind is not Kind.FLOAT]

    def replace_signals(self, signals: Signals, noise: float, model: str) -> Self:
        """The bench with the plant of another model: its signals, and the noise of the controlled one's sensor.

        Raises:
            InputError: it lacks a signal that the bench uses, or has it in another unit.
        """
        if signals == self.signals:
            return replace(self, noise=noise)
        words = {each.name for spec in self.frames.frames for each in spec.fields}
        new_signals = {s.word: (s.unit, s.role) for s in signals[1:]}
        signal_list = ", ".join(f"{word} ({unit})" for word, (unit, _) in new_signals.items())
        for s in self.signals[1:]:
            if s.word in words or s.role in ("command", "drive"):
                require(new_signals.get(s.word) == (s.unit, s.role), self.name, s.word,
                        f"a plant that has this signal, as {s.role} in {s.unit}; {model} has {signal_list}; another "
                        "bench by --bench FILE")
        return replace(self, signals=signals, noise=noise)

    @property
    def rate(self) -> float:
        """Cycles a second."""
        return 1e9 / self.cycle_ns

    @property
    def has_plant_node(self) -> bool:
        """Whether the plant is a node of its own on the bus."""
        return Role.PLANT in self.nodes

    @property
    def most_missed(self) -> int:
        """Cycles in a row without a drive frame after which the plant gets no current."""
        return 3 if self.timeout_ns is None else max(1, -(-self.timeout_ns // self.cycle_ns))

    @property
    def profile(self) -> Profile:
        """Meaning of the controller's control word and status word."""
        controller = self.nodes.get(Role.CONTROLLER)
        return "none" if controller is None else controller.profile

    @property
    def rig_node(self) -> int:
        """Node-ID of the rig: 1, or the largest that is free if a device has that."""
        node_ids = {node.node for node in self.nodes.values()}
        return 1 if 1 not in node_ids else next(number for number in range(127, 0, -1) if number not in node_ids)

    def find_number(self, role: Role) -> int:
        """The node-ID of a participant; on plain CAN, where nobody has one, the number of its role."""
        if role in self.nodes:
            return self.nodes[role].node
        return self.rig_node if role is Role.RIG and self.nodes else int(role)

    @property
    def enables(self) -> tuple[str, ...]:
        """Fields of `phases` that enable the controller: 0 in set-up or clean-up, and not in main."""
        return tuple(name for name, values in self.phases.items()
                     if values.get("main") and 0 in (values.get("setup"), values.get("cleanup"), values.get("safe")))

    @property
    def can_disable(self) -> bool:
        """Whether a control word or a field of `phases` switches the controller off."""
        return self.profile != "none" or bool(self.enables)

    def is_enabled(self, phase: str) -> bool:
        """Whether the fields that enable the controller do so in a phase: "setup", "main" or "cleanup"."""
        return all(self.phases[name].get(phase, 0) != 0 for name in self.enables)

    def describe_node(self, role: Role) -> str:
        """A participant as messages name it: "node 2 controller" on CANopen, else "controller"."""
        has_number = role in self.nodes or (role is Role.RIG and self.nodes)
        return f"node {self.find_number(role)} {role.name.lower()}" if has_number else role.name.lower()

    def list_participants(self) -> dict[int, str]:
        """Who takes part in a run: number, and name with it."""
        return {self.find_number(role): self.describe_node(role) for role in Role
                if role is not Role.PLANT or self.has_plant_node}

    def read_data_sheet(self, role: Role) -> tuple[str, str]:
        """Name and text of a node's EDS or DCF."""
        path = self.nodes[role].eds
        name = next((name for name in self.files if path.as_posix().endswith(name)), path.name)
        return name, decode_device_text(self.files[name] if name in self.files else path.read_bytes())

    def list_services(self) -> list[tuple[int, str]]:
        """Identifiers that carry no values of the bench, and what they are: NMT, SYNC, and the services of the nodes.
        """
        emcy_ids = {} if not self.nodes else {
            self.rig_node: 0x080 + self.rig_node, **{node.node: node.emcy_id for node in self.nodes.values()}}
        return [*([] if self.frames.sync is None else [(self.frames.sync, "SYNC")]),
                *([(0x000, "NMT")] if self.nodes else []),
                *((base + number, f"{service} of node {number}") for number in emcy_ids
                  for base, service in SERVICES.items()),
                *((emcy_id, f"EMCY of node {number}") for number, emcy_id in emcy_ids.items() if emcy_id is not None)]


def decode_device_text(data: bytes) -> str:
    """The text of an EDS, DCF or DBC; those of old tools are not UTF-8."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")
