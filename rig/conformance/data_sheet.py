"""The EDS of the node under test (CiA 306): what it promises, read by the `canopen` library and as plain text."""
from __future__ import annotations

import logging
import struct
from collections.abc import Iterator
from configparser import Error as ConfigError
from configparser import RawConfigParser
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import canopen
from canopen.objectdictionary import ODVariable

from plant.errors import InputError

Number = int | float
BOOLEAN, REAL32, REAL64 = 0x01, 0x08, 0x11
VISIBLE_STRING, OCTET_STRING, UNICODE_STRING, DOMAIN = 0x09, 0x0A, 0x0B, 0x0F
UNSIGNED8, UNSIGNED16, UNSIGNED32 = 0x05, 0x06, 0x07
SIGNED = (0x02, 0x03, 0x04, 0x10, 0x12, 0x13, 0x14, 0x15)
SIZES = {  # data type (CiA 301, table 44) -> bytes
    BOOLEAN: 1, 0x02: 1, 0x03: 2, 0x04: 4, UNSIGNED8: 1, UNSIGNED16: 2, UNSIGNED32: 4, REAL32: 4, 0x0C: 6, 0x0D: 6,
    0x10: 3, REAL64: 8, 0x12: 5, 0x13: 6, 0x14: 7, 0x15: 8, 0x16: 3, 0x18: 5, 0x19: 6, 0x1A: 7, 0x1B: 8,
}  # fmt: skip
RPDO, TPDO, MAPPING = 0x1400, 0x1800, 0x200  # communication parameters; the mapping is MAPPING further on
# Objects that start something when they are written: store, restore, verify, commands, programs, network management.
_ACTIVE = (range(0x1010, 0x1012), range(0x1020, 0x1029), range(0x1F00, 0x2000))


class Variable(NamedTuple):
    """One sub-index as the EDS describes it."""

    index: int  # type: ignore[assignment]  # the word of the standard; nobody asks this tuple for the place of a value
    sub: int
    name: str
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
    def is_readable(self) -> bool:
        return self.access != "wo"

    @property
    def is_writable(self) -> bool:
        return self.access in ("rw", "wo", "rww", "rwr")

    @property
    def is_number(self) -> bool:
        """Whether its values are numbers of a fixed length."""
        return self.data_type in SIZES and self.data_type not in (0x0C, 0x0D)

    @property
    def size(self) -> int:
        """Length in bytes, 0 if it has no fixed one."""
        return SIZES.get(self.data_type, 0)

    @property
    def bits(self) -> int:
        """Length in a PDO."""
        return 1 if self.data_type == BOOLEAN else 8 * self.size

    @property
    def is_active(self) -> bool:
        """Whether writing it may start something: such an object is left alone."""
        return any(self.index in each for each in _ACTIVE)

    @property
    def is_communication(self) -> bool:
        """Whether it belongs to the communication profile, whose meaning CiA 301 gives."""
        return 0x1000 <= self.index < 0x2000

    def decode(self, data: bytes) -> Number:
        """The number in these bytes. Raises ValueError for a wrong length."""
        if len(data) != self.size:
            raise ValueError(f"{len(data)} bytes instead of {self.size}")
        if self.data_type in (REAL32, REAL64):
            value: float = struct.unpack("<f" if self.data_type == REAL32 else "<d", data)[0]
            return value
        return int.from_bytes(data, "little", signed=self.data_type in SIGNED)

    def show(self, data: bytes) -> str:
        """The value for a reader: a number, a text or bytes in hexadecimal."""
        if self.is_number and len(data) == self.size:
            value = self.decode(data)
            return f"0x{value:X}" if isinstance(value, int) and self.data_type not in SIGNED else f"{value:g}"
        return repr(data.decode("latin-1")) if self.data_type == VISIBLE_STRING else data.hex(" ")

    def encode(self, value: Number) -> bytes:
        """The bytes of a number. Raises OverflowError for one that does not fit."""
        if self.data_type in (REAL32, REAL64):
            return struct.pack("<f" if self.data_type == REAL32 else "<d", value)
        return int(value).to_bytes(self.size, "little", signed=self.data_type in SIGNED)

    @property
    def default_bytes(self) -> bytes | None:
        """Its default as an SDO upload sends it, None if the EDS has none."""
        if self.default is None or self.default == "":
            return None
        if isinstance(self.default, str):
            return self.default.encode("utf-16-le" if self.data_type == UNICODE_STRING else "latin-1", "replace")
        return self.default if isinstance(self.default, bytes) else self.encode(self.default)


