"""Chapter 1: the EDS agrees with CiA 306, with CiA 301 and with itself. Nothing is sent."""
from __future__ import annotations

import re

from rig.conformance.conformance_case import CaseFailed, case, join_labels, require, require_none
from rig.conformance.data_sheet import (
    DOMAIN,
    MAPPING,
    OCTET_STRING,
    RPDO,
    SIZES,
    TPDO,
    UNICODE_STRING,
    UNSIGNED8,
    UNSIGNED16,
    UNSIGNED32,
    VISIBLE_STRING,
    DataSheet,
    Variable,
    is_restricted,
)
from rig.conformance.target import Target

# Data type and access of objects of the communication profile, CiA 301, 7.5.2.
STANDARD = {
    (0x1000, 0): (UNSIGNED32, "ro const"), (0x1001, 0): (UNSIGNED8, "ro"), (0x1002, 0): (UNSIGNED32, "ro"),
    (0x1003, 0): (UNSIGNED8, "rw"), (0x1003, 1): (UNSIGNED32, "ro"), (0x1005, 0): (UNSIGNED32, "rw const ro"),
    (0x1006, 0): (UNSIGNED32, "rw const ro"), (0x1007, 0): (UNSIGNED32, "rw const ro"),
    (0x1008, 0): (VISIBLE_STRING, "const ro"), (0x1009, 0): (VISIBLE_STRING, "const ro"),
    (0x100A, 0): (VISIBLE_STRING, "const ro"), (0x100C, 0): (UNSIGNED16, "rw ro const"),
    (0x100D, 0): (UNSIGNED8, "rw ro const"), (0x1010, 1): (UNSIGNED32, "rw"), (0x1011, 1): (UNSIGNED32, "rw"),
    (0x1014, 0): (UNSIGNED32, "rw const ro"), (0x1015, 0): (UNSIGNED16, "rw const ro"),
    (0x1016, 1): (UNSIGNED32, "rw const ro"), (0x1017, 0): (UNSIGNED16, "rw const ro"),
    (0x1018, 1): (UNSIGNED32, "ro const"), (0x1018, 2): (UNSIGNED32, "ro const"),
    (0x1018, 3): (UNSIGNED32, "ro const"), (0x1018, 4): (UNSIGNED32, "ro const"),
    (0x1019, 0): (UNSIGNED8, "rw const ro"), (0x1029, 1): (UNSIGNED8, "rw const ro"),
    (0x1200, 1): (UNSIGNED32, "ro const"), (0x1200, 2): (UNSIGNED32, "ro const"),
}  # fmt: skip
PDO_PARAMETERS = {1: UNSIGNED32, 2: UNSIGNED8, 3: UNSIGNED16, 4: UNSIGNED8, 5: UNSIGNED16, 6: UNSIGNED8}


@case("1.1", "sections of the file", "CiA 306",
      "FileInfo, DeviceInfo and MandatoryObjects are there; DeviceInfo has its keys")
def check_sections(t: Target) -> str:
    """The sections and keys that every EDS has."""
    text = t.sheet.text
    missing = [name for name in ("FileInfo", "DeviceInfo", "MandatoryObjects") if not text.has_section(name)]
    require(not missing, f"no section {join_labels(missing)}")
    keys = ("VendorName", "VendorNumber", "ProductName", "ProductNumber", "RevisionNumber", "Granularity",
            "NrOfRXPDO", "NrOfTXPDO")
    missing = [key for key in keys if not text.has_option("DeviceInfo", key)]
    require(not missing, f"DeviceInfo has no {join_labels(missing)}")
    rates = [key for key in text.options("DeviceInfo") if key.startswith("BaudRate_")
             and _number(t.sheet, "DeviceInfo", key) == 1]
    require(bool(rates), "DeviceInfo names no bit rate")
    return f"{len(text.sections())} sections; bit rates {', '.join(rate[9:] for rate in rates)} kbit/s"


