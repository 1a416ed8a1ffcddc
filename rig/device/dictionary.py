"""Object dictionary: the entries of an EDS (CiA 306) and their values in use."""

import struct
from pathlib import Path
from typing import cast

from canopen.objectdictionary import ODVariable, datatypes

from plant import read_file, require
from rig.benches import INVALID, decode_device_text, list_variables, read_dictionary
from rig.device.sdo import Abort, SdoAbort, abort_unless

Value = int | float | bytes

_STRINGS = (datatypes.VISIBLE_STRING, datatypes.OCTET_STRING, datatypes.DOMAIN)


def find_struct(entry: ODVariable) -> struct.Struct | None:
    """What packs the number of an entry; None for strings and domains, and for numbers of 24 bits and the like."""
    packer = ODVariable.STRUCT_TYPES.get(entry.data_type or 0)
    return packer if type(packer) is struct.Struct else None


def read_default(entry: ODVariable) -> Value:
    """What an entry holds after power-on."""
    default: int | float | bytes | str | None = entry.default
    if find_struct(entry) is not None:
        return 0 if default is None else cast(Value, default)
    # CiA 301: a VISIBLE_STRING is ASCII; some data sheets are not
    return default.encode("ascii", "replace") if isinstance(default, str) else cast(bytes, default or b"")


class Dictionary:
    """Entries by (index, sub-index) and, beside them, the plain dict of their values.

    `values` is public and hot: the PDOs read and write it directly. Strings and domains are bytes.
    """

    def __init__(self, path: Path, node_id: int) -> None:
        self.path = path
        self.entries = _load(path, node_id)
        self.values: dict[tuple[int, int], Value] = {}
        self._indices = {index for index, _ in self.entries}
        self.restore(0x1000, 0xFFFF)

    def restore(self, first: int, last: int) -> None:
        """Set the objects from index `first` to `last` to their defaults."""
        self.values |= {key: read_default(entry) for key, entry in self.entries.items() if first <= key[0] <= last}

    def list_subs(self, index: int) -> list[int]:
        """The sub-indices of an object above 0, in order; empty if there is no such object."""
        return sorted(sub for i, sub in self.entries if i == index and sub)

    def read_number(self, index: int, sub: int, absent: int = 0) -> int:
        """An integer object's value, or `absent` where the device has no such object."""
        return cast(int, self.values.get((index, sub), absent))

    def find(self, index: int, sub: int) -> ODVariable:
        """The entry. Raises SdoAbort: no such object, no such sub-index."""
        entry = self.entries.get((index, sub))
        if entry is None:
            raise SdoAbort(Abort.NO_SUBINDEX if index in self._indices else Abort.NO_OBJECT)
        return entry

    def encode(self, index: int, sub: int) -> bytes:
        """The value as SDO upload sends it. Raises SdoAbort: absent, write-only."""
        entry = self.find(index, sub)
        abort_unless(entry.readable, Abort.WRITE_ONLY)
        value = self.values[index, sub]
        number = find_struct(entry)
        return cast(bytes, value) if number is None else number.pack(value)

    def find_size(self, index: int, sub: int) -> int:
        """Bytes an SDO download must bring, 0 for any number. Raises SdoAbort: absent, read-only."""
        entry = self.find(index, sub)
        abort_unless(entry.writable, Abort.READ_ONLY)
        number = find_struct(entry)
        return 0 if number is None else number.size

    def decode(self, index: int, sub: int, data: bytes) -> Value:
        """The value an SDO download would store. Raises SdoAbort: absent, read-only, length, range."""
        size, entry = self.find_size(index, sub), self.find(index, sub)
        number = find_struct(entry)
        if number is None:
            return data
        abort_unless(len(data) >= size, Abort.TOO_SHORT)
        abort_unless(len(data) <= size, Abort.TOO_LONG)
        value: int | float = number.unpack(data)[0]
        abort_unless(entry.max is None or value <= entry.max, Abort.TOO_HIGH)
        abort_unless(entry.min is None or value >= entry.min, Abort.TOO_LOW)
        return value


def _load(path: Path, node_id: int) -> dict[tuple[int, int], ODVariable]:
    """Read the EDS. Raises InputError if it cannot be read or holds a type this core does not know."""
    od = read_dictionary(str(path), decode_device_text(read_file(path)), node_id)
    entries = {(each.index, each.subindex): each for each in list_variables(od) if each.index >= 0x1000}
    for (index, sub), entry in entries.items():
        require(find_struct(entry) is not None or entry.data_type in _STRINGS, path, f"{index:04X}sub{sub:X}.DataType",
                "an integer of 8, 16, 32 or 64 bits, REAL, string or DOMAIN, "
                f"not 0x{entry.data_type or 0:04X}")
    return entries


PRODUCER = 1 << 30  # 0x1005: the node sends SYNC
_CAN_ID = 0x7FF
_UNUSED = 0x3FFFF800  # bit 29 asks for a 29-bit identifier, whose bits follow
_RESTRICTED = (  # CiA 301, 7.3.5, table 40
    range(0x080), range(0x101, 0x181), range(0x581, 0x600), range(0x601, 0x680),
    range(0x6E0, 0x700), range(0x701, 0x780), range(0x780, 0x800),
)  # fmt: skip


def is_restricted(can_id: int) -> bool:
    """Whether no configurable object may use this identifier (CiA 301, 7.3.5, table 40).

    >>> is_restricted(0x5FF), is_restricted(0x580), is_restricted(0x182)
    (True, False, False)
    """
    return any(can_id in each for each in _RESTRICTED)


def check_switchable(old: int, new: int) -> None:
    """Check a new value of an entry with a valid bit: PDO (CiA 301, 7.5.2.35 and 7.5.2.37) or EMCY (7.5.2.17).

    The identifier of a valid entry is fixed: it is first made invalid (bit 31), with whatever identifier, then changed.

    Raises:
        SdoAbort: a 29-bit or restricted identifier, or a change of a valid one.
    """
    abort_unless(not new & _UNUSED, Abort.VALUE)
    if not new & INVALID:
        abort_unless(not is_restricted(new & _CAN_ID), Abort.VALUE)
        abort_unless(old & INVALID or not (old ^ new) & _CAN_ID, Abort.STATE)


def check_sync(new: int) -> None:
    """Check a new value of 0x1005 (CiA 301, 7.5.2.5) for a device that consumes SYNC and cannot produce it.

    Raises:
        SdoAbort: a 29-bit or restricted identifier, or the order to produce SYNC.
    """
    abort_unless(not new & (_UNUSED | PRODUCER) and not is_restricted(new & _CAN_ID), Abort.VALUE)


def check_consumer_entry(entry: int, others: list[int]) -> None:
    """Check a new value of an entry of 0x1016 (CiA 301, 7.5.2.19); `others` are the values of the other entries.

    The standard leaves an entry with a node above 127 unused. It is refused here, because nobody would notice that the
    supervision asked for does not happen. Time 0 or node 0 switch an entry off.

    Raises:
        SdoAbort: reserved bits are set, a node above 127, or a node that another entry watches.
    """
    node, time = entry >> 16, entry & 0xFFFF
    abort_unless(not entry >> 24 and (node <= 127 or not time), Abort.VALUE)
    is_watched = any(other >> 16 & 0xFF == node and other & 0xFFFF for other in others)
    abort_unless(not (node and time and is_watched), Abort.INCOMPATIBLE)