class Pdo(NamedTuple):
    """One PDO that the EDS describes, by number from 1."""

    number: int
    is_sent: bool  # by the node under test: a TPDO

    @property
    def parameter(self) -> int:
        """Index of its communication parameters."""
        return (TPDO if self.is_sent else RPDO) + self.number - 1

    @property
    def mapping(self) -> int:
        """Index of its mapping."""
        return self.parameter + MAPPING

    @property
    def name(self) -> str:
        return f"{'TPDO' if self.is_sent else 'RPDO'}{self.number}"


class DataSheet:
    """An EDS for one node-ID. `text` is the file section by section, `variables` what it describes.

    Raises InputError for a file that is not an EDS.
    """

    def __init__(self, path: Path, node: int) -> None:
        self.path, self.node = path, node
        self.text = RawConfigParser(inline_comment_prefixes=(";",))
        self.text.optionxform = str  # type: ignore[assignment, method-assign]
        try:
            with path.open(encoding="latin-1") as file:
                self.text.read_file(file)
            with _silence(logging.getLogger("canopen.objectdictionary.eds")):  # test 1.1 says what it would warn of
                od: Any = canopen.import_od(str(path), node)
        except (OSError, ValueError, KeyError, TypeError, ConfigError) as error:
            logging.getLogger(__name__).debug("EDS %s", path, exc_info=True)
            raise InputError(path, "", f"an electronic data sheet (CiA 306): {error}".replace("\n", " ")) from None
        self.objects: dict[int, list[Variable]] = {
            index: [_read_variable(each) for each in ([od[index]] if isinstance(od[index], ODVariable)
                                                      else [od[index][sub] for sub in sorted(od[index])])]
            for index in sorted(od) if index >= 0x1000}
        self.variables = [variable for each in self.objects.values() for variable in each]
        if not self.variables:
            raise InputError(path, "", "an electronic data sheet (CiA 306) with objects")
        self._by_key = {(variable.index, variable.sub): variable for variable in self.variables}
        self.pdos = [Pdo(index - base + 1, base == TPDO) for base in (RPDO, TPDO)
                     for index in self.objects if base <= index < base + MAPPING]

    def find(self, index: int, sub: int = 0) -> Variable | None:
        """The variable, None if the EDS has none there."""
        return self._by_key.get((index, sub))

    def is_writable(self, index: int, sub: int = 0) -> bool:
        """Whether the EDS lets a master write there."""
        variable = self.find(index, sub)
        return variable is not None and variable.is_writable

    def default_identifier(self, index: int, absent: int) -> int:
        """The 11-bit identifier that a COB-ID object has after a reset, `absent` if the EDS has no such object."""
        variable = self.find(index)
        return int(variable.default) & 0x7FF if variable and isinstance(variable.default, int) else absent

    @property
    def name(self) -> str:
        """The product, as the EDS names it."""
        return self.text.get("DeviceInfo", "ProductName", fallback="").strip() or self.path.name


@contextmanager
def _silence(logger: logging.Logger) -> Iterator[None]:
    """Within, the logger reports nothing."""
    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before


def _read_variable(variable: ODVariable) -> Variable:
    default = variable.default
    if variable.data_type not in SIZES and isinstance(default, bytearray):
        default = bytes(default)
    return Variable(variable.index, variable.subindex, variable.name, variable.data_type or 0,
                    (variable.access_type or "").lower(), default, variable.min, variable.max,
                    bool(variable.pdo_mappable))


RESTRICTED_RANGES = (
    (0x000, 0x000), (0x001, 0x07F), (0x101, 0x180), (0x581, 0x5FF), (0x601, 0x67F), (0x6E0, 0x6FF), (0x701, 0x77F),
    (0x780, 0x7FF),
)  # fmt: skip


def is_restricted(can_id: int) -> bool:
    """Whether no PDO, SYNC, EMCY or TIME may use this identifier.

    >>> is_restricted(0x5FF), is_restricted(0x182)
    (True, False)
    """
    return any(low <= can_id <= high for low, high in RESTRICTED_RANGES)


def list_restricted_ends() -> list[int]:
    """First and last identifier of each restricted range: those that a test tries.

    >>> len(list_restricted_ends())
    15
    """
    return sorted({end for each in RESTRICTED_RANGES for end in each})