@case("1.2", "mandatory objects", "7.5.2.1, 7.5.2.2, 7.5.2.21", "0x1000, 0x1001 and 0x1018 with sub 0 and 1")
def check_mandatory_objects(t: Target) -> str:
    """CiA 301 asks every node for three objects."""
    missing = [f"0x{index:04X}" for index in (0x1000, 0x1001, 0x1018) if index not in t.sheet.objects]
    missing += [f"0x1018:{sub}" for sub in (0, 1) if t.sheet.find(0x1018, sub) is None and "0x1018" not in missing]
    require(not missing, f"missing: {join_labels(missing)}")
    return f"all there, of {len(t.sheet.objects)} objects"


@case("1.3", "lists of objects", "CiA 306",
      "every object is in one list, every list entry has a section, the counts are right")
def check_lists(t: Target) -> str:
    """The three lists name exactly the objects that are described."""
    text, listed, problems = t.sheet.text, [], []
    areas = {"MandatoryObjects": range(0x1000, 0x1019), "OptionalObjects": range(0x1000, 0x10000),
             "ManufacturerObjects": range(0x2000, 0x6000)}
    for name, permitted in areas.items():
        if not text.has_section(name):
            continue
        entries = [_number(t.sheet, name, key) for key in text.options(name) if key.isdigit()]
        count = _number(t.sheet, name, "SupportedObjects")
        if count != len(entries):
            problems.append(f"{name} says {count} and lists {len(entries)}")
        problems += [f"0x{index:04X} in {name}" for index in entries if index not in permitted]
        listed += entries
    described = {int(name, 16) for name in text.sections() if re.fullmatch("[0-9A-Fa-f]{4}", name)}
    problems += [f"0x{index:04X} is listed twice" for index in sorted(set(listed)) if listed.count(index) > 1]
    problems += [f"0x{index:04X} is listed and not described" for index in sorted(set(listed) - described)]
    problems += [f"0x{index:04X} is described and not listed" for index in sorted(described - set(listed))]
    require_none(problems)
    return f"{len(listed)} objects in the lists"


@case("1.4", "sub-indices", "7.4, CiA 306",
      "SubNumber is the number of sub-indices; sub 0 holds the highest one")
def check_subindices(t: Target) -> str:
    """Arrays and records say how many sub-indices they have, in two places."""
    problems, count = [], 0
    for index, variables in t.sheet.objects.items():
        section = next((name for name in t.sheet.text.sections() if name.upper() == f"{index:04X}"), "")
        if _number(t.sheet, section, "ObjectType", 7) not in (8, 9) or _number(t.sheet, section, "CompactSubObj"):
            continue
        count += 1
        stated = _number(t.sheet, section, "SubNumber", -1)
        subs = [variable.sub for variable in variables]
        if stated != len(subs):
            problems.append(f"0x{index:04X} says SubNumber {stated} and has {len(subs)}")
        if 0 not in subs:
            problems.append(f"0x{index:04X} has no sub 0")
            continue
        first = variables[subs.index(0)]
        highest = first.default if isinstance(first.default, int) else None
        is_list = index == 0x1003 or _is_mapping(index)  # their sub 0 counts what is in use
        if first.data_type != UNSIGNED8 or (not is_list and highest != max(subs)):
            problems.append(f"0x{index:04X}:0 is {highest}, the highest sub-index is {max(subs)}")
        if is_list and highest is not None and highest > max(subs):
            problems.append(f"0x{index:04X}:0 is {highest}, there are {max(subs)}")
    require_none(problems)
    return f"{count} arrays and records"


@case("1.5", "types, access and limits", "7.4, CiA 306",
      "known ObjectType, DataType and AccessType; the default fits its type and its limits")
