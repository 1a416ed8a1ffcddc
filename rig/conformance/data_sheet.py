"""The EDS of the node under test (CiA 306): what it promises, read by the `canopen` library and as plain text."""
from __future__ import annotations

import logging
import struct
from configparser import Error as ConfigError
from configparser import RawConfigParser
from pathlib import Path
from typing import Any, NamedTuple

import canopen
from canopen.objectdictionary import ODVariable, datatypes

from plant.errors import InputError
from rig.conformance.conformance_case import require

Number = int | float
SIZES = {data_type: each.size for data_type, each in ODVariable.STRUCT_TYPES.items()} | {
    datatypes.TIME_OF_DAY: 6, datatypes.TIME_DIFFERENCE: 6}  # data type (CiA 301, table 44) -> bytes
FLOATS = {datatypes.REAL32: "<f", datatypes.REAL64: "<d"}
RPDO, TPDO, MAPPING = 0x1400, 0x1800, 0x200  # communication parameters; the mapping is MAPPING further on
HISTORY = 0x1003
# Objects that start something when they are written: store, restore, verify, commands, programs, network management.
_ACTIVE = (range(0x1010, 0x1012), range(0x1020, 0x1029), range(0x1F00, 0x2000))


class Variable(NamedTuple):
    """One sub-index as the EDS describes it."""

    index: int  # type: ignore[assignment]  # the word of the standard; nobody asks this tuple for the place of a value
    sub: int
    data_type: int
    access: str  # rw, ro, wo, const, rww, rwr
    default: Number | str | bytes | None
    low: Number | None
    high: Number | None
    is_mappable: bool

    @property
    def label(self) -> str:
        """How it is named in a report."""
        return f"0x{self.index:04X}:{self.sub:X}"

    @property
    def key(self) -> tuple[int, int]:
        """Index and sub-index."""
        return self.index, self.sub

    @property
    def is_readable(self) -> bool:
        return self.access != "wo"

    @property
    def is_writable(self) -> bool:
        return "w" in self.access

    @property
    def size(self) -> int:
        """Length of a number in bytes, 0 for what has no fixed one."""
        return SIZES.get(self.data_type, 0)

    @property
    def bits(self) -> int:
        """Length in a PDO."""
        return 1 if self.data_type == datatypes.BOOLEAN else 8 * self.size

    @property
    def is_active(self) -> bool:
        """Whether writing it may start something: such an object is left alone."""
        return any(self.index in each for each in _ACTIVE)

    @property
    def is_communication(self) -> bool:
        """Whether it belongs to the communication profile, whose meaning CiA 301 gives."""
        return 0x1000 <= self.index < 0x2000

    @property
    def has_valid_bit(self) -> bool:
        """Whether it is a COB-ID that bit 31 switches off: of a PDO or of EMCY."""
        return self.key == (0x1014, 0) or (self.index in PDO_PARAMETERS and self.sub == 1)

    @property
    def is_mapping(self) -> bool:
        """Whether it belongs to the mapping of a PDO."""
        return self.index - MAPPING in PDO_PARAMETERS

    def is_inside(self, value: Number) -> bool:
        """Whether a value keeps to its limits."""
        return (self.low is None or value >= self.low) and (self.high is None or value <= self.high)

    def decode(self, data: bytes) -> Number:
        """The number in these bytes. Raises Problem for a wrong length."""
        require(len(data) == self.size, f"{self.label} has {len(data)} bytes, expected {self.size}")
        if self.data_type in FLOATS:
            return float(struct.unpack(FLOATS[self.data_type], data)[0])
        return int.from_bytes(data, "little", signed=self.data_type in datatypes.SIGNED_TYPES)

    def encode(self, value: Number) -> bytes:
        """The bytes of a number. Raises OverflowError for one that does not fit."""
        if self.data_type in FLOATS:
            return struct.pack(FLOATS[self.data_type], value)
        return int(value).to_bytes(self.size, "little", signed=self.data_type in datatypes.SIGNED_TYPES)

    def can_hold(self, value: Number) -> bool:
        """Whether a number fits its type."""
        try:
            self.encode(value)
        except OverflowError:
            return False
        return True

    def show(self, data: bytes) -> str:
        """The value for a reader: a number, a text or bytes in hexadecimal."""
        if self.size and len(data) == self.size:
            value = self.decode(data)
            is_signed = self.data_type in (*FLOATS, *datatypes.SIGNED_TYPES)
            return f"{value:g}" if is_signed else f"0x{value:X}"
        return repr(data.decode("latin-1")) if self.data_type == datatypes.VISIBLE_STRING else data.hex(" ")

    def change(self, data: bytes) -> bytes:
        """Other bytes of the same length, within the limits: by the smallest step where that is possible.

        Raises Problem if there are none.
        """
        require(data, f"{self.label} has 0 bytes")
        offers = (bytes((data[0] ^ bits,)) + data[1:] for bits in (1, 2, 3))
        return next((offer for offer in offers if len(data) != self.size or self.is_inside(self.decode(offer))), data)

    @property
    def default_bytes(self) -> bytes | None:
        """Its default as an SDO upload sends it, None if the EDS has none."""
        if self.default is None or self.default == "":
            return None
        if isinstance(self.default, str):
            is_wide = self.data_type == datatypes.UNICODE_STRING
            return self.default.encode("utf-16-le" if is_wide else "latin-1", "replace")
        return self.default if isinstance(self.default, bytes) else self.encode(self.default)


