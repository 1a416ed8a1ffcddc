"""An EDS or DCF as frames of a CANopen device: its PDOs, as its mapping parameters say (CiA 301, 7.5.2.35 to 38)."""

import io
import re
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, NamedTuple

from canopen.objectdictionary import ODVariable, datatypes
from canopen.objectdictionary.eds import import_eds

from plant import require
from rig.benches.bench import EXTENDED, Field, FrameSpec, Kind, Role
from rig.benches.layout import DeviceFrame, Slot, Use, use_reader

INVALID = 1 << 31  # in a COB-ID: the PDO is switched off
LONG = 1 << 29  # in a COB-ID: the identifier has 29 bits
RPDO, TPDO, MAPPING = 0x1400, 0x1800, 0x200  # communication parameters; the mapping is MAPPING further on
PARAMETERS = frozenset((*range(RPDO, RPDO + MAPPING), *range(TPDO, TPDO + MAPPING)))
_LONGEST = 64  # bits of a PDO
LAST_SYNCHRONOUS, EVENT_DRIVEN = 240, (254, 255)  # transmission types of PDOs (CiA 301, table 70)
_KINDS = {datatypes.BOOLEAN: Kind.UNSIGNED, datatypes.REAL32: Kind.FLOAT, datatypes.REAL64: Kind.FLOAT,
          **dict.fromkeys(datatypes.SIGNED_TYPES, Kind.SIGNED),
          **dict.fromkeys(datatypes.UNSIGNED_TYPES, Kind.UNSIGNED)}
_OBJECT = re.compile(r"0x([0-9A-Fa-f]{1,4})(?::(0x[0-9A-Fa-f]{1,2}|\d{1,3}))?")


class Pdo(NamedTuple):
    """One PDO of a dictionary."""

    name: str  # RPDO1
    parameter: int  # index of its communication parameters
    is_received: bool
    cob_id: int  # with INVALID and LONG
    kind: int  # transmission type
    entries: tuple[tuple[int, int, int], ...]  # index, sub, bits

    @property
    def mapping(self) -> int:
        """Index of its mapping."""
        return self.parameter + MAPPING

    @property
    def length(self) -> int:
        """Bits."""
        return sum(bits for _, _, bits in self.entries)

    @property
    def is_cyclic(self) -> bool:
        """Whether it goes with each n-th SYNC, n being its type."""
        return 1 <= self.kind <= LAST_SYNCHRONOUS


def parse_object(text: str) -> tuple[int, int] | None:
    """Index and sub-index of "0x2110:1" or "0x2100"; None for another text.

    >>> parse_object("0x2110:1"), parse_object("0x6040"), parse_object("2100")
    ((8464, 1), (24640, 0), None)
    """
    match = _OBJECT.fullmatch(text.strip())
    if match is None:
        return None
    sub = match[2] or "0"
    number = int(sub, 16) if sub.startswith("0x") else int(sub)
    return (int(match[1], 16), number) if number < 256 else None


def name_object(index: int, sub: int) -> str:
    """The object as bench files and messages name it.

    >>> name_object(0x2110, 1), name_object(0x6040, 0)
    ('0x2110:1', '0x6040')
    """
    return f"0x{index:04X}:{sub}" if sub else f"0x{index:04X}"


@cache  # bench, master, nodes and conformance tests ask for the same, and nobody changes it; to read it takes some ms
def read_dictionary(name: str, text: str, node: int) -> Any:
    """The object dictionary of an EDS or DCF for a node-ID, as canopen reads it.

    Raises:
        InputError: not an EDS, or a DCF of another node.
    """
    with use_reader("canopen", name, "an electronic data sheet (CiA 306): {}"):  # it warns of what no bench uses
        dictionary: Any = import_eds(io.StringIO(text), node)  # type: ignore[no-untyped-call]
    require(any(index >= 0x1000 for index in dictionary), name, "", "an electronic data sheet (CiA 306) with objects")
    file_node = read_node(text)
    require(file_node in (None, node), name, "NodeID", f"{node}, the node of the bench file, not {file_node}")
    if file_node is None and not name.lower().endswith(".dcf"):
        for variable in list_variables(dictionary):
            variable.value = None  # in an EDS it is a slip of its tool: the device is not to be configured so
    return dictionary