def check_types(t: Target) -> str:
    """Each variable is described with values that CiA 306 knows."""
    problems = []
    strings = (VISIBLE_STRING, OCTET_STRING, UNICODE_STRING, DOMAIN)
    access_types = ("ro", "wo", "rw", "rwr", "rww", "const")
    for index in t.sheet.objects:
        section = next((name for name in t.sheet.text.sections() if name.upper() == f"{index:04X}"), "")
        if _number(t.sheet, section, "ObjectType", 7) not in (0, 2, 5, 6, 7, 8, 9):
            problems.append(f"0x{index:04X} has an unknown ObjectType")
    for variable in t.sheet.variables:
        if variable.data_type not in SIZES and variable.data_type not in strings:
            problems.append(f"{variable.label} has DataType 0x{variable.data_type:04X}")
        if variable.access not in access_types:
            problems.append(f"{variable.label} has AccessType {variable.access!r}")
        if not variable.is_number or not isinstance(variable.default, int | float):
            continue
        try:
            variable.encode(variable.default)
        except (OverflowError, ValueError):
            problems.append(f"{variable.label}: {variable.default} does not fit its type")
        low, high = variable.low, variable.high
        if (low is not None and variable.default < low) or (high is not None and variable.default > high):
            problems.append(f"{variable.label}: {variable.default} is outside its limits")
    require_none(problems)
    return f"{len(t.sheet.variables)} variables"


@case("1.6", "communication profile", "7.5.2", "objects 0x1000 to 0x1FFF have the type and access of CiA 301")
def check_standard_objects(t: Target) -> str:
    """Objects whose type and access CiA 301 gives."""
    problems, count = [], 0
    for variable in t.sheet.variables:
        expected = _find_standard(variable)
        if expected is None:
            continue
        count += 1
        data_type, access = expected
        if variable.data_type != data_type:
            problems.append(f"{variable.label} has DataType 0x{variable.data_type:04X}, expected 0x{data_type:04X}")
        if variable.access not in access.split():
            problems.append(f"{variable.label} is {variable.access}, expected {' or '.join(access.split())}")
    require_none(problems)
    return f"{count} objects of the standard"


@case("1.7", "PDO parameters", "7.5.2.35 to 7.5.2.38", "each PDO has parameters and a mapping; DeviceInfo counts them")
def check_pdo_parameters(t: Target) -> str:
    """Communication and mapping parameters come in pairs."""
    problems = []
    for pdo in t.sheet.pdos:
        problems += [f"{pdo.name} has no 0x{pdo.parameter:04X}:{sub}" for sub in (0, 1, 2)
                     if t.sheet.find(pdo.parameter, sub) is None]
        if pdo.mapping not in t.sheet.objects:
            problems.append(f"{pdo.name} has no mapping 0x{pdo.mapping:04X}")
    known = {pdo.mapping for pdo in t.sheet.pdos}
    problems += [f"0x{index:04X} maps a PDO that is not there" for index in t.sheet.objects
                 if _is_mapping(index) and index not in known]
    for key, is_sent in (("NrOfRXPDO", False), ("NrOfTXPDO", True)):
        count = sum(pdo.is_sent is is_sent for pdo in t.sheet.pdos)
        stated = _number(t.sheet, "DeviceInfo", key, -1)
        if stated != count:
            problems.append(f"{key} is {stated}, {count} are described")
    require_none(problems)
    return f"{len(t.sheet.pdos)} PDOs"


@case("1.8", "PDO mapping", "7.5.2.36, 7.5.2.38",
      "mapped objects exist, may be mapped in that direction, have that length; at most 64 bits")
def check_pdo_mapping(t: Target) -> str:
    """The default mappings name objects that can be mapped."""
    problems, count = [], 0
    for pdo in t.sheet.pdos:
        head = t.sheet.find(pdo.mapping, 0)
        used = head.default if head is not None and isinstance(head.default, int) else 0
        total = 0
        for sub in range(1, used + 1):
            entry = t.sheet.find(pdo.mapping, sub)
            word = entry.default if entry is not None and isinstance(entry.default, int) else 0
            index, mapped_sub, bits = word >> 16, word >> 8 & 0xFF, word & 0xFF
            total += bits
            count += 1
            if 0 < index < 0x20:  # a dummy entry
                continue
            mapped = t.sheet.find(index, mapped_sub)
            if mapped is None:
                problems.append(f"{pdo.name} maps 0x{index:04X}:{mapped_sub:X}, which is not there")
            elif not mapped.is_mappable:
                problems.append(f"{pdo.name} maps {mapped.label}, which has PDOMapping=0")
            elif mapped.bits != bits:
                problems.append(f"{pdo.name} maps {mapped.label} with {bits} bits, it has {mapped.bits}")
            elif (not mapped.is_readable or mapped.access == "rww") if pdo.is_sent else (
                    not mapped.is_writable or mapped.access == "rwr"):
                problems.append(f"{pdo.name} maps {mapped.label}, which is {mapped.access}")
        if total > 64:
            problems.append(f"{pdo.name} has {total} bits")
    require_none(problems)
    return f"{count} mapped objects"