PDO_PARAMETERS = frozenset((*range(RPDO, RPDO + MAPPING), *range(TPDO, TPDO + MAPPING)))


class Pdo(NamedTuple):
    """One PDO that the EDS describes."""

    name: str  # RPDO1
    is_sent: bool  # by the node under test: a TPDO
    parameter: int  # index of its communication parameters
    mapping: int  # index of its mapping


class DataSheet:
    """An EDS for one node-ID. `text` is the file section by section, `variables` what it describes.

    Raises InputError for a file that is not an EDS.
    """

    def __init__(self, path: Path, node: int) -> None:
        self.path, self.node = path, node
        self.text = RawConfigParser(inline_comment_prefixes=(";",))
        self.text.optionxform = str  # type: ignore[assignment, method-assign]
        warnings = logging.getLogger("canopen.objectdictionary.eds")
        warnings.disabled = True  # test 1.1 says what it would warn of
        try:
            with path.open(encoding="latin-1") as file:
                self.text.read_file(file)
            od: Any = canopen.import_od(str(path), node)
        except (OSError, ValueError, KeyError, TypeError, ConfigError) as error:
            logging.getLogger(__name__).debug("EDS %s", path, exc_info=True)
            raise InputError(path, "", f"an electronic data sheet (CiA 306): {error}".replace("\n", " ")) from None
        finally:
            warnings.disabled = False
        self.objects: dict[int, list[Variable]] = {
            index: [_read_variable(each) for each in ([od[index]] if isinstance(od[index], ODVariable)
                                                      else [od[index][sub] for sub in sorted(od[index])])]
            for index in sorted(od) if index >= 0x1000}
        self.variables = [variable for each in self.objects.values() for variable in each]
        if not self.variables:
            raise InputError(path, "", "an electronic data sheet (CiA 306) with objects")
        self._by_key = {variable.key: variable for variable in self.variables}
        self.pdos = [Pdo(f"{kind}{index - base + 1}", kind == "TPDO", index, index + MAPPING)
                     for kind, base in (("RPDO", RPDO), ("TPDO", TPDO))
                     for index in self.objects if base <= index < base + MAPPING]

    def find(self, index: int, sub: int = 0) -> Variable | None:
        """The variable, None if the EDS has none there."""
        return self._by_key.get((index, sub))

    def is_writable(self, index: int, sub: int = 0) -> bool:
        """Whether the EDS lets a master write there."""
        variable = self.find(index, sub)
        return variable is not None and variable.is_writable

    def default(self, index: int, sub: int = 0) -> int | None:
        """The integer that an object holds after a reset, None if the EDS gives none."""
        variable = self.find(index, sub)
        return variable.default if variable is not None and isinstance(variable.default, int) else None

    def default_identifier(self, index: int, absent: int) -> int:
        """The 11-bit identifier that a COB-ID object has after a reset, `absent` if the EDS gives none."""
        word = self.default(index)
        return absent if word is None else word & 0x7FF

    @property
    def name(self) -> str:
        """The product, as the EDS names it."""
        return self.text.get("DeviceInfo", "ProductName", fallback="").strip() or self.path.name


def _read_variable(each: ODVariable) -> Variable:
    return Variable(each.index, each.subindex, each.data_type or 0, (each.access_type or "").lower(), each.default,
                    each.min, each.max, bool(each.pdo_mappable))


_RESTRICTED = (
    (0x000, 0x000), (0x001, 0x07F), (0x101, 0x180), (0x581, 0x5FF), (0x601, 0x67F), (0x6E0, 0x6FF), (0x701, 0x77F),
    (0x780, 0x7FF),
)  # fmt: skip
RESTRICTED_ENDS = sorted({end for each in _RESTRICTED for end in each})  # those that a test tries


def is_restricted(can_id: int) -> bool:
    """Whether no PDO, SYNC, EMCY or TIME may use this identifier.

    >>> is_restricted(0x5FF), is_restricted(0x182)
    (True, False)
    """
    return any(low <= can_id <= high for low, high in _RESTRICTED)