def read_node(text: str) -> int | None:
    """The node-ID that a DCF is for; None of an EDS."""
    match = re.search(r"^\[DeviceComm?issioning\][^\[]*^NodeID\s*=\s*(0x[0-9A-Fa-f]{1,2}|[1-9]\d{0,2})\s*$", text,
                      re.MULTILINE | re.IGNORECASE)
    return None if match is None else int(match[1], 0)


def find_variable(dictionary: Any, index: int, sub: int) -> ODVariable | None:
    """The variable of a dictionary; None if it has none there."""
    item = dictionary.get(index)
    if item is None or isinstance(item, ODVariable):
        return item if not sub else None
    is_compact = sub not in item.subindices and read_number(dictionary, index, 0) is None  # it lists no elements
    variable: ODVariable | None = (item if is_compact else item.subindices).get(sub)
    return variable


def read_number(dictionary: Any, index: int, sub: int) -> int | None:
    """The whole number that the device holds after a reset, or that the DCF writes; None if the file gives none."""
    item = dictionary.get(index)
    variable = item if isinstance(item, ODVariable) else getattr(item, "subindices", {}).get(sub)
    value = _find_value(variable)
    return value if type(value) is int else None


def _find_value(variable: ODVariable | None) -> object:
    """What an object holds after a reset, or what the DCF writes; None if the file gives neither."""
    return None if variable is None else variable.default if variable.value is None else variable.value


def find_sync(dictionary: Any) -> int:
    """The identifier of SYNC, 0x80 if the dictionary gives none."""
    word = read_number(dictionary, 0x1005, 0)
    return 0x80 if word is None else _read_identifier(word)


def find_emcy(dictionary: Any, node: int) -> int | None:
    """The identifier of a node's EMCY, 0x80 + node-ID if the dictionary gives none; None: 0x1014 switches it off."""
    word = read_number(dictionary, 0x1014, 0)
    return 0x80 + node if word is None else None if word & INVALID else _read_identifier(word)


def _read_identifier(cob_id: int) -> int:
    return cob_id & 0x1FFF_FFFF | EXTENDED if cob_id & LONG else cob_id & 0x7FF


def list_pdos(dictionary: Any, node: int) -> Iterator[Pdo]:
    """All PDOs of a dictionary, also those that are switched off; an empty mapping entry is left out."""
    for base, kind, first in ((RPDO, "RPDO", 0x200), (TPDO, "TPDO", 0x180)):
        for number in (index - base for index in sorted(dictionary) if base <= index < base + MAPPING):
            default_cob_id = first + 0x100 * number + node if number < 4 else INVALID
            cob_id = read_number(dictionary, base + number, 1)
            transmission = read_number(dictionary, base + number, 2)
            count = read_number(dictionary, base + MAPPING + number, 0) or 0
            words = [read_number(dictionary, base + MAPPING + number, sub) for sub in range(1, min(count, 64) + 1)]
            entries = tuple((word >> 16 & 0xFFFF, word >> 8 & 0xFF, word & 0xFF) for word in words if word)
            yield Pdo(f"{kind}{number + 1}", base + number, base == RPDO,
                      default_cob_id if cob_id is None else cob_id, 255 if transmission is None else transmission,
                      entries)


def is_mapped(dictionary: Any, key: str, *, is_received: bool) -> bool:
    """Whether a PDO that is on carries an object."""
    return any(name_object(index, sub) == key for pdo in list_pdos(dictionary, 0) for index, sub, _ in pdo.entries
               if pdo.is_received is is_received and not pdo.cob_id & INVALID)


def map_pdos(name: str, dictionary: Any, node: int, uses: Mapping[str, Use]) -> Iterator[DeviceFrame]:
    """The PDOs in which `uses` (objects, as `name_object` writes them) lie.

    Raises:
        InputError: an object that the dictionary lacks, that has the wrong type or access, or that no PDO maps; a PDO
            of more than 8 bytes, or with a transmission type that the rig cannot serve.
    """
    pdos = list(list_pdos(dictionary, node))
    valid_pdos = [(pdo, [name_object(index, sub) for index, sub, _ in pdo.entries])
                  for pdo in pdos if not pdo.cob_id & INVALID]
    for key, use in uses.items():
        _check_object(name, dictionary, key, use)
        if not any(key in keys and use.is_received in (pdo.is_received, None) for pdo, keys in valid_pdos):
            raise use.place.refuse(_describe_unmapped(dictionary, pdos, key, use))
    synchronous_keys = {key for pdo, keys in valid_pdos for key in keys if not pdo.is_received and pdo.is_cyclic}
    awaited_keys = {key for key, use in uses.items() if use.is_needed} - synchronous_keys  # only this PDO brings them
    for pdo, keys in valid_pdos:
        if used_keys := {key for key in keys if key in uses and uses[key].is_received in (pdo.is_received, None)}:
            is_answer = pdo.is_cyclic or (pdo.kind in EVENT_DRIVEN and not awaited_keys.isdisjoint(used_keys))
            yield _map_pdo(name, dictionary, pdo, used_keys, is_answer=is_answer)