@case("1.9", "identity", "7.5.2.21",
      "the vendor-ID is not 0; DeviceInfo repeats vendor-ID, product code and revision of 0x1018")
def check_identity(t: Target) -> str:
    """What identifies the product. The vendor-ID is given by CiA."""
    problems = []
    vendor = _default(t.sheet, 0x1018, 1)
    if not vendor:
        raise CaseFailed(f"the vendor-ID is {vendor if vendor is not None else 'not given'}, which is invalid")
    for sub, key in ((1, "VendorNumber"), (2, "ProductNumber"), (3, "RevisionNumber")):
        value, stated = _default(t.sheet, 0x1018, sub), _number(t.sheet, "DeviceInfo", key, -1)
        if value is not None and value != stated:
            problems.append(f"0x1018:{sub} is 0x{value:X}, {key} is {f'0x{stated:X}' if stated >= 0 else 'not given'}")
    require_none(problems)
    reserved = " (reserved by CiA: no vendor's)" if 0xAFFF0000 <= vendor <= 0xFFFEFFFF or vendor >= 0xFFFF1000 else ""
    return f"vendor-ID 0x{vendor:08X}{reserved}"


@case("1.10", "COB-IDs", "7.3.3, 7.3.5",
      "no default uses a restricted identifier, and no two objects send under the same")
def check_identifiers(t: Target) -> str:
    """COB-IDs as they are after a reset."""
    problems: list[str] = []
    sent: dict[int, str] = {}
    entries = [(pdo.name, t.sheet.find(pdo.parameter, 1), pdo.is_sent) for pdo in t.sheet.pdos]
    entries += [("SYNC", t.sheet.find(0x1005), False), ("EMCY", t.sheet.find(0x1014), True)]
    count = 0
    for name, variable, is_sent in entries:
        if variable is None or not isinstance(variable.default, int):
            continue
        value = variable.default
        if name not in ("SYNC",) and value & 1 << 31:
            continue
        count += 1
        can_id = value & 0x7FF
        if is_restricted(can_id):
            problems.append(f"{name} uses 0x{can_id:03X}, which is restricted")
        if is_sent and can_id in sent:
            problems.append(f"{name} and {sent[can_id]} send 0x{can_id:03X}")
        if is_sent:
            sent[can_id] = name
    require_none(problems)
    return f"{count} COB-IDs"


def _find_standard(variable: Variable) -> tuple[int, str] | None:
    """Type and access that CiA 301 gives this variable, None if it gives none."""
    index, sub = variable.index, variable.sub
    if any(base <= index < base + MAPPING for base in (RPDO, TPDO)) and sub in PDO_PARAMETERS:
        return PDO_PARAMETERS[sub], "rw ro const"
    if _is_mapping(index):
        return (UNSIGNED32 if sub else UNSIGNED8), "rw ro const"
    if index in (0x1003, 0x1016) and sub > 1:
        sub = 1
    return STANDARD.get((index, sub))


def _is_mapping(index: int) -> bool:
    return any(base + MAPPING <= index < base + 2 * MAPPING for base in (RPDO, TPDO))


def _default(sheet: DataSheet, index: int, sub: int) -> int | None:
    variable = sheet.find(index, sub)
    return variable.default if variable is not None and isinstance(variable.default, int) else None


def _number(sheet: DataSheet, section: str, key: str, absent: int = 0) -> int:
    """A number in the file. Raises CaseFailed for one that cannot be read."""
    text = sheet.text.get(section, key, fallback="").strip() if section else ""
    try:
        return int(text, 0) if text else absent
    except ValueError:
        raise CaseFailed(f"[{section}] {key}={text} is no number") from None