def _check_object(name: str, dictionary: Any, key: str, use: Use) -> None:
    """Refuse an object that is absent, no number, or that goes the other way."""
    index, sub = parse_object(key) or (0, 0)
    variable = find_variable(dictionary, index, sub)
    if variable is None:
        near = dictionary.get(index)
        subs = "" if near is None or isinstance(near, ODVariable) else (
            f"; it has the sub-indices {', '.join(map(str, list(near.subindices)[:12]))}")
        raise use.place.refuse(f"an object of {name}; it has no {key}{subs}")
    use.place.require(variable.data_type in _KINDS,
                      f"a number; {key} ({variable.name}) has the data type 0x{variable.data_type or 0:04X}")
    use.place.require(variable.writable or not use.is_received,
                      f"an object that can be written; {key} ({variable.name}) is {variable.access_type}")
    use.place.require(variable.readable or use.is_received is not False,
                      f"an object that can be read; {key} ({variable.name}) is {variable.access_type}")


def _describe_unmapped(dictionary: Any, pdos: list[Pdo], key: str, use: Use) -> str:
    """What to do about an object that is in no PDO that is on."""
    kind = "TPDO" if use.is_received is False else "RPDO"
    candidates = [pdo for pdo in pdos if pdo.name.startswith(kind)]
    off_pdo = next((pdo for pdo in candidates
                    if any(name_object(index, sub) == key for index, sub, _ in pdo.entries)), None)
    if off_pdo is not None:
        return (f"an object that a {kind} maps; {off_pdo.name} maps {key}, but is switched off (bit 31 of "
                f"0x{off_pdo.parameter:04X}:1)")
    index, sub = parse_object(key) or (0, 0)
    variable = find_variable(dictionary, index, sub)
    bits = len(variable) if variable is not None else 0
    if variable is not None and not variable.pdo_mappable:
        return f"an object that a {kind} maps; {key} cannot be mapped (PDOMapping=0)"
    remark = "".join(f"{pdo.name} maps {name_object(*at)}, which the file lacks; " for pdo in candidates
                     for *at, _ in pdo.entries if at[0] > 0x1000 and find_variable(dictionary, *at) is None)
    room = [pdo.name for pdo in candidates if pdo.length + bits <= _LONGEST]
    where = f"{' and '.join(room)} {'has' if len(room) == 1 else 'have'} room" if room else f"no {kind} has room"
    return f"an object that a {kind} maps; {remark}for {key} with {bits} bits {where} (map it in a DCF)"


def _map_pdo(name: str, dictionary: Any, pdo: Pdo, used_keys: set[str], *, is_answer: bool) -> DeviceFrame:
    """The frame of a PDO; only the objects of `used_keys` keep their names."""
    where = f"0x{pdo.mapping:04X}"
    require(0 < pdo.length <= _LONGEST, name, where, f"at most 8 bytes in {pdo.name}, not {pdo.length} bits")
    require(0 <= pdo.kind <= LAST_SYNCHRONOUS or pdo.kind in EVENT_DRIVEN, name, f"0x{pdo.parameter:04X}:2",
            f"a transmission type 0 to 240, 254 or 255 for {pdo.name}, not {pdo.kind}")
    slots, lowest = [], 0
    for index, sub, length in pdo.entries:
        key, variable = name_object(index, sub), find_variable(dictionary, index, sub)
        kind = Kind.UNSIGNED if variable is None else _KINDS.get(variable.data_type or 0, Kind.UNSIGNED)
        size = 1 if variable is None or variable.data_type == datatypes.BOOLEAN else len(variable)
        # Many devices map a BOOLEAN as a byte.
        require(key not in used_keys or length == size or (size, length) == (1, 8), name, where,
                f"{key} with {size} bits in {pdo.name}, not {length}")
        if kind is Kind.FLOAT and length != size:
            kind = Kind.UNSIGNED
        slots.append(Slot(name=key if key in used_keys else "", start=read_start(variable),
                          bits=Field(name="", lowest=lowest, length=length, kind=kind)))
        lowest += length
    return DeviceFrame(slots=tuple(slots), spec=FrameSpec(
        name=pdo.name, identifier=_read_identifier(pdo.cob_id), length=(lowest + 7) // 8,
        sender=Role.RIG if pdo.is_received else Role.CONTROLLER,
        every=pdo.kind if not pdo.is_received and pdo.is_cyclic else 1,
        is_before_sync=pdo.is_received and pdo.kind <= LAST_SYNCHRONOUS, is_answer=is_answer or pdo.is_received))


def read_start(variable: ODVariable | None) -> float:
    """The number that an object holds after a reset, 0 if the file gives none."""
    value = _find_value(variable)
    return value if isinstance(value, int | float) and abs(value) < 1 << 64 else 0


def encode_value(variable: ODVariable, value: float) -> bytes | None:
    """The bytes of a number in an object, None if it cannot hold it."""
    kind = _KINDS.get(variable.data_type or 0)
    if kind is None:  # a text, or a domain
        return None
    is_whole = kind is not Kind.FLOAT
    ranges = [(variable.min, variable.max)]
    if is_whole:  # canopen cuts numbers of 24 bits and the like
        ranges.append(Field(name="", lowest=0, length=len(variable), kind=kind).range)
    is_outside = any((low is not None and value < low) or (high is not None and value > high) for low, high in ranges)
    if is_outside or (is_whole and value % 1):
        return None
    try:
        return bytes(variable.encode_raw(int(value) if is_whole else float(value)))
    except OverflowError:
        return None


def list_values(dictionary: Any) -> tuple[tuple[int, int, bytes], ...]:
    """The values that a DCF gives to objects that can be written, in the order in which a device takes them.

    A PDO is switched off first, then its mapping is emptied, filled and counted, then its parameters follow, and last
    its COB-ID (CiA 301, 7.5.2.36).
    """
    values: dict[tuple[int, int], bytes] = {}
    for variable in list_variables(dictionary):
        if variable.value is not None and variable.writable and variable.index >= 0x1000:
            try:
                values[variable.index, variable.subindex] = variable.encode_raw(variable.value)
            except (TypeError, ValueError, UnicodeError):
                continue  # a value that does not fit its type cannot be written either
    writes = [(index, sub, data) for (index, sub), data in values.items() if not RPDO <= index < TPDO + 2 * MAPPING]
    for parameter in sorted({index & ~MAPPING for index, _ in values if RPDO <= index < TPDO + 2 * MAPPING}):
        mapping = {sub: data for (index, sub), data in values.items() if index == parameter + MAPPING}
        sub_values = {sub: data for (index, sub), data in values.items() if index == parameter and sub}
        default = read_number(dictionary, parameter, 1)
        if mapping and default is not None and dictionary[parameter][1].writable:
            sub_values.setdefault(1, default.to_bytes(4, "little"))
        cob_id = sub_values.pop(1, None)
        if mapping and cob_id is not None:
            writes.append((parameter, 1, (int.from_bytes(cob_id, "little") | INVALID).to_bytes(4, "little")))
        count = mapping.pop(0, None)
        if count is not None and mapping:
            writes.append((parameter + MAPPING, 0, bytes(len(count))))
        writes += [*((parameter + MAPPING, sub, data) for sub, data in mapping.items()),
                   *([(parameter + MAPPING, 0, count)] if count is not None else []),
                   *((parameter, sub, data) for sub, data in sub_values.items()),
                   *([(parameter, 1, cob_id)] if cob_id is not None else [])]
    return tuple(writes)


def list_variables(dictionary: Any) -> Iterator[ODVariable]:
    """All variables of a dictionary, in order."""
    for index in sorted(dictionary):
        item = dictionary[index]
        if isinstance(item, ODVariable):
            yield item
        else:
            yield from (item.subindices[sub] for sub in sorted(item.subindices))
